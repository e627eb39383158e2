"""Pi3-splat: components and Gaussians, compared with recorded outputs of the published code."""

import dataclasses

import torch

from stages.core.geometry.rotations import covariance
from stages.core.models.pi3.config import Pi3Config
from stages.core.models.pi3.feature_head import FeatureHead
from stages.core.models.pi3.network import Geometry
from stages.core.models.pi3.splat import CHANNELS, Pi3Splat, band_factors, decompose, splat
from tests.core.models.pi3.recordings import CLOSE
from tests.core.models.pi3.test_network import TINY, random_weights, views

TINY_SPLAT = dataclasses.replace(TINY, splat_widths=(16, 16, 8), splat_features=8)
assert_close = torch.testing.assert_close


def test_names_and_shapes_equal_the_published_ones(manifest):
    with torch.device("meta"):
        model = Pi3Splat()
    published = manifest("pi3_splat_state_dict")
    assert {name: tuple(x.shape) for name, x in model.state_dict().items()} == published
    assert len(published) == 1422


@torch.no_grad()
def test_feature_head_equals_recording(recorded):
    inputs, expected, weights = recorded("feature_head")
    model = FeatureHead(16, (16, 16, 8), 8, CHANNELS).eval()
    model.load_state_dict(weights)
    assert_close(model(inputs["tokens"], inputs["imgs"]), expected["gaussian_params"], **CLOSE)


def test_gaussians_equal_recording(recorded):
    inputs, expected, _ = recorded("gaussian_adapter")
    opacities = inputs["opacities"][0]
    raw = torch.cat([opacities.logit()[..., None], inputs["raw"][0]], -1)
    geometry = Geometry(inputs["local_means"][0], torch.ones_like(opacities), inputs["camera_poses"][0])
    gaussians = splat(geometry, raw)
    assert_close(gaussians.means, expected["means"][0], **CLOSE)
    assert_close(covariance(gaussians.quats, gaussians.scales), expected["covariances"][0], **CLOSE)
    assert_close(gaussians.scales, expected["scales_local"][0], **CLOSE)
    assert_close(gaussians.sh.mT, expected["harmonics"][0], **CLOSE)
    assert_close(gaussians.opacities, opacities.flatten(), **CLOSE)
    assert_close(band_factors(), expected["sh_mask"], **CLOSE)


def test_decomposition_of_covariances_equals_recording(recorded):
    inputs, expected, _ = recorded("world_scale_rot")
    scales, quats = decompose(inputs["covariances"][0])
    assert_close(scales, expected["scales"][0], **CLOSE)
    rebuilt = covariance(expected["rotations_wxyz"][0], expected["scales"][0])
    assert_close(covariance(quats, scales), rebuilt, **CLOSE)
    assert (quats[:, 0] >= 0).all()


@torch.no_grad()
def test_geometry_equals_that_of_the_encoder():
    model = random_weights(Pi3Splat(TINY_SPLAT), size=0.1)
    geometry, raw = model(views(), at_once=1)
    assert raw.shape == (3, 28, 42, CHANNELS)
    assert_close(geometry.points, model.encoder(views()).points, **CLOSE)
    assert_close(raw, model(views(), at_once=8)[1], **CLOSE)


def test_config_is_inferred_from_the_weights():
    assert Pi3Config.of(Pi3Splat(TINY_SPLAT).encoder.state_dict()) == TINY_SPLAT
