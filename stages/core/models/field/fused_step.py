"""A step of the force field in fifteen kernels: on a GPU the plain one is seven hundred, most too small to fill it.

    _begin     advance                         half a drift, where everything is then
    _meeting   gather search select show       which points touch what, and what can be seen there
    _touch     introduce listen hear explain answer
    _end       kick product watch strain deform

Intermediate tensors hold coordinates apart: for an object all x, then all y, then all z.
"""

from __future__ import annotations

import math

import torch
import triton
from torch import Tensor, nn

from stages.core.kernels.field import bodies
from stages.core.kernels.field import broad_phase as meeting
from stages.core.kernels.field import contact_features as places
from stages.core.kernels.field import contact_messages as touching
from stages.core.kernels.field import deformation_features as straining
from stages.core.kernels.field import skinny_matmul as thin
from stages.core.kernels.field import velocity_update as kicks
from stages.core.models.dynamics import FRAME
from stages.core.models.external_forces import ExternalForces
from stages.core.models.field import contact_points as near
from stages.core.models.field.contact_forces import ACCELERATION_UNIT, CONTACT_SATURATION
from stages.core.models.field.deformation import MAX_DAMPER_WEIGHT, MAX_DISPLACEMENT, MAX_SPRING_WEIGHT
from stages.core.models.field.force_field import (
    FRICTION_CUTOFF_SPEED,
    MAX_FRICTION_SPEED,
    MAX_PENETRATION,
    MAX_RECOVERY_SPEED,
    MAX_SPEED,
    MAX_SPIN,
    SEPARATION_SPEED,
    BodyState,
    FieldScene,
    ForceField,
)

LARGEST = 4096  # keypoints of an object: all of them are held in registers
ROWS = 64  # of a block of places or points


def fits(field: ForceField, scene: FieldScene) -> bool:
    """Whether the kernels are made for such a model and scene; they count what they write with 32 bits."""
    b, o, n, _ = scene.shape.arm.shape
    sizes = field.config["deform"] and field.config["hidden"] in (16, 32, 64, 128) and n <= LARGEST
    half = scene.shape.blur.dtype == torch.float16  # as for rollouts in single precision on CUDA
    return sizes and half and 64 * b * o * sum(lists(o, n)) < 2**31


def step(
    field: ForceField, scene: FieldScene, state: BodyState, t: Tensor | float, dt: float, external: ExternalForces
) -> BodyState:
    """What `ForceField.step` does, in single precision, without gradients."""
    return _Step(field, scene, external, dt).run(state, t)


def points(scene: FieldScene, state: BodyState) -> Tensor:
    """What `ForceField.points` does."""
    b, o, n, _ = state.u.shape
    given = [x.contiguous() for x in (state.com, state.quat, state.u, scene.shape.arm)]
    out = torch.empty_like(given[2])
    bodies.world_points[(b * o, triton.cdiv(n, 256))](*given, out, n, BLOCK=256)
    return out


def lists(o: int, n: int) -> list[int]:
    """Room for places where an object touches each other one, the floor and the walls: one list after the other."""
    return [ROWS * math.ceil(part * n / ROWS) for part in ((near.PAIR_FRACTION,) * (o - 1) + (1.0, near.WALL_FRACTION))]


def _layers(*layers: nn.Linear) -> tuple[Tensor, ...]:
    """Weights and biases in turn."""
    return tuple(x for layer in layers for x in (layer.weight, layer.bias))


class _Step:
    """Sizes, what is given as one block of memory each, and the four parts of a step."""

    def __init__(self, field: ForceField, scene: FieldScene, external: ExternalForces, dt: float):
        self.field, self.scene, self.external, self.dt = field, scene, external, dt
        self.b, self.o, self.n, _ = scene.shape.arm.shape
        self.objects, self.kinds, self.hidden = self.b * self.o, self.o + 1, field.config["hidden"]
        for name in ("arm", "normal", "spacing", "size", "inverse"):
            setattr(self, name, getattr(scene.shape, name).contiguous())
        for name in ("valid", "mass_fraction", "mass", "gravity", "box"):
            setattr(self, name, getattr(scene.shape.initial, name).contiguous())
        self.code, self.pinned = scene.code.contiguous(), external.pinned.contiguous()

        *others, floor, narrow = lists(self.o, self.n)
        wide, self.slots = others[0] if others else floor, sum(others) + floor + narrow
        self.lists = (self.o, self.n, wide, narrow, self.slots)
        self.places, self.floor, self.wide = self.slots // ROWS, floor // ROWS, wide // ROWS  # in blocks
        self.whole = {"BLOCK": max(64, triton.next_power_of_2(self.n)), "num_warps": 8}
        precision = "tf32x3" if torch.get_float32_matmul_precision() == "highest" else "tf32"
        self.network = {"ROWS": ROWS, "H": self.hidden, "PRECISION": precision}

    def run(self, state: BodyState, t: Tensor | float) -> BodyState:
        body, moved, inner, planes = self._begin(state)
        count, point, felt, record = self._meeting(body, moved, planes)
        known, parts, *grip = self._touch(count, point, felt, record)
        pushed = tuple(grip)  # nobody: not read
        if self.external.object.shape[1]:
            pushed = self.external.wrench(moved[:, :, :3].mT, body[..., :3].contiguous(), t, self.dt)
        return self._end(body, moved, inner, parts, felt, grip, known, pushed)

    def _new(self, *shape: int) -> Tensor:
        return self.arm.new_empty(self.b, self.o, *shape)

    def _count(self, *shape: int) -> Tensor:
        return torch.empty(self.b, self.o, *shape, dtype=torch.int32, device=self.arm.device)

    def _begin(self, state: BodyState) -> tuple[Tensor, ...]:
        body, moved = self._new(bodies.BODY_SIZE.value), self._new(bodies.POINT_SIZE.value, self.n)
        inner, planes = self._new(bodies.FIELD_SIZE.value, self.n), self._new(2, self.n)
        bodies.drift_half_step[(self.objects,)](
            *(x.contiguous() for x in state), self.arm, self.normal, self.valid, self.size, self.inverse, self.pinned,
            self.box, body, moved, inner, planes, self.o, self.n, self.dt, MAX_DISPLACEMENT=MAX_DISPLACEMENT,
            NO_CONTACT=near.NO_CONTACT,
            FRAME=FRAME, **self.whole,
        )  # fmt: skip
        return body, moved, inner, planes

    def _meeting(self, body: Tensor, moved: Tensor, planes: Tensor) -> tuple[Tensor, ...]:
        o, n, m = self.o, self.n, self.o - 1
        close, keys, which, partner = self._new(m, 3, n), self._new(m, n), self._count(m, n), self._count(m, n)
        many = self._count(m)
        if m:
            meeting.gather_candidates[(self.objects, m)](
                body, moved, self.valid, close, which, many, o, n, SEARCH_RADIUS=near.SEARCH_RADIUS, **self.whole
            )
            meeting.nearest_candidates[(self.objects * m, triton.cdiv(n, meeting.QUERY_BLOCK))](
                body, moved, close, which, many, keys, partner, o, n, SEARCH_RADIUS=near.SEARCH_RADIUS, FRAME=FRAME,
                QUERY_BLOCK=meeting.QUERY_BLOCK, CANDIDATE_CHUNK=meeting.CANDIDATE_CHUNK,
            )  # fmt: skip
        count, felt = self._count(self.kinds), self._new(self.kinds, 3, n)
        point, theirs = self._count(self.slots), self._count(self.slots)
        meeting.select_contacts[(self.objects, self.kinds)](
            keys, planes, which, partner, many, self.valid, count, point, theirs, felt, *self.lists,
            PAIR_FRACTION=near.PAIR_FRACTION,
            WALL_FRACTION=near.WALL_FRACTION, NO_CONTACT=near.NO_CONTACT, **self.whole,
        )  # fmt: skip
        record = self._new(self.slots * places.COLUMNS.value)
        places.contact_features[(self.objects, self.places)](
            body, moved, count, point, theirs, record, self.spacing, self.mass_fraction, self.size, self.mass,
            self.gravity,
            self.box, *self.lists, FULL_CONTACT=near.FULL_CONTACT, NO_CONTACT=near.NO_CONTACT, GAP_UNIT=near.GAP_UNIT,
            ARM_UNIT=near.ARM_UNIT, FRAME=FRAME,
            ROWS=ROWS, num_warps=2,
        )  # fmt: skip
        return count, point, felt, record

    def _touch(self, count: Tensor, point: Tensor, felt: Tensor, record: Tensor) -> tuple[Tensor, ...]:
        field, pair, plane, h = self.field, self.field.pairs, self.field.planes, self.hidden
        known, inputs = self._new(self.kinds + 1, h), self._new(self.kinds, h)
        own = _layers(pair.own, pair.other, plane.own, field.stress.own)
        touching.project_embeddings[(self.objects, self.kinds + 1)](self.code, *own, known, self.o, H=h)
        message, weight = self._new(self.slots, h), self._new(self.slots)
        heard, total = self._new(self.places, h), self._new(self.places)
        ears = (_layers(net.see, net.hear[0], net.hear[2]) for net in (pair, plane))
        touching.encode_messages[(self.objects, self.places)](
            record, count, *ears, known, message, weight, heard, total, *self.lists, **self.network
        )
        listened, scale, status = self._new(self.kinds, h), self._new(self.kinds), self._new(h)
        grip = self._new()
        touching.aggregate_messages[(self.objects,)](
            self.code, heard, total, _layers(field.status[0], field.status[2]), *_layers(field.hold), listened,
            scale, status, grip, *self.lists, CONTACT_SATURATION=CONTACT_SATURATION,
            MAX_FRICTION_SPEED=MAX_FRICTION_SPEED, ROWS=ROWS, BLOCKS=triton.next_power_of_2(self.floor), H=h,
            num_warps=8,
        )  # fmt: skip
        touching.update_contacts[(self.objects, self.kinds)](
            listened, status, _layers(field.between[0], field.between[2]),
            _layers(field.against[0], field.against[2]), *_layers(pair.tell, plane.tell), inputs, self.o, H=h,
        )  # fmt: skip
        parts = self._new(self.places, bodies.WRENCH_SIZE.value)
        mouths = (_layers(net.say[0], net.say[2]) for net in (pair, plane))
        touching.decode_forces[(self.objects, self.places)](
            record, count, point, *mouths, inputs, message, weight, scale, felt, parts, *self.lists,
            ACCELERATION_UNIT=ACCELERATION_UNIT,
            SEPARATION_SPEED=SEPARATION_SPEED, GAP_UNIT=near.GAP_UNIT, ARM_UNIT=near.ARM_UNIT, **self.network,
        )  # fmt: skip
        return known, parts, grip, scale

    def _end(
        self, body: Tensor, moved: Tensor, inner: Tensor, parts: Tensor, felt: Tensor, grip: list[Tensor],
        known: Tensor, pushed: tuple[Tensor, Tensor],
    ) -> BodyState:  # fmt: skip
        o, n, scene, stress = self.o, self.n, self.scene, self.field.stress
        com, quat, velocity, momentum = (self._new(width) for width in (3, 4, 3, 3))
        high, low = (torch.empty(self.b, o, 9, n, dtype=torch.float16, device=self.arm.device) for _ in range(2))
        scale = self._new(9)
        kicks.update_velocities[(self.objects,)](
            body, moved, inner, parts, felt, *grip, *pushed, self.arm, self.valid, self.mass_fraction, self.size,
            self.mass, self.inverse, self.pinned, self.gravity, self.box, com, quat, velocity, momentum, high, low,
            scale, o, n, self.dt, self.places, self.wide, HAS_EXTERNAL=self.external.object.shape[1] > 0,
            CONTACT_SATURATION=CONTACT_SATURATION, MAX_PENETRATION=MAX_PENETRATION,
            MAX_RECOVERY_SPEED=MAX_RECOVERY_SPEED, MAX_SPEED=MAX_SPEED, MAX_SPIN=MAX_SPIN,
            FRICTION_CUTOFF_SPEED=FRICTION_CUTOFF_SPEED, FRAME=FRAME,
            BLOCKS=triton.next_power_of_2(self.places - (o - 1) * self.wide), **self.whole,
        )  # fmt: skip
        mean = thin.split_matmul(scene.shape.blur.flatten(0, 1).flatten(1, 2), high.flatten(0, 1), low.flatten(0, 1))
        blocks = triton.cdiv(n, ROWS)
        record, field = self._new(blocks, straining.FEATURE_COLUMNS.value, ROWS), self._new(3, n)
        straining.deformation_features[(self.objects, blocks)](
            body, inner, mean, scale, self.arm, self.normal, self.size, self.gravity, record, o, n, blocks,
            ROWS=ROWS, num_warps=2,
        )  # fmt: skip
        straining.internal_accelerations[(self.objects, blocks)](
            record, known, scene.compliance_scale.contiguous(), _layers(stress.see), _layers(stress.say[0],
            stress.say[2]),
            field, n, blocks, self.kinds, MAX_SPRING_WEIGHT=MAX_SPRING_WEIGHT,
            MAX_DAMPER_WEIGHT=MAX_DAMPER_WEIGHT, **self.network,
        )  # fmt: skip
        u, du = self._new(n, 3), self._new(n, 3)
        stiffness, damping = scene.stiffness.contiguous(), scene.damping.contiguous()
        kicks.update_displacements[(self.objects,)](
            inner, field, self.arm, self.valid, self.mass_fraction, self.size, self.inverse, stiffness, damping,
            self.pinned,
            u, du, n, self.dt, MAX_SPEED=MAX_SPEED, MAX_DISPLACEMENT=MAX_DISPLACEMENT, **self.whole,
        )  # fmt: skip
        return BodyState(com, quat, velocity, momentum, u, du)
