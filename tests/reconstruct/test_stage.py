"""Complete reconstructions, from photos/ to scene.ply."""

import contextlib
import dataclasses
import io
import json
import logging
from pathlib import Path
from typing import NamedTuple

import pytest
import torch

from stages.core.errors import InputError
from stages.core.geometry.cameras import centres
from stages.core.scene.cameras import Cameras
from stages.core.scene.scene import Scene
from stages.core.scene.scene_ply import read_scene
from stages.reconstruct import depth, features, photometric
from stages.reconstruct.options import QUALITY_PRESETS, ReconstructOptions
from stages.reconstruct.stage import Report, run
from tests.reconstruct.raycast import BLOCK, arc, photograph, write_set


class Run(NamedTuple):
    """A complete run and its reports."""

    folder: Path  # folder of the photo set
    options: ReconstructOptions
    report: Report
    scene: Scene
    stdout: str
    log: str


def reconstruct_set(folder: Path, cameras: Cameras, preset: dict, **options) -> Run:
    """Reconstruct a ray-cast set with its true cameras, using a reduced draft preset."""
    chosen = ReconstructOptions(cameras=write_set(folder, cameras), quality="draft", **options)
    log, stdout = io.StringIO(), io.StringIO()
    handler, logger = logging.StreamHandler(log), logging.getLogger("stages")
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(stdout):
        patch.setitem(QUALITY_PRESETS, "draft", dataclasses.replace(QUALITY_PRESETS["draft"], **preset))
        level = logger.level
        logger.setLevel(logging.INFO)
        logger.addHandler(handler)
        try:
            report = run(folder / "images", folder / "scene.ply", chosen)
        finally:
            logger.removeHandler(handler)
            logger.setLevel(level)
    return Run(folder, chosen, report, read_scene(folder / "scene.ply"), stdout.getvalue(), log.getvalue())


pytestmark = pytest.mark.usefixtures("device")
SMALL = {"gaussians": 2000, "iterations": 5, "iterations_cuda": 5}


@pytest.fixture(scope="module")
def made(tmp_path_factory, device) -> Run:
    """A run with seven photos, every third one held out, with enough iterations for a test of its quality."""
    preset, cameras = {"gaussians": 6000, "iterations": 120, "iterations_cuda": 120}, arc(7, (160, 120), sweep=70.0)
    return reconstruct_set(tmp_path_factory.mktemp("set"), cameras, preset, holdout=3, device=device)


@pytest.fixture(scope="module")
def small(tmp_path_factory, device) -> Run:
    """A run with four small photos, a scale reference and very few iterations."""
    reference = "photos=photo_00.png,photo_03.png distance=0.25"
    cameras = arc(4, (96, 72), sweep=40.0)
    folder = tmp_path_factory.mktemp("small")
    return reconstruct_set(folder, cameras, SMALL, scale_reference=reference, device=device)


@pytest.fixture
def small_preset(monkeypatch):
    """Reduce the draft preset so that a run takes seconds."""
    monkeypatch.setitem(QUALITY_PRESETS, "draft", dataclasses.replace(QUALITY_PRESETS["draft"], **SMALL))


def test_table_is_horizontal_at_zero(made):
    scene = made.scene
    assert scene.floor == 0.0
    outside = (scene.gaussians.means[:, :2].norm(dim=1) > 0.45) & (scene.gaussians.means[:, :2].norm(dim=1) < 0.9)
    assert scene.gaussians.means[outside, 2].abs().median() < 0.006  # at a distance of 1.6, matched to 1/4 of a pixel


def test_up_and_floor_agree_with_the_truth(made):
    from stages.lab.bench.reconstruct import upright_error

    scene = made.scene
    tilt, floor = upright_error(scene.cameras, arc(7, (160, 120), sweep=70.0), scene.floor, 0.0)
    assert tilt < 0.5 and floor < 0.3  # in degrees and % of the scene's size


def test_block_has_its_size(made):
    scene = made.scene
    means = scene.gaussians.means
    top = ((means[:, 2] - BLOCK[2]).abs() < 0.03) & (means[:, :2].norm(dim=1) < 0.45)
    assert top.sum() > 100
    side = (means[top, :2].quantile(0.95, dim=0) - means[top, :2].quantile(0.05, dim=0)).sort().values
    # 9/10 of the two sides, at any rotation about the vertical
    assert 0.3 < float(side[0]) < 0.6 and 0.35 < float(side[1]) < 0.7


def test_given_cameras_keep_scale_and_names(made):
    scene = made.scene
    assert scene.cameras.names == tuple(f"photo_{i:02d}.png" for i in range(7))
    eyes, true = centres(scene.cameras.viewmats), centres(arc(7, sweep=70.0).viewmats)
    torch.testing.assert_close(torch.pdist(eyes), torch.pdist(true), rtol=1e-4, atol=1e-4)
    assert "transforms.json" in scene.scale["source"] and not scene.has_known_scale


def test_held_out_photos_are_rendered_well(made):
    from stages.core.scene.images import read_image
    from stages.reconstruct.photometric import score_views
    from stages.reconstruct.photos import Views

    folder, scene = made.folder, made.scene
    images = tuple((read_image(folder / "images" / n) * 255).round().to(torch.uint8) for n in scene.cameras.names)
    views = Views(images, scene.cameras)
    held, _ = score_views(scene.gaussians, views, [3], background=scene.background)
    assert held > 19
    mean = torch.stack([image.float().mean((0, 1)) / 255 for image in images]).mean(0)
    assert scene.background == pytest.approx(mean.tolist(), abs=0.02)
    assert scene.provenance["options"]["holdout"] == 3


def test_held_out_photos_are_reported_on_stdout(made):
    assert made.stdout.startswith("held-out photos: 3  PSNR ") and len(made.stdout.splitlines()) == 1
    assert "7 of 7 photos" in made.log


def test_cameras_of_other_photos_are_refused(tmp_path):
    write_set(tmp_path / "one", arc(3, (64, 48)))
    cameras = write_set(tmp_path / "two", arc(3, (64, 48)))
    cameras.write_text(cameras.read_text().replace("photo_", "other_"))
    with pytest.raises(InputError, match=r"transforms.json: names 0 of the photos.*photo_00.png"):
        run(tmp_path / "one" / "images", tmp_path / "s.ply", ReconstructOptions(cameras=cameras))
    assert not (tmp_path / "s.ply").exists()


def test_cameras_of_photos_that_were_not_yet_upright_are_refused(tmp_path):
    cameras = write_set(tmp_path, arc(3, (64, 48)))
    cameras.write_text(json.dumps(json.loads(cameras.read_text()) | {"w": 48, "h": 64}))
    with pytest.raises(InputError, match=r"photo_00.png has 48x64 pixels, but upright the photo has 64x48"):
        run(tmp_path / "images", tmp_path / "s.ply", ReconstructOptions(cameras=cameras))


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"quality": "best"}, "draft, normal, high"),
        ({"holdout": 1}, "2 or more"),
        ({"resolution": 8}, "64 to 4096"),
        ({"iterations": 10**9}, "or up to 1000000"),
    ],
)
def test_invalid_options(wrong, words):
    with pytest.raises(InputError, match=words):
        ReconstructOptions(**wrong)


@pytest.mark.slow
def test_real_photos_are_all_placed(shared):
    """The published number for this set is also 11 of 11."""
    from stages.reconstruct.photo_reader import read_photos
    from stages.reconstruct.sfm import estimate_cameras

    model = estimate_cameras(read_photos(shared / "data" / "photos" / "kermit" / "images"))
    assert len(model.cameras) == 11
    assert len(model.points) > 500


def test_interrupted_run_resumes_from_finished_steps(small, small_preset, tmp_path, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    def repeated(*_, **__):
        pytest.fail("a finished step is computed again")

    photos, out = small.folder / "images", tmp_path / "s.ply"
    with monkeypatch.context() as patch:
        patch.setattr(photometric, "fit_gaussians", interrupt)
        with pytest.raises(KeyboardInterrupt):
            run(photos, out, small.options)
    kept = tmp_path / ".steps-s.ply"
    assert {p.name for p in kept.iterdir()} == {"key", "features.pt", "matches.db", "depth.pt"}
    with monkeypatch.context() as patch:
        patch.setattr(features, "extract", repeated)
        patch.setattr(features, "match_descriptors", repeated)
        patch.setattr(depth, "estimate_depth_maps", repeated)
        report = run(photos, out, dataclasses.replace(small.options, resume=True))
    assert not kept.exists() and "depth" not in report.seconds
    torch.testing.assert_close(read_scene(out).gaussians.means, small.scene.gaussians.means, rtol=0, atol=1e-5)


def test_input_error_leaves_no_files(small, small_preset, tmp_path):
    for names, words in (
        ("photo_00.png,x.png", "no camera of x.png"),
        ("photo_00.png,photo_00.png", "the same position"),
    ):
        wrong = dataclasses.replace(small.options, scale_reference=f"photos={names} distance=1")
        with pytest.raises(InputError, match=words):
            run(small.folder / "images", tmp_path / "s.ply", wrong)
    assert not list(tmp_path.iterdir())


def test_mixed_formats_sizes_and_unicode_names(small_preset, tmp_path):
    # landscape and portrait, large and small, grey, CMYK, rotated by EXIF; photos of three unknown cameras
    Image = pytest.importorskip("PIL.Image")
    folder = tmp_path / "Küche 写真 № 1"
    folder.mkdir()
    wide, tall = arc(6, (320, 240), sweep=50.0), arc(6, (240, 320), sweep=50.0)
    for i in range(6):
        pixels = (photograph(tall if i == 5 else wide, i)[0] * 255).round().byte().numpy()
        image, exif = Image.fromarray(pixels), Image.Exif()
        if i == 1:
            image = image.convert("L")
        elif i == 2:
            image = image.convert("CMYK")
        elif i == 3:
            exif[0x0112], image = 6, image.rotate(90, expand=True)
        elif i == 4:
            image = image.resize((400, 300), Image.LANCZOS)
        image.save(folder / f"foto {i} ä.jpg", quality=95, exif=exif)
    out = tmp_path / "scène 1.ply"
    report = run(folder, out, ReconstructOptions(quality="draft", resolution=128))
    assert report.placed == 6 and {p.name for p in tmp_path.iterdir()} == {folder.name, out.name}
    scene = read_scene(out)
    assert scene.cameras.names == tuple(f"foto {i} ä.jpg" for i in range(6))
    assert scene.cameras.sizes.tolist() == [[128, 96]] * 5 + [[96, 128]]
    assert scene.cameras.photos.sizes.tolist() == [*[[320, 240]] * 4, [400, 300], [240, 320]]


@pytest.mark.parametrize("source", ["transforms.json", "COLMAP"])
def test_lens_of_given_cameras_is_stored(small_preset, tmp_path, source):
    pycolmap = pytest.importorskip("pycolmap")

    true = arc(4, (96, 72), sweep=40.0)
    path, lens = write_set(tmp_path, true), {"k1": 0.01, "k2": -0.004, "p1": 0.0005, "p2": 0.001}
    if source == "COLMAP":
        K, model, path = true.Ks[0].tolist(), pycolmap.Reconstruction(), tmp_path / "model"
        params = [K[0][0], K[1][1], K[0][2], K[1][2], *lens.values()]
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(model="OPENCV", width=96, height=72, params=params, camera_id=1)
        )
        for i, (name, viewmat) in enumerate(zip(true.names, true.viewmats, strict=True), start=1):
            image = pycolmap.Image(name=name, camera_id=1, image_id=i)
            model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(viewmat[:3].double().numpy()))
        path.mkdir()
        model.write(str(path))
    else:
        path.write_text(json.dumps({**json.loads(path.read_text()), **lens}))
    run(tmp_path / "images", tmp_path / "s.ply", ReconstructOptions(cameras=path, quality="draft", resolution=64))
    cameras = read_scene(tmp_path / "s.ply").cameras
    assert cameras.sizes.tolist() == [[64, 48]] * 4 and cameras.photos.sizes.tolist() == [[96, 72]] * 4
    torch.testing.assert_close(cameras.photos.Ks, true.Ks)
    torch.testing.assert_close(cameras.photos.distortion, torch.tensor([[*lens.values(), 0]]).expand(4, 5))


def test_scale_reference_gives_metres(small):
    eyes = centres(small.scene.cameras.viewmats)
    assert float((eyes[0] - eyes[3]).norm()) * small.scene.metres_per_unit == pytest.approx(0.25, rel=1e-4)
    assert small.options.scale_reference in small.scene.scale["source"] and small.scene.has_known_scale


def test_report_and_advice(small):
    report = small.report
    assert "peak memory" in small.log and "to improve the scene: 4 photos are few" in small.log
    assert any("between photo_00.png and photo_03.png" in sentence for sentence in report.advice)
    assert report.placed == report.photos == 4 and report.held_out is None and report.memory > 0.1
