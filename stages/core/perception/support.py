"""Find the supporting surface of a scene: its shape, its noise, and its extent."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from stages.core.geometry.cameras import centres
from stages.core.geometry.cells import distinct_cells
from stages.core.geometry.planes import ransac
from stages.core.scene.cameras import Cameras
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.scene import Scene

SEARCH_RADIUS = 1.5  # distance from the focus within which Gaussians are examined [camera distance]
GRID_CELLS = 300  # cells along a side of the grid over the surface
MAX_QUANTILE_POINTS = 100_000  # maximum number of points that a quantile of distances is computed from


@dataclass(frozen=True)
class ViewExtent:
    """The point that the cameras look at, and their distance from it, the unit of most thresholds (camera distance)."""

    focus: Float[Tensor, "3"]
    radius: float  # median distance of the cameras from the focus [scene units]


def view_extent(scene: Scene) -> ViewExtent:
    """The focus of the cameras and their median distance from it.

    Without cameras: the median of the Gaussians, and 1.5 times the 80 % quantile of their distances from it.
    """
    if scene.cameras is not None and len(scene.cameras):
        focus = _focus(scene.cameras, scene.floor)
        radius = float((centres(scene.cameras.viewmats) - focus).norm(dim=1).median())
        if radius > 0 and np.isfinite(radius):
            return ViewExtent(focus, radius)
    g = scene.gaussians
    opaque = g.means[(g.opacities > 0.1) & g.means.isfinite().all(1)]
    if not len(opaque):
        return ViewExtent(torch.zeros(3), 1.0)
    focus = opaque.median(0).values
    distance = evenly_spaced((opaque - focus).norm(dim=1), MAX_QUANTILE_POINTS)
    return ViewExtent(focus, 1.5 * max(float(distance.quantile(0.8)), 1e-6))


def evenly_spaced(values: Float[Tensor, "n"], count: int) -> Float[Tensor, "m"]:
    """At most `count` of the sorted values, at evenly spaced ranks; all values, unsorted, if there are no more."""
    if len(values) <= count:
        return values
    return values.sort().values[torch.linspace(0, len(values) - 1, count, dtype=torch.float64).round().long()]


def _focus(cameras: Cameras, floor: float | None) -> Float[Tensor, "3"]:
    """Median of the intersections of the optical axes with the floor, or else the point nearest to all axes."""
    eyes, ahead = centres(cameras.viewmats), cameras.viewmats[:, 2, :3]
    down = ahead[:, 2] < -0.15
    if floor is not None and down.any():
        distance = (floor - eyes[down, 2]) / ahead[down, 2]
        return (eyes[down] + ahead[down] * distance.clamp_min(0)[:, None]).median(0).values
    across = torch.eye(3) - ahead[:, :, None] * ahead[:, None, :]
    A, b = across.sum(0), (across @ eyes[:, :, None]).sum(0)
    ridge = 1e-6 * torch.eye(3) * A.trace()
    return torch.linalg.solve(A + ridge, b + ridge @ eyes.mean(0)[:, None])[:, 0]


@dataclass(frozen=True)
class Support:
    """A nearly level surface z = p(x, y) + relief with a quadratic p, and its extent."""

    view: ViewExtent
    coefficients: Float[Tensor, "6"]  # of 1, x, y, x^2, xy, y^2 about the focus, in units of the camera distance
    noise: float  # robust standard deviation of its Gaussians from it [scene units]
    cell: float  # side of a grid cell [scene units]
    region: Bool[Tensor, "gx gy"]  # cells of the table, visible or under objects; the grid is centred on the focus
    relief: Float[Tensor, "gx gy"]  # large-scale deviation of the table, or its reconstruction, from p [scene units]

    @property
    def tolerance(self) -> float:
        """Height up to which Gaussians belong to the surface itself [scene units]."""
        return min(max(3 * self.noise, 0.004 * self.view.radius), 0.02 * self.view.radius)

    def heights(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Heights of points above the surface [scene units]."""
        return points[:, 2] - self.surface(points)

    def surface(self, points: Float[Tensor, "n d"]) -> Float[Tensor, "n"]:
        """Height z of the surface at the x and y of points [scene units]."""
        xy = (points[:, :2] - self.view.focus[:2]) / self.view.radius
        far = xy.norm(dim=1, keepdim=True).clamp_min(SEARCH_RADIUS) / SEARCH_RADIUS  # p is radially constant beyond it
        i, j = self.cells(points).unbind(1)
        return _terms(xy / far) @ self.coefficients + self.relief[i, j]

    def cells(self, points: Float[Tensor, "n d"]) -> Int[Tensor, "n 2"]:
        """Grid cell of each point, clamped to the grid."""
        half = self.cell * len(self.region) / 2
        index = ((points[:, :2] - self.view.focus[:2] + half) / self.cell).floor()
        return index.nan_to_num(0).clamp(0, len(self.region) - 1).long()

    def inside(self, points: Float[Tensor, "n d"], margin: float = 0.0) -> Bool[Tensor, "n"]:
        """Whether points are over the table, or at most `margin` [scene units] beyond its edge."""
        i, j = self.cells(points).unbind(1)
        if not margin:
            return self.region[i, j]
        return torch.from_numpy(ndimage.distance_transform_edt(~self.region.numpy()) * self.cell <= margin)[i, j]


def _terms(xy: Float[Tensor, "n 2"]) -> Float[Tensor, "n 6"]:
    x, y = xy.unbind(1)
    return torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y], 1)


def find_support(scene: Scene, view: ViewExtent | None = None, seed: int = 0) -> Support | None:
    """The surface at `scene.floor`, or else the largest level surface near the focus; None if there is none."""
    view = view or view_extent(scene)
    g, R = scene.gaussians, view.radius
    points = g.means[is_opaque(g, R) & ((g.means - view.focus)[:, :2].norm(dim=1) < SEARCH_RADIUS * R)]
    floor = scene.floor if scene.floor is not None else _level(points, view, seed)
    if floor is None or not np.isfinite(floor):
        return None
    band = points[(points[:, 2] - floor).abs() < 0.05 * R]
    if len(band) < 50:
        return None
    coefficients, noise = _fit(band, floor, view, seed)
    bare = Support(
        view, coefficients, noise, 2 * SEARCH_RADIUS * R / GRID_CELLS,
        torch.zeros(GRID_CELLS, GRID_CELLS, dtype=torch.bool), torch.zeros(GRID_CELLS, GRID_CELLS),
    )  # fmt: skip
    uneven = replace(bare, relief=_relief(bare, band))
    even = 1 / (1 + ((band - view.focus)[:, :2].norm(dim=1) / (0.7 * R)) ** 4)
    noise = R * _spread((uneven.heights(band) / R).double(), even)
    found = replace(uneven, noise=noise)
    found = replace(found, region=_region(found, band))
    return found if found.region.any() else None


def is_opaque(g: Gaussians, radius: float) -> Bool[Tensor, "n"]:
    """Mask of Gaussians that are finite, opaque (opacity above 0.1) and smaller than 0.2 `radius`."""
    return g.means.isfinite().all(1) & (g.opacities > 0.1) & (g.scales.amax(1) < 0.2 * radius)


def _level(points: Float[Tensor, "n 3"], view: ViewExtent, seed: int) -> float | None:
    """Height of the level plane with the most inliers near the focus, by RANSAC; None if they are less than 5 %."""
    near = 1 / (1 + ((points - view.focus).norm(dim=1) / (0.5 * view.radius)) ** 4)
    found = ransac(points, 0.01 * view.radius, near, lambda normals: normals[:, 2] > 0.98, seed=seed)
    if found is None or float(near[found[1]].sum() / near.sum()) < 0.05:
        return None
    plane = found[0]
    return float((plane.offset - view.focus[:2] @ plane.normal[:2]) / plane.normal[2])


def _fit(band: Float[Tensor, "n 3"], floor: float, view: ViewExtent, seed: int) -> tuple[Tensor, float]:
    """Fit a quadratic surface by iteratively reweighted least squares with Tukey's biweight; also return its noise.

    Each patch of the table has the same weight, reduced far from the focus. A ridge penalty on the curvature keeps low
    objects, such as a keyboard, from bending the surface.
    """
    R = view.radius
    local = (band - torch.cat([view.focus[:2], torch.tensor([floor])])) / R
    patch, count = distinct_cells(((local[:, :2] + SEARCH_RADIUS) / 0.02).floor().long())
    even = (1 / count[patch].float()) / (1 + (local[:, :2].norm(dim=1) / 0.7) ** 4)
    coefficients = torch.zeros(6, dtype=torch.float64)
    found = ransac(local, 0.004, even, lambda normals: normals[:, 2] > 0.99, trials=300, seed=seed)
    if found is not None:
        n, d = found[0]
        coefficients[:3] = torch.tensor([d / n[2], -n[0] / n[2], -n[1] / n[2]])
    terms, z, start = _terms(local[:, :2]).double(), local[:, 2].double(), coefficients.clone()
    ridge = torch.diag(torch.tensor([1e-6, 1e-3, 1e-3, 0.03, 0.03, 0.03], dtype=torch.float64))
    for _ in range(8):
        residual = z - terms @ coefficients
        noise = _spread(residual, even)
        width = max(4.685 * noise, 0.003)
        weight = even * (1 - (residual / width) ** 2).clamp_min(0) ** 2
        A = terms.mT @ (weight[:, None] * terms) + ridge * weight.sum()
        b = terms.mT @ (weight * (z - terms @ start))
        coefficients = start + torch.linalg.solve(A, b)
    coefficients[0] += floor / R
    return (coefficients * R).float(), noise * R


def _spread(residual: Float[Tensor, "n"], weights: Float[Tensor, "n"], bin: float = 2.5e-4) -> float:
    """Standard deviation of the peak of the residuals near 0, from its half width at half maximum on the narrower side.

    Quantiles are not usable, since a large fraction of the residuals belongs to low objects on the surface.
    """
    edges = np.arange(-0.04, 0.04 + bin, bin)
    height, _ = np.histogram(residual.numpy(), edges, weights=weights.numpy())
    height = ndimage.gaussian_filter1d(height, 2.0)
    middle = len(height) // 2
    peak = middle - 20 + int(np.argmax(height[middle - 20 : middle + 20]))
    low = height < 0.5 * height[peak]
    left = low[:peak][::-1].argmax() if low[:peak].any() else peak
    right = low[peak:].argmax() if low[peak:].any() else len(height) - peak
    return float(max(1, min(left, right)) * bin / 1.177)


def cell_medians(
    support: Support, points: Float[Tensor, "n d"], values: Float[Tensor, "n v"], coarse: int = 1
) -> Float[Tensor, "gx gy v"]:
    """Median of the points' values in each cell, or in each block of `coarse` x `coarse` cells; nan in empty ones."""
    side = -(-len(support.region) // coarse)
    cell = (support.cells(points) // coarse) @ torch.tensor([side, 1])
    out = torch.full((side * side, values.shape[1]), torch.nan)
    for v in range(values.shape[1]):
        order = np.lexsort((values[:, v].numpy(), cell.numpy()))
        which, first, count = np.unique(cell.numpy()[order], return_index=True, return_counts=True)
        out[which, v] = values[:, v][order[first + count // 2]]
    return out.reshape(side, side, -1)


def sliding_quantile(grid: Float[Tensor, "gx gy v"], radius: int, fraction: float = 0.5) -> Float[Tensor, "gx gy v"]:
    """Quantile over a window of `radius` cells around each cell, ignoring nan; empty windows take the nearest value."""
    side = 2 * radius + 1
    out = []
    for layer in grid.unbind(2):
        padded = np.pad(layer.numpy(), radius, constant_values=np.nan)
        stack = np.lib.stride_tricks.sliding_window_view(padded, (side, side)).reshape(*layer.shape, -1)
        stack = np.sort(stack, axis=-1)  # nan go last
        count = np.isfinite(stack).sum(-1)
        pick = np.take_along_axis(stack, (fraction * (count - 1).clip(0)).astype(int)[..., None], -1)[..., 0]
        if count.any():
            near = ndimage.distance_transform_edt(count == 0, return_distances=False, return_indices=True)
            pick = pick[tuple(near)]
        out.append(torch.from_numpy(np.nan_to_num(pick)).float())
    return torch.stack(out, 2)


def _relief(bare: Support, band: Float[Tensor, "n 3"]) -> Float[Tensor, "gx gy"]:
    """Large-scale relief: quantiles over windows a quarter of the camera distance wide, mostly free of objects."""
    h = bare.heights(band)
    near = h.abs() < 0.025 * bare.view.radius
    if not near.any():
        return bare.relief
    coarse = 3
    rough = sliding_quantile(cell_medians(bare, band[near], h[near, None], coarse), radius=4, fraction=0.45)[..., 0]
    smooth = ndimage.gaussian_filter(rough.numpy(), 1.5)
    fine = ndimage.zoom(smooth, len(bare.region) / len(smooth), order=1)
    return torch.from_numpy(fine).float()


def _region(bare: Support, band: Float[Tensor, "n 3"]) -> Bool[Tensor, "gx gy"]:
    """Cells of the connected piece of surface in focus, by morphological closing over the objects that stand on it."""
    on = band[bare.heights(band).abs() < bare.tolerance]
    count = np.zeros((GRID_CELLS, GRID_CELLS))
    np.add.at(count, tuple(bare.cells(on).T.numpy()), 1)
    density = ndimage.uniform_filter(count, 3)
    middle = slice(GRID_CELLS // 2 - GRID_CELLS // 8, GRID_CELLS // 2 + GRID_CELLS // 8)
    usual = density[middle, middle]
    seen = density > 0.1 * np.median(usual[usual > 0]) if (usual > 0).any() else density > 0  # ignores stray Gaussians
    seen = _closed(np.pad(seen, 40), 4)
    parts, count = ndimage.label(seen)
    if not count:
        return torch.zeros(GRID_CELLS, GRID_CELLS, dtype=torch.bool)
    middle = (np.arange(GRID_CELLS + 80) - GRID_CELLS / 2 - 39.5) * bare.cell / bare.view.radius
    near = 1 / (1 + (np.hypot(*np.meshgrid(middle, middle, indexing="ij")) / 0.5) ** 4)
    best = 1 + int(np.argmax(ndimage.sum(near, parts, np.arange(1, count + 1))))
    part = ndimage.binary_fill_holes(_closed(parts == best, 20))
    return torch.from_numpy(part[40:-40, 40:-40].copy())


def _closed(mask: np.ndarray, radius: int) -> np.ndarray:
    """Morphological closing by a disc, by distance transforms: its cost does not grow with the radius."""
    if not mask.any():
        return mask
    outside = np.pad(ndimage.distance_transform_edt(~mask) > radius, 1, constant_values=True)
    return (ndimage.distance_transform_edt(~outside) > radius)[1:-1, 1:-1]


def topples(points: Float[Tensor, "n 2"], base: Float[Tensor, "m 2"]) -> bool:
    """Whether a body falls over: the centroid of its points lies outside the convex hull of its base points (x, y)."""
    try:
        hull = ConvexHull(base.double().numpy()).equations
    except (QhullError, ValueError):  # the base has no area
        return False
    return bool((hull[:, :2] @ points.double().mean(0).numpy() + hull[:, 2]).max() > 0)
