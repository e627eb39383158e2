"""Impacts and exact Coulomb friction in the contacts of MuJoCo's bodies.

A contact reverses the speed of approach, times the restitution, within a substep (Newton's law of impact); that follows
from the larger loss factor of both materials. Contacts that approach are solved for without those that merely touch,
then those that this makes approach, and so on: of a row of balls the last one flies off, as in Newton's cradle. The
other forces are those that all contacts need after these impacts. Below REST_SPEED nothing rebounds, since stacks that
rebound at any speed never come to rest: critically damped springs then push bodies apart, at no more than that speed,
since a body that meets an edge may be deep inside at once. Their frequency is the highest that the substep resolves, so
that resting bodies sink in by less than 1e-3 of the smallest object. Impacts that would give energy to bodies do not
rebound.

Friction aims at no slip at the end of a substep; with the smaller deceleration that follows from the materials' damping
it would be viscous: bodies would creep on slopes, and keep their slip in collisions. MuJoCo's friction cones are a
convex relaxation, in which a contact that slides at speed s also separates at friction s, which lifts bodies and gives
them energy. So that speed, known from the previous pass, is subtracted and the forces are solved for again.
Sources: Todorov, Erez and Tassa 2012, "MuJoCo: a physics engine for model-based control"; exact friction from
the relaxed one: De Saxce and Feng 1998, "The bipotential method"; Le Lidec et al. 2024, "Contact models in robotics";
impacts in turns: Smith et al. 2012, "Reflections on simultaneous impact".
"""

from __future__ import annotations

import numpy as np

from stages.simulate.rigid_model import OMEGA

REST_SPEED = 0.1  # normal speed below which contacts do not rebound [units]; a fall of 0.5 % of the smallest object
MAX_TURNS = 20  # of impacts; a light body between heavy ones would need hundreds, so that all contacts take the last
APART = -1e9  # reference of a contact that takes no part
MAX_PASSES = 8  # of the solver for exact friction; in each the error of a sliding box shrinks by mu^2 / (1 + mu^2)
SLIP_TOLERANCE = 0.01  # error of a contact's normal acceleration with which they end, relative to gravity plus itself
REBOUND_TOLERANCE = 0.001  # the same of a contact that rebounds, relative to itself


def find_contact_forces(mujoco, model, data, restitution: np.ndarray) -> None:
    """Find the forces in the contacts of `data`, between geometries of which each has a `restitution`.

    Where impacts would give energy to the bodies that they connect, none of them rebounds: Newton's law of impact may
    do so where bodies are hit at several points at once.
    """
    force, free = data.qfrc_smooth.copy(), data.qacc_smooth.copy()
    timestep, change = model.opt.timestep, np.zeros(data.nefc)  # of the contacts' velocities by impacts / timestep
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
    """Solve for the impacts of the contacts that rebound, with the references that are set.

    `velocity` and half of what accelerates in the substep are the mean velocity, on which the work of impacts depends.
    """
    timestep = model.opt.timestep
    wanted = data.efc_aref[normal]
    solve(mujoco, model, data, normal, friction, rebounds)
    work = data.qfrc_constraint * (velocity + data.qacc * timestep / 2)
    of_island = np.bincount(data.dof_island + 1, work)  # the first is that of bodies without contacts
    stopped = rebounds & (of_island[data.efc_island[normal] + 1] > 0)
    if stopped.any():
        data.efc_aref[normal] = np.where(stopped, -data.efc_vel[normal] / timestep, wanted)
        solve(mujoco, model, data, normal, friction, rebounds)


def set_references(
    data, timestep: float, restitution: np.ndarray, change: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Let contacts rebound within a substep, push slow ones apart, and let friction stop slip within a substep.

    `change` (r,) is that of the constraints' velocities by earlier impacts of the substep, divided by it. Returns the
    constraint rows (k,) of the contacts' normals, friction coefficients (k,), and which (k,) rebound.
    """
    active = data.contact.efc_address >= 0
    normal = data.contact.efc_address[active]
    speed = data.efc_vel[normal] + timestep * change[normal]
    push = np.minimum(-(OMEGA**2) * data.efc_pos[normal], 2 * OMEGA * REST_SPEED) - 2 * OMEGA * speed
    share = (-speed / REST_SPEED - 1).clip(0, 1)  # of twice that speed or more all of them rebounds
    rebound = share * restitution[data.contact.geom[active]].min(1) * -speed
    data.efc_aref[normal] = change[normal] + np.where(rebound > 0, (rebound - speed) / timestep, push)
    along = normal[:, None] + [1, 2]
    data.efc_aref[along] = -data.efc_vel[along] / timestep
    return normal, data.contact.friction[active, 0], rebound > 0


def solve(mujoco, model, data, normal: np.ndarray, friction: np.ndarray, rebounds: np.ndarray) -> None:
    """Find the contact forces with exact Coulomb friction, by passes that know the slip after the previous one.

    `normal` (k,) are the rows of the contacts' normals, `friction` (k,) their coefficients, and `rebounds` (k,) masks
    those whose velocity after the substep is met without the compliance of resting contacts (see IMPEDANCE).
    """
    along, wanted = normal[:, None] + [1, 2], data.efc_aref[normal]
    slip = np.linalg.norm(data.efc_aref[along], axis=1)  # after the substep, divided by it
    slip = np.maximum(slip - friction * np.maximum(wanted + 1, 0), 0)  # a box that slides with this normal force
    rate, lack = np.zeros(data.nefc), np.zeros(len(normal))
    for _ in range(MAX_PASSES):
        data.efc_aref[normal] = wanted + lack - friction * slip
        mujoco.mj_fwdConstraint(model, data)
        mujoco.mj_mulJacVec(model, data, rate, data.qacc)
        before, slip = slip, np.linalg.norm(rate[along] - data.efc_aref[along], axis=1)
        error, pressing = friction * np.abs(slip - before), data.efc_force[normal] > 0
        missing = np.where(rebounds & pressing, wanted - rate[normal], 0)
        lack += missing
        touching = pressing | (rate[normal] < wanted)
        inexact = (touching & (error > SLIP_TOLERANCE * (1 + np.abs(wanted)))).any()
        if not inexact and not (np.abs(missing) > REBOUND_TOLERANCE * np.abs(wanted)).any():
            break
