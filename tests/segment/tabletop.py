"""Tabletop scenes with known labels: shapes of Gaussians on a plane, with cameras on a circle around them."""

import torch

from stages.core.geometry.cameras import intrinsics, orbit
from stages.core.scene.cameras import Cameras
from stages.core.scene.gaussians import Gaussians, concatenate
from stages.core.scene.scene import Scene
from stages.lab.assets.shapes import Surface, box, ellipsoid, sheet, to_gaussians

WOOD = (0.55, 0.4, 0.25)


def orbit_cameras(count: int = 8, side: int = 160, elevation: float = 35.0) -> Cameras:
    viewmats = orbit(count, torch.tensor([0.0, 0.0, 0.05]), 1.0, elevation)
    K = intrinsics(side, side, 1.4 * side)
    names = tuple(f"{i:02d}.jpg" for i in range(count))
    return Cameras(viewmats, K.expand(count, 3, 3).clone(), torch.full((count, 2), side), names)


def coloured_gaussians(surface: Surface, rgb: tuple, object_id: int, grain: float = 0.03) -> Gaussians:
    rng = torch.Generator().manual_seed(object_id)
    colours = torch.tensor(rgb) + grain * torch.randn(len(surface.points), 3, generator=rng)
    return to_gaussians(surface, colours, object_id, 0.9)


def visible_from_above(surface: Surface) -> Surface:
    """The part of a surface that a reconstruction contains, which excludes its bottom."""
    return surface.kept((surface.normals[:, 2] > -0.5) & (surface.points[:, 2] > 0))


def table_gaussians(spacing: float = 0.012, side: float = 1.2) -> Gaussians:
    return coloured_gaussians(sheet(side, side, spacing), WOOD, 0)


def block(centre: tuple, sides: tuple, rgb: tuple, object_id: int, spacing: float = 0.007) -> Gaussians:
    return coloured_gaussians(visible_from_above(box(sides, spacing).moved((*centre, sides[2] / 2))), rgb, object_id)


def egg(centre: tuple, radii: tuple, rgb: tuple, object_id: int, n: int = 1500) -> Gaussians:
    return coloured_gaussians(visible_from_above(ellipsoid(radii, n).moved(centre)), rgb, object_id)


def scene_of(*parts: Gaussians, noise: float = 0.0, tilt: float = 0.0, cameras: bool = True) -> Scene:
    """A scene of all parts with noise [m] of the positions, in which z is sheared by `tilt` along x."""
    g = concatenate(parts)
    rng = torch.Generator().manual_seed(1)
    means = g.means + noise * torch.randn(len(g), 3, generator=rng)
    means = torch.stack([means[:, 0], means[:, 1], means[:, 2] + tilt * means[:, 0]], 1)
    moved = Gaussians(means, g.quats, g.scales, g.opacities, g.sh, g.object_id)
    return Scene(moved, (), orbit_cameras() if cameras else None, 0.0)


def three_apart(side: float = 1.2, **how) -> Scene:
    """A red block, a blue egg and a green tower, separate on a table; a smaller table reduces the time of networks."""
    return scene_of(
        table_gaussians(side=side), block((-0.2, -0.1), (0.12, 0.1, 0.08), (0.8, 0.1, 0.1), 1),
        egg((0.2, -0.1, 0.07), (0.06, 0.06, 0.07), (0.1, 0.2, 0.8), 2),
        block((0.02, 0.2), (0.06, 0.06, 0.16), (0.1, 0.6, 0.2), 3), **how,
    )  # fmt: skip


def best_overlap(found: torch.Tensor, truth: torch.Tensor) -> dict[int, float]:
    """For each true object, the largest IoU with a found object."""
    out = {}
    for t in truth.unique().tolist():
        if t > 0:
            mine = truth == t
            out[t] = max(
                float((mine & (found == f)).sum() / (mine | (found == f)).sum()) for f in found.unique().tolist()
            )
    return out
