"""Comparison of videos, folders of images and single images: PSNR and SSIM of each frame."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import zip_longest
from pathlib import Path

import cv2
import torch
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from stages.core.errors import InputError
from stages.core.scene.formats import VIDEO_SUFFIXES
from stages.core.scene.images import list_photos, read_image, read_video, video_info
from stages.evaluate.options import EvaluateOptions
from stages.evaluate.result import Curve, Pictures, Result

WINDOW, SIGMA = 11, 1.5  # size and standard deviation of SSIM's window [px]
REPORT_FRAMES = 4  # most pairs of frames shown in the report

Image = Float[Tensor, "h w 3"]


def psnr(predicted: Image, truth: Image) -> float:
    """Peak signal to noise ratio [dB] for values in 0..1; infinite for identical images."""
    error = (predicted.double() - truth.double()).square().mean()
    return float(-10 * torch.log10(error))


def ssim(predicted: Image, truth: Image) -> float:
    """Structural similarity for values in 0..1, averaged over channels and over windows entirely inside the image.

    Source: Wang et al. 2004, "Image quality assessment", eq. 13: Gaussian window 11 x 11, sigma 1.5, K1 = 0.01,
    K2 = 0.03. stages/core/kernels/splat/ssim.py instead pads images with zeros, so the values of
    `ngff reconstruct --holdout` and of the benchmarks differ slightly.
    """
    x, y = predicted.double(), truth.double()
    mean_x, mean_y, square_x, square_y, product = (_blur(image) for image in (x, y, x * x, y * y, x * y))
    var_x, var_y, covariance = square_x - mean_x**2, square_y - mean_y**2, product - mean_x * mean_y
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
    structure = (2 * covariance + c2) / (var_x + var_y + c2)
    return float((luminance * structure).mean())


def _blur(image: Image) -> Float[Tensor, "h2 w2 3"]:
    """Gaussian-weighted mean of each window that lies inside the image."""
    border = WINDOW // 2
    blurred = cv2.GaussianBlur(image.numpy(), (WINDOW, WINDOW), SIGMA)
    return torch.from_numpy(blurred[border:-border, border:-border])


def compare(prediction: Path, truth: Path, options: EvaluateOptions) -> Result:
    """PSNR and SSIM of each pair of frames, in order. Raises InputError if number, rate or size of frames differ."""
    notes = _check_rates(prediction, truth)
    total = options.frames or _count(truth)
    shown = set(torch.linspace(0, total - 1, min(REPORT_FRAMES, total)).round().int().tolist())
    scores, pictures = [], []
    frames = zip_longest(_frames(prediction), _frames(truth))
    for i, (predicted, true) in enumerate(tqdm(frames, total=total, unit="frame")):
        if options.frames is not None and i == options.frames:
            break
        if predicted is None or true is None:
            raise _length_error(prediction, truth, i, options)
        _check_sizes(prediction, truth, predicted, true)
        scores.append((psnr(predicted, true), ssim(predicted, true)))
        if i in shown:
            caption = f"frame {i}: PSNR {scores[-1][0]:.2f} dB, SSIM {scores[-1][1]:.3f}"
            pictures.append(Pictures(caption, {"prediction": predicted, "truth": true}))
    if options.frames is not None and len(scores) < options.frames:
        raise InputError(
            f"--frames {options.frames}: both files have only {len(scores)} frames; give {len(scores)} or fewer"
        )
    if options.frames is not None:
        notes.append(f"only the first {options.frames} frames were compared, as given by --frames")
    values = torch.tensor(scores, dtype=torch.float64)
    overall = {"PSNR": float(values[:, 0].mean()), "SSIM": float(values[:, 1].mean()), "frames": len(scores)}
    curves = [Curve(name, values[:, i].tolist()) for i, name in enumerate(("PSNR", "SSIM"))]
    return Result("pictures", overall, {}, notes, curves, "PSNR [dB] of each frame", pictures=pictures)


def _frames(path: Path) -> Iterator[Image]:
    """The images of a folder or video, or a single image."""
    if path.is_dir():
        return (read_image(photo) for photo in list_photos(path))
    return read_video(path) if path.suffix.lower() in VIDEO_SUFFIXES else iter([read_image(path)])


def _count(path: Path) -> int:
    """Number of frames, for the progress bar and the choice of frames for the report."""
    if path.is_dir():
        return len(list_photos(path))
    return max(video_info(path)[0], 1) if path.suffix.lower() in VIDEO_SUFFIXES else 1


def _check_rates(prediction: Path, truth: Path) -> list[str]:
    """Notes on how frames correspond. Raises InputError for videos with different frame rates."""
    if all(p.is_file() and p.suffix.lower() in VIDEO_SUFFIXES for p in (prediction, truth)):
        predicted, true = video_info(prediction)[1], video_info(truth)[1]
        if abs(predicted - true) > 1e-3 * true:
            raise InputError(
                f"{prediction}: has {predicted:g} frames per second, but {truth} has {true:g}; "
                f"render one of the two again with `ngff render --fps {true:g}`"
            )
        return []
    if prediction.is_dir() and truth.is_dir():
        names = [[p.stem for p in list_photos(folder)] for folder in (prediction, truth)]
        equal = names[0] == names[1]
        return ["images were matched by name" if equal else "images were matched by order, since names differ"]
    return []


def _length_error(prediction: Path, truth: Path, shared: int, options: EvaluateOptions) -> InputError:
    """The error for files that have only the first `shared` frames in common."""
    counts = f"{prediction}: {_count(prediction)} frames, but {truth} has {_count(truth)}"
    if options.frames is not None:
        return InputError(f"{counts}; --frames {options.frames} is more than both have, give {shared} or fewer")
    return InputError(f"{counts}; give --frames {shared} to compare the first {shared}")


def _check_sizes(prediction: Path, truth: Path, predicted: Tensor, true: Tensor) -> None:
    """Raise InputError unless both images have the same size and are large enough for SSIM."""
    if predicted.shape != true.shape:
        (h, w), (h2, w2) = predicted.shape[:2], true.shape[:2]
        raise InputError(
            f"{prediction}: has images of {w}x{h} pixels, but {truth} has {w2}x{h2}; "
            f"render again with the same view and `--resolution {max(w2, h2)}`"
        )
    if min(predicted.shape[:2]) < WINDOW:
        raise InputError(f"{prediction}: SSIM needs images of at least {WINDOW} pixels; render them larger")
