"""Inpainting: brightness gradients, texture, edges and degenerate images."""

import numpy as np
import pytest

from stages.refine import inpaint as inpainting
from stages.refine.inpaint import inpaint

SIDE = 96


def middle(size: int = 24) -> np.ndarray:
    hole = np.zeros((SIDE, SIDE), bool)
    at = slice(SIDE // 2 - size // 2, SIDE // 2 + size // 2)
    hole[at, at] = True
    return hole


def filled(rgb: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """The inpainted image; before, the hole has a colour that must not occur in the result."""
    return inpaint(np.where(hole[..., None], np.float32([1, 0, 1]), rgb).astype(np.float32), hole, ~hole, 0)


def psnr(one: np.ndarray, two: np.ndarray) -> float:
    return -10 * float(np.log10(np.square(one - two).mean()))


def test_brightness_gradient_continues_without_a_seam():
    x = np.linspace(0.2, 0.8, SIDE, dtype=np.float32)
    rgb = np.stack([np.broadcast_to(x, (SIDE, SIDE))] * 3, -1)
    out = filled(rgb, middle())
    assert np.abs(out - rgb)[middle()].max() < 0.03
    assert (out[~middle()] == rgb[~middle()]).all()


def test_colours_are_interpolated_between_pure_pixels_where_too_few_are_known():
    """The table around the hole has colours of the object; known stripes of it are too narrow for copying."""
    hole, y = middle(40), np.mgrid[:SIDE, :SIDE][0]
    known = ~hole & (y % 6 < 2)
    beside = middle(52)
    rgb = np.where(beside[..., None], np.float32([0.1, 0.1, 0.3]), np.float32([0.7, 0.6, 0.5]))
    plain, pure = (inpaint(rgb, hole, known, 0, pure=mask) for mask in (None, ~beside))
    assert np.abs(pure[hole] - [0.7, 0.6, 0.5]).max() < 0.01 < 0.3 < np.abs(plain[hole] - [0.7, 0.6, 0.5]).max()


@pytest.mark.parametrize("shade", [0.0, 0.3], ids=["even", "lit from one side"])
def test_checker_pattern_continues(shade):
    """A pattern with a period of 12 cells, so copies must fit to both sides of the hole."""
    y, x = np.mgrid[:SIDE, :SIDE]
    value = 0.3 + 0.4 * ((x // 6 + y // 6) % 2) + shade * x / SIDE
    rgb = np.stack([value, 0.5 * value, 0.8 * value], -1).astype(np.float32)
    assert psnr(filled(rgb, middle())[middle()], rgb[middle()]) > 27


@pytest.mark.parametrize("slope", [-0.6, pytest.param(0.3, marks=pytest.mark.slow)], ids=["falling", "rising"])
def test_straight_edges_continue(slope):
    """A strip of table between two woven mats crosses a wide round hole; it must be neither blurred nor widened."""
    side, colours = 120, np.float32([[0.85, 0.5, 0.45], [0.55, 0.4, 0.2], [0.35, 0.4, 0.45]])
    y, x = np.mgrid[:side, :side] - side / 2
    away = (y - slope * x) / np.hypot(1, slope)
    which = (away > -10).astype(int) + (away > 10)
    weave = 0.06 * np.sin(1.3 * x + 0.4 * y) * (which != 1)
    grain = 0.02 * np.random.default_rng(0).standard_normal((side, side, 1))
    rgb = (colours[which] + weave[..., None] + grain).astype(np.float32)
    hole = np.hypot(y, x) < 28
    out = filled(rgb, hole)
    nearest = np.linalg.norm(out[..., None, :] - colours, axis=-1).argmin(-1)
    assert (nearest != which)[hole].mean() < 0.02
    assert psnr(out[hole], rgb[hole]) > 28


def test_best_of_several_trials_is_used(monkeypatch):
    y, x = np.mgrid[:SIDE, :SIDE]
    rgb = np.repeat((0.3 + 0.4 * ((x // 6 + y // 6) % 2))[..., None], 3, 2).astype(np.float32)
    hole = middle(6)  # small enough to be filled without a coarser level
    monkeypatch.setattr("stages.refine.inpaint.TRIES", 1)
    alone, tries = filled(rgb, hole), []

    def spoiled(level, rng, *numbers):
        """The first trial is correct; later ones are black."""
        tries.append(searched(level, rng, *numbers))
        if len(tries) > 1:
            level.image[level.hole] = 0.0
        return tries[-1]

    monkeypatch.setattr("stages.refine.inpaint.TRIES", 4)
    searched = inpainting._search
    monkeypatch.setattr("stages.refine.inpaint._search", spoiled)
    assert np.array_equal(filled(rgb, hole), alone) and len(tries) == 4


def test_texture_contrast_is_kept():
    """Noise cannot be reproduced exactly, but its standard deviation can."""
    rgb = 0.5 + 0.1 * np.random.default_rng(0).standard_normal((SIDE, SIDE, 3)).astype(np.float32)
    out = filled(rgb.clip(0, 1), middle())
    assert 0.06 < out[middle()].std() < 0.14


@pytest.mark.parametrize(
    ("shape", "known"),
    [((1, 1), "none"), ((2, 3), "half"), ((5, 200), "half"), ((64, 64), "none"), ((64, 64), "all"),
     ((64, 64), "one"), ((64, 64), "scattered")],
)  # fmt: skip
def test_images_with_few_known_pixels_are_filled(shape, known):
    rng = np.random.default_rng(0)
    rgb = rng.random((*shape, 3), np.float32)
    mask = np.broadcast_to({
        "none": False, "all": True, "half": np.arange(shape[1]) < shape[1] // 2,
        "one": np.arange(np.prod(shape)).reshape(shape) == 77, "scattered": rng.random(shape) < 0.1,
    }[known], shape)  # fmt: skip
    out = inpaint(rgb, ~mask, mask, 0)
    assert out.shape == rgb.shape and np.isfinite(out).all() and out.min() >= 0 and out.max() <= 1
    assert (out[mask] == rgb[mask]).all()


def test_same_seed_gives_the_same_image():
    rgb = np.random.default_rng(0).random((SIDE, SIDE, 3)).astype(np.float32)
    assert (filled(rgb, middle()) == filled(rgb, middle())).all()
