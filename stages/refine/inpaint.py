"""Holes in a picture filled with what is seen elsewhere in it, so that edges and texture go on.

The hole is put together from seen patches that agree with their surroundings and with each other, coarse to fine:
where an edge runs into it at both ends, patches along the edge are what agrees. What is seen beside the hole in a
lighter or darker place than where the patches come from is carried smoothly over it at last, so that there is no seam.

Patches are compared in integers: colours of 8 bits, weights of 10. Sums of their products are exact in float64, in
whatever order they are added, so the result does not depend on the number of threads or on the processor.

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
LIGHT = 6.0  # standard deviation of what counts as light [cells]
LIGHTER = 0.1  # most that a place may be lighter than where its patches come from; more is another thing
SHALLOW = 4  # holes no deeper than this are filled at once, others from a coarser picture [cells]
FEWEST = 1000  # patches to copy from that a coarser picture must have, so that all kinds of edges are among them
LARGEST = 40_000  # patches to be found in the coarsest picture, however few there are to copy from
SOURCES = 8000  # patches compared with every patch of the hole in the coarsest picture
MOST = 60_000  # patches that are still searched for in a finer one; more keep the coarser answer
SCARCE = 0.3  # patches to copy from for each to be found, at least
FEW = 12_000  # patches to be found in all tries together
TRIES = 8  # at the coarsest picture, of which the one whose patches agree best is taken
ENOUGH = (0.25, 0.65)  # share of a patch that is there to go by, drawn for each try
FIRST = (0.5, 0.95)  # share of the rim that waits for the rest of it, of more contrast
ROUNDS = 3  # of search in every finer picture
DOUBT = 0.7  # weight of a cell's colour in the hole, for each cell of depth
COLOUR = 255  # integer colour of full intensity
WEIGHT = 1023  # integer weight of a cell that is trusted fully
VOTE = 1 << 14  # integer weight of a patch that matches exactly
Y, X = (d.ravel() for d in np.mgrid[-REACH : REACH + 1, -REACH : REACH + 1])


def inpaint(
    rgb: Float[np.ndarray, "h w 3"],
    hole: Bool[np.ndarray, "h w"],
    known: Bool[np.ndarray, "h w"],
    seed: int,
    rounds: int = ROUNDS,
) -> Float[np.ndarray, "h w 3"]:
    """The picture with new colours in the holes; cells that are neither hole nor known stay, and are not trusted.

    With few `rounds` of search at full size, or none, it is quicker and more blurred.
    """
    known = known & ~hole
    if not known.any() or not hole.any():
        return rgb
    smooth = _membrane(np.where(known[..., None], rgb, 0).astype(np.float32), known.astype(np.float32))
    image = np.rint(COLOUR * np.where(known[..., None], rgb, smooth))
    image = _complete(image, hole, known, np.random.default_rng(seed), rounds) / COLOUR
    return np.where(hole[..., None], image, rgb).clip(0, 1).astype(rgb.dtype)


def _membrane(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Values where the weight is 1; elsewhere those of ever coarser pictures.

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
    """A picture with patches to be found for the targets: every cell whose patch reaches into the hole."""

    image: np.ndarray  # (h, w, 3) integer colours, changed in place
    hole: np.ndarray  # (h, w)
    trust: np.ndarray  # (h, w) integer weight of a cell's colour when patches are compared
    source: np.ndarray  # (h, w) whether a patch around the cell is known all over
    at: np.ndarray  # (t, 2) targets

    @staticmethod
    def of(image: np.ndarray, hole: np.ndarray, known: np.ndarray) -> _Level:
        side = np.ones((2 * REACH + 1, 2 * REACH + 1))
        inner = np.zeros_like(hole)
        inner[REACH:-REACH, REACH:-REACH] = True
        trust = np.rint(WEIGHT * np.where(hole | known, DOUBT ** ndimage.distance_transform_edt(hole), 0))
        near = ndimage.binary_dilation(hole, side) & inner
        return _Level(image.copy(), hole, trust, ndimage.binary_erosion(known, side) & inner, np.argwhere(near))

    def patches(self, at: Int[np.ndarray, "t 2"]) -> Float[np.ndarray, "t p 3"]:
        return self.image.reshape(-1, 3).take(self._cells(at), axis=0)

    def weights(self, at: Int[np.ndarray, "t 2"], told: Bool[np.ndarray, "h w"] | bool = True) -> np.ndarray:
        """How much each cell of the patches, if told, is to be trusted (t, p)."""
        return (self.trust * told).ravel().take(self._cells(at))

    def _cells(self, at: Int[np.ndarray, "t 2"]) -> Int[np.ndarray, "t p"]:
        width = self.hole.shape[1]
        return (at[:, 0] * width + at[:, 1])[:, None] + (Y * width + X)

    def distances(
        self, P: Float[np.ndarray, "t p 3"], W: Float[np.ndarray, "t p"], match: Int[np.ndarray, "t 2"]
    ) -> Float[np.ndarray, "t"]:
        """Of patches to those around their matches."""
        difference = P - self.patches(match)
        return np.einsum("tp,tpc,tpc->t", W, difference, difference) / W.sum(1).clip(1)

    def vote(
        self, at: Int[np.ndarray, "t 2"], match: Int[np.ndarray, "t 2"], distance: Float[np.ndarray, "t"]
    ) -> Bool[np.ndarray, "h w"]:
        """Every cell of the hole takes the mean of what the patches over it say; which had any."""
        said, told = self.said(at, match, distance)
        told &= self.hole
        self.image[told] = np.rint(said[told])
        return told

    def said(self, at: np.ndarray, match: np.ndarray, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The mean of what patches say of every cell, good matches first, and of which they say anything."""
        sigma = max(float(np.median(distance)), 1e-3)
        weight = np.rint(VOTE * (np.exp(-distance / (0.5 * sigma)) + 1e-4))[:, None]
        total = np.zeros((self.hole.size, 4))
        image = np.concatenate([self.image, np.ones((*self.hole.shape, 1))], 2).reshape(-1, 4)
        to, of = self._cells(at), self._cells(match)
        for p in range(to.shape[1]):
            total[to[:, p]] += weight * image.take(of[:, p], axis=0)  # no target twice, so no cell twice
        total = total.reshape(*self.hole.shape, 4)
        return total[..., :3] / total[..., 3:].clip(1), total[..., 3] > 0

    def even(self, match: Int[np.ndarray, "t 2"]) -> None:
        """By how much the seen cells around are lighter than patches say goes for the hole as well, smoothly."""
        distance = self.distances(self.patches(self.at), self.weights(self.at), match)
        said, told = self.said(self.at, match, distance)
        rim = (told & ~self.hole & (self.trust > 0)).astype(np.float32)
        near = cv2.GaussianBlur(rim, (0, 0), LIGHT)[..., None]
        step = (self.image - said).astype(np.float32)
        lighter = cv2.GaussianBlur(rim[..., None] * step, (0, 0), LIGHT) / np.maximum(near, 1e-6)
        over = cv2.GaussianBlur(_membrane(rim[..., None] * lighter, rim), (0, 0), LIGHT)
        self.image[self.hole] += over[self.hole].clip(-LIGHTER * COLOUR, LIGHTER * COLOUR)


def _complete(
    image: np.ndarray, hole: np.ndarray, known: np.ndarray, rng: np.random.Generator, rounds: int
) -> np.ndarray:
    """The picture with its hole filled, from a coarse picture of it to itself."""
    levels = [_Level.of(image, hole, known)]
    while ndimage.distance_transform_edt(hole).max() > SHALLOW:
        image, hole, known = _halved(image, hole, known)
        coarser = _Level.of(image, hole, known)
        count = int(coarser.source.sum())
        if count < FEWEST and (not count or len(levels[-1].at) <= LARGEST):
            break
        levels.append(coarser)
    if levels[0].source.sum() <= SCARCE * len(levels[0].at):
        return levels[0].image  # too little to copy from: smooth colours alone
    found = _best(levels[-1], rng)
    for level in levels[-2::-1]:
        found = _refined(level, found, rng, ROUNDS if level is not levels[0] else rounds)
    level = levels[0]
    level.even(found[level.at[:, 0], level.at[:, 1]])
    return level.image


def _halved(image: np.ndarray, hole: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A picture of half the size; a cell is known where most of it is, else a part of the hole where some of it is."""
    height, width = (side // 2 * 2 for side in hole.shape)
    four = lambda v: v[:height, :width].reshape(height // 2, 2, width // 2, 2, *v.shape[2:]).sum((1, 3))  # noqa: E731
    weight = 999 * known + 1  # what is not known counts where nothing else does
    half = np.rint(four(image * weight[..., None]) / four(weight)[..., None])
    most = four(known) >= 3
    return half, (four(hole) > 0) & ~most, most


def _best(level: _Level, rng: np.random.Generator) -> Int[np.ndarray, "h w 2"]:
    """The field of matches of the best of a few tries: where an edge comes out crooked, patches agree less."""
    fields, costs, images, start = [], [], [], level.image.copy()
    for _ in range(max(1, min(TRIES, FEW // len(level.at)))):
        level.image[:] = start
        fields.append(_searched(level, rng, rng.uniform(*ENOUGH), rng.uniform(*FIRST)))
        match = fields[-1][tuple(level.at.T)]
        costs.append(level.distances(level.patches(level.at), level.weights(level.at), match).mean())
        images.append(level.image.copy())
    best = int(np.argmin(costs))
    level.image[:] = images[best]
    return fields[best]


def _searched(
    level: _Level, rng: np.random.Generator, enough: float, wait: float, rounds: int = 4
) -> Int[np.ndarray, "h w 2"]:
    """A match for every target among all sources, or many of them: from the rim inwards, then all together.

    Where most goes on at the rim it is carried on first: edges run on straight before what is even spreads over them.
    """
    sources = np.argwhere(level.source)
    sources = sources[rng.permutation(len(sources))[:SOURCES]]
    Q = level.patches(sources).reshape(len(sources), -1)
    told, at = ~level.hole, level.at
    while len(at) and not told[level.hole].all():
        there = cv2.blur((told & (level.trust > 0)).astype(np.float32), (2 * REACH + 1, 2 * REACH + 1))
        at = level.at[(there >= enough)[tuple(level.at.T)] & ~told[tuple(level.at.T)]]
        if len(at):
            P, W = level.patches(at), level.weights(at, told)
            first = _first(P, W, wait)
            at, P, W = at[first], P[first], W[first]
            match = sources[_nearest(P, W, Q)]
            told = told | level.vote(at, match, level.distances(P, W, match))
    W = level.weights(level.at)
    for _ in range(rounds):
        P = level.patches(level.at)
        match = sources[_nearest(P, W, Q)]
        level.vote(level.at, match, level.distances(P, W, match))
    return _field(level, match)


def _first(P: Float[np.ndarray, "t p 3"], W: Float[np.ndarray, "t p"], wait: float) -> Bool[np.ndarray, "t"]:
    """Which patches have the most contrast in what is known of them."""
    total = W.sum(1)
    squares, sums = np.einsum("tp,tpc,tpc->t", W, P, P), np.einsum("tp,tpc->tc", W, P)
    contrast = (squares - np.einsum("tc,tc->t", sums, sums) / total) / total
    return contrast >= np.quantile(contrast, wait)


def _nearest(P: Float[np.ndarray, "t p 3"], W: Float[np.ndarray, "t p"], Q: Float[np.ndarray, "s d"]) -> np.ndarray:
    """Which row of Q is nearest to each patch, squares weighted by W."""
    squares, nearest = (Q * Q).T, []
    for i in range(0, len(P), 512):
        weight = np.repeat(W[i : i + 512], 3, axis=1)
        weighted = weight * P[i : i + 512].reshape(len(weight), -1)
        nearest.append(np.argmin(weight @ squares - 2 * weighted @ Q.T, 1))
    return np.concatenate(nearest)


def _refined(level: _Level, coarse: Int[np.ndarray, "h w 2"], rng: np.random.Generator, rounds: int) -> np.ndarray:
    """Matches of a coarser picture carried over, then improved by those of neighbours and by small steps."""
    cell = np.minimum(level.at // 2, np.array(coarse.shape[:2]) - 1)
    match = 2 * coarse[cell[:, 0], cell[:, 1]] + level.at - 2 * cell
    nearest = ndimage.distance_transform_edt(~level.source, return_distances=False, return_indices=True)
    match = nearest[(slice(None), *match.clip(0, np.array(level.hole.shape) - 1).T)].T
    P, W = level.patches(level.at), level.weights(level.at)
    level.vote(level.at, match, level.distances(P, W, match))
    for _ in range(rounds if len(match) <= MOST else 0):
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
    """The match of every cell; cells that are no target are their own."""
    field = np.stack(np.mgrid[: level.hole.shape[0], : level.hole.shape[1]], -1)
    field[level.at[:, 0], level.at[:, 1]] = match
    return field
