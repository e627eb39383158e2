"""Impacts and exact Coulomb friction in the contacts of MuJoCo's bodies.

A contact reverses the speed of approach, times the restitution, within a substep (Newton's law of impact); that follows
from the larger loss factor of both materials. Below REST_SPEED nothing rebounds, since stacks that rebound at any speed
never come to rest: critically damped springs then push bodies apart, at no more than that speed, since a body that
meets an edge may be deep inside at once. Their frequency is the highest that the substep resolves, so that resting
bodies sink in by less than 1e-3 of the smallest object. Impacts that would give energy to bodies do not rebound.

Friction aims at no slip at the end of a substep; with the smaller deceleration that follows from the materials' damping
it would be viscous: bodies would creep on slopes, and keep their slip in collisions. MuJoCo's friction cones are a
convex relaxation, in which a contact that slides at speed s also separates at friction s, which lifts bodies and gives
them energy. So that speed, known from the previous pass, is subtracted and the forces are solved for again.
Sources: Todorov, Erez and Tassa 2012, "MuJoCo: a physics engine for model-based control"; exact friction from
the relaxed one: De Saxce and Feng 1998, "The bipotential method"; Le Lidec et al. 2024, "Contact models in robotics".
"""

from __future__ import annotations

import numpy as np

from stages.simulate.rigid_model import OMEGA

REST_SPEED = 0.1  # normal speed below which contacts do not rebound [units]; a fall of 0.5 % of the smallest object
MAX_PASSES = 8  # of the solver for exact friction; in each the error of a sliding box shrinks by mu^2 / (1 + mu^2)
SLIP_TOLERANCE = 0.01  # error of a contact's normal acceleration with which they end, relative to gravity plus itself


def find_contact_forces(mujoco, model, data, restitution: np.ndarray) -> None:
    """Find the forces in the contacts of `data`, between geometries of which each has a `restitution`.

    Where contacts would give energy to the bodies that they connect, none of them rebounds: Newton's law of impact may
    do so where bodies are hit at several points at once.
    """
    timestep = model.opt.timestep
    normal, friction, rebounds = set_references(data, timestep, restitution)
    wanted = data.efc_aref[normal]
    solve(mujoco, model, data, normal, friction)
    if not rebounds.any():
        return
    work = data.qfrc_constraint * (data.qvel + data.qacc * timestep / 2)
    of_island = np.bincount(data.dof_island + 1, work)  # the first is that of bodies without contacts
    stopped = rebounds & (of_island[data.efc_island[normal] + 1] > 0)
    if stopped.any():
        data.efc_aref[normal] = np.where(stopped, -data.efc_vel[normal] / timestep, wanted)
        solve(mujoco, model, data, normal, friction)


def set_references(data, timestep: float, restitution: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Let contacts rebound within a substep, push slow ones apart, and let friction stop slip within a substep.

    Returns the constraint rows (k,) of the contacts' normals, friction coefficients (k,), and which (k,) rebound.
    """
    active = data.contact.efc_address >= 0
    normal = data.contact.efc_address[active]
    speed = data.efc_vel[normal]
    push = np.minimum(-(OMEGA**2) * data.efc_pos[normal], 2 * OMEGA * REST_SPEED) - 2 * OMEGA * speed
    share = (-speed / REST_SPEED - 1).clip(0, 1)  # of twice that speed or more all of them rebounds
    rebound = share * restitution[data.contact.geom[active]].min(1) * -speed
    data.efc_aref[normal] = np.where(rebound > 0, (rebound - speed) / timestep, push)
    along = normal[:, None] + [1, 2]
    data.efc_aref[along] = -data.efc_vel[along] / timestep
    return normal, data.contact.friction[active, 0], rebound > 0


def solve(mujoco, model, data, normal: np.ndarray, friction: np.ndarray) -> None:
    """Find the contact forces with exact Coulomb friction, by passes that know the slip after the previous one.

    `normal` (k,) are the rows of the contacts' normals, and `friction` (k,) their coefficients.
    """
    along, wanted = normal[:, None] + [1, 2], data.efc_aref[normal]
    slip = np.linalg.norm(data.efc_aref[along], axis=1)  # after the substep, divided by it
    slip = np.maximum(slip - friction * np.maximum(wanted + 1, 0), 0)  # a box that slides with this normal force
    rate = np.zeros(data.nefc)
    for _ in range(MAX_PASSES):
        data.efc_aref[normal] = wanted - friction * slip
        mujoco.mj_fwdConstraint(model, data)
        mujoco.mj_mulJacVec(model, data, rate, data.qacc)
        before, slip = slip, np.linalg.norm(rate[along] - data.efc_aref[along], axis=1)
        error = friction * np.abs(slip - before)
        touching = (data.efc_force[normal] > 0) | (rate[normal] < wanted)
        if not (touching & (error > SLIP_TOLERANCE * (1 + np.abs(wanted)))).any():
            break
