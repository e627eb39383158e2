"""The published neural Gaussian force field, with its parameter names, so that its checkpoints load.

Source: "Learning Physics-Grounded 4D Dynamics with Neural Gaussian Force Fields" (ICLR 2026) and its public code.
Details of that code on which its checkpoints depend are kept and noted in place, with two exceptions: the neighbour
search has no cap, and padding does not enter the object encoder (`padding_encoded` restores the published behaviour).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor, nn
from torch.nn.functional import linear

from stages.core.kernels.threads import large_operation, parallel_map, small_operations
from stages.core.models.dynamics import Dynamics
from stages.core.models.external_forces import ExternalForces
from stages.core.models.field.narrow_phase import near_walls, nearest
from stages.core.models.field.rigid_body import fit_rigid_motion
from stages.core.models.initial_conditions import GRAVITY, InitialConditions, centre_of_mass, inertia, offsets

MASS = 0.1  # mass of every object [kg]
CONTACT_RADIUS = 0.05  # points closer than this are in contact [m]
BLOCK_POINTS = 768  # points that a CPU thread processes at a time: fastest of 512 to 1536 (Intel Xeon, two cores)


class PaperState(NamedTuple):
    """State of objects: local points, centre of mass and Euler angles."""

    local: Float[Tensor, "b o n 3"]  # keypoints relative to the centre of mass, before rotation [m]
    local_velocity: Float[Tensor, "b o n 3"]  # [m/s]
    com: Float[Tensor, "b o 3"]  # [m]
    velocity: Float[Tensor, "b o 3"]  # [m/s]
    angle: Float[Tensor, "b o 3"]  # about x, y, z, applied in this order [rad]
    rate: Float[Tensor, "b o 3"]  # time derivatives of the Euler angles, not an angular velocity vector [rad/s]


def blocks(count: int, inner: int, outer: int) -> list[nn.Module]:
    """Layers Linear, LayerNorm, ReLU, repeated `count` times."""
    widths = [inner] + [outer] * count
    pairs = zip(widths[:-1], widths[1:], strict=True)
    layers = [(nn.Linear(a, b), nn.LayerNorm(b), nn.ReLU(inplace=True)) for a, b in pairs]
    return [layer for block in layers for layer in block]


def _perceptron(inner: int, hidden: int, outer: int) -> nn.Sequential:
    """Three linear layers with ReLU between them."""
    return nn.Sequential(
        nn.Linear(inner, hidden), nn.ReLU(inplace=True), nn.Linear(hidden, hidden), nn.ReLU(inplace=True),
        nn.Linear(hidden, outer),
    )  # fmt: skip


def euler_matrix(angle: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation matrix Rz Ry Rx of angles about x, y, z [rad]."""
    (sx, sy, sz), (cx, cy, cz) = angle.sin().unbind(-1), angle.cos().unbind(-1)
    rows = [
        cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx,
        sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx,
        -sy, cy * sx, cy * cx,
    ]  # fmt: skip
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def euler_angles(R: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """Inverse of `euler_matrix` [rad]."""
    pitch = torch.asin((-R[..., 2, 0]).clamp(-1, 1))
    return torch.stack([torch.atan2(R[..., 2, 1], R[..., 2, 2]), pitch, torch.atan2(R[..., 1, 0], R[..., 0, 0])], -1)


def angle_rates(angle: Float[Tensor, "*b 3"], spin: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    """Rates of the Euler angles of a body with angular velocity `spin` [rad/s]; bounded near gimbal lock."""
    (_, sy, sz), (_, cy, cz) = angle.sin().unbind(-1), angle.cos().unbind(-1)
    about_z = cz * spin[..., 0] + sz * spin[..., 1]
    about_y = cz * spin[..., 1] - sz * spin[..., 0]
    roll = about_z * cy / cy.square().clamp_min(1e-2)
    return torch.stack([roll, about_y, spin[..., 2] + sy * roll], -1)


def _blocks(x: Shaped[Tensor, "b o n *c"]) -> tuple[Tensor, ...]:
    """Split the points into blocks of about BLOCK_POINTS on a CPU without gradients; otherwise return one block."""
    if x.is_cuda or torch.is_grad_enabled():
        return (x,)
    return x.split(max(1, BLOCK_POINTS // max(1, x.shape[0] * x.shape[1])), 2)


def _map_blocks(function: Callable, *blocks: Sequence) -> list:
    """Apply a function to each block of points, in parallel on several CPU threads.

    PyTorch's own threads would synchronise after each operation.
    """
    arguments = list(zip(*blocks, strict=True))
    if len(arguments) == 1:
        return [function(*arguments[0])]
    with large_operation():
        return parallel_map(lambda block: function(*block), arguments)


def _maximum(x: Float[Tensor, "b o m h"], counts: Bool[Tensor, "b o m"]) -> Float[Tensor, "b o h"]:
    """Maximum over the points where `counts` is true, -inf if there are none."""
    return x.masked_fill(~counts[..., None], -torch.inf).amax(2)


class ResidualLinear(nn.Module):
    """x + ReLU(LayerNorm(Linear x))."""

    def __init__(self, width: int):
        super().__init__()
        self.mlp = nn.Sequential(*blocks(1, width, width))

    def forward(self, x: Float[Tensor, "*b w"]) -> Float[Tensor, "*b w"]:
        """Return the input plus its transformed copy, of the same width."""
        return x + self.mlp(x)


class ObjectEncoder(nn.Module):
    """Shape embedding from an unordered set of points (Qi et al. 2017, "PointNet")."""

    def __init__(self, hidden: int, layers: int):
        super().__init__()
        self.input_embedding = nn.Sequential(*blocks(1, 3, hidden))
        self.extraction_blocks = nn.ModuleList(ResidualLinear(hidden) for _ in range(layers))
        self.global_features = nn.Sequential(*blocks(1, hidden, hidden))

    def forward(self, local: Float[Tensor, "b o n 3"], counts: Bool[Tensor, "b o n"]) -> Float[Tensor, "b o h"]:
        """Max-pooled embedding of the `local` points [m] where `counts` is true; objects without points pool to 0."""
        maxima = _map_blocks(self._block_maximum, _blocks(local), _blocks(counts))
        maximum = torch.stack(maxima).amax(0)
        return self.global_features(torch.where(counts.any(2, keepdim=True), maximum, 0.0))

    def _block_maximum(self, local: Float[Tensor, "b o m 3"], counts: Bool[Tensor, "b o m"]) -> Float[Tensor, "b o h"]:
        x = self.input_embedding(local)
        for block in self.extraction_blocks:
            x = block(x)
        return _maximum(x, counts)


class StressNet(nn.Module):
    """Acceleration of each local point of an object [m/s^2]."""

    def __init__(self, hidden: int):
        super().__init__()
        h = hidden
        self.feature_layer = _perceptron(12, h, h)
        self.output_layer = _perceptron(2 * h, h, 3)  # input: a point's features and their maximum over the object

    def forward(self, x: Float[Tensor, "b o n 12"], counts: Bool[Tensor, "b o n"]) -> Float[Tensor, "b o n 3"]:
        """Accelerations [m/s^2] from each point's features and their maximum over the points where `counts` is true."""
        blocks = _map_blocks(self._features, _blocks(x), _blocks(counts))
        maximum = torch.stack([maximum for _, maximum in blocks]).amax(0)
        maximum = torch.where(counts.any(2, keepdim=True), maximum, 0.0)
        first, *others = self.output_layer
        own, shared = first.weight.chunk(2, 1)
        offset = linear(maximum, shared, first.bias)[:, :, None]  # once per object instead of per point

        def output(x: Tensor, _: Tensor) -> Tensor:
            x = linear(x, own).add_(offset)
            for layer in others:
                x = layer(x)
            return x

        return torch.cat(_map_blocks(output, *zip(*blocks, strict=True)), 2)

    def _features(
        self, x: Float[Tensor, "b o m 12"], counts: Bool[Tensor, "b o m"]
    ) -> tuple[Float[Tensor, "b o m h"], Float[Tensor, "b o h"]]:
        x = self.feature_layer(x)
        return x, _maximum(x, counts)


class Predictor(nn.Module):
    """Force and torque on every object and acceleration of its local points."""

    def __init__(self, hidden: int, layers: int, deform: bool, padding_encoded: bool):
        super().__init__()
        h, wide = hidden, 2 * hidden
        self.padding_encoded = padding_encoded
        self.pointnet = ObjectEncoder(h, layers)
        self.state_embedding = nn.Sequential(*blocks(layers, 12, h))
        self.brunch = nn.Sequential(*blocks(layers, wide, wide))
        self.trunk = nn.Sequential(*blocks(layers, h, wide))
        self.output = nn.Sequential(*blocks(1, wide, wide), nn.Linear(wide, 9))
        self.boundary_net = nn.Sequential(*blocks(layers, wide, wide), nn.Linear(wide, 9))
        self.stress_net = StressNet(h) if deform else None

    def forward(
        self, initial: InitialConditions, state: PaperState, rest: Float[Tensor, "b o n 3"]
    ) -> tuple[Float[Tensor, "b o 3"], Float[Tensor, "b o 3"], Float[Tensor, "b o n 3"]]:
        """Return force [N], torque [N m], and acceleration of the local points [m/s^2] (0 without deformation).

        `rest` are the local points at time 0 [m].
        """
        counts = torch.ones_like(initial.valid) if self.padding_encoded else initial.valid
        points = world_points(state)
        shape = self.pointnet(state.local, counts)
        contact = nearest(points, initial.valid, CONTACT_RADIUS)[0] < CONTACT_RADIUS  # (b, receiver, sender, n)
        walls = near_walls(points, initial.valid, initial.box, CONTACT_RADIUS)
        pair = self._pairs(shape, state) * contact.any(-1)[..., None]
        wall = self._floor(shape, state, initial) * walls.any(-1)[..., None]
        force, torque, _ = (pair.sum(2) + wall).split(3, -1)
        if self.stress_net is None:
            return force, torque, torch.zeros_like(points)
        latent = torch.einsum("bijn,bijd->bind", contact.to(pair), pair[..., 6:])
        latent = torch.stack([latent, walls[..., None] * wall[:, :, None, 6:]], -2)
        # the matrix of the negated angles is not the inverse rotation; the published checkpoints were trained with it
        rotated = latent @ euler_matrix(-state.angle).mT[:, :, None]
        stretch = 100 * (state.local - rest)
        x = torch.cat([stretch, 100 * state.local_velocity, rotated.flatten(-2)], -1)
        return force, torque, self.stress_net(x, counts)

    def _pairs(self, shape: Float[Tensor, "b o h"], state: PaperState) -> Float[Tensor, "b o o 9"]:
        """Force, torque and latent vector of object i due to object j."""
        s = _placement(state)
        o = shape.shape[1]
        relative = self.state_embedding(s[:, :, None] - s[:, None])
        receiver = shape[:, :, None].expand(-1, -1, o, -1)
        return self.output(self.brunch(torch.cat([receiver, relative], -1)) * self.trunk(shape)[:, None])

    def _floor(
        self, shape: Float[Tensor, "b o h"], state: PaperState, initial: InitialConditions
    ) -> Float[Tensor, "b o 9"]:
        """Force, torque and latent vector of an object due to the room.

        The input includes the height of the floor; walls enter only through contact.
        """
        floor = torch.zeros_like(state.com)
        floor[..., 2] = initial.floor
        s = _placement(state._replace(com=state.com - floor))
        return self.boundary_net(torch.cat([shape, self.state_embedding(s)], -1))


def _placement(state: PaperState) -> Float[Tensor, "b o 12"]:
    return torch.cat([state.com, state.angle, state.velocity, state.rate], -1)


def _rest(initial: InitialConditions) -> Float[Tensor, "b o n 3"]:
    return initial.points - centre_of_mass(initial, initial.points)[:, :, None]


def world_points(state: PaperState) -> Float[Tensor, "b o n 3"]:
    """Keypoints in world coordinates [m]."""
    return state.local @ euler_matrix(state.angle).mT + state.com[:, :, None]


class PaperForceField(Dynamics):
    """Engine `ngff-paper`; without `deform`, `ngff-paper-rigid`.

    Mass and gravity are constants of the model; materials are not inputs.
    """

    inputs = frozenset({"points", "mass_fraction", "velocity", "spin", "box"})

    def __init__(self, hidden: int = 200, layers: int = 4, deform: bool = True, padding_encoded: bool = False):
        super().__init__()
        self.config = {"hidden": hidden, "layers": layers, "deform": deform, "padding_encoded": padding_encoded}
        self.predictor = Predictor(hidden, layers, deform, padding_encoded)
        self.register_buffer("gravity", torch.tensor(GRAVITY[2]))

    def initial_state(self, initial: InitialConditions) -> PaperState:
        """Return undeformed objects with zero angles; angular velocities are taken as angle rates."""
        com = centre_of_mass(initial, initial.points)
        local = _rest(initial)
        return PaperState(local, torch.zeros_like(local), com, initial.velocity, torch.zeros_like(com), initial.spin)

    def state_from_motion(
        self, initial: InitialConditions, points: Float[Tensor, "b o n 3"], velocities: Float[Tensor, "b o n 3"]
    ) -> PaperState:
        """Fit a rigid motion to the keypoints, as Euler angles and their rates; the residual is the deformation."""
        arm = offsets(initial, initial.points)
        inverse = torch.linalg.inv(inertia(initial.mass_fraction, arm))
        m = fit_rigid_motion(initial.mass_fraction, arm, inverse, points, velocities)
        angle = euler_angles(m.R)
        rate = angle_rates(angle, m.spin)
        return PaperState(_rest(initial) + m.u, m.du, m.com, m.velocity, angle, rate)

    def derivative(
        self, initial: InitialConditions, t: Tensor | float, state: PaperState, external: ExternalForces
    ) -> PaperState:
        """Return rates of the state by predicted and external forces and gravity; 0 for padding and pinned objects."""
        if initial.points.is_cuda or torch.is_grad_enabled():
            return self._rates(initial, t, state, external)
        with small_operations():  # except those on blocks of points
            return self._rates(initial, t, state, external)

    def _rates(
        self, initial: InitialConditions, t: Tensor | float, state: PaperState, external: ExternalForces
    ) -> PaperState:
        force, torque, stress = self.predictor(initial, state, _rest(initial))
        applied, twist = external.wrench(world_points(state), state.com, t)
        # the external torque is divided by the mass twice, as published
        acceleration = (force + applied) / MASS + self.gravity * torch.eye(3, device=force.device)[2]
        angular = (torque + twist / MASS) / MASS
        movable = ~external.pinned[..., None]
        inner = (initial.valid & movable)[..., None]
        return PaperState(
            state.local_velocity * inner, stress * inner, state.velocity * movable, acceleration * movable,
            state.rate * movable, angular * movable,
        )  # fmt: skip

    def points(self, initial: InitialConditions, state: PaperState) -> Float[Tensor, "b o n 3"]:
        """Keypoints in world coordinates [m]."""
        return world_points(state)


def rigid(**config) -> PaperForceField:
    """Engine `ngff-paper-rigid`: the ablation without deformation."""
    return PaperForceField(**{**config, "deform": False})
