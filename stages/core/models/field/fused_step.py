"""One force-field step as fifteen fused Triton kernels; the unfused step launches about 700 small ones.

    _drift      drift_half_step                              half a drift, kinematics of bodies and keypoints
    _contacts   gather_candidates nearest_candidates select_contacts contact_features
    _messages   project_embeddings encode_messages aggregate_messages update_contacts decode_forces
    _update     update_velocities split_matmul deformation_features internal_accelerations update_displacements

The reference is `ForceField.step`. Intermediate tensors store coordinates separately: for each object all x, then all
y, then all z. The contact points of an object are in one list: a segment per other object, then floor, then walls.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor, nn

from stages.core.kernels.field import (
    bodies,
    broad_phase,
    contact_features,
    contact_messages,
    deformation_features,
    layers,
    skinny_matmul,
    velocity_update,
)
from stages.core.models.dynamics import FRAME
from stages.core.models.external_forces import ExternalForces
from stages.core.models.field import contact_points as near
from stages.core.models.field.contact_forces import ACCELERATION_UNIT, CONTACT_SATURATION, ContactNet
from stages.core.models.field.deformation import MAX_DAMPER_WEIGHT, MAX_DISPLACEMENT, MAX_SPRING_WEIGHT
from stages.core.models.field.floor_response import (
    FRICTION_CUTOFF_SPEED,
    MAX_FRICTION_SPEED,
    MAX_PENETRATION,
    MAX_RECOVERY_SPEED,
    SEPARATION_SPEED,
)
from stages.core.models.field.state import MAX_SPEED, MAX_SPIN, BodyState, FieldScene

MAX_KEYPOINTS = 4096  # largest number of keypoints of an object: a kernel holds all of them in registers
ROWS = layers.ROWS.value  # contact points or keypoints per block
CONSTANTS = bodies.FieldConstants(
    FRAME=FRAME, SEARCH_RADIUS=near.SEARCH_RADIUS, NO_CONTACT=near.NO_CONTACT, FULL_CONTACT=near.FULL_CONTACT,
    PAIR_FRACTION=near.PAIR_FRACTION, WALL_FRACTION=near.WALL_FRACTION, GAP_UNIT=near.GAP_UNIT,
    ARM_UNIT=near.ARM_UNIT, CONTACT_SATURATION=CONTACT_SATURATION, ACCELERATION_UNIT=ACCELERATION_UNIT,
    SEPARATION_SPEED=SEPARATION_SPEED, MAX_FRICTION_SPEED=MAX_FRICTION_SPEED,
    FRICTION_CUTOFF_SPEED=FRICTION_CUTOFF_SPEED, MAX_PENETRATION=MAX_PENETRATION,
    MAX_RECOVERY_SPEED=MAX_RECOVERY_SPEED, MAX_SPEED=MAX_SPEED, MAX_SPIN=MAX_SPIN, MAX_DISPLACEMENT=MAX_DISPLACEMENT,
    MAX_SPRING_WEIGHT=MAX_SPRING_WEIGHT, MAX_DAMPER_WEIGHT=MAX_DAMPER_WEIGHT,
)  # fmt: skip


def fits(field: nn.Module, scene: FieldScene) -> bool:
    """Whether the kernels, which index their outputs with 32 bits, support this ForceField and scene."""
    b, o, n, _ = scene.shape.arm.shape
    sizes = field.config["deform"] and field.config["hidden"] in (16, 32, 64, 128) and n <= MAX_KEYPOINTS
    half = scene.shape.blur.dtype == torch.float16  # set by `ForceField.precompute` on CUDA in single precision
    return sizes and half and 64 * b * o * sum(segment_sizes(o, n)) < 2**31


def step(
    field: nn.Module, scene: FieldScene, state: BodyState, t: Tensor | float, dt: float, external: ExternalForces
) -> BodyState:
    """`ForceField.step` in single precision, without gradients; `field` is the ForceField."""
    return FusedStep(field, scene, dt, external)(state, t)


def points(scene: FieldScene, state: BodyState) -> Tensor:
    """Return the positions of the keypoints (b o n 3) [m], as `ForceField.points`."""
    b, o, n, _ = state.u.shape
    state = BodyState(*(x.contiguous() for x in state))
    out = torch.empty_like(state.u)
    bodies.world_points[(b * o, triton.cdiv(n, 256))](state, scene.shape.arm.contiguous(), out, n, BLOCK=256)
    return out


def segment_sizes(o: int, n: int) -> list[int]:
    """Slots for an object's contact points with each other object, the floor and the walls; multiples of ROWS."""
    fractions = (near.PAIR_FRACTION,) * (o - 1) + (1.0, near.WALL_FRACTION)
    return [ROWS * math.ceil(fraction * n / ROWS) for fraction in fractions]


def _linear(layer: nn.Linear) -> tuple[Tensor, Tensor]:
    return layer.weight, layer.bias


def _network(layers: nn.Sequential) -> tuple[tuple[Tensor, Tensor], ...]:
    """Weight and bias of each linear layer."""
    return tuple(_linear(x) for x in layers if isinstance(x, nn.Linear))


class _Layers(NamedTuple):
    """Layers of each kernel that evaluates networks."""

    embeddings: contact_messages.EmbeddingLayers
    encoder: contact_messages.EncoderLayers
    status: contact_messages.StatusLayers
    context: contact_messages.ContextLayers
    decoder: contact_messages.DecoderLayers
    deformation: deformation_features.DeformationLayers


def _collect_layers(field: nn.Module) -> _Layers:
    precision = tl.constexpr("tf32x3" if torch.get_float32_matmul_precision() == "highest" else "tf32")
    hidden = tl.constexpr(field.config["hidden"])
    pairs, planes, deformation = field.pairs, field.planes, field.deformation

    def encoder(net: ContactNet, vectors: int, scalars: int) -> contact_messages.ContactEncoder:
        return contact_messages.ContactEncoder(_linear(net.input_layer), _network(net.message), tl.constexpr(vectors),
                                               tl.constexpr(scalars))  # fmt: skip

    def decoder(net: ContactNet, vectors: int) -> contact_messages.ContactDecoder:
        return contact_messages.ContactDecoder(_network(net.decoder), tl.constexpr(vectors))

    return _Layers(
        embeddings=contact_messages.EmbeddingLayers(
            _linear(pairs.own_projection), pairs.partner_projection and _linear(pairs.partner_projection),
            _linear(planes.own_projection), _linear(deformation.embedding_projection), hidden,
        ),
        encoder=contact_messages.EncoderLayers(encoder(pairs, 10, 7), encoder(planes, 8, 5), hidden, precision),
        status=contact_messages.StatusLayers(_network(field.object_update), _linear(field.friction), hidden),
        context=contact_messages.ContextLayers(
            _network(field.pair_update), _linear(pairs.context_projection), _network(field.plane_update),
            _linear(planes.context_projection), hidden,
        ),
        decoder=contact_messages.DecoderLayers(decoder(pairs, 10), decoder(planes, 8), hidden, precision),
        deformation=deformation_features.DeformationLayers(
            _linear(deformation.input_layer), _network(deformation.decoder), hidden, precision
        ),
    )  # fmt: skip


class FusedStep:
    """Step of one rollout as a function of state and time, in four groups of kernel launches.

    Holds what all steps share: sizes, contiguous inputs and layers. The weights may change in place during use; the
    other arguments must not change.
    """

    def __init__(self, field: nn.Module, scene: FieldScene, dt: float, external: ExternalForces):
        self.scene, self.external = scene, external
        self.b, self.o, self.n, _ = scene.shape.arm.shape
        self.objects = self.b * self.o
        shape, initial = scene.shape, scene.shape.initial
        arrays = {
            "arm": shape.arm, "normal": shape.normal, "valid": initial.valid, "mass_fraction": initial.mass_fraction,
            "spacing": shape.spacing, "size": shape.size, "mass": initial.mass, "inverse": shape.inverse,
            "keypoint_inverse": shape.keypoint_inverse, "pinned": external.pinned, "box": initial.box,
            "gravity": initial.gravity, "embedding": scene.embedding, "stiffness": scene.stiffness,
            "damping": scene.damping, "compliance_scale": scene.compliance_scale,
        }  # fmt: skip
        arrays = {name: x.contiguous() for name, x in arrays.items()}
        block = tl.constexpr(max(64, triton.next_power_of_2(self.n)))
        self.inputs = bodies.StepInputs(**arrays, o=self.o, n=self.n, dt=dt, BLOCK=block)
        self.layers = _collect_layers(field)
        self.segments = segment_sizes(self.o, self.n)
        self.blocks = sum(self.segments) // ROWS

    def __call__(self, state: BodyState, t: Tensor | float) -> BodyState:
        drifted = self._drift(state)
        lists = self._contacts(drifted)
        messages = self._messages(lists)
        wrench = None
        if self.external.object.shape[1]:
            positions, com = drifted.points[:, :, :3].mT, drifted.body[..., :3].contiguous()
            wrench = velocity_update.ExternalWrench(*self.external.wrench(positions, com, t, self.inputs.dt))
        return self._update(drifted, lists, messages, wrench)

    def _new(self, *shape: int) -> Tensor:
        return self.inputs.arm.new_empty(self.b, self.o, *shape)

    def _count(self, *shape: int) -> Tensor:
        return torch.empty(self.b, self.o, *shape, dtype=torch.int32, device=self.inputs.arm.device)

    def _drift(self, state: BodyState) -> bodies.Kinematics:
        widths = bodies.POINT_SIZE.value, bodies.FIELD_SIZE.value, 2
        drifted = bodies.Kinematics(self._new(bodies.BODY_SIZE.value), *(self._new(k, self.n) for k in widths),
                                    self.o, self.n, self.inputs.BLOCK)  # fmt: skip
        state = BodyState(*(x.contiguous() for x in state))
        bodies.drift_half_step[(self.objects,)](state, self.inputs, drifted, CONSTANTS, num_warps=8)
        return drifted

    def _contacts(self, drifted: bodies.Kinematics) -> broad_phase.ContactLists:
        n, m, kinds = self.n, self.o - 1, self.o + 1
        candidates = broad_phase.NearPoints(
            position=self._new(m, 3, n), which=self._count(m, n), count=self._count(m), key=self._new(m, n),
            partner=self._count(m, n),
        )  # fmt: skip
        if m:
            broad_phase.gather_candidates[(self.objects, m)](
                self.inputs.valid, drifted, candidates, CONSTANTS, num_warps=8
            )
            blocks = triton.cdiv(n, broad_phase.QUERY_BLOCK.value)
            broad_phase.nearest_candidates[(self.objects * m, blocks)](drifted, candidates, CONSTANTS)
        *others, floor, narrow = self.segments
        slots, wide = sum(self.segments), others[0] if others else floor
        padded = [tl.constexpr(triton.next_power_of_2(k // ROWS)) for k in (floor, floor + narrow)]
        lists = broad_phase.ContactLists(
            count=self._count(kinds), point=self._count(slots), partner=self._count(slots),
            record=self._new(slots * contact_features.COLUMNS.value), acceleration=self._new(kinds, 3, n),
            wide=wide, narrow=narrow, slots=slots, o=self.o, n=n, FLOOR_BLOCKS=padded[0], PLANE_BLOCKS=padded[1],
        )  # fmt: skip
        broad_phase.select_contacts[(self.objects, kinds)](
            self.inputs.valid, drifted, candidates, lists, CONSTANTS, num_warps=8
        )
        contact_features.contact_features[(self.objects, self.blocks)](
            self.inputs, drifted, lists, CONSTANTS, num_warps=2
        )
        return lists

    def _messages(self, lists: broad_phase.ContactLists) -> contact_messages.Messages:
        kinds, slots, h = self.o + 1, lists.slots, self.layers.status.H.value
        messages = contact_messages.Messages(
            offset=self._new(kinds + 1, h), message=self._new(slots, h), weight=self._new(slots),
            block_sum=self._new(self.blocks, h), block_weight=self._new(self.blocks), mean=self._new(kinds, h),
            scale=self._new(kinds), status=self._new(h), friction=self._new(), context=self._new(kinds, h),
            wrenches=self._new(self.blocks, bodies.WRENCH_SIZE.value),
        )  # fmt: skip
        of_objects, of_lists, of_blocks = (self.objects,), (self.objects, kinds), (self.objects, self.blocks)
        embeddings = self.objects, kinds + 1
        embedding, layers = self.inputs.embedding, self.layers
        contact_messages.project_embeddings[embeddings](embedding, self.o, layers.embeddings, messages.offset)
        contact_messages.encode_messages[of_blocks](lists, layers.encoder, messages)
        contact_messages.aggregate_messages[of_objects](
            embedding, lists, layers.status, messages, CONSTANTS, num_warps=8
        )
        contact_messages.update_contacts[of_lists](self.o, layers.context, messages)
        contact_messages.decode_forces[of_blocks](lists, layers.decoder, messages, CONSTANTS)
        return messages

    def _update(
        self, drifted: bodies.Kinematics, lists: broad_phase.ContactLists, messages: contact_messages.Messages,
        wrench: velocity_update.ExternalWrench | None,
    ) -> BodyState:  # fmt: skip
        n, inputs = self.n, self.inputs
        new = BodyState(*(self._new(width) for width in (3, 4, 3, 3)), self._new(n, 3), self._new(n, 3))
        halves = (torch.empty(self.b, self.o, 9, n, dtype=torch.float16, device=inputs.arm.device) for _ in range(2))
        split = velocity_update.SplitFields(*halves, self._new(9))
        velocity_update.update_velocities[(self.objects,)](
            inputs, drifted, lists, messages, wrench, new, split, CONSTANTS, num_warps=8
        )
        weights = self.scene.shape.blur.flatten(0, 1).flatten(1, 2)
        averages = skinny_matmul.split_matmul(weights, split.high.flatten(0, 1), split.low.flatten(0, 1))
        blocks = triton.cdiv(n, ROWS)
        of_blocks = self.objects, blocks
        record = self._new(blocks, deformation_features.FEATURE_COLUMNS.value, ROWS)
        acceleration = self._new(3, n)
        deformation_features.deformation_features[of_blocks](inputs, drifted, averages, split.unit, record, num_warps=2)
        deformation_features.internal_accelerations[of_blocks](
            inputs, record, self.layers.deformation, messages.offset, acceleration, CONSTANTS
        )
        velocity_update.update_displacements[(self.objects,)](
            inputs, drifted, acceleration, new, CONSTANTS, num_warps=8
        )
        return new
