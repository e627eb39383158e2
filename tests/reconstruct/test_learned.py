"""Learned backends: the steps after the network, with true geometry as its output; and complete small runs."""

import dataclasses
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import save_file

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.geometry.cameras import centres
from stages.core.geometry.similarity import umeyama
from stages.core.models.pi3.network import Pi3, halve
from stages.core.models.pi3.splat import Pi3Splat
from stages.core.scene.scene_ply import read_scene
from stages.reconstruct import learned
from stages.reconstruct import options as choices
from stages.reconstruct.learned import NetworkOutput
from stages.reconstruct.options import ReconstructOptions
from stages.reconstruct.photometric import score_views
from stages.reconstruct.stage import run
from stages.reconstruct.step_cache import StepCache
from tests.core.models.pi3.test_network import TINY, random_weights
from tests.core.models.pi3.test_splat import TINY_SPLAT
from tests.reconstruct.oracle import photos_of, true_splats, truth
from tests.reconstruct.raycast import BLOCK, arc, write_set

pytestmark = pytest.mark.usefixtures("device", "one_thread")
SIZE = (112, 84)  # multiples of the patch size, so that photos are not resized


@pytest.fixture(autouse=True)
def small(monkeypatch):
    draft = dataclasses.replace(choices.QUALITY_PRESETS["draft"], gaussians=5000, iterations=40)
    monkeypatch.setitem(choices.QUALITY_PRESETS, "draft", draft)


def assembled(tmp_path, count=4, splats=False, noise=0.0, **given):
    """A scene assembled from true geometry in an arbitrary frame and unit, and the true cameras."""
    cameras = arc(count, SIZE, sweep=70.0)
    photos, geometry = photos_of(cameras, tmp_path), truth(cameras, scale=3.7)
    if noise:  # smooth errors, such as those of networks
        coarse = noise * torch.randn(count, 1, 6, 8, generator=torch.Generator().manual_seed(3))
        factor = 1 + F.interpolate(coarse, geometry.points.shape[1:3], mode="bicubic")[:, 0]
        geometry = dataclasses.replace(geometry, points=geometry.points * factor[..., None])
    raw = true_splats(photos, SIZE, geometry, float(cameras.Ks[0, 0, 0])) if splats else None
    options = ReconstructOptions(**{"quality": "draft", **given})
    output, device = NetworkOutput(geometry, raw), pick_device(options.device)
    return learned.assemble(photos, list(photos.images), output, options, StepCache(), device), cameras


def to_truth(made, cameras):
    """Similarity from the scene to the true world, defined by the camera centres."""
    return umeyama(centres(made.scene.cameras.viewmats), centres(cameras.viewmats))


def surface_error(points: torch.Tensor) -> torch.Tensor:
    """Distance of points from the table or the block on it."""
    a, b, top = BLOCK
    outside = (points[:, :2].abs() - torch.tensor([a, b])).clamp_min(0).norm(dim=1)
    block = torch.hypot(outside, (points[:, 2] - top).clamp_min(0))
    inside = torch.stack([a - points[:, 0].abs(), b - points[:, 1].abs(), top - points[:, 2]]).abs().amin(0)
    return torch.minimum(torch.where(block > 0, block, inside), points[:, 2].abs())


@pytest.mark.parametrize("options", [
    {"weights": Path("a")}, {"download": True}, {"backend": "pi3", "matcher": "aliked-lightglue"},
])  # fmt: skip
def test_options_of_another_backend_are_refused(options):
    with pytest.raises(InputError, match="only works? with --backend"):
        ReconstructOptions(**options)


@pytest.mark.parametrize("splats", [False, True], ids=["pi3", "pi3-splat"])
def test_true_geometry_gives_the_true_scene(tmp_path, splats):
    made, cameras = assembled(tmp_path, splats=splats, iterations=0)
    back = to_truth(made, cameras)
    assert surface_error(back(made.scene.gaussians.means)).quantile(0.9) < 0.02
    torch.testing.assert_close(back(centres(made.scene.cameras.viewmats)), centres(cameras.viewmats), atol=1e-3, rtol=0)
    torch.testing.assert_close(made.scene.cameras.Ks, cameras.Ks, rtol=2e-3, atol=0.1)
    up = back.rotation @ torch.tensor([0.0, 0, 1])
    assert up[2] > 0.9998  # tilt of at most one degree
    assert abs(float(back(torch.zeros(1, 3))[0, 2])) < 0.01  # the floor is the table
    assert score_views(made.scene.gaussians, made.views, made.trained)[0] > 17  # an image of the mean colour has 12.6


def test_fit_improves_held_out_views_under_two_percent_noise(tmp_path):
    plain, cameras = assembled(tmp_path, noise=0.02, iterations=0, holdout=3)
    fitted, _ = assembled(tmp_path, noise=0.02, iterations=60, holdout=3)
    assert plain.held_out == [0, 3]
    before, after = (score_views(made.scene.gaussians, made.views, made.held_out)[0] for made in (plain, fitted))
    assert after > before + 0.5
    assert surface_error(to_truth(fitted, cameras)(fitted.scene.gaussians.means)).median() < 0.03


def test_one_photo_is_enough(tmp_path):
    made, cameras = assembled(tmp_path, count=1, iterations=0, holdout=3)
    assert made.trained == [0] and not made.held_out
    scale = 1.6 / float(centres(made.scene.cameras.viewmats)[0].norm())
    assert float(centres(made.scene.cameras.viewmats)[0, 2]) * scale == pytest.approx(
        float(centres(cameras.viewmats)[0, 2]), rel=0.1
    )  # the same height above the table
    assert score_views(made.scene.gaussians, made.views, [0])[0] > 17


def test_no_floor_without_a_supporting_plane(tmp_path, monkeypatch):
    assert assembled(tmp_path, count=2, iterations=0)[0].scene.floor == 0.0
    monkeypatch.setattr(
        "stages.reconstruct.world_frame.PLANE_CRITERIA", ((0.5, 2.0), (0.05, 2.0))
    )  # no plane is accepted
    made, _ = assembled(tmp_path, count=2, iterations=0)
    assert made.scene.floor is None
    assert any("no table or floor" in sentence for sentence in made.advice)


def test_merged_gaussians_look_like_the_original_ones(tmp_path):
    many, _ = assembled(tmp_path, count=2, splats=True, iterations=0, quality="high")
    few, _ = assembled(tmp_path, count=2, splats=True, iterations=0)
    assert len(few.scene.gaussians) <= 1.25 * 5000 < len(many.scene.gaussians)
    loss = score_views(many.scene.gaussians, many.views, [1])[0] - score_views(few.scene.gaussians, few.views, [1])[0]
    assert loss < 1


@pytest.mark.parametrize("name", ["pi3", "pi3-splat"])
@pytest.mark.parametrize("count", [1, 3])
def test_complete_runs_with_a_tiny_network(tmp_path, monkeypatch, name, count):
    """Random weights give a meaningless scene, but all steps run: reading photos, weights, network, scene.ply."""
    write_set(tmp_path, arc(count, (170, 120)))
    model = random_weights(Pi3(TINY) if name == "pi3" else Pi3Splat(TINY_SPLAT), size=0.05)
    point_head = getattr(model.encoder, "point_head", None) or model.point_head
    point_head.proj.weight.data *= 0.01  # so that neighbouring pixels have nearly the same depth
    point_head.proj.bias.data *= 0.01
    save_file(model.state_dict(), tmp_path / f"{name}.safetensors")
    monkeypatch.setenv("NGFF_WEIGHTS", str(tmp_path))
    options = ReconstructOptions(backend=name, quality="draft", iterations=3)
    report = run(tmp_path / "images", tmp_path / "s.ply", options)
    scene = read_scene(tmp_path / "s.ply")
    assert report.placed == count == len(scene.cameras) and len(scene.gaussians) > 0
    assert scene.gaussians.means.isfinite().all() and scene.floor == 0.0
    assert scene.provenance["options"]["backend"] == name
    assert scene.cameras.photos.sizes.tolist() == [[170, 120]] * count  # the views are their central parts


def test_errors_for_missing_weights_and_given_cameras(tmp_path, monkeypatch):
    monkeypatch.setenv("NGFF_WEIGHTS", str(tmp_path / "none"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "none"))
    cameras = write_set(tmp_path, arc(2, (64, 48)))
    for options, words in (
        (ReconstructOptions(backend="pi3"), "no weights in .*huggingface.co/yyfz233/Pi3"),
        (ReconstructOptions(backend="pi3-splat", weights=tmp_path / "w.pth", download=True), "w.pth: no such file"),
        (ReconstructOptions(backend="pi3", cameras=cameras), "--cameras: --backend pi3 estimates the cameras"),
    ):
        with pytest.raises(InputError, match=words):
            run(tmp_path / "images", tmp_path / "s.ply", options)
    assert not (tmp_path / "s.ply").exists()


@torch.no_grad()
def test_bf16_is_close_to_fp32():
    """Runs the precision that is used on a GPU on the CPU."""
    model = random_weights(Pi3(TINY), size=0.1)
    images = torch.rand(3, 3, 56, 42, generator=torch.Generator().manual_seed(0))
    exact = model(images)
    with torch.autocast("cpu", torch.bfloat16):
        coarse = model(images)
        again = halve(model)(images)
    torch.testing.assert_close(again.points, coarse.points)
    assert model.camera_head.fc_t.weight.dtype == torch.float32 != model.decoder[0].mlp.fc1.weight.dtype
    assert coarse.points.dtype == coarse.poses.dtype == torch.float32
    torch.testing.assert_close(coarse.points, exact.points, rtol=0.1, atol=0.1)
    torch.testing.assert_close(coarse.poses, exact.poses, rtol=0.1, atol=0.1)
