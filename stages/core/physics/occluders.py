"""Spheres that approximate the objects for shadows; they move with the keypoints as Gaussians do."""

from __future__ import annotations

import logging
from dataclasses import replace
from itertools import product

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.errors import InputError
from stages.core.geometry.cells import distinct_cells
from stages.core.kernels.sphere_shadows import Spheres
from stages.core.physics.keypoints import KEYPOINTS_PER_GAUSSIAN, farthest_points, nearest_weights
from stages.core.physics.particles import sample_bodies
from stages.core.physics.skinning import Skinning
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.scene import Scene
from stages.core.scene.trajectory import Binding, Keypoints

log = logging.getLogger(__name__)
PARTICLES = 4000  # particles of all objects together, which are clustered into spheres
SPHERES = 8  # per object
MAX_SPHERES = 480  # of all objects together
LLOYD_STEPS = 8
_VIEWS = torch.nn.functional.normalize(  # axes, face diagonals and space diagonals of a cube
    torch.tensor([view for view in product((1.0, 0.0, -1.0), repeat=3) if view > (0.0, 0.0, 0.0)])
)


class Occluders:
    """The spheres at rest, bound to keypoints; the spheres of frames are on `device`."""

    def __init__(self, rest: Spheres, keypoints: Keypoints, device: str = "cpu"):
        self.binding = _bind(rest, keypoints)
        self.rest, m = rest.to(device), len(rest.radii)
        carriers = Gaussians(
            rest.centres, torch.tensor([[1.0, 0, 0, 0]]).repeat(m, 1), rest.radii[:, None].repeat(1, 3), torch.ones(m),
            torch.zeros(m, 1, 3), rest.object_id,
        )  # fmt: skip
        self._skinning = Skinning(carriers.to(device), self.binding, keypoints)
        _, self._object = self.rest.object_id.unique(return_inverse=True)
        self._radius = self._per_object(self._from_middle() + self.rest.radii, "amax")

    def moved(self, positions: Float[Tensor, "p 3"], fade: bool = False) -> Spheres:
        """The spheres for these keypoint positions [scene units].

        With `fade` an object blocks no light at rest, and its full share once it has moved by its radius.
        """
        centres, weights = self._skinning(positions).means, self.rest.weights
        if fade:
            distance = self._per_object((centres - self.rest.centres).norm(dim=1), "mean")
            weights = weights * (distance / self._radius).clamp_max(1)
        return replace(self.rest, centres=centres, weights=weights)

    def _from_middle(self) -> Float[Tensor, "m"]:
        middle = torch.stack([self._per_object(axis, "mean") for axis in self.rest.centres.unbind(1)], 1)
        return (self.rest.centres - middle).norm(dim=1)

    def _per_object(self, values: Float[Tensor, "m"], reduce: str) -> Float[Tensor, "m"]:
        """The mean or maximum over the spheres of an object, at each of its spheres."""
        count = int(self._object.max()) + 1
        return values.new_zeros(count).scatter_reduce(0, self._object, values, reduce, include_self=False)[self._object]


def make_occluders(scene: Scene, keypoints: Keypoints, device: str = "cpu") -> Occluders | None:
    """Spheres of the objects that have keypoints; None if there are no such objects, or an object cannot be sampled."""
    moving = [o for o in scene.objects if bool((keypoints.object_id == o.id).any())]
    count = min(SPHERES, MAX_SPHERES // max(len(moving), 1))
    if not count or not moving:
        return None
    try:
        bodies = sample_bodies(scene, PARTICLES, skin=True)
    except InputError as error:
        log.warning("shadows are not rendered: %s", error)
        return None
    parts = []
    for row, o in enumerate(scene.objects):
        own = bodies.body == row
        if o in moving and bool(own.any()):
            parts.append(_spheres(bodies.x[own].float(), bodies.volume[own].float(), bodies.spacing, count, o.id))
    fields = zip(*((s.centres, s.radii, s.weights, s.object_id) for s in parts), strict=True)
    return Occluders(Spheres(*(torch.cat(f) for f in fields)), keypoints, device) if parts else None


def _spheres(x: Tensor, volume: Tensor, spacing: float, count: int, id: int) -> Spheres:
    """Cluster the particles of an object by Lloyd's algorithm; each cluster gives the sphere of equal volume."""
    centres = x[farthest_points(x, count)]
    for _ in range(LLOYD_STEPS):
        nearest = torch.cdist(x, centres).argmin(1)
        size = torch.bincount(nearest, minlength=len(centres))
        sums = torch.zeros_like(centres).index_add(0, nearest, x)
        centres = torch.where(size[:, None] > 0, sums / size.clamp_min(1)[:, None], centres)
    volumes = torch.zeros(len(centres)).index_add(0, torch.cdist(x, centres).argmin(1), volume)
    centres, volumes = centres[volumes > 0], volumes[volumes > 0]
    radii = (0.75 / torch.pi * volumes) ** (1 / 3)
    weight = float(_projected_area(x, spacing) / (torch.pi * radii.square().sum()))
    m = len(radii)
    return Spheres(centres, radii, torch.full((m,), weight), torch.full((m,), id))


def _projected_area(x: Tensor, spacing: float) -> float:
    """Projected area of a body of voxels of edge `spacing` [square scene units], averaged over several views."""
    areas = []
    for view in _VIEWS:
        a = torch.nn.functional.normalize(torch.linalg.cross(view, torch.tensor([0.12, 0.52, -0.7])), dim=0)
        cells = (torch.stack([x @ a, x @ torch.linalg.cross(view, a)], 1) / spacing).round().long()
        areas.append(len(distinct_cells(cells)[1]))
    return sum(areas) / len(areas) * spacing**2


def _bind(spheres: Spheres, keypoints: Keypoints) -> Binding:
    """Bind each sphere to the nearest keypoints of its object."""
    m = len(spheres.radii)
    index, weight = torch.full((m, KEYPOINTS_PER_GAUSSIAN), -1), torch.zeros(m, KEYPOINTS_PER_GAUSSIAN)
    for id in spheres.object_id.unique():
        rows, own = spheres.object_id == id, (keypoints.object_id == id).nonzero()[:, 0]
        near, weight[rows] = nearest_weights(keypoints.rest[own].float(), spheres.centres[rows], KEYPOINTS_PER_GAUSSIAN)
        index[rows] = own[near]
    return Binding(index, weight)
