"""π³: components compared with recorded outputs of the published code, names in the state dict, and invariances."""

import pytest
import torch

from stages.core.models.pi3.config import Pi3Config
from stages.core.models.pi3.dinov2 import REGISTERS, DinoV2
from stages.core.models.pi3.heads import CameraHead, LinearMap, TransformerDecoder, local_points, orthogonal
from stages.core.models.pi3.layers import ViTBlock
from stages.core.models.pi3.network import CAMERA_REGISTERS, Pi3, alternate
from stages.core.models.pi3.rope import patch_positions, rotary_embedding, rotate
from tests.core.models.pi3.recordings import CLOSE

TINY = Pi3Config(width=32, head=16, encoder_depth=2, decoder_depth=4, head_depth=1, camera_width=16, table=4)
assert_close = torch.testing.assert_close


def random_weights(model: torch.nn.Module, seed: int = 0, size: float = 0.2) -> torch.nn.Module:
    """Replace all parameters by random values, so that every one affects the output."""
    generator = torch.Generator().manual_seed(seed)
    for parameter in model.parameters():
        parameter.data = size * torch.randn(parameter.shape, generator=generator)
    return model.eval()


def views(count: int = 3, size: tuple[int, int] = (28, 42)) -> torch.Tensor:
    return torch.rand(count, 3, *size, generator=torch.Generator().manual_seed(1))


def test_names_and_shapes_equal_the_published_ones(manifest):
    with torch.device("meta"):
        model = Pi3()
    assert {name: tuple(x.shape) for name, x in model.state_dict().items()} == manifest("pi3_state_dict")
    assert sum(p.numel() for p in model.parameters()) == 958_696_732


def test_rotary_embedding_equals_recording(recorded):
    inputs, expected, _ = recorded("rope2d")
    assert_close(rotate(inputs["tokens"], rotary_embedding(inputs["positions"], 16)), expected["tokens"], **CLOSE)


@torch.no_grad()
def test_dinov2_equals_recording(recorded):
    inputs, expected, weights = recorded("dinov2_vit_tiny")
    model = DinoV2(32, 8, 2, table=4)
    del weights["mask_token"]  # used in pretraining only; not among the published weights
    model.load_state_dict(weights)
    tokens = model(inputs["images_normalized"])
    assert_close(tokens[:, 0], expected["x_norm_clstoken"], **CLOSE)
    assert_close(tokens[:, 1 : 1 + REGISTERS], expected["x_norm_regtokens"], **CLOSE)
    assert_close(tokens[:, 1 + REGISTERS :], expected["x_norm_patchtokens"], **CLOSE)


@torch.no_grad()
@pytest.mark.parametrize("at_once", [1, 8])
def test_alternating_attention_equals_recording(recorded, at_once):
    inputs, expected, weights = recorded("alternating_attention")
    registers = weights.pop("register_token")[0]
    blocks = torch.nn.ModuleList(ViTBlock(64, 16, normalised=True, scaled=True) for _ in range(4))
    blocks.load_state_dict({name.removeprefix("decoder."): x for name, x in weights.items()})
    scenes, count, height, width = inputs["BNHW"].tolist()
    positions = patch_positions(count, height // 14, width // 14, CAMERA_REGISTERS)
    assert torch.equal(positions.repeat(scenes, 1, 1), expected["pos"])
    for scene, output in zip(inputs["hidden"].split(count), expected["hidden_cat"].split(count), strict=True):
        x = torch.cat([registers.expand(count, -1, -1), scene], 1)
        assert_close(alternate(blocks, x, rotary_embedding(positions, 16), at_once), output, **CLOSE)


@torch.no_grad()
def test_transformer_decoder_equals_recording(recorded):
    inputs, expected, weights = recorded("transformer_decoder")
    model = TransformerDecoder(32, 32, 24, head=16, depth=2)
    model.load_state_dict(weights)
    assert_close(model(inputs["hidden"], rotary_embedding(inputs["xpos"], 16)), expected["out"], **CLOSE)


@torch.no_grad()
def test_local_points_equal_recording(recorded):
    inputs, expected, weights = recorded("linear_pts3d")
    model = LinearMap(16, 3)
    model.load_state_dict(weights)
    raw = model(inputs["tokens"], *(inputs["HW"] // 14).tolist())
    assert_close(raw, expected["raw"], **CLOSE)
    assert_close(local_points(raw), expected["local_points"], **CLOSE)


@torch.no_grad()
def test_camera_poses_equal_recording(recorded):
    inputs, expected, weights = recorded("camera_head")
    model = CameraHead(32)
    model.load_state_dict(weights)
    assert_close(model(inputs["feat"]), expected["pose"], **CLOSE)


def test_orthogonalisation_equals_recording(recorded):
    inputs, expected, _ = recorded("svd_orthogonalize")
    assert_close(orthogonal(inputs["m9"]), expected["rot"], **CLOSE)


@torch.no_grad()
def test_results_are_equivariant_to_the_order_of_photos():
    model = random_weights(Pi3(TINY))
    order = [2, 0, 1]
    original, permuted = model(views()), model(views()[order])
    assert_close(original.points[order], permuted.points, rtol=1e-3, atol=1e-4)
    assert_close(original.poses[order], permuted.poses, rtol=1e-3, atol=1e-4)


@torch.no_grad()
def test_photos_affect_each_other_and_batch_size_does_not_matter():
    model = random_weights(Pi3(TINY))
    joint, single = model(views()), model(views()[:1])
    assert (joint.points[:1] - single.points).abs().max() > 1e-3
    assert single.points.shape == (1, 28, 42, 3) and single.confidence.shape == (1, 28, 42)
    batched = model(views(), at_once=1)
    assert_close(joint.points, batched.points, **CLOSE)
    assert_close(joint.confidence, batched.confidence, **CLOSE)
    assert_close(joint.poses, batched.poses, **CLOSE)


def test_config_is_inferred_from_the_weights():
    assert Pi3Config.of(Pi3(TINY).state_dict()) == TINY
    with pytest.raises(KeyError):
        Pi3Config.of({"conv.weight": torch.zeros(1)})
