"""Exemplar-based inpainting: fills holes of an image with patches from its known part.

Patches are chosen, coarse to fine, to agree with the surroundings of the hole and with each other, which continues
edges and texture. Finally, the difference in brightness between the boundary of the hole and the copied patches is
interpolated smoothly over the hole, so that there is no seam.

Patches are compared in integers: colours with 8 bits, weights with 10 bits. Sums of their products are exact in float64
in any order, so that the result does not depend on the number of threads or on the processor.

Source: Wexler, Shechtman and Irani 2007, "Space-time completion of video"; search as in Barnes et al. 2009,
"PatchMatch".
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

PATCH_RADIUS = 3  # [px]
ILLUMINATION_SIGMA = 6.0  # standard deviation of the blur of brightness differences [px]
MAX_ILLUMINATION = 0.1  # largest brightness difference that is interpolated; larger ones are other surfaces
MAX_DEPTH = 4  # largest depth of a hole that is filled without a coarser level [px]
MIN_SOURCES = 1000  # fewest source patches of a coarser level, so that they contain all kinds of edges
MAX_COARSEST_TARGETS = 40_000  # most target patches of the coarsest level, for any number of sources
MAX_SOURCE_PATCHES = 8000  # most source patches that are compared with every target of the coarsest level
MAX_SEARCHED_TARGETS = 60_000  # most targets of a finer level that are searched; with more, coarse matches are kept
MIN_SOURCE_RATIO = 0.3  # source patches per target patch, below which colours are interpolated
MAX_TRIAL_TARGETS = 12_000  # most target patches of all trials together
TRIES = 8  # most trials at the coarsest level, of which the one with the smallest patch distance is used
KNOWN_FRACTION = (0.25, 0.65)  # range of the smallest known fraction of patches matched next; drawn for each trial
WAITING_FRACTION = (0.5, 0.95)  # range of the fraction of patches that wait, with low contrast; drawn for each trial
ROUNDS = 3  # rounds of search at each finer level
DEPTH_DECAY = 0.7  # factor on the weight of a pixel of the hole per pixel of depth
COLOUR = 255  # integer colour of full intensity
WEIGHT = 1023  # integer weight of a known pixel
VOTE = 1 << 14  # integer weight of an exactly matching patch
Y, X = (d.ravel() for d in np.mgrid[-PATCH_RADIUS : PATCH_RADIUS + 1, -PATCH_RADIUS : PATCH_RADIUS + 1])


def inpaint(
    rgb: Float[np.ndarray, "h w 3"],
    hole: Bool[np.ndarray, "h w"],
    known: Bool[np.ndarray, "h w"],
    seed: int,
    rounds: int = ROUNDS,
    pure: Bool[np.ndarray, "h w"] | None = None,
) -> Float[np.ndarray, "h w 3"]:
    """Fill the holes of an image. Pixels that are neither hole nor known are unchanged, and not used as source.

    Fewer `rounds` of search at full size, or none, are faster and give a more blurred result. If there are too few
    known pixels for copying texture, colours are interpolated between the known pixels that are `pure`.
    """
    known = known & ~hole
    if not known.any() or not hole.any():
        return rgb
    image = _fill(np.rint(COLOUR * _interpolated(rgb, known)), hole, known, np.random.default_rng(seed), rounds)
    if image is None:
        between = known if pure is None or not (known & pure).any() else known & pure
        image = COLOUR * _interpolated(rgb, between)
    return np.where(hole[..., None], image / COLOUR, rgb).clip(0, 1).astype(rgb.dtype)


def _interpolated(rgb: Float[np.ndarray, "h w 3"], known: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w 3"]:
    """Interpolate all pixels that are not known."""
    return _membrane(np.where(known[..., None], rgb, 0).astype(np.float32), known.astype(np.float32))


def _membrane(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Keep values where the weight is 1, and interpolate elsewhere from coarser levels.

    Source: Gortler et al. 1996, "The lumigraph", push and pull.
    """
    height, width = weight.shape
    if max(height, width) < 2 or (weight > 0).all():
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
    """A pyramid level. Targets are pixels whose patches overlap the hole; sources, pixels with fully known patches."""

    image: np.ndarray  # (h, w, 3) integer colours, modified in place
    hole: np.ndarray  # (h, w) mask of the pixels to fill
    trust: np.ndarray  # (h, w) integer weight of each pixel in patch comparisons
    source: np.ndarray  # (h, w) mask of the sources
    at: np.ndarray  # (t, 2) row and column of the targets

    @staticmethod
    def of(image: np.ndarray, hole: np.ndarray, known: np.ndarray) -> _Level:
        """The level of an image."""
        side = np.ones((2 * PATCH_RADIUS + 1, 2 * PATCH_RADIUS + 1))
        inner = np.zeros_like(hole)
        inner[PATCH_RADIUS:-PATCH_RADIUS, PATCH_RADIUS:-PATCH_RADIUS] = True
        trust = np.rint(WEIGHT * np.where(hole | known, DEPTH_DECAY ** ndimage.distance_transform_edt(hole), 0))
        near = ndimage.binary_dilation(hole, side) & inner
        return _Level(image.copy(), hole, trust, ndimage.binary_erosion(known, side) & inner, np.argwhere(near))

    def patches(self, at: Int[np.ndarray, "t 2"]) -> Float[np.ndarray, "t p 3"]:
        """Colours of the patches around the pixels `at`."""
        return self.image.reshape(-1, 3).take(self._cells(at), axis=0)

    def weights(self, at: Int[np.ndarray, "t 2"], known: Bool[np.ndarray, "h w"] | bool = True) -> np.ndarray:
        """Weights (t, p) of the pixels of the patches around the pixels `at`, 0 where not `known`."""
        return (self.trust * known).ravel().take(self._cells(at))

    def _cells(self, at: Int[np.ndarray, "t 2"]) -> Int[np.ndarray, "t p"]:
        width = self.hole.shape[1]
        return (at[:, 0] * width + at[:, 1])[:, None] + (Y * width + X)

    def distances(
        self, P: Float[np.ndarray, "t p 3"], W: Float[np.ndarray, "t p"], match: Int[np.ndarray, "t 2"]
    ) -> Float[np.ndarray, "t"]:
        """Weighted mean squared difference between patches P and the patches around their matches."""
        difference = P - self.patches(match)
        return np.einsum("tp,tpc,tpc->t", W, difference, difference) / W.sum(1).clip(1)

    def vote(
        self, at: Int[np.ndarray, "t 2"], match: Int[np.ndarray, "t 2"], distance: Float[np.ndarray, "t"]
    ) -> Bool[np.ndarray, "h w"]:
        """Set pixels of the hole to the weighted mean of the matched patches that cover them; returns their mask."""
        mean, filled = self.blended(at, match, distance)
        filled &= self.hole
        self.image[filled] = np.rint(mean[filled])
        return filled

    def blended(self, at: np.ndarray, match: np.ndarray, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean of the matched patches that cover each pixel, weighted by quality, and the mask of covered pixels."""
        sigma = max(float(np.median(distance)), 1e-3)
        weight = np.rint(VOTE * (np.exp(-distance / (0.5 * sigma)) + 1e-4))[:, None]
        total = np.zeros((self.hole.size, 4))
        image = np.concatenate([self.image, np.ones((*self.hole.shape, 1))], 2).reshape(-1, 4)
        to, of = self._cells(at), self._cells(match)
        for p in range(to.shape[1]):
            total[to[:, p]] += weight * image.take(of[:, p], axis=0)  # no duplicate indices, as targets are unique
        total = total.reshape(*self.hole.shape, 4)
        return total[..., :3] / total[..., 3:].clip(1), total[..., 3] > 0

    def equalise(self, match: Int[np.ndarray, "t 2"]) -> None:
        """Add the difference between image and matched patches at the boundary to the hole, interpolated over it."""
        distance = self.distances(self.patches(self.at), self.weights(self.at), match)
        mean, filled = self.blended(self.at, match, distance)
        boundary = (filled & ~self.hole & (self.trust > 0)).astype(np.float32)
        near = cv2.GaussianBlur(boundary, (0, 0), ILLUMINATION_SIGMA)[..., None]
        step = (self.image - mean).astype(np.float32)
        lighter = cv2.GaussianBlur(boundary[..., None] * step, (0, 0), ILLUMINATION_SIGMA) / np.maximum(near, 1e-6)
        over = cv2.GaussianBlur(_membrane(boundary[..., None] * lighter, boundary), (0, 0), ILLUMINATION_SIGMA)
        self.image[self.hole] += over[self.hole].clip(-MAX_ILLUMINATION * COLOUR, MAX_ILLUMINATION * COLOUR)


def _fill(
    image: np.ndarray, hole: np.ndarray, known: np.ndarray, rng: np.random.Generator, rounds: int
) -> np.ndarray | None:
    """Fill the hole from the coarsest level to the finest; None if too few patches are known."""
    levels = [_Level.of(image, hole, known)]
    while ndimage.distance_transform_edt(hole).max() > MAX_DEPTH:
        image, hole, known = _downsample(image, hole, known)
        coarser = _Level.of(image, hole, known)
        count = int(coarser.source.sum())
        if count < MIN_SOURCES and (not count or len(levels[-1].at) <= MAX_COARSEST_TARGETS):
            break
        levels.append(coarser)
    if levels[0].source.sum() <= MIN_SOURCE_RATIO * len(levels[0].at):
        return None
    found = _best_trial(levels[-1], rng)
    for level in levels[-2::-1]:
        found = _refine(level, found, rng, ROUNDS if level is not levels[0] else rounds)
    level = levels[0]
    level.equalise(found[level.at[:, 0], level.at[:, 1]])
    return level.image


def _downsample(image: np.ndarray, hole: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image and masks at half the size; a pixel is known if 3 of its 4 pixels are, else a hole if any of them is."""
    height, width = (side // 2 * 2 for side in hole.shape)
    four = lambda v: v[:height, :width].reshape(height // 2, 2, width // 2, 2, *v.shape[2:]).sum((1, 3))  # noqa: E731
    weight = 999 * known + 1  # unknown pixels matter only where there is no known one
    half = np.rint(four(image * weight[..., None]) / four(weight)[..., None])
    mostly_known = four(known) >= 3
    return half, (four(hole) > 0) & ~mostly_known, mostly_known


def _best_trial(level: _Level, rng: np.random.Generator) -> Int[np.ndarray, "h w 2"]:
    """Match field of the trial with the smallest patch distance, which broken edges increase."""
    fields, costs, images, start = [], [], [], level.image.copy()
    for _ in range(max(1, min(TRIES, MAX_TRIAL_TARGETS // len(level.at)))):
        level.image[:] = start
        fields.append(_search(level, rng, rng.uniform(*KNOWN_FRACTION), rng.uniform(*WAITING_FRACTION)))
        match = fields[-1][tuple(level.at.T)]
        costs.append(level.distances(level.patches(level.at), level.weights(level.at), match).mean())
        images.append(level.image.copy())
    best = int(np.argmin(costs))
    level.image[:] = images[best]
    return fields[best]


def _search(
    level: _Level, rng: np.random.Generator, min_known: float, waiting: float, rounds: int = 4
) -> Int[np.ndarray, "h w 2"]:
    """Exhaustive search for the best match of every target: from the boundary inwards, then for all targets together.

    Patches of high contrast are matched first, so that edges continue straight before uniform regions cover them.
    """
    sources = np.argwhere(level.source)
    sources = sources[rng.permutation(len(sources))[:MAX_SOURCE_PATCHES]]
    Q = level.patches(sources).reshape(len(sources), -1)
    filled, at = ~level.hole, level.at
    while len(at) and not filled[level.hole].all():
        available = cv2.blur(
            (filled & (level.trust > 0)).astype(np.float32), (2 * PATCH_RADIUS + 1, 2 * PATCH_RADIUS + 1)
        )
        at = level.at[(available >= min_known)[tuple(level.at.T)] & ~filled[tuple(level.at.T)]]
        if len(at):
            P, W = level.patches(at), level.weights(at, filled)
            first = _high_contrast(P, W, waiting)
            at, P, W = at[first], P[first], W[first]
            match = sources[_nearest(P, W, Q)]
            filled = filled | level.vote(at, match, level.distances(P, W, match))
    W = level.weights(level.at)
    for _ in range(rounds):
        P = level.patches(level.at)
        match = sources[_nearest(P, W, Q)]
        level.vote(level.at, match, level.distances(P, W, match))
    return _field(level, match)


def _high_contrast(P: Float[np.ndarray, "t p 3"], W: Float[np.ndarray, "t p"], waiting: float) -> Bool[np.ndarray, "t"]:
    """Mask of the patches whose contrast in known pixels is above the quantile `waiting`."""
    total = W.sum(1)
    squares, sums = np.einsum("tp,tpc,tpc->t", W, P, P), np.einsum("tp,tpc->tc", W, P)
    contrast = (squares - np.einsum("tc,tc->t", sums, sums) / total) / total
    return contrast >= np.quantile(contrast, waiting)


def _nearest(P: Float[np.ndarray, "t p 3"], W: Float[np.ndarray, "t p"], Q: Float[np.ndarray, "s d"]) -> np.ndarray:
    """Index of the row of Q that is nearest to each patch, by squared distance weighted by W."""
    squares = (Q * Q).reshape(len(Q), -1, 3).sum(2)
    sources, nearest = np.concatenate([squares, -2 * Q], 1).T, []
    for i in range(0, len(P), 512):
        weight = W[i : i + 512]
        weighted = (weight[..., None] * P[i : i + 512]).reshape(len(weight), -1)
        nearest.append(np.argmin(np.concatenate([weight, weighted], 1) @ sources, 1))
    return np.concatenate(nearest)


def _refine(level: _Level, coarse: Int[np.ndarray, "h w 2"], rng: np.random.Generator, rounds: int) -> np.ndarray:
    """Upsample the matches of the coarser level, and improve them by propagation from neighbours and random search."""
    cell = np.minimum(level.at // 2, np.array(coarse.shape[:2]) - 1)
    match = 2 * coarse[cell[:, 0], cell[:, 1]] + level.at - 2 * cell
    nearest = ndimage.distance_transform_edt(~level.source, return_distances=False, return_indices=True)
    match = nearest[(slice(None), *match.clip(0, np.array(level.hole.shape) - 1).T)].T
    P, W = level.patches(level.at), level.weights(level.at)
    level.vote(level.at, match, level.distances(P, W, match))
    for _ in range(rounds if len(match) <= MAX_SEARCHED_TARGETS else 0):
        P = level.patches(level.at)
        distance = level.distances(P, W, match)
        for step in ((0, 1), (1, 0), (0, -1), (-1, 0), None):
            if step is None:
                other = match + rng.integers(-2, 3, match.shape)
            else:
                other = _field(level, match)[level.at[:, 0] + step[0], level.at[:, 1] + step[1]] - step
            which = np.nonzero((other != match).any(1) & _usable(level, other))[0]
            theirs = level.distances(P[which], W[which], other[which])
            closer = theirs < distance[which]
            match[which[closer]], distance[which[closer]] = other[which[closer]], theirs[closer]
        level.vote(level.at, match, distance)
    return _field(level, match)


def _usable(level: _Level, match: np.ndarray) -> Bool[np.ndarray, "t"]:
    height, width = level.hole.shape
    inside = ((match >= 0) & (match < (height, width))).all(1)
    return inside & level.source[match[:, 0].clip(0, height - 1), match[:, 1].clip(0, width - 1)]


def _field(level: _Level, match: np.ndarray) -> Int[np.ndarray, "h w 2"]:
    """The match of every pixel; pixels that are not targets match themselves."""
    field = np.stack(np.mgrid[: level.hole.shape[0], : level.hole.shape[1]], -1)
    field[level.at[:, 0], level.at[:, 1]] = match
    return field
