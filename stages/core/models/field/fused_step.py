"""One force-field step as fifteen fused Triton kernels; the unfused step launches about 700 small ones.

    _drift      drift_half_step                              half a drift, kinematics of bodies and keypoints
    _contacts   gather_candidates nearest_candidates select_contacts contact_features
    _messages   project_embeddings encode_messages aggregate_messages update_contacts decode_forces
    _update     update_velocities split_matmul deformation_features internal_accelerations update_displacements

The reference is `ForceField.step`. Intermediate tensors store coordinates apart: for an object all x, then all y, then
all z. Contact points of an object lie in one list: a segment for each other object, then floor, then walls.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import triton
from torch import Tensor, nn

from stages.core.kernels.field import (
    bodies,
    broad_phase,
    contact_features,
    contact_messages,
    deformation_features,
    skinny_matmul,
    velocity_update,
)
from stages.core.models.dynamics import FRAME
from stages.core.models.external_forces import ExternalForces
from stages.core.models.field import contact_points as near
from stages.core.models.field.contact_forces import ACCELERATION_UNIT, CONTACT_SATURATION
from stages.core.models.field.deformation import MAX_DAMPER_WEIGHT, MAX_DISPLACEMENT, MAX_SPRING_WEIGHT
from stages.core.models.field.floor_response import (
    FRICTION_CUTOFF_SPEED,
    MAX_FRICTION_SPEED,
    MAX_PENETRATION,
    MAX_RECOVERY_SPEED,
    SEPARATION_SPEED,
)
from stages.core.models.field.state import MAX_SPEED, MAX_SPIN, BodyState, FieldScene

MAX_KEYPOINTS = 4096  # of an object: a kernel holds all of them in registers
ROWS = 64  # contact points or keypoints of a block


def fits(field: nn.Module, scene: FieldScene) -> bool:
    """Whether the kernels support this ForceField and scene; they index their outputs with 32 bits."""
    b, o, n, _ = scene.shape.arm.shape
    sizes = field.config["deform"] and field.config["hidden"] in (16, 32, 64, 128) and n <= MAX_KEYPOINTS
    half = scene.shape.blur.dtype == torch.float16  # set by `ForceField.precompute` on CUDA in single precision
    return sizes and half and 64 * b * o * sum(segment_sizes(o, n)) < 2**31


def step(
    field: nn.Module, scene: FieldScene, state: BodyState, t: Tensor | float, dt: float, external: ExternalForces
) -> BodyState:
    """`ForceField.step` in single precision, without gradients; `field` is the ForceField."""
    return _Step(field, scene, external, dt).run(state, t)


def points(scene: FieldScene, state: BodyState) -> Tensor:
    """Positions of the keypoints (b o n 3) [m], as `ForceField.points`."""
    b, o, n, _ = state.u.shape
    inputs = [x.contiguous() for x in (state.com, state.quat, state.u, scene.shape.arm)]
    out = torch.empty_like(inputs[2])
    bodies.world_points[(b * o, triton.cdiv(n, 256))](*inputs, out, n, BLOCK=256)
    return out


def segment_sizes(o: int, n: int) -> list[int]:
    """Slots for an object's contact points with each other object, the floor and the walls; multiples of ROWS."""
    fractions = (near.PAIR_FRACTION,) * (o - 1) + (1.0, near.WALL_FRACTION)
    return [ROWS * math.ceil(fraction * n / ROWS) for fraction in fractions]


def _layers(*layers: nn.Linear) -> tuple[Tensor, ...]:
    """Weight and bias of each layer."""
    return tuple(x for layer in layers for x in (layer.weight, layer.bias))


class _Kinematics(NamedTuple):
    """Bodies and keypoints after half a drift, in the layout of kernels/field/bodies.py."""

    body: Tensor
    point_states: Tensor
    deformation: Tensor
    planes: Tensor  # distances of the keypoints from floor and walls, as sort keys


class _Contacts(NamedTuple):
    """Contact points: their number in each segment, their keypoints, forces at keypoints and input features."""

    count: Tensor
    point: Tensor
    local_forces: Tensor
    record: Tensor


class _ContactEffect(NamedTuple):
    """What the contact messages give: an offset to the networks' first layers, wrenches and friction of each object."""

    offset: Tensor
    wrenches: Tensor
    friction: Tensor
    scale: Tensor


class _Step:
    """Sizes, contiguous inputs and the four groups of kernel launches of one step."""

    def __init__(self, field: nn.Module, scene: FieldScene, external: ExternalForces, dt: float):
        self.field, self.scene, self.external, self.dt = field, scene, external, dt
        self.b, self.o, self.n, _ = scene.shape.arm.shape
        self.objects, self.kinds, self.hidden = self.b * self.o, self.o + 1, field.config["hidden"]
        for name in ("arm", "normal", "spacing", "size", "inverse", "keypoint_inverse"):
            setattr(self, name, getattr(scene.shape, name).contiguous())
        for name in ("valid", "mass_fraction", "mass", "gravity", "box"):
            setattr(self, name, getattr(scene.shape.initial, name).contiguous())
        self.embedding, self.pinned = scene.embedding.contiguous(), external.pinned.contiguous()

        *others, floor, narrow = segment_sizes(self.o, self.n)
        wide, self.slots = others[0] if others else floor, sum(others) + floor + narrow
        self.segments = (self.o, self.n, wide, narrow, self.slots)
        self.blocks, self.floor, self.wide = self.slots // ROWS, floor // ROWS, wide // ROWS  # numbers of blocks
        self.whole = {"BLOCK": max(64, triton.next_power_of_2(self.n)), "num_warps": 8}
        precision = "tf32x3" if torch.get_float32_matmul_precision() == "highest" else "tf32"
        self.network = {"ROWS": ROWS, "H": self.hidden, "PRECISION": precision}

    def run(self, state: BodyState, t: Tensor | float) -> BodyState:
        drifted = self._drift(state)
        contacts = self._contacts(drifted)
        effect = self._messages(contacts)
        # without external forces the kernel takes these arguments but does not read them
        wrench = effect.friction, effect.scale
        if self.external.object.shape[1]:
            positions, com = drifted.point_states[:, :, :3].mT, drifted.body[..., :3].contiguous()
            wrench = self.external.wrench(positions, com, t, self.dt)
        return self._update(drifted, contacts.local_forces, effect, wrench)

    def _new(self, *shape: int) -> Tensor:
        return self.arm.new_empty(self.b, self.o, *shape)

    def _count(self, *shape: int) -> Tensor:
        return torch.empty(self.b, self.o, *shape, dtype=torch.int32, device=self.arm.device)

    def _drift(self, state: BodyState) -> _Kinematics:
        body, point_states = self._new(bodies.BODY_SIZE.value), self._new(bodies.POINT_SIZE.value, self.n)
        deformation, planes = self._new(bodies.FIELD_SIZE.value, self.n), self._new(2, self.n)
        bodies.drift_half_step[(self.objects,)](
            *(x.contiguous() for x in state), self.arm, self.normal, self.valid, self.size, self.inverse, self.pinned,
            self.box, body, point_states, deformation, planes, self.o, self.n, self.dt,
            MAX_DISPLACEMENT=MAX_DISPLACEMENT, NO_CONTACT=near.NO_CONTACT, FRAME=FRAME, **self.whole,
        )  # fmt: skip
        return _Kinematics(body, point_states, deformation, planes)

    def _contacts(self, drifted: _Kinematics) -> _Contacts:
        body, point_states, _, planes = drifted
        o, n, m = self.o, self.n, self.o - 1
        candidates, keys, which, partner = self._new(m, 3, n), self._new(m, n), self._count(m, n), self._count(m, n)
        candidate_count = self._count(m)
        if m:
            broad_phase.gather_candidates[(self.objects, m)](
                body, point_states, self.valid, candidates, which, candidate_count, o, n,
                SEARCH_RADIUS=near.SEARCH_RADIUS, **self.whole,
            )  # fmt: skip
            broad_phase.nearest_candidates[(self.objects * m, triton.cdiv(n, broad_phase.QUERY_BLOCK))](
                body, point_states, candidates, which, candidate_count, keys, partner, o, n,
                SEARCH_RADIUS=near.SEARCH_RADIUS, FRAME=FRAME, QUERY_BLOCK=broad_phase.QUERY_BLOCK,
                CANDIDATE_CHUNK=broad_phase.CANDIDATE_CHUNK,
            )  # fmt: skip
        count, local_forces = self._count(self.kinds), self._new(self.kinds, 3, n)
        point, partner_point = self._count(self.slots), self._count(self.slots)
        broad_phase.select_contacts[(self.objects, self.kinds)](
            keys, planes, which, partner, candidate_count, self.valid, count, point, partner_point, local_forces,
            *self.segments, PAIR_FRACTION=near.PAIR_FRACTION, WALL_FRACTION=near.WALL_FRACTION,
            NO_CONTACT=near.NO_CONTACT, **self.whole,
        )  # fmt: skip
        record = self._new(self.slots * contact_features.COLUMNS.value)
        contact_features.contact_features[(self.objects, self.blocks)](
            body, point_states, count, point, partner_point, record, self.spacing, self.mass_fraction, self.size,
            self.mass, self.gravity, self.box, *self.segments, FULL_CONTACT=near.FULL_CONTACT,
            NO_CONTACT=near.NO_CONTACT, GAP_UNIT=near.GAP_UNIT, ARM_UNIT=near.ARM_UNIT, FRAME=FRAME, ROWS=ROWS,
            num_warps=2,
        )  # fmt: skip
        return _Contacts(count, point, local_forces, record)

    def _messages(self, contacts: _Contacts) -> _ContactEffect:
        count, point, local_forces, record = contacts
        field, pair, plane, h = self.field, self.field.pairs, self.field.planes, self.hidden
        offset, context = self._new(self.kinds + 1, h), self._new(self.kinds, h)
        projections = _layers(
            pair.own_projection, pair.partner_projection, plane.own_projection, field.deformation.embedding_projection
        )  # fmt: skip
        contact_messages.project_embeddings[(self.objects, self.kinds + 1)](
            self.embedding, *projections, offset, self.o, H=h
        )  # fmt: skip
        message, weight = self._new(self.slots, h), self._new(self.slots)
        message_sum, total = self._new(self.blocks, h), self._new(self.blocks)
        encoders = (_layers(net.input_layer, net.message[0], net.message[2]) for net in (pair, plane))
        contact_messages.encode_messages[(self.objects, self.blocks)](
            record, count, *encoders, offset, message, weight, message_sum, total, *self.segments, **self.network,
        )  # fmt: skip
        mean_message, scale, status = self._new(self.kinds, h), self._new(self.kinds), self._new(h)
        friction = self._new()
        contact_messages.aggregate_messages[(self.objects,)](
            self.embedding, message_sum, total, _layers(field.object_update[0], field.object_update[2]),
            *_layers(field.friction), mean_message, scale, status, friction, *self.segments,
            CONTACT_SATURATION=CONTACT_SATURATION,
            MAX_FRICTION_SPEED=MAX_FRICTION_SPEED, ROWS=ROWS, BLOCKS=triton.next_power_of_2(self.floor), H=h,
            num_warps=8,
        )  # fmt: skip
        contact_messages.update_contacts[(self.objects, self.kinds)](
            mean_message, status, _layers(field.pair_update[0], field.pair_update[2]),
            _layers(field.plane_update[0], field.plane_update[2]),
            *_layers(pair.context_projection, plane.context_projection), context, self.o, H=h,
        )  # fmt: skip
        wrenches = self._new(self.blocks, bodies.WRENCH_SIZE.value)
        decoders = (_layers(net.decoder[0], net.decoder[2]) for net in (pair, plane))
        contact_messages.decode_forces[(self.objects, self.blocks)](
            record, count, point, *decoders, context, message, weight, scale, local_forces, wrenches, *self.segments,
            ACCELERATION_UNIT=ACCELERATION_UNIT, SEPARATION_SPEED=SEPARATION_SPEED, GAP_UNIT=near.GAP_UNIT,
            ARM_UNIT=near.ARM_UNIT, **self.network,
        )  # fmt: skip
        return _ContactEffect(offset, wrenches, friction, scale)

    def _update(
        self, drifted: _Kinematics, local_forces: Tensor, effect: _ContactEffect, wrench: tuple[Tensor, Tensor]
    ) -> BodyState:
        body, point_states, deformation, _ = drifted
        o, n, scene, net = self.o, self.n, self.scene, self.field.deformation
        com, quat, velocity, momentum = (self._new(width) for width in (3, 4, 3, 3))
        high, low = (torch.empty(self.b, o, 9, n, dtype=torch.float16, device=self.arm.device) for _ in range(2))
        scale = self._new(9)
        velocity_update.update_velocities[(self.objects,)](
            body, point_states, deformation, effect.wrenches, local_forces, effect.friction, effect.scale, *wrench,
            self.arm, self.valid, self.mass_fraction, self.size, self.mass, self.inverse, self.pinned, self.gravity,
            self.box, com, quat, velocity, momentum, high, low, scale, o, n, self.dt, self.blocks, self.wide,
            HAS_EXTERNAL=self.external.object.shape[1] > 0, CONTACT_SATURATION=CONTACT_SATURATION,
            MAX_PENETRATION=MAX_PENETRATION, MAX_RECOVERY_SPEED=MAX_RECOVERY_SPEED, MAX_SPEED=MAX_SPEED,
            MAX_SPIN=MAX_SPIN, FRICTION_CUTOFF_SPEED=FRICTION_CUTOFF_SPEED, FRAME=FRAME,
            BLOCKS=triton.next_power_of_2(self.blocks - (o - 1) * self.wide), **self.whole,
        )  # fmt: skip
        mean = skinny_matmul.split_matmul(
            scene.shape.blur.flatten(0, 1).flatten(1, 2), high.flatten(0, 1), low.flatten(0, 1)
        )
        blocks = triton.cdiv(n, ROWS)
        record, field = self._new(blocks, deformation_features.FEATURE_COLUMNS.value, ROWS), self._new(3, n)
        deformation_features.deformation_features[(self.objects, blocks)](
            body, deformation, mean, scale, self.arm, self.normal, self.size, self.gravity, record, o, n, blocks,
            ROWS=ROWS, num_warps=2,
        )  # fmt: skip
        deformation_features.internal_accelerations[(self.objects, blocks)](
            record, effect.offset, scene.compliance_scale.contiguous(), _layers(net.input_layer),
            _layers(net.decoder[0], net.decoder[2]), field, n, blocks, self.kinds,
            MAX_SPRING_WEIGHT=MAX_SPRING_WEIGHT, MAX_DAMPER_WEIGHT=MAX_DAMPER_WEIGHT, **self.network,
        )  # fmt: skip
        u, du = self._new(n, 3), self._new(n, 3)
        stiffness, damping = scene.stiffness.contiguous(), scene.damping.contiguous()
        velocity_update.update_displacements[(self.objects,)](
            deformation, field, self.arm, self.valid, self.mass_fraction, self.size, self.keypoint_inverse, stiffness,
            damping, self.pinned, u, du, n, self.dt, MAX_SPEED=MAX_SPEED, MAX_DISPLACEMENT=MAX_DISPLACEMENT,
            **self.whole,
        )  # fmt: skip
        return BodyState(com, quat, velocity, momentum, u, du)
