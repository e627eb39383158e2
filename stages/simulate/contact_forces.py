"""Impacts and exact Coulomb friction for MuJoCo's contacts.

Impacts: a contact leaves with its speed of approach times the restitution, within a substep (Newton's law of impact).
A pair has the smaller of its two coefficients of restitution (the larger loss factor). Approaching contacts are solved
first, without those that merely touch; then those that now approach because of these impacts, and so on, so that the
last ball of a row flies off, as in Newton's cradle. After the impacts all contacts are solved together. Impacts that
would add energy are inelastic.

Resting contacts: below REST_SPEED nothing rebounds, since stacks would never come to rest. Critically damped springs
then resolve penetration, at no more than that speed, since a body that meets an edge may suddenly be deep inside. Their
frequency is the highest that the substep resolves, so that resting bodies sink in by less than 1e-3 of the size of the
smallest object.

Friction: the target is zero slip at the end of a substep. With the smaller deceleration that follows from the damping
of the materials, friction would be viscous: bodies would creep on slopes and keep their slip in collisions. MuJoCo's
friction cones are a convex relaxation, in which a contact that slides at speed s also separates at speed mu s, which
lifts bodies and adds energy. This separation speed, taken from the previous pass, is subtracted from the target, and
the forces are solved for again.
Sources: Todorov, Erez and Tassa 2012, "MuJoCo: a physics engine for model-based control"; exact friction from
the relaxed one: De Saxce and Feng 1998, "The bipotential method"; Le Lidec et al. 2024, "Contact models in robotics";
impacts in turns: Smith et al. 2012, "Reflections on simultaneous impact".
"""

from __future__ import annotations

import numpy as np

from stages.simulate.rigid_model import OMEGA

REST_SPEED = 0.1  # normal speed below which contacts do not rebound [units]; from a fall of 0.5 % of the smallest size
MAX_TURNS = 20  # rounds of impacts; a light body between heavy ones would need hundreds: the last has all contacts
APART = -1e9  # reference acceleration that disables a contact
MAX_PASSES = 16  # passes for exact friction
MIXED = 3  # earlier passes whose differences extrapolate to the next slip
SLIP_TOLERANCE = 0.01  # of the normal acceleration of a contact, relative to gravity plus that acceleration
REBOUND_TOLERANCE = 0.001  # of the normal acceleration of a contact that rebounds, relative to that acceleration


def find_contact_forces(mujoco, model, data, restitution: np.ndarray) -> None:
    """Compute the contact forces in `data`; `restitution` has the coefficient of each geometry.

    Newton's law of impact may add energy where bodies are hit at several points at once. Where the impacts of a
    connected group of bodies would do so, none of them rebounds.
    """
    force, free = data.qfrc_smooth.copy(), data.qacc_smooth.copy()
    timestep, change = model.opt.timestep, np.zeros(data.nefc)  # change: of contact velocities by impacts / timestep
    for turn in range(MAX_TURNS):
        normal, friction, rebounds = set_references(data, timestep, restitution, change)
        if not rebounds.any():
            break
        if turn < MAX_TURNS - 1:
            data.efc_aref[normal[~rebounds]] = APART
        velocity = data.qvel + timestep / 2 * (data.qacc_smooth - free)
        _collide(mujoco, model, data, normal, friction, rebounds, velocity)
        data.qfrc_smooth += data.qfrc_constraint
        data.qacc_smooth[:] = data.qacc
        mujoco.mj_mulJacVec(model, data, change, data.qacc - free)
    else:
        normal, friction, rebounds = set_references(data, timestep, np.zeros_like(restitution), change)
    solve(mujoco, model, data, normal, friction, rebounds)
    data.qfrc_constraint += data.qfrc_smooth - force
    data.qfrc_smooth[:], data.qacc_smooth[:] = force, free


def _collide(
    mujoco, model, data, normal: np.ndarray, friction: np.ndarray, rebounds: np.ndarray, velocity: np.ndarray
) -> None:
    """Solve for the impacts of the contacts that rebound, with the reference accelerations in `data`.

    `velocity`: generalized velocity without the change by these impacts. With half of that change it is the mean
    velocity over the substep, which determines the work of the impacts.
    """
    timestep = model.opt.timestep
    wanted = data.efc_aref[normal]
    solve(mujoco, model, data, normal, friction, rebounds)
    work = data.qfrc_constraint * (velocity + data.qacc * timestep / 2)
    of_island = np.bincount(data.dof_island + 1, work)  # entry 0: bodies without contacts
    stopped = rebounds & (of_island[data.efc_island[normal] + 1] > 0)
    if stopped.any():
        data.efc_aref[normal] = np.where(stopped, -data.efc_vel[normal] / timestep, wanted)
        solve(mujoco, model, data, normal, friction, rebounds)


def set_references(
    data, timestep: float, restitution: np.ndarray, change: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Set the reference accelerations: fast contacts rebound, slow ones are pushed apart, and friction stops slip.

    `change` (r,) is the change of constraint velocities by earlier impacts of the substep, divided by the timestep.
    Returns the constraint rows (k,) of the contact normals, friction coefficients (k,), and a mask (k,) of the
    contacts that rebound.
    """
    active = data.contact.efc_address >= 0
    normal = data.contact.efc_address[active]
    speed = data.efc_vel[normal] + timestep * change[normal]
    push = np.minimum(-(OMEGA**2) * data.efc_pos[normal], 2 * OMEGA * REST_SPEED) - 2 * OMEGA * speed
    share = (-speed / REST_SPEED - 1).clip(0, 1)  # restitution is blended in between one and two REST_SPEED
    rebound = share * restitution[data.contact.geom[active]].min(1) * -speed
    data.efc_aref[normal] = change[normal] + np.where(rebound > 0, (rebound - speed) / timestep, push)
    along = normal[:, None] + [1, 2]
    data.efc_aref[along] = -data.efc_vel[along] / timestep
    return normal, data.contact.friction[active, 0], rebound > 0


def solve(mujoco, model, data, normal: np.ndarray, friction: np.ndarray, rebounds: np.ndarray) -> None:
    """Solve for contact forces with exact Coulomb friction, by an accelerated fixed-point iteration on the slips.

    `normal` (k,) has the constraint rows of the contact normals and `friction` (k,) the coefficients. `rebounds` (k,)
    masks the contacts that must reach their target velocity exactly, without the compliance of resting contacts (see
    IMPEDANCE).
    """
    along, wanted = normal[:, None] + [1, 2], data.efc_aref[normal]
    slip = np.linalg.norm(data.efc_aref[along], axis=1)  # slip speed after the substep, divided by the timestep
    slip = np.maximum(slip - friction * np.maximum(wanted + 1, 0), 0)  # initial guess: that of a single sliding box
    rate, lack = np.zeros(data.nefc), np.zeros(len(normal))
    tried, errors = [], []
    for _ in range(MAX_PASSES):
        data.efc_aref[normal] = wanted + lack - friction * slip
        mujoco.mj_fwdConstraint(model, data)
        mujoco.mj_mulJacVec(model, data, rate, data.qacc)
        tried.append(slip)
        errors.append(np.linalg.norm(rate[along] - data.efc_aref[along], axis=1) - slip)
        error, pressing = friction * np.abs(errors[-1]), data.efc_force[normal] > 0
        missing = np.where(rebounds & pressing, wanted - rate[normal], 0)
        lack += missing
        touching = pressing | (rate[normal] < wanted)
        inexact = (touching & (error > SLIP_TOLERANCE * (1 + np.abs(wanted)))).any()
        if not inexact and not (np.abs(missing) > REBOUND_TOLERANCE * np.abs(wanted)).any():
            break
        slip = np.maximum(next_argument(tried[-MIXED - 1 :], errors[-MIXED - 1 :]), 0)


def next_argument(tried: list[np.ndarray], errors: list[np.ndarray]) -> np.ndarray:
    """The next iterate (k,) of a fixed-point iteration, by Anderson acceleration.

    `tried` has the previous iterates, the latest last, and `errors` the function's values minus the iterates. Plain
    iteration oscillates where a body is wedged between others, such as a ball in a groove. Source: Walker and Ni 2011,
    "Anderson acceleration for fixed-point iterations".
    """
    if len(tried) == 1:
        return tried[0] + errors[0]
    argument, error = (np.stack([x[-1] - before for before in x[:-1]], 1) for x in (tried, errors))
    mix = np.linalg.lstsq(error, errors[-1], rcond=1e-8)[0]
    return tried[-1] + errors[-1] - (argument + error) @ mix
