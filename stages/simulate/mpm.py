"""The MPM engine: samples particles in the objects, simulates them and transfers their motion to the keypoints.

The solver works in SI units; input and output are in scene units.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.kernels.mpm.constitutive import COROTATED, MAX_LOSS, NEO_HOOKEAN, maxwell_branches
from stages.core.physics.forces import Force, ForcePrompts
from stages.core.physics.keypoints import nearest_weights
from stages.core.physics.material_parts import part_of_points
from stages.core.physics.materials import MODELS, Material
from stages.core.physics.mpm import solver as mpm
from stages.core.physics.mpm.body_shapes import BodyShape, shape_of_voxels
from stages.core.physics.particles import Bodies
from stages.core.physics.skinning import object_rotations
from stages.core.physics.solid_surface import solid_surface
from stages.core.physics.state import FrameState
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.trajectory import Keypoints
from stages.simulate.changes import changed_options, changed_pins
from stages.simulate.moving_grid import GridBodies, MovingGrid
from stages.simulate.options import MpmQuality, SimulateOptions
from stages.simulate.setup import SceneSetup, choose_for_bodies, held_as_seen, set_up_scene

log = logging.getLogger(__name__)
PARTICLES_PER_KEYPOINT = 8  # particles whose motion a keypoint follows
GPU_STEP = 8e-4  # shortest substep on a GPU, in the units of MpmQuality.step
CFL_MARGIN = 0.85  # fraction of the stability limit up to which materials may be stiff or viscous


def rollout(
    scene: Scene, keypoints: Keypoints, prompts: ForcePrompts, options: SimulateOptions
) -> Iterator[FrameState]:
    """Yield one state per frame, the first of which is the initial state.

    Each body has a velocity field of its own. On a GPU the quality levels above draft use twice the resolution and
    stiffer materials. Raises InputError if a body leaves the domain or its motion is no longer finite.
    """
    unit, device = scene.metres_per_unit, pick_device(options.device)
    level, fine = options.level, device != "cpu" and options.quality != "draft"
    if fine:
        level = replace(level, step=min(level.step, GPU_STEP))
    setup = set_up_scene(scene, prompts, options, refinement=2 if fine else 1)
    setup.warn_of_lifted(scene)
    if held_as_seen(scene, options):
        log.warning("--engine mpm does not hold objects of photos at rest: all objects may move from the start")
    body, dx = setup.bodies.body, 2 * setup.bodies.spacing * unit
    particles = _particles(scene, setup, prompts, options, level)
    box = mpm.Box(tuple(unit * v for v in setup.box.low), tuple(unit * v for v in setup.box.high))
    shapes = [_shape(scene, o.id, setup.bodies.x[body == row], setup.bodies.spacing, options.seed).scaled(unit)
              for row, o in enumerate(scene.objects)]  # fmt: skip
    bodies = GridBodies(body, scene.objects, shapes)
    grid = MovingGrid(particles, box, dx, device, bodies, fixed=options.box is not None)
    ids = [o.id for o in scene.objects]
    attachment = _attach(scene, keypoints, setup.bodies)
    gravity = _gravity(particles, options)
    substeps = grid.substeps(options.dt, gravity)
    log.info(
        "%d particles, grid spacing %.3g m, %d nodes, substep %.3g s (%d per frame; more for fast motion)",
        len(particles), dx, grid.solver.grid.count, options.dt / substeps, substeps,
    )  # fmt: skip

    def states() -> Iterator[FrameState]:
        current, held, weight = options, prompts.pinned, gravity
        for frame in range(options.steps):
            now = grid.solver.particles
            x = now.x.cpu()
            yield _state(scene, setup, attachment, x / unit, now.F.cpu(), particles.mass)
            if frame < options.steps - 1:
                t = frame * options.dt
                active, changes = prompts.during(t, (frame + 1) * options.dt)
                if changes:
                    current, held = changed_options(current, changes), changed_pins(held, changes)
                    new = _changed(scene, setup, replace(prompts, pinned=held), current, level)
                    _change(grid.solver, particles, new)
                    weight = _gravity(particles, current)
                forces = [_PromptedForce(f, particles, setup, ids.index(f.object_id)) for f in active
                          if f.active_fraction(t, t + options.dt) > 0]  # fmt: skip
                acceleration = sum((f.acceleration(x, t, t + options.dt) for f in forces), weight)
                try:
                    grid.advance(options.dt, acceleration)
                except mpm.Diverged as error:
                    raise _divergence(scene.objects[int(body[error.particle])], t) from error

    return states()


def _shape(scene: Scene, object_id: int, x: Float[Tensor, "p 3"], h: float, seed: int) -> BodyShape:
    """The undeformed shape of an object with particles at `x` and the particle spacing `h`, in scene units."""
    return shape_of_voxels(x.double().numpy(), h, solid_surface(scene, object_id, seed))


def _gravity(particles: mpm.Particles, options: SimulateOptions) -> Float[Tensor, "p 3"]:
    """Gravitational acceleration of each particle [m/s^2]; 0 for held particles."""
    gravity = torch.tensor([0.0, 0.0, -options.gravity]).repeat(len(particles), 1)
    gravity[particles.held > 0] = 0
    return gravity


def _changed(
    scene: Scene, setup: SceneSetup, prompts: ForcePrompts, options: SimulateOptions, level: MpmQuality
) -> mpm.Particles:
    """`_particles` with changed materials, friction and pins. Raises InputError if a material model would change."""
    materials = choose_for_bodies(scene, setup.bodies, options)
    for o in scene.objects:
        models = [{part.material.model for part in m[o.id].parts} for m in (materials, setup.materials)]
        if models[0] != models[1]:
            raise InputError(f"object {o.id} ({o.name}) cannot become {materials[o.id].name} during a simulation with "
                             "--engine mpm: its current material has a different material model")  # fmt: skip
    return _particles(scene, replace(setup, materials=materials), prompts, options, level)


def _change(solver: mpm.Solver, particles: mpm.Particles, new: mpm.Particles) -> None:
    """Set the materials and pins of the particles to those of `new`; newly pinned particles stop."""
    stopped = (new.held > 0) & (particles.held == 0)
    now = solver.particles
    changed = {name: getattr(new, name) for name in
               ("mass", "stiffness", "friction", "held", "plastic", "branch_modulus", "branch_rate")}  # fmt: skip
    for name, value in changed.items():
        setattr(particles, name, value)
    solver.set(
        **changed,
        v=now.v * ~stopped[:, None].to(now.v.device),
        C=now.C * ~stopped[:, None, None].to(now.C.device),
    )


def _divergence(o: SceneObject, time: float) -> InputError:
    return InputError(
        f"object {o.id} ({o.name}) left the domain or its motion diverged at {time:.2f} s; use a finer "
        "--quality, a softer --material, a wider --box if there is one, or a smaller --velocity or --force"
    )


def _particles(
    scene: Scene, setup: SceneSetup, prompts: ForcePrompts, options: SimulateOptions, level: MpmQuality
) -> mpm.Particles:
    """Particles of all objects in SI units, with materials that are softened if the substep of `level` requires it."""
    unit, body, x = scene.metres_per_unit, setup.bodies.body, setup.bodies.x
    h, volume = setup.bodies.spacing * unit, setup.bodies.volume * unit**3
    columns = torch.zeros(len(body), 9)  # E, density, nu, viscosity, friction, model, and three parameters of the model
    branches = torch.zeros(len(body), 4)  # moduli and relaxation rates of the two Maxwell branches
    velocity, held = torch.zeros(len(body), 3), torch.zeros(len(body), dtype=torch.int8)
    for row, o in enumerate(scene.objects):
        choice, mine = setup.materials[o.id], (body == row).nonzero()[:, 0]
        length = unit * float((x[mine].amax(0) - x[mine].amin(0)).max())
        friction = choice.material.friction if options.friction is None else options.friction
        part_of = part_of_points(choice, x[mine])
        for k, part in enumerate(choice.parts):
            m, rows = part.material, mine[part_of == k]
            E, loss, viscosity, modulus, rate = _stable_material(m, length, h, level)
            model = MODELS[m.model]
            branches[rows] = torch.tensor([*modulus, *rate])
            columns[rows] = torch.tensor([E, m.density, m.nu, viscosity, friction, model.kernel,
                                          *model.solver_parameters(m.plastic, E / m.E)])  # fmt: skip
            held[rows] = part.pinned or o.id in prompts.pinned
            message = f"object {o.id} ({o.name}): {part.name}, {scene.mass_text(float(m.density * volume[rows].sum()))}"
            message += ", pinned" if part.pinned or o.id in prompts.pinned else ""
            if choice.guessed:
                message += f"; material not known, taking {choice.name} (--material {o.id}=... changes it)"
            if m.E > E:
                message += f"; Young's modulus reduced from {m.E:.2g} to {E:.2g} Pa for --quality {options.quality}"
            if m.loss > 1.05 * loss:
                message += f"; loss factor reduced from {m.loss:.2g} to {loss:.2g}"
            if not len(rows):
                message = f"object {o.id} ({o.name}): no particles are in its part of {part.name}"
            log.info("%s", message)
        velocity[mine] = unit * torch.tensor(prompts.velocity.get(o.id, (0.0, 0.0, 0.0)))
    E, density, nu, viscosity, friction, model = columns[:, :6].unbind(1)
    particles = mpm.at_rest(setup.start * unit, volume, mpm.ParticleMaterial(E, nu, density, viscosity, friction))
    particles.model, particles.plastic = model.to(torch.int8), columns[:, 6:].contiguous()
    if bool(branches.any()):
        particles = mpm.with_branches(particles, branches[:, :2].contiguous(), branches[:, 2:].contiguous())
    particles.rest = x * unit
    particles.v, particles.held = velocity * (held == 0)[:, None], held
    return particles


class _StableMaterial(NamedTuple):
    """Material parameters with which the solver is stable."""

    E: float  # [Pa]
    loss: float  # loss factor tan(delta)
    viscosity: float  # [Pa s]
    branch_modulus: tuple[float, float]  # moduli of the Maxwell branches, relative to E
    branch_rate: tuple[float, float]  # relaxation rates of the Maxwell branches [1/s]


def _stable_material(m: Material, length: float, h: float, level: MpmQuality) -> _StableMaterial:
    """The material of a body of this `length` [m], as stiff as the substep allows; `h` is the particle spacing [m].

    Maxwell branches give elastic materials their loss factor from the lowest longitudinal vibration of a bar of this
    length, omega = pi c / L, down to a tenth of that frequency, since impacts are a few times slower than this
    vibration. The stiffness of the branches shortens the substep. Materials that flow have the viscosity E loss / omega
    of a Kelvin-Voigt solid, reduced if the substep requires it.
    """
    substep = level.substep(h)
    fastest = CFL_MARGIN * mpm.SAFETY * 2 * h / substep
    elastic = MODELS[m.model].kernel in (NEO_HOOKEAN, COROTATED)
    loss = min(m.loss, MAX_LOSS)
    E = min(m.E, mpm.modulus_at_wave_speed(fastest, m.nu, m.density))
    omega = math.pi * math.sqrt(E / m.density) / length
    if elastic:
        return _StableMaterial(E, loss, 0.0, *maxwell_branches(loss, omega))
    viscosity = min(m.loss * E / omega, CFL_MARGIN * mpm.VISCOUS * m.density * (2 * h) ** 2 / substep)
    return _StableMaterial(E, viscosity * omega / E, viscosity, (0.0, 0.0), (0.0, 0.0))


class _PromptedForce:
    """A force prompt, distributed over the particles of its object that are not held."""

    def __init__(self, force: Force, particles: mpm.Particles, setup: SceneSetup, row: int):
        self.force, self.mass = force, particles.mass
        self.mine = (setup.bodies.body == row).float() * (particles.held == 0)
        weight = self.mine.clone()
        if force.at is not None:
            distance = (setup.bodies.x - torch.tensor(force.at)).norm(dim=1)
            nearest = distance[self.mine > 0].min() if bool(self.mine.any()) else distance.min()
            radius = 4 * setup.bodies.spacing  # two grid cells, in addition to the nearest distance
            weight *= torch.exp(-(((distance - nearest) / radius) ** 2) / 2) * (distance - nearest < 2 * radius)
        self.weight = weight / (weight * self.mass).sum().clamp_min(1e-30)  # [1/kg]; the sum of mass * weight is 1

    def acceleration(self, x: Float[Tensor, "p 3"], start: float, end: float) -> Float[Tensor, "p 3"]:
        """Accelerations [m/s^2] of particles at `x` [m], averaged over the time from `start` to `end` [s]."""
        active = self.force.active_fraction(start, end)
        if not active:
            return torch.zeros_like(x)
        a = self.weight[:, None] * torch.tensor(self.force.force)
        if any(self.force.torque) and bool(self.mine.any()):
            m = self.mass * self.mine
            r = x - (m[:, None] * x).sum(0) / m.sum()
            inertia = (m * r.square().sum(1)).sum() * torch.eye(3) - (m[:, None] * r).mT @ r
            angular = torch.linalg.solve(inertia.double(), torch.tensor(self.force.torque).double()).float()
            a = a + self.mine[:, None] * torch.linalg.cross(angular.expand_as(r), r)
        return active * a


class _Attachment(NamedTuple):
    """Keypoints, and the particles that each keypoint follows."""

    keypoints: Keypoints
    index: Int[Tensor, "k j"]  # rows of the particles
    weight: Float[Tensor, "k j"]  # weights of the particles; each row sums to 1


def _attach(scene: Scene, keypoints: Keypoints, bodies: Bodies) -> _Attachment:
    index = torch.zeros(len(keypoints.rest), PARTICLES_PER_KEYPOINT, dtype=torch.int64)
    weight = torch.zeros(len(keypoints.rest), PARTICLES_PER_KEYPOINT)
    for row, o in enumerate(scene.objects):
        mine = keypoints.object_id == o.id
        own = (bodies.body == row).nonzero()[:, 0]
        if bool(mine.any()):
            near, weight[mine] = nearest_weights(bodies.x[own], keypoints.rest[mine], PARTICLES_PER_KEYPOINT)
            index[mine] = own[near]
    return _Attachment(keypoints, index, weight)


def _state(
    scene: Scene, setup: SceneSetup, attachment: _Attachment, x: Float[Tensor, "p 3"], F: Float[Tensor, "p 3 3"],
    mass: Float[Tensor, "p"],
) -> FrameState:  # fmt: skip
    """The state with keypoints moved and deformed with their particles; in the first frame only the lift moves them.

    Positions `x` of the particles in scene units, deformation gradients `F`, `mass` in kg.
    """
    keypoints, index, weight = attachment
    bodies = setup.bodies
    row = bodies.body[index[:, 0]] if len(index) else torch.zeros(0, dtype=torch.int64)
    moved = x - setup.start
    arm = keypoints.rest[:, None] - bodies.x[index]
    deformed = ((F[index] - torch.eye(3)) @ arm[..., None])[..., 0]
    positions = keypoints.rest + setup.lift[row] + (weight[..., None] * (moved[index] + deformed)).sum(1)
    total = torch.zeros(len(scene.objects)).index_add(0, bodies.body, mass)
    com = torch.zeros(len(scene.objects), 3).index_add(0, bodies.body, mass[:, None] * x) / total[:, None]
    rotation = object_rotations(keypoints, positions, [o.id for o in scene.objects])
    return FrameState(positions, com - setup.floor_offset, rotation, total)
