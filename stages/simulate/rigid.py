"""The rigid-body engine: one MuJoCo body per object, with Coulomb friction and restitution.

The simulation is non-dimensional, so that no solver constant depends on the size of the scene or on gravity. The unit
of length is the longest side of the smallest object, that of mass the median mass, that of time SUBSTEPS substeps.

Contacts have restitution and exact Coulomb friction (`contact_forces.py`); a pair has the larger of its two friction
coefficients, as in the other engines. Round objects are balls or cylinders with rolling resistance; the sides of two
cylinders touch along a line (`cylinder_contacts.py`), faces of convex bodies over the area that they share
(`face_contacts.py`). Non-convex bodies collide with their surfaces (`surface_contacts.py`). Overlaps at the start are
kept (`initial_overlaps.py`), and objects of photos stay at rest until disturbed (`resting_bodies.py`). An object with
more than half of it below the floor stands on something else, such as the ground beside a table: it gets a plane of its
own, with which no other body collides.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cache, partial

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.geometry.rotations import matrix
from stages.core.geometry.upright_boxes import longest_side
from stages.core.kernels.threads import parallel_map
from stages.core.perception.table_outline import TableOutline
from stages.core.physics.forces import Force, ForcePrompts
from stages.core.physics.materials import MODELS, MaterialChoice
from stages.core.physics.rigid_shapes import standing_shapes
from stages.core.physics.state import FrameState
from stages.core.scene.scene import Scene
from stages.core.scene.trajectory import Keypoints
from stages.simulate.background import background_boxes
from stages.simulate.changes import changed_options, changed_pins
from stages.simulate.contact_forces import find_contact_forces
from stages.simulate.cylinder_contacts import CylinderContacts
from stages.simulate.engine_choice import MAX_RIGID_SAG, sag
from stages.simulate.face_contacts import FaceContacts
from stages.simulate.initial_overlaps import InitialOverlaps
from stages.simulate.options import SimulateOptions
from stages.simulate.resting_bodies import FALLING, FREE, SUPPORT_GAP, RestingBodies, Stance, leans
from stages.simulate.rigid_model import SUBSTEPS, Body, Units, mujoco_model, restitution
from stages.simulate.setup import (
    SceneSetup,
    check_motion,
    choose_for_bodies,
    from_photos,
    held_as_seen,
    set_up_scene,
    table_of,
)
from stages.simulate.surface_contacts import BodyFrame, SurfaceContacts, SurfaceShape, ball_shape, object_shape
from stages.simulate.table_edges import TableEdges

log = logging.getLogger(__name__)
MAX_SUBSTEPS = 5_000  # per frame
MAX_TRAVEL = 0.05  # largest displacement in a substep, against tunnelling [size of the smallest object]
ON_FLOOR = 0.02  # largest gap between the floor and a body that stands on it [simulation units]


def rollout(
    scene: Scene, keypoints: Keypoints, prompts: ForcePrompts, options: SimulateOptions
) -> Iterator[FrameState]:
    """Yield one state per frame, the first of which is the initial state.

    Raises InputError if the motion is no longer finite.
    """
    setup = set_up_scene(scene, prompts, options)
    bodies = _bodies(scene, setup, prompts, options)
    world = _World(scene, setup, bodies, prompts, options)
    log.info("%d bodies, %d of them non-convex, substep %.3g s (%d per frame)", len(bodies),
             sum(not b.shape.convex for b in bodies), options.dt / world.substeps, world.substeps)  # fmt: skip
    return _states(world, keypoints, setup, prompts, options)


def _states(
    world: _World, keypoints: Keypoints, setup: SceneSetup, prompts: ForcePrompts, options: SimulateOptions
) -> Iterator[FrameState]:
    """Yield the states of all frames; keypoints move rigidly with their bodies."""
    scene, bodies = world.scene, world.bodies
    row = torch.tensor([[o.id for o in scene.objects].index(int(i)) for i in keypoints.object_id], dtype=torch.int64)
    com = torch.stack([b.shape.com for b in bodies])
    arm = (keypoints.rest - com[row])[..., None]
    placed, middle, first = keypoints.rest + setup.lift[row], com + setup.lift, torch.cat(world.pose(), 1)
    current, held, acting = options, prompts.pinned, prompts.forces
    for frame in range(options.steps):
        centre, quat = world.pose()
        moved = (torch.cat([centre, quat], 1) != first).any(1, keepdim=True)  # other objects keep their exact positions
        centre = torch.where(moved, centre / scene.metres_per_unit, middle)
        check_motion(torch.cat([centre, quat[:, 1:]]), frame, options)
        positions = torch.where(moved[row], centre[row] + (matrix(quat)[row] @ arm)[..., 0], placed)
        yield FrameState(positions, centre, quat, world.mass)
        if frame < options.steps - 1:
            active, changes = prompts.during(frame * options.dt, (frame + 1) * options.dt)
            if active is not acting:
                world.set_forces(active, held)
                acting = active
            if changes:
                current, held = changed_options(current, changes), changed_pins(held, changes)
                world.change(choose_for_bodies(scene, setup.bodies, current), held, current)
                whole = any(c.what == "gravity" for c in changes)
                world.release(i for i, o in enumerate(scene.objects) if whole or o.id in {c.object_id for c in changes})
            world.advance(frame * options.dt)


def _bodies(scene: Scene, setup: SceneSetup, prompts: ForcePrompts, options: SimulateOptions) -> list[Body]:
    """The objects as rigid bodies at their initial positions.

    Parts below the floor are cut off, except of objects that are mostly below it.
    """
    unit, bodies = scene.metres_per_unit, []
    floor = setup.box.low[2]
    shapes = standing_shapes(scene, options.seed, floor)
    for row, (o, (shape, ground)) in enumerate(zip(scene.objects, shapes, strict=True)):
        choice, (shift, inertia) = setup.materials[o.id], setup.uneven_moments(row)
        if ground < floor:
            log.info("object %d (%s) is below the floor; the floor under it is placed at %.3g", o.id, o.name, ground)
        shape = replace(shape, com=shape.com + shift, inertia=shape.inertia + shape.volume * inertia)
        m, pinned = choice.material, o.id in prompts.pinned
        mass = m.density * shape.volume * unit**3
        friction = m.friction if options.friction is None else options.friction
        start = unit * (shape.com + setup.lift[row])
        bodies.append(Body(shape, m, friction, mass, start, pinned, unit * ground))
        guess = f"; material not known, taking {choice.name} (--material {o.id}=... changes it)" * choice.guessed
        log.info("object %d (%s): %s, %s%s%s", o.id, o.name, choice.name, scene.mass_text(mass), ", pinned" * pinned,
                 guess)  # fmt: skip
        z = shape.hull[:, 2]
        height = unit * float(z.max() - z.min())
        if MODELS[m.model].plastic:
            log.warning("object %d (%s): %s yields or flows, but rigid bodies keep their shape; use --engine mpm",
                        o.id, o.name, choice.name)  # fmt: skip
        elif sag(m, height, options.gravity) > MAX_RIGID_SAG:
            log.warning("object %d (%s): %s is compressed by %.0f %% by its own weight, but rigid bodies keep "
                        "their shape; "
                        "use --engine ngff or mpm", o.id, o.name, choice.name,
                        100 * sag(m, height, options.gravity))  # fmt: skip
    return bodies


class _World:
    """MuJoCo's model and state of the bodies, and the contacts that replace MuJoCo's own."""

    def __init__(self, scene: Scene, setup: SceneSetup, bodies: list[Body], prompts: ForcePrompts,
                 options: SimulateOptions):  # fmt: skip
        import mujoco  # noqa: PLC0415 -- slow to import

        mujoco.set_mju_user_warning(log.debug)  # by default it writes a file where the command was started
        self._mujoco, self.bodies, self._dt = mujoco, bodies, options.dt
        self.scene, self._ids = scene, [o.id for o in scene.objects]
        self._held: dict[int, np.ndarray] = {}  # row among the free bodies -> pose, of bodies pinned by a change
        self.mass = torch.tensor([b.mass for b in bodies])  # [kg]
        unit = scene.metres_per_unit
        velocity = [unit * torch.tensor(prompts.velocity.get(o.id, (0.0, 0.0, 0.0))) for o in scene.objects]
        size = unit * min(longest_side(b.shape.hull) for b in bodies)
        floor = unit * setup.box.low[2]
        table = table_of(scene, options)
        fall = max(float(b.start[2]) for b in bodies) - (floor if table is None else unit * table.ground)
        speed = max(float(v.norm()) for v in velocity) + math.sqrt(2 * abs(options.gravity) * max(fall, size))
        mass_of = {o.id: b.mass for o, b in zip(scene.objects, bodies, strict=True)}
        # forces shorter than a frame are impulses and do not count: a live session does not know them at the start
        pushes = ((math.hypot(*f.force) + math.hypot(*f.torque) / size) / mass_of[f.object_id] for f in prompts.forces
                  if f.end - f.start > options.dt)  # fmt: skip
        acceleration = max(abs(options.gravity), *pushes, 1e-9)
        substep = min(math.sqrt(size / acceleration) / SUBSTEPS, MAX_TRAVEL * size / max(speed, 1e-9))
        self.substeps = max(1, math.ceil(min(options.dt / substep, MAX_SUBSTEPS)))
        mass = sorted(b.mass for b in bodies)[len(bodies) // 2]
        self.units = Units(size, SUBSTEPS * options.dt / self.substeps, mass)
        box = [[unit * v / size for v in corner] for corner in (setup.box.low, setup.box.high)]
        around = background_boxes(scene, setup.box.low[2]) if from_photos(scene) else []
        around = [np.array(corners) * unit / size for corners in around]
        gravity = options.gravity * self.units.time**2 / size
        levels = [floor / size] if table is None else [floor / size, table.ground * unit / size]
        self.model = mujoco_model(bodies, self.units, gravity, levels, box if options.box else None, around)
        self.data = mujoco.MjData(self.model)
        self._restitution = np.ones(self.model.ngeom)
        for row, b in enumerate(bodies):
            self._restitution[self.model.geom_bodyid == row + 1] = restitution(b.material.loss)
        self._free = [i for i, b in enumerate(bodies) if not b.pinned]
        axes = matrix(torch.from_numpy(self.model.body_iquat[1:][self._free])).numpy()
        self._inertia = axes * self.model.body_inertia[1:][self._free][:, None] @ axes.transpose(0, 2, 1)
        for k, i in enumerate(self._free):
            self.data.qvel[FALLING * k : FALLING * k + 3] = velocity[i].numpy() * self.units.time / size
        self.set_forces(prompts.forces, prompts.pinned)
        at_rest = self._at_rest(scene, setup, prompts, options)
        self._start = self.data.qpos.reshape(-1, FREE).copy()
        self._cylinders = CylinderContacts(mujoco, self.model)
        self._faces = FaceContacts(mujoco, self.model)
        self._find_contacts = cache(partial(self._initial_contacts, setup, table, at_rest, options))
        self._has_moved = False
        if options.live:  # now, so that the user's first drag does not wait for it
            self._find_contacts()
        self.release(i for i in self._free if i not in at_rest)

    def _initial_contacts(
        self, setup: SceneSetup, table: TableOutline | None, at_rest: list[int], options: SimulateOptions
    ) -> None:
        """Find the initial overlaps, contacts and supports; deferred until something moves, which needs them."""
        lift = setup.lift.double().numpy()[self._free] * self.scene.metres_per_unit / self.units.length
        self._find_positions()
        self._faces.replace(self.data)
        self._overlaps = InitialOverlaps(self.model, self.data)
        convex = all(b.shape.convex for b in self.bodies)
        self._surfaces = None if convex else self._surface_contacts(setup, options)
        self._edges = None if table is None else self._table_edges(table)
        self.data.qpos.reshape(-1, FREE)[:, :3] -= lift
        self._resting = self._resting_bodies(setup, at_rest)
        self.data.qpos.reshape(-1, FREE)[:, :3] += lift

    def set_forces(self, forces: Sequence[Force], pinned: Collection[int]) -> None:
        """Set the forces that act from now on; forces on pinned objects have no effect."""
        rows = ((f, self._ids.index(f.object_id)) for f in forces if f.object_id not in pinned)
        self._forces = [(f, row, None if f.at is None else self._arm(f.at, row)) for f, row in rows]

    def _arm(self, at, row: int) -> np.ndarray:
        """Vector from the centre of mass to the point of application `at`, in the body's frame [simulation units]."""
        com = self.bodies[row].shape.com
        return ((torch.tensor(at) - com) * self.scene.metres_per_unit / self.units.length).double().numpy()

    def change(self, materials: dict[int, MaterialChoice], pinned: Collection[int], options: SimulateOptions) -> None:
        """Change materials, pins, friction and gravity from now on; objects pinned at the start stay pinned."""
        model = self.model
        model.opt.gravity[2] = -options.gravity * self.units.time**2 / self.units.length
        self.mass = self.mass.clone()  # states that were yielded refer to the old tensor
        for row, id in enumerate(self._ids):
            m, b = materials[id].material, self.bodies[row]
            factor = m.density / b.material.density * b.mass / self.units.mass / model.body_mass[row + 1]
            model.body_mass[row + 1] *= factor
            model.body_inertia[row + 1] *= factor
            self.mass[row] = b.mass * m.density / b.material.density
            for geom in np.nonzero(model.geom_bodyid == row + 1)[0]:
                model.geom_friction[geom, 0] = m.friction if options.friction is None else options.friction
                self._restitution[geom] = restitution(m.loss)
        self._mujoco.mj_setConst(model, self._mujoco.MjData(model))
        free = {self._ids[i]: k for k, i in enumerate(self._free)}
        self._held = {k: self.data.qpos[FREE * k : FREE * (k + 1)].copy() for id, k in free.items() if id in pinned}

    def pose(self) -> tuple[Float[Tensor, "o 3"], Float[Tensor, "o 4"]]:
        """Centres of mass [m] and rotations relative to the start (w x y z)."""
        self._mujoco.mj_kinematics(self.model, self.data)
        count = len(self.bodies) + 1  # 0 is the world
        centre, quat = (torch.from_numpy(a[1:count].copy()).float() for a in (self.data.xpos, self.data.xquat))
        return centre * self.units.length, quat

    def _at_rest(self, scene: Scene, setup: SceneSetup, prompts: ForcePrompts, options: SimulateOptions) -> list[int]:
        """Rows of the objects that photos show at rest and that no prompt lifts or throws at the start."""
        if not held_as_seen(scene, options) or options.gravity <= 0:
            return []
        return [i for i in self._free if not setup.lift[i].any() and not any(prompts.velocity.get(self._ids[i], ()))]

    def _surface_contacts(self, setup: SceneSetup, options: SimulateOptions) -> SurfaceContacts:
        scale = self.scene.metres_per_unit / self.units.length

        def shape(row: int) -> SurfaceShape:
            b = self.bodies[row]
            if b.shape.ball is not None:
                return ball_shape(scale * (b.shape.ball.centre - b.shape.com.double().numpy()),
                                  scale * b.shape.ball.radius)  # fmt: skip
            ground, frame = b.ground / self.scene.metres_per_unit, BodyFrame(tuple(b.shape.com.tolist()), scale)
            hull = tuple(map(tuple, b.shape.hull.tolist())) if b.shape.convex else ()
            return object_shape(self.scene, self._ids[row], options.seed, ground, frame, hull)

        return SurfaceContacts(self._mujoco, self.model, self.data, parallel_map(shape, range(len(self.bodies))))

    def _table_edges(self, table: TableOutline) -> TableEdges:
        scale = self.scene.metres_per_unit / self.units.length
        outline = TableOutline(table.normals, scale * table.offsets, scale * table.ground)
        corners = [scale * (b.shape.hull - b.shape.com).double().numpy() for b in self.bodies]
        return TableEdges(self._mujoco, self.model, self.data, outline, corners)

    def _resting_bodies(self, setup: SceneSetup, at_rest: list[int]) -> RestingBodies:
        """The bodies held at rest; the poses in `data` must be as reconstructed, without lifts."""
        unit = self.scene.metres_per_unit / self.units.length
        lift = setup.lift.double().numpy() * unit
        self.model.geom_margin[:] = SUPPORT_GAP
        self._find_positions()
        stances, touching = [], self._touching()
        for i, b in enumerate(self.bodies):
            points = b.shape.hull.double() * unit
            height = float(b.shape.com[2] * unit - points[:, 2].min())
            start = b.start.double().numpy() / self.units.length - lift[i] - b.shape.com.double().numpy() * unit
            low, high = (start + corner.numpy() for corner in (points.amin(0), points.amax(0)))
            on_floor = bool(setup.on_floor_as_seen[i]) or float(low[2]) - setup.box.low[2] * unit < ON_FLOOR
            half_width, leaning = float((high - low)[:2].min()) / 2, leans(points.numpy(), b.shape.com.numpy() * unit)
            stances.append(Stance(b.friction, height, half_width, on_floor, low, high, leaning))
        resting = RestingBodies(self.model, stances, *touching, [i + 1 for i in at_rest])
        self.model.geom_margin[:] = 0
        return resting

    def _touching(self) -> tuple[np.ndarray, np.ndarray]:
        """Pairs (k, 2) of bodies that touch, and contact normals (k, 3) from the first to the second body.

        MuJoCo's contacts have gaps up to the current geom_margin, SUPPORT_GAP.
        """
        contact = self.data.contact
        pairs, normal = self.model.geom_bodyid[contact.geom], contact.frame[:, :3]
        kept = contact.exclude == 0
        if self._surfaces is None:
            return pairs[kept], normal[kept]
        kept, near = kept & ~self._surfaces.replaced(contact.geom), self._surfaces.touching(self.data)
        return np.concatenate([pairs[kept], near[0]]), np.concatenate([normal[kept], near[1]])

    def release(self, rows: Iterable[int]) -> None:
        """Release the held objects at these rows, and those that rest on them."""
        bodies = [i + 1 for i in rows]
        if not bodies:
            return
        self._find_contacts()
        self._has_moved = True
        released = self._resting.release(bodies)
        if released:
            log.debug("moved from rest: %s", ", ".join(self.scene.objects[i - 1].name for i in released))

    def advance(self, time: float) -> None:
        """Advance by one frame that begins at `time` [s]."""
        step = self._dt / self.substeps
        acting = [row for row in self._forces if row[0].active_fraction(time, time + self._dt) > 0]
        self.release(row for _, row, _ in acting)
        self.data.xfrc_applied[:] = 0
        if not self._has_moved or self._resting.fixed.all():
            return
        for n in range(self.substeps):
            if acting:
                self._apply_forces(acting, time + n * step, step)
            self._step()

    def _step(self) -> None:
        """Advance by one substep, in which held bodies that contact forces release already move."""
        self._find_forces()
        while self._resting.release_disturbed(self.data):
            self._find_forces()
        self._mujoco.mj_Euler(self.model, self.data)
        self._resting.restore(self.data, self._start)
        for k, pose in self._held.items():
            self.data.qpos[FREE * k : FREE * (k + 1)] = pose
            self.data.qvel[FALLING * k : FALLING * (k + 1)] = 0

    def _find_forces(self) -> None:
        """Compute the accelerations like mj_forward, with our own contacts and contact forces."""
        mujoco, model, data = self._mujoco, self.model, self.data
        self._find_positions()
        if self._surfaces is not None:
            self._surfaces.exclude(data)
        self._faces.replace(data)
        found = data.ncon
        if self._surfaces is not None:
            self._surfaces.add(data, self._resting.fixed)
        if self._edges is not None:
            self._edges.apply(data, self._resting.fixed)
        for stage in (mujoco.mj_makeConstraint, mujoco.mj_island, mujoco.mj_projectConstraint):
            stage(model, data)
        if found:
            self._overlaps.subtract(data, self._resting.fixed, found)
        mujoco.mj_fwdVelocity(model, data)
        self._centre_gyroscopic_torques()
        mujoco.mj_fwdActuation(model, data)
        mujoco.mj_fwdAcceleration(model, data)
        if data.nefc:
            find_contact_forces(mujoco, model, data, self._restitution)
        else:
            mujoco.mj_fwdConstraint(model, data)

    def _find_positions(self) -> None:
        """Compute positions, inertia and contacts like mj_fwdPosition, with our own contacts between cylinders."""
        mujoco = self._mujoco
        for stage in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_makeM, mujoco.mj_factorM,
                      mujoco.mj_collision):  # fmt: skip
            stage(self.model, self.data)
        self._cylinders.replace(self.data)

    def _centre_gyroscopic_torques(self) -> None:
        """Evaluate the gyroscopic torques at the angular velocity in the middle of the substep, by one Newton step.

        MuJoCo evaluates them at its start, which adds energy to tumbling bodies, without bound to slender ones.
        Source: Catto 2015, "Numerical methods" (Game Developers Conference).
        """
        # in body frames; the result is invariant to a common scale of torque and inertia
        spin, torque = (x.reshape(-1, FALLING)[:, 3:] for x in (self.data.qvel, self.data.qfrc_bias))
        inertia, half = self._inertia, self.model.opt.timestep / 2
        momentum = np.einsum("nij,nj->ni", inertia, spin)
        slope = _crosses(spin) @ inertia - _crosses(momentum)
        torque[:] = (inertia @ np.linalg.solve(inertia + half * slope, torque[..., None]))[..., 0]

    def _apply_forces(self, acting: list, time: float, step: float) -> None:
        """Set the force and torque on each body, averaged over the substep from `time` to `time + step` [s]."""
        self.data.xfrc_applied[:] = 0
        for f, row, arm in acting:
            active = f.active_fraction(time, time + step)
            force = np.array(f.force) * (active / self.units.force)
            torque = np.array(f.torque) * (active / (self.units.force * self.units.length))
            if arm is not None:
                torque = torque + np.cross(self.data.xmat[row + 1].reshape(3, 3) @ arm, force)
            self.data.xfrc_applied[row + 1] += np.concatenate([force, torque])


def _crosses(v: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """Skew-symmetric matrices of the cross products v x."""
    out = np.zeros((len(v), 3, 3))
    x, y, z = v.T
    out[:, 2, 1], out[:, 0, 2], out[:, 1, 0] = x, y, z
    return out - out.transpose(0, 2, 1)
