"""The MPM engine: Gaussians to particles, particles through time, their motion to the keypoints.

The solver works in metres and kilograms; what comes in and goes out is in scene units.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.geometry.neighbours import knn
from stages.core.physics.forces import Force, ForcePrompts, vector
from stages.core.physics.keypoints import nearest_weights
from stages.core.physics.materials import MaterialChoice, choose_materials
from stages.core.physics.mpm import solver as mpm
from stages.core.physics.mpm.resample import subdivide
from stages.core.physics.particles import Bodies, sample_bodies
from stages.core.physics.skinning import object_rotations
from stages.core.physics.state import FrameState
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.trajectory import Keypoints
from stages.simulate.options import MpmQuality, SimulateOptions

log = logging.getLogger(__name__)
NEAR = 8  # particles that a keypoint follows
TOUCH, STUCK = 3.0, 0.1  # spacings within which bodies touch; share of a body that does so and holds it
FINE = 2e-5  # shortest substep worth taking on a GPU [s]


@dataclass(frozen=True)
class SceneSetup:
    """Where everything stands at the start, in scene units."""

    bodies: Bodies  # as seen
    lift: Float[Tensor, "o 3"]  # asked for by the user, and shown
    on_floor: Bool[Tensor, "o"]  # on the floor
    floor_offset: Float[Tensor, "o 3"]  # taken on by the simulation alone, so that what stands on the floor touches it
    bottom: Float[Tensor, "o"]  # where each ends below, as seen
    on_floor_as_seen: Bool[Tensor, "o"]  # on the floor, as seen
    box: mpm.Box

    @property
    def start(self) -> Float[Tensor, "p 3"]:
        return self.bodies.x + (self.lift + self.floor_offset)[self.bodies.body]


def rollout(
    scene: Scene, keypoints: Keypoints, prompts: ForcePrompts, options: SimulateOptions
) -> Iterator[FrameState]:
    """One state a frame, the first being the start.

    Raises InputError when a body leaves the box or its motion is no longer finite.
    """
    unit, device = scene.metres_per_unit, pick_device(options.device)
    level, fine = options.level, device != "cpu" and options.quality != "draft"
    if fine:  # it costs seconds there: bodies at twice the resolution, and stiffer
        level = replace(level, substep=min(level.substep, FINE))
    materials = choose_materials(scene.objects, options.material, options.materials)
    stage = set_up_scene(scene, prompts, options, fine)
    body, dx = stage.bodies.body, 2 * stage.bodies.spacing * unit
    particles = _particles(scene, stage, materials, prompts, options, level)
    # particles keep a spacing inside of what they stand for, on the floor as well
    low = (*stage.box.low[:2], stage.box.low[2] + stage.bodies.spacing)
    box = mpm.Box(tuple(unit * v for v in low), tuple(unit * v for v in stage.box.high))
    solver = mpm.Solver(particles, box, dx, device)
    ids = [o.id for o in scene.objects]
    _tell_stuck(scene, stage, prompts)
    pushes = [_Push(f, particles, stage, ids.index(f.object_id)) for f in prompts.forces]
    follow = _follow(scene, keypoints, stage.bodies)
    gravity = torch.tensor([0.0, 0.0, -options.gravity]).repeat(len(particles), 1)
    gravity[particles.held > 0] = 0
    substeps = solver.substeps(options.dt, gravity)
    log.info(
        "%d particles, grid spacing %.3g m, %d nodes, substep %.3g s (%d a frame; more where things move fast)",
        len(particles), dx, solver.grid.count, options.dt / substeps, substeps,
    )  # fmt: skip

    def states() -> Iterator[FrameState]:
        for frame in range(options.steps):
            now = solver.particles
            x = now.x.cpu()
            yield _state(scene, keypoints, stage, follow, x / unit, now.F.cpu(), particles.mass)
            if frame < options.steps - 1:
                t = frame * options.dt
                push = sum((p(x, t, t + options.dt) for p in pushes), gravity)
                try:
                    solver.advance(options.dt, push)
                except mpm.Diverged as error:
                    raise _went_wrong(scene.objects[int(body[error.particle])], t) from error

    return states()


def _went_wrong(o: SceneObject, time: float) -> InputError:
    return InputError(
        f"object {o.id} ({o.name}) left the box or its motion ceased to be finite at {time:.2f} s; use a finer "
        "--quality, a softer --material, a wider --box, or a smaller --velocity or --force"
    )


def set_up_scene(scene: Scene, prompts: ForcePrompts, options: SimulateOptions, fine: bool = False) -> SceneSetup:
    """Particles, and the box they live in; what hovers or sinks a little at the floor is settled onto it."""
    bodies = sample_bodies(scene, options.level.particles, options.seed)
    if fine:
        bodies = subdivide(bodies, options.seed)
    count, h = len(scene.objects), bodies.spacing
    lift = torch.zeros(count, 3)
    for row, o in enumerate(scene.objects):
        lift[row, 2] = prompts.lift.get(o.id, 0.0)
    # half a spacing below the lowest particles end their voxels, and one more the body that is seen
    lowest = torch.stack([bodies.x[bodies.body == row, 2].quantile(0.01) for row in range(count)])
    bottom = lowest - 1.5 * h
    start = bottom + lift[:, 2]
    asked = vector_box(options.box) if options.box else None
    if options.floor is not None:
        floor = options.floor
    elif asked is not None:
        floor = asked.low[2]
    elif scene.floor is not None:
        floor = scene.floor
    else:
        floor = float(start.min())
        log.info("the scene has no floor; one is put under the lowest object, at %.3g (--floor changes it)", floor)
    settled = torch.zeros(count, 3)
    gap = start - floor
    standing, stood = gap < 2 * h, bottom - floor < 2 * h
    for row, o in enumerate(scene.objects):
        if standing[row] and o.id not in prompts.pinned:
            settled[row, 2] = -gap[row]
            if gap[row] < -4 * h:
                log.warning("object %d (%s) reaches %.3g below the floor; it is taken to stand all the same",
                            o.id, o.name, -gap[row])  # fmt: skip
    x = bodies.x + (lift + settled)[bodies.body]
    box = asked or _box(x, floor, h)
    box = mpm.Box((*box.low[:2], floor), box.high)
    low, high = torch.tensor(box.low), torch.tensor(box.high)
    # a few particles under the floor (the robust bottom is not the lowest) would be thrown up by it
    x[:, 2].clamp_(min=floor + 1.25 * h)
    outside = ((x < low) | (x > high)).any(1)
    if bool(outside.any()):
        o = scene.objects[int(bodies.body[outside.nonzero()[0, 0]])]
        raise InputError(f"--box {options.box}: object {o.id} ({o.name}) is not inside; it spans "
                         f"{_span(x[bodies.body == list(scene.objects).index(o)])}")  # fmt: skip
    seen = x - (lift + settled)[bodies.body]
    return SceneSetup(replace(bodies, x=seen), lift, standing, settled, bottom, stood, box)


def vector_box(text: str) -> mpm.Box:
    """Six numbers: lower corner, upper corner."""
    where, parts = f"--box {text!r}", text.split(",")
    if len(parts) != 6:
        raise InputError(f"{where}: write x0,y0,z0,x1,y1,z1")
    box = mpm.Box(vector(",".join(parts[:3]), where), vector(",".join(parts[3:]), where))
    if any(low >= high for low, high in zip(box.low, box.high, strict=True)):
        raise InputError(f"{where}: the first corner must be below the second in x, y and z")
    return box


def _span(x: Float[Tensor, "p 3"]) -> str:
    low, high = x.amin(0), x.amax(0)
    return " x ".join(f"{a:.3g}..{b:.3g}" for a, b in zip(low.tolist(), high.tolist(), strict=True))


def _box(x: Float[Tensor, "p 3"], floor: float, h: float) -> mpm.Box:
    """Twice the region of the objects, and at least as far to the sides as they can fall; less if memory is short."""
    low, high = x.amin(0), x.amax(0)
    size = float((high - low).max())
    room = max(size / 2, float(high[2]) - floor, 20 * h)
    while True:
        box = mpm.Box((float(low[0]) - room, float(low[1]) - room, floor),
                      (float(high[0]) + room, float(high[1]) + room, float(high[2]) + max(room, size)))  # fmt: skip
        nodes = math.prod((b - a) / (2 * h) + 16 for a, b in zip(box.low, box.high, strict=True))
        if nodes < mpm.MAX_NODES / 2 or room <= 20 * h:
            return box
        room *= 0.8
        size *= 0.8


def _particles(
    scene: Scene, stage: SceneSetup, materials: dict[int, MaterialChoice], prompts: ForcePrompts,
    options: SimulateOptions, level: MpmQuality,
) -> mpm.Particles:  # fmt: skip
    """Particles in metres, with each object's material, made soft enough for the quality's substep."""
    unit, body = scene.metres_per_unit, stage.bodies.body
    h, volume = stage.bodies.spacing * unit, stage.bodies.volume * unit**3
    fastest = 0.85 * mpm.SAFETY * 2 * h / level.substep
    rows = torch.zeros(len(scene.objects), 9)  # E density nu viscosity friction model, and its three numbers
    velocity, held = torch.zeros(len(scene.objects), 3), torch.zeros(len(scene.objects), dtype=torch.int8)
    for row, o in enumerate(scene.objects):
        choice = materials[o.id]
        m = choice.material
        E = min(m.E, mpm.modulus_at_wave_speed(fastest, m.nu, m.density))
        size = unit * float((stage.bodies.x[body == row].amax(0) - stage.bodies.x[body == row].amin(0)).max())
        # loss factor of a bar's slowest vibration, omega = pi c / L (damping E omega_1 / omega is Kelvin-Voigt's)
        viscosity = m.loss * E * size / (math.pi * math.sqrt(E / m.density))
        viscosity = min(viscosity, 0.85 * mpm.VISCOUS * m.density * (2 * h) ** 2 / level.substep)
        friction = m.friction if options.friction is None else options.friction
        rows[row] = torch.tensor([E, m.density, m.nu, viscosity, friction, mpm.MODELS[m.model],
                                  *mpm.plastic_parameters(m.model, m.plastic, E / m.E)])  # fmt: skip
        velocity[row] = unit * torch.tensor(prompts.velocity.get(o.id, (0.0, 0.0, 0.0)))
        held[row] = o.id in prompts.pinned
        mass = float(m.density * volume[body == row].sum())
        what = f"object {o.id} ({o.name}): {choice.name}, {mass:.3g} kg" + (", pinned" if held[row] else "")
        if choice.guessed:
            what += f"; material not known, taking {choice.name} (--material {o.id}=... changes it)"
        if m.E > E:
            what += f"; E {m.E:.2g} softened to {E:.2g} Pa at this quality"
        log.info("%s", what)
    E, density, nu, viscosity, friction, model = rows[body, :6].unbind(1)
    particles = mpm.at_rest(stage.start * unit, volume, density, E, nu, viscosity, friction)
    particles.model, particles.plastic = model.to(torch.int8), rows[body, 6:].contiguous()
    particles.v, particles.held = velocity[body] * (held[body] == 0)[:, None], held[body]
    return particles


def _tell_stuck(scene: Scene, stage: SceneSetup, prompts: ForcePrompts) -> None:
    """Warns of what is to be pushed and touches others: with one velocity at each node, bodies hold each other."""
    x, body = stage.start, stage.bodies.body
    pushed = {f.object_id for f in prompts.forces} | set(prompts.velocity)
    for row, o in enumerate(scene.objects):
        mine = body == row
        if o.id not in pushed or bool(mine.all()):
            continue
        distance, nearest = knn(x[~mine], x[mine], 1)
        touching = distance[:, 0] < TOUCH * stage.bodies.spacing
        if float(touching.float().mean()) > STUCK:
            others = body[~mine][nearest[touching, 0]].unique().tolist()
            log.warning("object %d (%s) touches %s: what touches on MPM's grid neither slips nor parts easily, and a "
                        "push may do less than it should; compare with --engine ngff",
                        o.id, o.name, ", ".join(str(scene.objects[i].id) for i in others))  # fmt: skip


class _Push:
    """A force prompt as accelerations [m/s^2] of the particles of its object."""

    def __init__(self, force: Force, particles: mpm.Particles, stage: SceneSetup, row: int):
        self.force, self.mass = force, particles.mass
        self.mine = (stage.bodies.body == row).float() * (particles.held == 0)
        share = self.mine.clone()
        if force.at is not None:
            distance = (stage.bodies.x - torch.tensor(force.at)).norm(dim=1)
            nearest = distance[self.mine > 0].min() if bool(self.mine.any()) else distance.min()
            reach = 4 * stage.bodies.spacing  # two cells, around the matter nearest to the place
            share *= torch.exp(-(((distance - nearest) / reach) ** 2) / 2) * (distance - nearest < 2 * reach)
        self.share = share / (share * self.mass).sum().clamp_min(1e-30)  # sum of mass x share is 1

    def __call__(self, x: Float[Tensor, "p 3"], start: float, end: float) -> Float[Tensor, "p 3"]:
        acting = self.force.active_fraction(start, end)
        if not acting:
            return torch.zeros_like(x)
        push = self.share[:, None] * torch.tensor(self.force.force)
        if any(self.force.torque) and bool(self.mine.any()):
            m = self.mass * self.mine
            r = x - (m[:, None] * x).sum(0) / m.sum()
            inertia = (m * r.square().sum(1)).sum() * torch.eye(3) - (m[:, None] * r).mT @ r
            spin = torch.linalg.solve(inertia.double(), torch.tensor(self.force.torque).double()).float()
            push = push + self.mine[:, None] * torch.linalg.cross(spin.expand_as(r), r)
        return acting * push


def _follow(scene: Scene, keypoints: Keypoints, bodies: Bodies) -> tuple[Int[Tensor, "k j"], Float[Tensor, "k j"]]:
    """For each keypoint the nearest particles of its object, and weights."""
    index = torch.zeros(len(keypoints.rest), NEAR, dtype=torch.int64)
    weight = torch.zeros(len(keypoints.rest), NEAR)
    for row, o in enumerate(scene.objects):
        mine = keypoints.object_id == o.id
        own = (bodies.body == row).nonzero()[:, 0]
        if bool(mine.any()):
            near, weight[mine] = nearest_weights(bodies.x[own], keypoints.rest[mine], NEAR)
            index[mine] = own[near]
    return index, weight


def _state(
    scene: Scene, keypoints: Keypoints, stage: SceneSetup, follow: tuple[Tensor, Tensor], x: Float[Tensor, "p 3"],
    F: Float[Tensor, "p 3 3"], mass: Float[Tensor, "p"],
) -> FrameState:  # fmt: skip
    """Keypoints move with the particles around them and with their deformation; at the start exactly by the lift."""
    index, weight = follow
    bodies = stage.bodies
    row = bodies.body[index[:, 0]] if len(index) else torch.zeros(0, dtype=torch.int64)
    moved = x - stage.start
    arm = keypoints.rest[:, None] - bodies.x[index]
    turned = ((F[index] - torch.eye(3)) @ arm[..., None])[..., 0]
    positions = keypoints.rest + stage.lift[row] + (weight[..., None] * (moved[index] + turned)).sum(1)
    total = torch.zeros(len(scene.objects)).index_add(0, bodies.body, mass)
    com = torch.zeros(len(scene.objects), 3).index_add(0, bodies.body, mass[:, None] * x) / total[:, None]
    rotation = object_rotations(keypoints, positions, [o.id for o in scene.objects])
    return FrameState(positions, com - stage.floor_offset, rotation)
