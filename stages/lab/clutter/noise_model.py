"""Fast approximate model of the errors of a reconstruction from photos, which would take minutes.

The depth of each view is distorted at outlines, smoothed, perturbed by spatially smooth noise, and removed where there
is no texture or only one view sees the surface. The points of all views are then merged as `reconstruct` does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import ndimage
from torch import Tensor

from stages.core.geometry.cameras import centres, resize
from stages.core.models.segmenter.surfels import cielab_of
from stages.core.models.segmenter.voxels import ScenePoints, within_reach
from stages.core.perception.support import view_extent
from stages.core.raster.rasterise import rasterise, visibility
from stages.core.scene.scene import Scene

WIDTH = 288  # longest side of the simulated views [px]


@dataclass(frozen=True)
class Degradation:
    """Strength of each kind of reconstruction error."""

    bend: float  # shift of depth relative to colour [px]
    fatten: float  # controls the fraction of the image in which nearer surfaces spread over their outlines
    drift: float  # relative depth noise, smooth over `patch` pixels
    patch: float  # correlation length of `drift` and `bend` [px]
    grain: float  # relative depth noise, independent in each pixel
    plain: float  # image gradient below which depth is smoothed, and in parts of the image lost
    holes: float  # controls how much of these textureless areas is lost
    merge: float  # side of the cells in which points are merged [camera distances]

    @classmethod
    def random(cls, rng: np.random.Generator) -> Degradation:
        """Random parameters, from a nearly perfect to a poor reconstruction."""
        u = rng.uniform()
        return cls(
            bend=2.2 * u * rng.uniform(), fatten=0.5 * u * rng.uniform(), drift=0.009 * u * rng.uniform(),
            patch=rng.uniform(4, 20), grain=0.0025 * u * rng.uniform(), plain=0.05 * rng.uniform() ** 2,
            holes=1.1 * rng.uniform(), merge=rng.uniform(0.0035, 0.0065),
        )  # fmt: skip


class _Points(NamedTuple):
    """Points of the views before merging."""

    points: Float[Tensor, "p 3"]
    normals: Float[Tensor, "p 3"]
    rgb: Float[Tensor, "p 3"]
    toward: Float[Tensor, "p 3"]  # unit vectors towards the camera
    label: Int[Tensor, "p"]  # true object

    def select(self, rows: Tensor) -> _Points:
        return _Points(*(column[rows] for column in self))


@torch.no_grad()
def observed(
    scene: Scene, rng: np.random.Generator, degradation: Degradation | None = None
) -> tuple[ScenePoints, Int[Tensor, "n"]]:
    """Points as a reconstruction would produce them, and the true object in the source pixel of each."""
    d = degradation or Degradation.random(rng)
    g, view = scene.gaussians, view_extent(scene)
    parts, seen, fronts = [], torch.zeros(len(g)), []
    for i in range(len(scene.cameras)):
        width, height = scene.cameras.sizes[i].tolist()
        scale = WIDTH / max(width, height)
        w, h = round(width * scale), round(height * scale)
        K = resize(scene.cameras.Ks[i], w / width, h / height)
        drawn = rasterise(g, scene.cameras.viewmats[[i]], K[None], w, h)
        *_, front, weight = visibility(g, scene.cameras.viewmats[i], K, w, h)
        seen += weight > 0.5
        fronts.append(front)
        parts.append(_view_points(drawn.rgb[0].numpy(), drawn.depth[0].numpy(), scene.cameras.viewmats[i], K, d, rng))
    views = []
    for (points, normals, rgb, toward, kept), front in zip(parts, fronts, strict=True):
        front = front.flatten().long()
        ok = kept & (front >= 0) & (seen[front.clamp_min(0)] >= 2)
        label = torch.where(front >= 0, g.object_id[front.clamp_min(0)], 0)
        views.append(_Points(points, normals, rgb, toward, label).select(ok))
    every = _Points(*(torch.cat(column) for column in zip(*views, strict=True)))
    local = (every.points - view.focus) / view.radius
    local[:, 2] = (every.points[:, 2] - (scene.floor or 0.0)) / view.radius
    return _merged(every._replace(points=local), d.merge, rng)


def _view_points(rgb: np.ndarray, depth: np.ndarray, viewmat: Tensor, K: Tensor, d: Degradation, rng) -> tuple:
    """Points (p, 3), normals, colours, directions to the camera and validity of depth, for all pixels in row order."""
    h, w = depth.shape
    far = float(np.quantile(depth[depth > 0], 0.99)) if (depth > 0).any() else 1.0
    z = np.where(depth > 0, depth, 2 * far)
    grey = ndimage.gaussian_filter(rgb.mean(2), 0.7)
    texture = ndimage.maximum_filter(np.hypot(*np.gradient(grey)), 5)
    z = _bent(z, d, rng)
    plain = np.clip(1.5 - texture / max(d.plain, 1e-6), 0, 1)
    z = plain * ndimage.gaussian_filter(z, 2.5) + (1 - plain) * z if d.plain > 0.004 else z
    nearest = ndimage.minimum_filter(z, 5)
    spread = _smooth(h, w, 6, rng) < (2 * d.fatten - 1) * 1.5 if d.fatten > 0.02 else np.zeros((h, w), bool)
    z = np.where(spread, nearest, z)
    z = z * (1 + d.drift * _smooth(h, w, d.patch, rng) + d.grain * rng.normal(size=(h, w)))
    lost = (plain > 0.5) & (_smooth(h, w, 8, rng) < -1 + 2.2 * d.holes)
    kept = (depth > 0) & (z < 1.5 * far) & ~lost & (_smooth(h, w, 5, rng) < 1.9)
    z = torch.from_numpy(z).float()
    u, v = torch.meshgrid(torch.arange(w) + 0.5, torch.arange(h) + 0.5, indexing="xy")
    rays = torch.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], torch.ones_like(u)], -1)
    eye = centres(viewmat[None])[0]
    points = (rays * z[..., None]) @ viewmat[:3, :3] + eye
    smooth = torch.from_numpy(np.stack([ndimage.gaussian_filter(points[..., i].numpy(), 1.0) for i in range(3)], -1))
    across, down = (torch.from_numpy(np.gradient(smooth.numpy(), axis=a).copy()) for a in (1, 0))
    toward = torch.nn.functional.normalize(eye - points, dim=-1)
    normals = torch.nn.functional.normalize(torch.linalg.cross(down, across), dim=-1)
    normals = torch.where((normals * toward).sum(-1, keepdim=True) > 0.1, normals, toward)
    return (points.flatten(0, 1), normals.flatten(0, 1), torch.from_numpy(rgb).flatten(0, 1), toward.flatten(0, 1),
            torch.from_numpy(kept).flatten())  # fmt: skip


def _bent(z: np.ndarray, d: Degradation, rng) -> np.ndarray:
    """Depth displaced in the image plane by a smooth random field of shifts."""
    h, w = z.shape
    rows, columns = np.mgrid[:h, :w]
    shift = [d.bend * _smooth(h, w, d.patch, rng) for _ in range(2)]
    at = [
        np.clip((base + s).round().astype(int), 0, top - 1)
        for base, s, top in zip((rows, columns), shift, (h, w), strict=True)
    ]
    return z[at[0], at[1]]


def _smooth(h: int, w: int, patch: float, rng) -> np.ndarray:
    """Gaussian noise of unit variance, smooth over `patch` pixels."""
    coarse = rng.normal(size=(int(h / patch) + 3, int(w / patch) + 3))
    out = ndimage.zoom(coarse, (h / (coarse.shape[0] - 1), w / (coarse.shape[1] - 1)), order=1)[:h, :w]
    out = np.pad(out, ((0, h - out.shape[0]), (0, w - out.shape[1])), mode="edge")
    return out / max(out.std(), 1e-6)


def _merged(views: _Points, side: float, rng: np.random.Generator) -> tuple[ScenePoints, Int[Tensor, "n"]]:
    """One surfel per occupied cell, with its most frequent label."""
    near = within_reach(views.points, torch.ones(len(views.points)), torch.zeros(len(views.points)))
    points, normals, rgb, toward, labels = views.select(near)
    _, owner, count = (points / side).floor().long().unique(dim=0, return_inverse=True, return_counts=True)

    def total(x: Tensor) -> Tensor:
        return torch.zeros(len(count), x.shape[1]).index_add_(0, owner, x)

    votes = torch.stack([owner, labels], 1).unique(dim=0, return_counts=True)
    order = votes[1].argsort(stable=True)
    own = torch.zeros(len(count), dtype=torch.int64)
    own[votes[0][order, 0]] = votes[0][order, 1]  # the label with the most votes is written last
    middle, n = total(points) / count[:, None], len(count)
    lab = cielab_of(total(rgb) / count[:, None])
    surfels = ScenePoints(
        middle, lab, torch.nn.functional.normalize(total(normals), dim=1),
        torch.from_numpy(rng.uniform(0.4, 0.9, n)).float(), total(toward),
    )  # fmt: skip
    return surfels, own
