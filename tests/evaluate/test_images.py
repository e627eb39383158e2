"""Comparison of images and videos: PSNR and SSIM."""

import math

import pytest
import torch
from scipy.ndimage import gaussian_filter

from stages.core.errors import InputError
from stages.core.scene.images import VideoWriter, write_png
from stages.evaluate import images
from stages.evaluate.images import psnr, ssim
from stages.evaluate.options import EvaluateOptions
from stages.evaluate.stage import run


def random_image(seed: int, h: int = 40, w: int = 50):
    return torch.rand(h, w, 3, generator=torch.Generator().manual_seed(seed))


def test_psnr_by_hand():
    black = torch.zeros(20, 20, 3)
    assert psnr(black + 0.1, black) == pytest.approx(20, abs=1e-5)  # -10 log10(0.01)
    half = black.clone()
    half[:10] = 1.0
    assert psnr(half, black) == pytest.approx(10 * math.log10(2), abs=1e-5)
    assert psnr(black, black) == math.inf


def test_ssim_agrees_with_scipy():
    # compared with scipy's Gaussian filter of radius 5, for windows inside the image
    a = random_image(0).double()
    b = (0.6 * a + 0.4 * random_image(1)).clamp(0, 1)

    def blur(x):
        return gaussian_filter(x, 1.5, radius=5)[5:-5, 5:-5]

    total = 0.0
    for channel in range(3):
        x, y = a[..., channel].numpy(), b[..., channel].numpy()
        mx, my = blur(x), blur(y)
        vx, vy, cov = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
        index = (2 * mx * my + 1e-4) * (2 * cov + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))
        total += index.mean() / 3
    assert ssim(a, b) == pytest.approx(total, abs=1e-9)
    assert ssim(a, a) == pytest.approx(1, abs=1e-12)


def folder(path, images):
    path.mkdir()
    for i, image in enumerate(images):
        write_png(path / f"{i:03d}.png", image)
    return path


def evaluate(mine, true, tmp_path, **options):
    return run(mine, true, tmp_path / "metrics.json", EvaluateOptions(**options))


def test_folders_are_compared_frame_by_frame(tmp_path):
    grey = torch.full((32, 32, 3), 51 / 255)
    true = folder(tmp_path / "true", [grey, grey])
    mine = folder(tmp_path / "mine", [grey + 51 / 255, grey + 102 / 255])  # errors of 0.2 and 0.4
    facts = evaluate(mine, true, tmp_path)
    expected = [-20 * math.log10(0.2), -20 * math.log10(0.4)]
    assert facts["per_frame"]["PSNR"] == pytest.approx(expected, abs=1e-5)
    assert facts["overall"]["PSNR"] == pytest.approx(sum(expected) / 2, abs=1e-5)
    assert facts["overall"]["frames"] == 2


def test_psnr_of_identical_images_is_infinite(tmp_path):
    write_png(tmp_path / "a.png", random_image(0))
    facts = evaluate(tmp_path / "a.png", tmp_path / "a.png", tmp_path)
    assert facts["overall"]["PSNR"] == "inf" and facts["overall"]["SSIM"] == pytest.approx(1)


def video(path, count, fps=25.0, size=48):
    with VideoWriter(path, fps) as writer:
        for i in range(count):
            writer.append(torch.full((size, size, 3), 0.2 + 0.05 * i))
    return path


def test_videos_must_have_equal_length_rate_and_size(tmp_path):
    true = video(tmp_path / "true.mp4", 6)
    with pytest.raises(InputError, match="4 frames, but .* has 6; give --frames 4"):
        evaluate(video(tmp_path / "short.mp4", 4), true, tmp_path)
    assert evaluate(tmp_path / "short.mp4", true, tmp_path, frames=4)["overall"]["PSNR"] == "inf"
    with pytest.raises(InputError, match="give 4 or fewer"):
        evaluate(tmp_path / "short.mp4", true, tmp_path, frames=5)
    with pytest.raises(InputError, match="1 frames, but .* has 6; give --frames 1"):
        evaluate(video(tmp_path / "single.mp4", 1), true, tmp_path)
    with pytest.raises(InputError, match="50 frames per second.*--fps 25"):
        evaluate(video(tmp_path / "fast.mp4", 6, fps=50.0), true, tmp_path)
    with pytest.raises(InputError, match="64x64.*--resolution 48"):
        evaluate(video(tmp_path / "large.mp4", 6, size=64), true, tmp_path)


def test_report_of_videos_contains_curves_and_images(tmp_path):
    true, mine = video(tmp_path / "true.mp4", 6), video(tmp_path / "mine.mp4", 6)
    images = [torch.full((48, 48, 3), 0.3 + 0.05 * i) for i in range(6)]
    with VideoWriter(mine, 25.0) as writer:
        for image in images:
            writer.append(image)
    evaluate(mine, true, tmp_path, report=tmp_path / "report.html")
    html = (tmp_path / "report.html").read_text()
    assert html.count("<polyline") == 1 and html.count("data:image/png;base64,iVBOR") == 8
    assert "PSNR" in html and "http" not in html.replace("http-equiv", "")


def test_frames_compares_the_first_ones_and_says_so(tmp_path):
    rng = torch.Generator().manual_seed(0)
    mine, true = (folder(tmp_path / name, torch.rand(3, 16, 16, 3, generator=rng)) for name in ("mine", "true"))
    whole, first = evaluate(mine, true, tmp_path), evaluate(mine, true, tmp_path, frames=2)
    assert whole["overall"]["frames"] == 3 and first["per_frame"]["PSNR"] == whole["per_frame"]["PSNR"][:2]
    assert any("only the first 2 frames" in note for note in first["notes"])
    assert not any("only the first" in note for note in whole["notes"])
    assert evaluate(mine, true, tmp_path, frames=1)["overall"]["frames"] == 1
    with pytest.raises(InputError, match="both files have only 3 frames; give 3 or fewer"):
        evaluate(mine, true, tmp_path, frames=4)


def test_images_correspond_by_name_or_by_order(tmp_path):
    true = folder(tmp_path / "true", [random_image(0), random_image(1)])
    mine = folder(tmp_path / "mine", [random_image(0), random_image(1)])
    assert evaluate(mine, true, tmp_path)["notes"] == ["images were matched by name"]
    (mine / "000.png").rename(mine / "0.png")
    assert evaluate(mine, true, tmp_path)["notes"] == ["images were matched by order, since names differ"]
    assert evaluate(mine / "0.png", true / "000.png", tmp_path)["notes"] == []


@pytest.mark.parametrize("side", [10, 11])
def test_images_have_room_for_a_window(tmp_path, side):
    write_png(tmp_path / "a.png", random_image(0, side, 30))
    if side == 11:
        assert evaluate(tmp_path / "a.png", tmp_path / "a.png", tmp_path)["overall"]["SSIM"] == pytest.approx(1)
    else:
        with pytest.raises(InputError, match="SSIM needs images of at least 11 pixels"):
            evaluate(tmp_path / "a.png", tmp_path / "a.png", tmp_path)


@pytest.mark.parametrize(("fps", "same"), [(25.02, True), (25.03, False), (24.97, False)])
def test_rates_of_videos_may_differ_by_a_thousandth(tmp_path, monkeypatch, fps, same):
    for name in ("mine.mp4", "true.mp4"):
        (tmp_path / name).touch()
    monkeypatch.setattr(images, "video_info", lambda path: (1, fps if path.stem == "mine" else 25.0))
    if same:
        assert images._check_rates(tmp_path / "mine.mp4", tmp_path / "true.mp4") == []
    else:
        with pytest.raises(InputError, match="frames per second, but .*ngff render --fps 25"):
            images._check_rates(tmp_path / "mine.mp4", tmp_path / "true.mp4")
