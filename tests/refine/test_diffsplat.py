"""The completer "diffsplat", with true output maps instead of the network, and with random weights."""

import logging
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from stages.core.errors import InputError
from stages.core.geometry.cameras import intrinsics
from stages.core.geometry.harmonics import C0
from stages.core.geometry.rotations import matrix
from stages.core.geometry.similarity import Similarity
from stages.core.models.diffsplat.maps import FOCAL, RADIUS, SCALES, cameras, to_gaussians
from stages.core.perception.observed_space import ObservedSpace
from stages.core.raster.rasterise import rasterise
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.scene_ply import read_scene, write_scene
from stages.evaluate.scenes import nearest_neighbours
from stages.lab.assets.shapes import ellipsoid
from stages.refine import diffsplat
from stages.refine.library import opaque_gaussians, transformed
from stages.refine.object_crop import crop_object
from stages.refine.options import RefineOptions
from stages.refine.registration import register
from stages.refine.registration_cloud import RegistrationCloud
from stages.refine.stage import refine, run
from tests.refine.sample_objects import asymmetric_object
from tests.segment.tabletop import coloured_gaussians, scene_of, table_gaussians

SIDE = 128
pytestmark = pytest.mark.usefixtures("device")
PLACE = Similarity(0.3, matrix(torch.tensor([0.9, 0.0, 0.0, 0.4])), torch.tensor([0.02, -0.03, 0.04]))
# includes a rotation by 5 degrees
OFF = Similarity(0.94, matrix(torch.tensor([1.0, 0.02, -0.03, 0.02])), torch.tensor([0.03, -0.02, 0.03]))


@pytest.fixture(scope="module")
def truth() -> Gaussians:
    return transformed(asymmetric_object(), PLACE)


@pytest.fixture(scope="module")
def seen(truth) -> Scene:
    """The visible part of an object on a table for three cameras on one side."""
    scene = scene_of(table_gaussians(0.02), truth)
    scene = replace(scene, cameras=scene.cameras[:3], objects=(SceneObject(1, "toy_thing"),))
    g = scene.gaussians
    return replace(scene, gaussians=g[(ObservedSpace.of(scene).weight > 0.02) | (g.object_id == 0)])


def maps_of(g: Gaussians, elevation: float) -> torch.Tensor:
    """The output maps of a perfect network: colour and depth rendered from DiffSplat's cameras."""
    viewmats = cameras(elevation)
    # the pixel centres in the corners are the corners of the image
    K = intrinsics(SIDE, SIDE, FOCAL * (SIDE - 1)).expand(4, 3, 3)
    drawn = rasterise(g, viewmats, K, SIDE, SIDE)
    maps = torch.zeros(4, 12, SIDE, SIDE)
    maps[:, :3] = 2 * drawn.rgb.permute(0, 3, 1, 2) / drawn.alpha[:, None].clamp_min(0.5) - 1
    maps[:, 3:6] = 2 * (SCALES[1] - 0.006) / (SCALES[1] - SCALES[0]) - 1
    maps[:, 6] = 1
    maps[:, 10] = torch.where(drawn.alpha > 0.9, 0.9, -1.0)
    maps[:, 11] = drawn.depth - RADIUS
    return maps.clamp(-1, 1)


@pytest.fixture(scope="module")
def perfect(seen, truth):
    """Replaces the network; returns the true object, slightly displaced from the pose of the crop's camera."""
    place = crop_object(seen, opaque_gaussians(seen, 1), SIDE).place
    R = place.rotation.mT
    back = Similarity(1 / place.scale, R, -(R @ place.translation) / place.scale)

    def generate(image, elevation, prompt, seed):
        assert image.shape == (SIDE, SIDE, 3) and prompt == "toy thing"
        return to_gaussians(maps_of(transformed(transformed(truth, back), OFF), elevation), cameras(elevation))

    return SimpleNamespace(side=SIDE, generate=generate)


@pytest.fixture(scope="module")
def whole(seen, perfect, device) -> Scene:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(diffsplat, "_model", lambda *_: perfect)
        return refine(seen, RefineOptions(completer="diffsplat", background=False, keep_raw=True, device=device))


def test_unseen_side_is_completed(seen, whole, truth):
    all_round = scene_of(table_gaussians(0.02), truth)
    outside = all_round.gaussians.means[
        (ObservedSpace.of(all_round).weight > 0.02) & (all_round.gaussians.object_id == 1)
    ]
    before, after = (s.gaussians.means[s.gaussians.object_id == 1] for s in (seen, whole))
    far = [nearest_neighbours(outside, points).distance for points in (before, after)]
    assert far[1].mean() < 0.3 * far[0].mean() and far[1].mean() < 0.02 * PLACE.scale
    assert nearest_neighbours(after, truth.means).distance.quantile(0.95) < 0.02 * PLACE.scale


def test_completed_colours_match_the_object(whole, truth):
    g = whole.gaussians[whole.gaussians.object_id == 1]
    index = nearest_neighbours(g.means, truth.means).index
    error = (g.sh[:, 0] - truth.sh[index, 0]).abs().mean(1) * C0
    assert error.median() < 0.05


def test_keep_raw_adds_the_uncompleted_object(seen, whole):
    assert [o.name for o in whole.objects] == ["toy_thing", "toy_thing (raw)"]
    counts = [int((whole.gaussians.object_id == i).sum()) for i in (1, 2)]
    assert counts[0] > counts[1] > 100


def test_registration_of_a_featureless_object_with_a_hint():
    """The part of a plain cylinder has no features to match; it is found close to a hint."""
    plain = coloured_gaussians(ellipsoid((0.2, 0.3, 0.5), 8000), (0.5, 0.5, 0.5), 1, grain=0.0)
    there = Similarity(0.4, matrix(torch.tensor([0.8, 0.2, -0.3, 0.1])), torch.tensor([0.2, 0.1, 0.3]))
    part = transformed(plain, there)[plain.means[:, 0] > -0.05]
    near = Similarity(0.4 * 1.05, there.rotation @ OFF.rotation, there.translation + 0.01)
    found = register(part, plain, hints=[near])
    assert found.similarity.scale == pytest.approx(0.4, rel=0.03)
    assert (found.similarity(plain.means) - there(plain.means)).norm(dim=1).mean() < 0.02 * RegistrationCloud.of(
        part
    ).diameter


def test_missing_weights_are_reported(seen, tmp_path, monkeypatch):
    monkeypatch.setenv("NGFF_WEIGHTS", str(tmp_path / "none"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    write_scene(tmp_path / "scene.ply", seen)
    with pytest.raises(InputError, match="chenguolin/DiffSplat"):
        run(tmp_path / "scene.ply", tmp_path / "out.ply", RefineOptions(completer="diffsplat"))
    with pytest.raises(InputError, match="cswry/OSEDiff"):
        run(tmp_path / "scene.ply", tmp_path / "out.ply", RefineOptions(completer="diffsplat", upscale="osediff"))
    assert not (tmp_path / "out.ply").exists()
    with pytest.raises(InputError, match="--completer diffsplat"):
        RefineOptions(photos=tmp_path)


def test_upscaling_needs_the_generator():
    with pytest.raises(InputError, match="--upscale: only works with --completer diffsplat"):
        RefineOptions(upscale="osediff")
    with pytest.raises(InputError, match="--upscale x2: choose from none, osediff"):
        RefineOptions(completer="diffsplat", upscale="x2")


@pytest.mark.slow
def test_output_of_random_weights_is_rejected(seen, tmp_path, caplog, monkeypatch):
    """Random weights in the published layouts, with both loaders, OSEDiff, a sampler with fewer steps, and fits."""
    pytest.importorskip("diffusers")
    pytest.importorskip("transformers")
    from stages.core.models.diffsplat import network
    from tests.core.models.diffsplat.tiny_model import save_tiny_model
    from tests.core.models.osediff.tiny_model import save_tiny_osediff

    monkeypatch.setattr(network, "STEPS", 3)
    monkeypatch.setattr(diffsplat, "RESTORED_SIDE", 100)
    write_scene(tmp_path / "scene.ply", seen)
    with caplog.at_level(logging.INFO):
        weights = save_tiny_osediff(save_tiny_model(tmp_path / "weights"))
        options = RefineOptions(completer="diffsplat", upscale="osediff", weights=weights, background=False)
        run(tmp_path / "scene.ply", tmp_path / "out.ply", options)
    assert "restored by osediff at 100 pixels" in caplog.text
    assert "unchanged" in caplog.text and "the object generated from" in caplog.text
    before, after = (int((s.gaussians.object_id == 1).sum()) for s in (seen, read_scene(tmp_path / "out.ply")))
    assert after <= before
