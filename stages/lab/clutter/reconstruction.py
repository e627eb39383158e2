"""Reconstruction of a simulated scene by `ngff reconstruct` with known cameras, and true labels of the result."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int, UInt8
from torch import Tensor

from stages.core.geometry.cameras import centres, depths, project
from stages.core.geometry.neighbours import knn
from stages.core.geometry.similarity import umeyama
from stages.core.perception.voting import collect_votes
from stages.core.raster.rasterise import rasterise, visibility
from stages.core.scene.cameras import LensDistortion
from stages.core.scene.scene import Scene
from stages.reconstruct.classic import reconstruct_from_model
from stages.reconstruct.options import ReconstructOptions
from stages.reconstruct.photos import Photos
from stages.reconstruct.sfm import SparseModel
from stages.reconstruct.step_cache import StepCache

MAX_DISTANCE = 0.025  # largest distance from the true surface; Gaussians beyond are floaters [camera distances]
FLOATER = -1  # label of floaters
POINTS = (600, 2500)  # number of points of the sparse model, as structure from motion finds in a dozen photos
POINT_NOISE = 0.002  # standard deviation of the sparse points' positions [camera distances]
HIDDEN = 0.02  # depth difference to the visible surface from which a point is not seen [camera distances]
ITERATIONS = 600  # iterations of the photometric fit; positions hardly change later


def reconstructed(
    scene: Scene, photos: Sequence[UInt8[Tensor, "h w 3"]], rng: np.random.Generator, device: str = "cpu"
) -> Scene:
    """The scene reconstructed from its photos with the true cameras. Raises InputError if they show too little."""
    names = scene.cameras.names
    given = Photos(tuple(photos), names, (0.0,) * len(names), Path("photos"))
    options = ReconstructOptions(cameras=Path("true cameras"), iterations=ITERATIONS, device=device)
    model = _sparse_model(scene, rng, device)
    return reconstruct_from_model(given, model, options, StepCache(), device).scene


def _sparse_model(scene: Scene, rng: np.random.Generator, device: str) -> SparseModel:
    """The true cameras, and random noisy points of the surface that are visible in two or more of them."""
    cameras, g = scene.cameras, scene.gaussians.to(device)
    count = int(rng.integers(*POINTS))
    points = scene.gaussians.means[torch.from_numpy(rng.permutation(len(g))[: 3 * count])]
    seen = torch.zeros(len(points), len(cameras), dtype=torch.bool)
    for i in range(len(cameras)):
        width, height = cameras.sizes[i].tolist()
        view = rasterise(g, cameras.viewmats[[i]].to(device), cameras.Ks[[i]].to(device), width, height)
        pixels, depth = project(points, cameras.viewmats[i], cameras.Ks[i]), depths(points, cameras.viewmats[i])
        inside = (depth > 0.05) & (pixels >= 0).all(1) & (pixels < torch.tensor([width, height])).all(1)
        x, y = torch.where(inside[:, None], pixels, 0.0).long().unbind(1)
        seen[:, i] = inside & ((view.depth[0].cpu().reshape(height, width)[y, x] - depth).abs() < HIDDEN)
    kept = torch.nonzero(seen.sum(1) >= 2)[:, 0][:count]
    point, view = torch.nonzero(seen[kept], as_tuple=True)
    noise = POINT_NOISE * torch.from_numpy(rng.normal(size=(len(kept), 3))).float()
    lenses = LensDistortion(torch.zeros(len(cameras), 5))
    return SparseModel(cameras, lenses, points[kept] + noise, point, view)


def true_labels(made: Scene, truth: Scene) -> Int[Tensor, "n"]:
    """Label of each Gaussian of `made`: majority vote of the true label images in its pixels, over all views.

    The nearest true Gaussian would give a wrong label where the reconstruction spreads an object over the table beside
    it, although photos show the table there. Gaussians in no view do take the label of the nearest true Gaussian, and
    those far from all true surfaces are floaters. Cameras are matched by name.
    """
    rows = [truth.cameras.names.index(name) for name in made.cameras.names]
    to_made = umeyama(_frames(truth.cameras.viewmats[rows]), _frames(made.cameras.viewmats))
    g, means = truth.gaussians, made.gaussians.means
    distance, nearest = knn(to_made(g.means), means.nan_to_num(1e6), 1)
    radius = float((centres(made.cameras.viewmats) - means.nan_to_num(0).median(0).values).norm(dim=1).median())
    votes = collect_votes(made, ((i, label_image(truth, row)) for i, row in enumerate(rows)))
    best, label = votes.max(1)
    label = torch.where(best > 0, label, g.object_id[nearest[:, 0]])
    return torch.where(distance[:, 0] < MAX_DISTANCE * radius, label, FLOATER)


def label_image(scene: Scene, view: int) -> Int[Tensor, "h w"]:
    """The object of the Gaussian with the largest weight in each pixel of a view; 0 in empty pixels."""
    width, height = scene.cameras.sizes[view].tolist()
    front = visibility(scene.gaussians, scene.cameras.viewmats[view], scene.cameras.Ks[view], width, height).index
    return torch.where(front >= 0, scene.gaussians.object_id[front.clamp_min(0).long()], 0)


def _frames(viewmats: Tensor) -> Tensor:
    """Camera centres and points along the camera axes, which determine a similarity even for two cameras."""
    eyes = centres(viewmats)
    return torch.cat([eyes, *(eyes + 0.3 * viewmats[:, i, :3] for i in range(3))])
