"""photos/ -> scene.ply, whole."""

import dataclasses
import logging

import pytest
import torch
from PIL import Image

from stages.core.errors import InputError
from stages.core.geometry.cameras import centres
from stages.core.scene.scene_ply import read_scene
from stages.reconstruct import options as choices
from stages.reconstruct.options import ReconstructOptions
from stages.reconstruct.stage import run
from tests.reconstruct.raycast import BLOCK, arc, photograph, write_set


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A ray-cast set with its true cameras, reconstructed small."""
    folder = tmp_path_factory.mktemp("set")
    cameras = write_set(folder, arc(7, (160, 120), sweep=70.0))
    out = folder / "scene.ply"
    small = {"draft": dataclasses.replace(choices.QUALITY_PRESETS["draft"], gaussians=6000, iterations=120)}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(choices, "QUALITY_PRESETS", {**choices.QUALITY_PRESETS, **small})
        run(folder / "images", out, ReconstructOptions(cameras=cameras, holdout=3, quality="draft"))
    return folder, read_scene(out)


def test_the_table_is_level_and_at_zero(made):
    _, scene = made
    assert scene.floor == 0.0
    outside = (scene.gaussians.means[:, :2].norm(dim=1) > 0.45) & (scene.gaussians.means[:, :2].norm(dim=1) < 0.9)
    assert scene.gaussians.means[outside, 2].abs().median() < 0.006  # 1.6 away, matched to a quarter of a pixel


def test_up_and_floor_are_those_of_the_truth(made):
    from stages.lab.bench.reconstruct import upright_error

    _, scene = made
    tilt, floor = upright_error(scene.cameras, arc(7, (160, 120), sweep=70.0), scene.floor, 0.0)
    assert tilt < 0.5 and floor < 0.3  # degrees, % of the scene's size


def test_the_block_stands_there_in_its_size(made):
    _, scene = made
    means = scene.gaussians.means
    top = ((means[:, 2] - BLOCK[2]).abs() < 0.03) & (means[:, :2].norm(dim=1) < 0.45)
    assert top.sum() > 100
    side = (means[top, :2].quantile(0.95, dim=0) - means[top, :2].quantile(0.05, dim=0)).sort().values
    # nine tenths of the two sides, which may have turned about the vertical
    assert 0.3 < float(side[0]) < 0.6 and 0.35 < float(side[1]) < 0.7


def test_given_cameras_keep_scale_and_names(made):
    _, scene = made
    assert scene.cameras.names == tuple(f"photo_{i:02d}.png" for i in range(7))
    eyes, true = centres(scene.cameras.viewmats), centres(arc(7, sweep=70.0).viewmats)
    torch.testing.assert_close(torch.pdist(eyes), torch.pdist(true), rtol=1e-4, atol=1e-4)
    assert "transforms.json" in scene.scale["source"]


def test_photos_kept_out_look_right_too(made, capsys, caplog):
    from stages.core.scene.images import read_image
    from stages.reconstruct.photometric import score_views
    from stages.reconstruct.photos import Views

    folder, scene = made
    images = tuple((read_image(folder / "images" / n) * 255).round().to(torch.uint8) for n in scene.cameras.names)
    views = Views(images, scene.cameras)
    held, _ = score_views(scene.gaussians, views, [3], background=scene.background)
    assert held > 19
    mean = torch.stack([image.float().mean((0, 1)) / 255 for image in images]).mean(0)
    assert scene.background == pytest.approx(mean.tolist(), abs=0.02)
    assert scene.provenance["options"]["holdout"] == 3


def test_held_out_photos_are_reported_on_stdout(tmp_path, capsys, caplog, monkeypatch):
    cameras = write_set(tmp_path, arc(5, (96, 72), sweep=40.0))
    tiny = dataclasses.replace(choices.QUALITY_PRESETS["draft"], gaussians=2000, iterations=5)
    monkeypatch.setitem(choices.QUALITY_PRESETS, "draft", tiny)
    with caplog.at_level(logging.INFO):
        run(tmp_path / "images", tmp_path / "s.ply", ReconstructOptions(cameras=cameras, holdout=4, quality="draft"))
    out = capsys.readouterr().out
    assert out.startswith("held-out photos: 2  PSNR ") and len(out.splitlines()) == 1
    assert "5 of 5 photos" in caplog.text


def test_cameras_of_other_photos_are_named(tmp_path):
    write_set(tmp_path / "one", arc(3, (64, 48)))
    cameras = write_set(tmp_path / "two", arc(3, (64, 48)))
    cameras.write_text(cameras.read_text().replace("photo_", "other_"))
    with pytest.raises(InputError, match=r"transforms.json: names 0 of the photos.*photo_00.png"):
        run(tmp_path / "one" / "images", tmp_path / "s.ply", ReconstructOptions(cameras=cameras))
    assert not (tmp_path / "s.ply").exists()


@pytest.mark.parametrize(
    ("wrong", "words"),
    [({"quality": "best"}, "draft, normal, high"), ({"holdout": 1}, "2 or more"), ({"resolution": 8}, "64 to 4096")],
)
def test_options_that_make_no_sense(wrong, words):
    with pytest.raises(InputError, match=words):
        ReconstructOptions(**wrong)


def test_real_photos_are_all_placed(shared):
    """The published figure for this set is 11 of 11."""
    from stages.reconstruct.photo_reader import read_photos
    from stages.reconstruct.sfm import estimate_cameras

    model = estimate_cameras(read_photos(shared / "data" / "photos" / "kermit" / "images"))
    assert len(model.cameras) == 11
    assert len(model.points) > 500


def small(monkeypatch, steps: int = 5) -> None:
    """Draft quality so small that a whole run takes seconds."""
    tiny = dataclasses.replace(choices.QUALITY_PRESETS["draft"], gaussians=2000, iterations=steps)
    monkeypatch.setitem(choices.QUALITY_PRESETS, "draft", tiny)


def test_a_run_that_was_stopped_goes_on_from_its_finished_steps(tmp_path, monkeypatch, caplog):
    from stages.reconstruct import depth, features, photometric

    cameras = write_set(tmp_path, arc(4, (96, 72), sweep=40.0))
    small(monkeypatch)
    options = ReconstructOptions(cameras=cameras, quality="draft")

    def stop(*_):
        raise KeyboardInterrupt

    def repeated(*_, **__):
        pytest.fail("a finished step is computed again")

    with monkeypatch.context() as patch:
        patch.setattr(photometric, "fit_gaussians", stop)
        with pytest.raises(KeyboardInterrupt):
            run(tmp_path / "images", tmp_path / "s.ply", options)
    left = tmp_path / ".steps-s.ply"
    assert {p.name for p in left.iterdir()} == {"key", "features.pt", "matches.db", "depth.pt"}
    with monkeypatch.context() as patch:
        patch.setattr(features, "extract", repeated)
        patch.setattr(features, "match_descriptors", repeated)
        patch.setattr(depth, "estimate_depth_maps", repeated)
        report = run(tmp_path / "images", tmp_path / "s.ply", dataclasses.replace(options, resume=True))
    assert not left.exists() and "depth" not in report.seconds
    run(tmp_path / "images", tmp_path / "t.ply", options)
    resumed, whole = read_scene(tmp_path / "s.ply"), read_scene(tmp_path / "t.ply")
    torch.testing.assert_close(resumed.gaussians.means, whole.gaussians.means, rtol=0, atol=1e-5)


def test_a_mistake_leaves_nothing_behind(tmp_path, monkeypatch):
    cameras = write_set(tmp_path, arc(4, (96, 72), sweep=40.0))
    small(monkeypatch)
    for names, words in (("photo_00.png,x.png", "found for x.png"), ("photo_00.png,photo_00.png", "the same position")):
        wrong = ReconstructOptions(cameras=cameras, quality="draft", scale_reference=f"photos={names} distance=1")
        with pytest.raises(InputError, match=words):
            run(tmp_path / "images", tmp_path / "s.ply", wrong)
    assert {p.name for p in tmp_path.iterdir()} == {"images", "transforms.json"}


def test_a_folder_of_mixed_kinds_with_spaces_and_unicode_in_every_name(tmp_path, monkeypatch):
    # Landscape and portrait, large and small, grey, CMYK, lying on its side: three cameras to be told apart.
    folder = tmp_path / "Küche 写真 № 1"
    folder.mkdir()
    small(monkeypatch)
    wide, tall = arc(6, (320, 240), sweep=50.0), arc(6, (240, 320), sweep=50.0)
    for i in range(6):
        pixels = (photograph(tall if i == 5 else wide, i)[0] * 255).round().byte().numpy()
        picture, exif = Image.fromarray(pixels), Image.Exif()
        if i == 1:
            picture = picture.convert("L")
        elif i == 2:
            picture = picture.convert("CMYK")
        elif i == 3:
            exif[0x0112], picture = 6, picture.rotate(90, expand=True)
        elif i == 4:
            picture = picture.resize((400, 300), Image.LANCZOS)
        picture.save(folder / f"foto {i} ä.jpg", quality=95, exif=exif)
    out = tmp_path / "scène 1.ply"
    report = run(folder, out, ReconstructOptions(quality="draft", resolution=128))
    assert report.placed == 6 and {p.name for p in tmp_path.iterdir()} == {folder.name, out.name}
    scene = read_scene(out)
    assert scene.cameras.names == tuple(f"foto {i} ä.jpg" for i in range(6))
    assert scene.cameras.sizes.tolist() == [[128, 96]] * 5 + [[96, 128]]


def test_a_measured_distance_between_two_photos_gives_metres(tmp_path, monkeypatch):
    cameras = write_set(tmp_path, arc(4, (96, 72), sweep=40.0))
    small(monkeypatch)
    known = "photos=photo_00.png,photo_03.png distance=0.25"
    run(tmp_path / "images", tmp_path / "s.ply", ReconstructOptions(
        cameras=cameras, quality="draft", scale_reference=known
    ))  # fmt: skip
    scene = read_scene(tmp_path / "s.ply")
    eyes = centres(scene.cameras.viewmats)
    assert float((eyes[0] - eyes[3]).norm()) * scene.metres_per_unit == pytest.approx(0.25, rel=1e-4)
    assert known in scene.scale["source"]


def test_the_end_says_what_would_be_better(tmp_path, monkeypatch, caplog):
    cameras = write_set(tmp_path, arc(4, (96, 72), sweep=40.0))
    small(monkeypatch)
    with caplog.at_level(logging.INFO):
        report = run(tmp_path / "images", tmp_path / "s.ply", ReconstructOptions(cameras=cameras, quality="draft"))
    assert "peak memory" in caplog.text and "to improve it: 4 photos are few" in caplog.text
    assert any("between photo_00.png and photo_03.png" in sentence for sentence in report.advice)
    assert report.placed == report.photos == 4 and report.held_out is None and report.memory > 0.1
