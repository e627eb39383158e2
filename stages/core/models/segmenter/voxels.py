"""Voxels with features from the Gaussians of a scene, the input of the segmentation network.

Lengths are in units of the distance of the cameras from their common focus, so that the network is independent of the
size of a scene.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.core.geometry.neighbours import knn
from stages.core.geometry.rotations import matrix
from stages.core.geometry.symmetric_matrices import eigh
from stages.core.scene.gaussians import SURFACE_OPACITY

VOXEL = 0.01  # side of a voxel [camera distance]
SCALES = (1.0, 1.5, 2.25)  # factors by which scenes are enlarged, so that objects of all sizes span many voxels
REACH = 1.5  # Gaussians farther from the focus are ignored [camera distance]
MAX_SCALE = 0.1  # Gaussians with a larger standard deviation are ignored as backdrops [camera distance]
NORMAL_NEIGHBOURS = 16  # voxels to which a normal is fitted
FEATURES, LAB = 11, slice(6, 9)  # number of features of a voxel, and the columns of its colour


@dataclass(frozen=True)
class ScenePoints:
    """Inputs of the network for each Gaussian; lengths in camera distances about the focus, z up."""

    points: Float[Tensor, "n 3"]  # z above the supporting plane
    lab: Float[Tensor, "n 3"]  # CIELAB
    normals: Float[Tensor, "n 3"]  # shortest axis, not oriented
    flatness: Float[Tensor, "n"]  # 0 for a ball, 1 for a disc
    toward: Float[Tensor, "n 3"]  # sum of unit directions to the cameras that see the Gaussian; 0: not seen

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, index) -> ScenePoints:
        return ScenePoints(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    def to(self, device: torch.device | str) -> ScenePoints:
        """Return a copy on another device."""
        return ScenePoints(*(getattr(self, name).to(device) for name in self.__dataclass_fields__))

    def enlarged(self, scale: float) -> ScenePoints:
        """Return a copy with positions multiplied by `scale`."""
        return replace(self, points=scale * self.points)

    def turned(self, R: Float[Tensor, "3 3"]) -> ScenePoints:
        """Return a copy rotated or mirrored about the focus."""
        points, normals, toward = (v @ R.mT for v in (self.points, self.normals, self.toward))
        return replace(self, points=points, normals=normals, toward=toward)


@dataclass(frozen=True)
class VoxelGrid:
    """Occupied voxels, their features, and the voxel of each surfel."""

    cells: Int[Tensor, "v 3"]
    points: Float[Tensor, "v 3"]  # mean position [camera distance]
    features: Float[Tensor, "v f"]
    owner: Int[Tensor, "n"]  # voxel of each surfel

    def __len__(self) -> int:
        return len(self.cells)

    def means(self, values: Float[Tensor, "n *c"]) -> Float[Tensor, "v *c"]:
        """Mean of values over the surfels of each voxel."""
        return _means(values, self.owner.argsort(stable=True), torch.bincount(self.owner, minlength=len(self)))

    @property
    def lab(self) -> Float[Tensor, "v 3"]:
        """Mean colours in CIELAB, scaled as network inputs."""
        return self.features[:, LAB]


def shortest_axes(quats: Float[Tensor, "n 4"], scales: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Direction of each Gaussian's shortest axis, which is the normal of a flat Gaussian."""
    return matrix(quats)[torch.arange(len(quats)), :, scales.argmin(1)]


def voxelise(surfels: ScenePoints, shift: Float[Tensor, "3"] | None = None, features: bool = True) -> VoxelGrid:
    """Voxelise a scene, without features if `features` is False; `shift` moves the surfels relative to the grid."""
    cell = (surfels.points + (0 if shift is None else shift)).div(VOXEL).floor().long()
    cells, owner, count = unique_cells(cell)
    order = owner.argsort(stable=True)
    points = _means(surfels.points, order, count)
    if not features:
        return VoxelGrid(cells, points, points[:, :0], owner)
    axes = surfels.flatness[:, None, None] * _outer(surfels.normals)
    lab, toward, axes = (_means(v, order, count) for v in (surfels.lab, surfels.toward, axes))
    normals = _normals(points, axes, toward)
    within = (points + (0 if shift is None else shift)) / VOXEL - cells - 0.5
    z = points[:, 2:]
    lab = lab / 50 - lab.new_tensor([1.0, 0, 0])
    columns = [within, normals, lab, (z / 0.02).tanh(), (z / 0.15).tanh()]
    return VoxelGrid(cells, points, torch.cat(columns, 1), owner)


def _means(values: Float[Tensor, "n *c"], order: Int[Tensor, "n"], count: Int[Tensor, "v"]) -> Float[Tensor, "v *c"]:
    """Means over groups of rows that are contiguous in `order`; summed in this order, so reproducible on a GPU."""
    total = torch.segment_reduce(values[order].flatten(1), "sum", lengths=count, axis=0)
    return (total / count[:, None]).reshape(-1, *values.shape[1:])


def _outer(v: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 3"]:
    return v[:, :, None] * v[:, None]


def _normals(points: Tensor, axes: Float[Tensor, "v 3 3"], toward: Float[Tensor, "v 3"]) -> Float[Tensor, "v 3"]:
    """Unit normals from the shortest axes of Gaussians and planes through neighbours, towards the cameras or up."""
    k = min(NORMAL_NEIGHBOURS, len(points))
    around = points[knn(points, points, k)[1]]
    centred = around - around.mean(1, keepdim=True)
    spread = centred.mT @ centred
    spread = spread / spread.diagonal(dim1=1, dim2=2).sum(1).clamp_min(1e-12)[:, None, None]
    normals = eigh(axes + torch.eye(3).to(axes) - 2 * spread)[1][:, :, -1]
    outward = torch.where(toward.norm(dim=1, keepdim=True) > 1e-6, toward, toward.new_tensor([0.0, 0, 1]))
    return normals * torch.where((normals * outward).sum(1, keepdim=True) < 0, -1.0, 1.0)


def neighbour_table(cells: Int[Tensor, "v 3"]) -> Int[Tensor, "v 27"]:
    """Index of the voxel at each of the 27 offsets -1..1 from every voxel; v where there is none.

    Column k is for offset (k // 9, k // 3 % 3, k % 3) - 1, so that column 26 - k is for the opposite offset.
    """
    count, own = len(cells), _keys(cells)
    keys, order = own.sort()
    offsets = torch.cartesian_prod(*[torch.arange(-1, 2)] * 3)[:13].to(cells)
    wanted = own[:, None] + (_keys(offsets) - _keys(torch.zeros_like(offsets[0])))
    at = torch.searchsorted(keys, wanted).clamp_max(count - 1)
    table = torch.full((count, 27), count, device=cells.device)
    table[:, 13] = torch.arange(count, device=cells.device)
    i, k = torch.nonzero(keys[at] == wanted, as_tuple=True)
    j = order[at[i, k]]
    table[i, k], table[j, 26 - k] = j, i
    return table


def _keys(cells: Int[Tensor, "*b 3"]) -> Int[Tensor, "*b"]:
    """Unique integer key of each cell, for coordinates within +-2^20."""
    x, y, z = (cells + (1 << 20)).unbind(-1)
    return (x << 42) | (y << 21) | z


def unique_cells(cells: Int[Tensor, "n 3"]) -> tuple[Int[Tensor, "v 3"], Int[Tensor, "n"], Int[Tensor, "v"]]:
    """Return the distinct cells, the cell of each row, and the number of rows in each cell."""
    keys, owner, count = _keys(cells).unique(return_inverse=True, return_counts=True)
    low = (1 << 21) - 1
    return torch.stack([keys >> 42, (keys >> 21) & low, keys & low], 1) - (1 << 20), owner, count


def coarser(cells: Int[Tensor, "v 3"]) -> tuple[Int[Tensor, "w 3"], Int[Tensor, "v"], Int[Tensor, "w 8"]]:
    """Return the voxels of twice the side, the coarse voxel of each voxel, and the voxels in each coarse voxel.

    Missing voxels have index v.
    """
    up, owner, _ = unique_cells(cells >> 1)
    children = torch.full((len(up), 8), len(cells), device=cells.device)
    x, y, z = (cells & 1).unbind(1)
    children[owner, 4 * x + 2 * y + z] = torch.arange(len(cells), device=cells.device)
    return up, owner, children


def within_reach(
    points: Float[Tensor, "n 3"], opacity: Float[Tensor, "n"], size: Float[Tensor, "n"]
) -> Bool[Tensor, "n"]:
    """Mask of Gaussians that are network inputs; lengths are in camera distances, relative to the focus."""
    finite = points.isfinite().all(1) & size.isfinite()
    return finite & (points.norm(dim=1) < REACH) & (opacity > SURFACE_OPACITY) & (size < MAX_SCALE)
