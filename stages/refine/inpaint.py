"""Holes in a picture filled with its own texture: smooth light from the rim, and patches of what is seen elsewhere.

Light and texture are told apart first. The light is carried smoothly over the hole, so that there is no seam; the
texture, what is left without it, is put together from seen patches that agree with their surroundings and with each
other, coarse to fine.

Source: Wexler, Shechtman and Irani 2007, "Space-time completion of video"; the search is that of Barnes et al. 2009,
"PatchMatch".
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

REACH = 3  # of a patch to either side [cells]
LIGHT = 12.0  # standard deviation of what counts as light [cells]
SHALLOW = 4  # holes no deeper than this are filled at once, others from a coarser picture [cells]
SMALLEST = 32  # shorter side of the coarsest picture [cells]
SOURCES = 2000  # patches compared with every patch of the hole in the coarsest picture
MOST = 25_000  # patches that are still searched for in a finer one; more keep the coarser answer
DOUBT = 0.7  # weight of a cell's colour in the hole, for each cell of depth
Y, X = (d.ravel() for d in np.mgrid[-REACH : REACH + 1, -REACH : REACH + 1])


def inpaint(
    rgb: Float[np.ndarray, "h w 3"], hole: Bool[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"], seed: int
) -> Float[np.ndarray, "h w 3"]:
    """The picture with new colours in the holes; cells that are neither hole nor known are filled, but not trusted."""
    gap = ~known | hole
    if gap.all() or not gap.any():
        return rgb
    light = _light(rgb, gap)
    texture = np.where(gap[..., None], 0.0, rgb - light).astype(np.float32)
    texture = _complete(texture, gap, np.random.default_rng(seed))
    return np.where(gap[..., None], light + texture, rgb).clip(0, 1).astype(rgb.dtype)


def _light(rgb: np.ndarray, gap: np.ndarray) -> Float[np.ndarray, "h w 3"]:
    """Blurred colours of what is known, carried smoothly over the gap."""
    weight = (~gap).astype(np.float32)
    near = cv2.GaussianBlur(weight, (0, 0), LIGHT)[..., None]
    blurred = cv2.GaussianBlur(rgb.astype(np.float32) * weight[..., None], (0, 0), LIGHT) / np.maximum(near, 1e-6)
    far = _membrane(np.where(gap[..., None], 0, blurred).astype(np.float32), weight)
    share = np.clip(4 * near - 1, 0, 1)  # half the window: at the rim of a hole
    return share * blurred + (1 - share) * cv2.GaussianBlur(far, (0, 0), LIGHT / 2)


def _membrane(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Values where the weight is 1; elsewhere those of ever coarser pictures.

    Source: Gortler et al. 1996, "The lumigraph", push and pull.
    """
    height, width = weight.shape
    if min(height, width) < 2 or (weight > 0).all():
        return values / np.maximum(weight, 1e-6)[..., None]
    half = ((width + 1) // 2, (height + 1) // 2)
    sums = cv2.resize(weight[..., None] * values, half, interpolation=cv2.INTER_AREA)
    coarse_weight = cv2.resize(weight, half, interpolation=cv2.INTER_AREA)
    means = sums / np.maximum(coarse_weight, 1e-6)[..., None]
    coarse = _membrane(means, (coarse_weight > 0).astype(np.float32))
    wide = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.where(weight[..., None] > 0, values, wide)


@dataclass
class _Level:
    """A picture with patches to be found for the targets: every cell whose patch reaches into the gap."""

    image: np.ndarray  # (h, w, 3), changed in place
    gap: np.ndarray  # (h, w)
    trust: np.ndarray  # (h, w) weight of a cell's colour when patches are compared
    source: np.ndarray  # (h, w) whether a patch around the cell is known all over
    at: np.ndarray  # (t, 2) targets

    @staticmethod
    def of(image: np.ndarray, gap: np.ndarray) -> _Level:
        depth = ndimage.distance_transform_edt(gap)
        side = 2 * REACH + 1
        source = ndimage.binary_erosion(~gap, np.ones((side, side)))
        inner = np.zeros_like(gap)
        inner[REACH:-REACH, REACH:-REACH] = True
        near = ndimage.binary_dilation(gap, np.ones((side, side))) & inner
        return _Level(image.copy(), gap, DOUBT ** depth, source & inner, np.argwhere(near))

    def patches(self, at: Int[np.ndarray, "t 2"]) -> Float[np.ndarray, "t p 3"]:
        return self.image[at[:, :1] + Y, at[:, 1:] + X]

    def distances(self, match: Int[np.ndarray, "t 2"]) -> Float[np.ndarray, "t"]:
        """Of every target's patch to that around its match."""
        weight = self.trust[self.at[:, :1] + Y, self.at[:, 1:] + X]
        squares = np.square(self.patches(self.at) - self.patches(match)).sum(2)
        return (weight * squares).sum(1) / weight.sum(1).clip(1e-6)

    def vote(self, match: Int[np.ndarray, "t 2"], distance: Float[np.ndarray, "t"]) -> Bool[np.ndarray, "h w"]:
        """Every cell of the gap takes the mean of what the patches over it say, good matches first; which had any."""
        heard = np.isfinite(distance)
        sigma = max(float(np.median(distance[heard])), 1e-8) if heard.any() else 1.0
        weight = np.where(heard, np.exp(-distance / (0.5 * sigma)) + 1e-4, 0).astype(np.float32)
        total, count = np.zeros_like(self.image), np.zeros(self.gap.shape, np.float32)
        for y, x in zip(Y, X, strict=True):
            to = (self.at[:, 0] + y, self.at[:, 1] + x)  # no target twice, so no cell twice
            total[to] += weight[:, None] * self.image[match[:, 0] + y, match[:, 1] + x]
            count[to] += weight
        told = self.gap & (count > 0)
        self.image[told] = total[told] / count[told][:, None]
        return told


def _complete(texture: np.ndarray, gap: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The texture with its gap filled, from a coarse picture of it to itself."""
    pictures = [(texture, gap)]
    while ndimage.distance_transform_edt(pictures[-1][1]).max() > SHALLOW and min(gap.shape) > 2 * SMALLEST:
        texture, gap = _halved(*pictures[-1])
        if not _Level.of(texture, gap).source.any():
            break
        pictures.append((texture, gap))
    found = None
    for texture, gap in reversed(pictures):
        level = _Level.of(texture, gap)
        if not level.source.any() or not len(level.at):
            return texture  # nothing to copy from: the light alone
        found = _searched(level, rng) if found is None else _refined(level, found, rng)
    return level.image


def _halved(texture: np.ndarray, gap: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A picture of half the size; a cell is known where most of it is."""
    height, width = (side // 2 * 2 for side in gap.shape)
    known = (~gap[:height, :width]).astype(np.float32)
    four = lambda v: v.reshape(height // 2, 2, width // 2, 2, *v.shape[2:]).sum((1, 3))  # noqa: E731
    count = four(known)
    half = four(texture[:height, :width] * known[..., None]) / np.maximum(count, 1)[..., None]
    return half.astype(np.float32), count < 3


def _searched(level: _Level, rng: np.random.Generator, rounds: int = 4) -> Int[np.ndarray, "h w 2"]:
    """A match for every target among all sources, or many of them: from the rim inwards, then all together."""
    sources = np.argwhere(level.source)
    sources = sources[rng.permutation(len(sources))[:SOURCES]]
    Q = level.patches(sources).reshape(len(sources), -1)
    settled, told = level.trust.astype(np.float32), ~level.gap
    while rounds:
        level.trust = settled * told
        W = level.trust[level.at[:, :1] + Y, level.at[:, 1:] + X]
        P = level.patches(level.at).reshape(len(level.at), -1)
        match = sources[_nearest(P, np.repeat(W, 3, axis=1), Q)]
        enough = (W > 0).mean(1) >= 0.4  # of a patch is there to go by
        rounds -= bool(told.all() or not (enough & ~told[level.at[:, 0], level.at[:, 1]]).any())
        told = told | level.vote(match, np.where(enough, level.distances(match), np.inf))
    level.trust = settled
    return _field(level, match)


def _nearest(P: Float[np.ndarray, "t d"], W: Float[np.ndarray, "t d"], Q: Float[np.ndarray, "s d"]) -> np.ndarray:
    """Which row of Q is nearest to each row of P, squares weighted by W."""
    squares, parts = (Q * Q).T, range(0, len(P), 512)
    return np.concatenate([np.argmin(W[i : i + 512] @ squares - 2 * (W * P)[i : i + 512] @ Q.T, 1) for i in parts])


def _refined(level: _Level, coarse: Int[np.ndarray, "h w 2"], rng: np.random.Generator, rounds: int = 2) -> np.ndarray:
    """Matches of a coarser picture carried over, then improved by those of neighbours and by small steps."""
    cell = np.minimum(level.at // 2, np.array(coarse.shape[:2]) - 1)
    match = 2 * coarse[cell[:, 0], cell[:, 1]] + level.at - 2 * cell
    sources = np.argwhere(level.source)
    lost = ~_usable(level, match)
    match[lost] = sources[rng.integers(0, len(sources), int(lost.sum()))]
    distance = level.distances(match)
    level.vote(match, distance)
    for _ in range(rounds if len(match) <= MOST else 0):
        distance = level.distances(match)
        for step in ((0, 1), (1, 0), (0, -1), (-1, 0)):
            field = _field(level, match)
            other = field[level.at[:, 0] + step[0], level.at[:, 1] + step[1]] - step
            match, distance = _better(level, match, distance, other)
        match, distance = _better(level, match, distance, match + rng.integers(-2, 3, match.shape))
        level.vote(match, distance)
    return _field(level, match)


def _better(level: _Level, match: np.ndarray, distance: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    other = np.where(_usable(level, other)[:, None], other, match)
    theirs = level.distances(other)
    return np.where((theirs < distance)[:, None], other, match), np.minimum(theirs, distance)


def _usable(level: _Level, match: np.ndarray) -> Bool[np.ndarray, "t"]:
    height, width = level.gap.shape
    inside = ((match >= 0) & (match < (height, width))).all(1)
    return inside & level.source[match[:, 0].clip(0, height - 1), match[:, 1].clip(0, width - 1)]


def _field(level: _Level, match: np.ndarray) -> Int[np.ndarray, "h w 2"]:
    """The match of every cell; cells that are no target are their own."""
    field = np.stack(np.mgrid[: level.gap.shape[0], : level.gap.shape[1]], -1)
    field[level.at[:, 0], level.at[:, 1]] = match
    return field
