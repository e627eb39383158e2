"""Sampling of painted signed distance fields: evenly spaced Gaussians with baked light."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.geometry.harmonics import C0, basis
from stages.core.geometry.neighbours import knn
from stages.core.scene.gaussians import Gaussians
from stages.lab.assets.shapes import Surface, to_gaussians
from stages.lab.assets.signed_distance import Field, Vec, union

GRID_CELLS = 64  # cells of the candidate grid along the longest side
SKY_LIGHT, KEY_LIGHT = (
    torch.tensor([0.0, 0.0, 1.0]),
    torch.nn.functional.normalize(torch.tensor([-0.35, -0.75, 0.85]), dim=0),
)
HIGHLIGHT_LEGENDRE = (1 / 14, 3 / 16, 5 / 21)  # Legendre coefficients of max(cos, 0)^6


@dataclass(frozen=True)
class PaintedPart:
    """Part of an object: its field, its colour as a function of points (n, 3) -> RGB (n, 3), and its gloss."""

    field: Field
    paint: Callable[[Tensor], Tensor]
    gloss: float = 0.0  # brightness added at the centre of the highlight


def gaussians_from_parts(
    parts: list[PaintedPart], half: Vec, n: int, smooth: float = 0.0, skin: float = 0.008
) -> Gaussians:
    """n flat Gaussians of SH degree 2 on the union of the parts, normalised to longest side 1.

    The union must lie within +-half; `smooth` is the blending width of its creases. A point has the colour and gloss of
    the nearest part. `skin` is half the width of the sampled band, less than half the thickness of the thinnest wall.
    Deterministic.
    """
    return normalise_size(sample_parts(parts, half, n, smooth, skin)[0])


def sample_parts(
    parts: list[PaintedPart], half: Vec, n: int, smooth: float = 0.0, skin: float = 0.008
) -> tuple[Gaussians, Int[Tensor, "n"]]:
    """Like `gaussians_from_parts`, but not normalised; also returns the part nearest to each Gaussian."""
    field = union(*(part.field for part in parts), smooth=smooth)
    surface = relax_points(field, sample_surface(field, half, n, skin))
    p = surface.points
    owner = torch.stack([part.field(p) for part in parts]).argmin(0)
    rgb, gloss = torch.zeros(len(p), 3), torch.zeros(len(p))
    for i, part in enumerate(parts):
        own = owner == i
        if own.any():
            rgb[own], gloss[own] = part.paint(p[own]), part.gloss
    light = diffuse_light(surface) * ambient_occlusion(field, surface)
    flat = to_gaussians(surface, rgb * light[:, None], 1, width=0.62)
    return replace(flat, sh=add_highlight(flat.sh, surface.normals, gloss)), owner


def normalise_size(g: Gaussians) -> Gaussians:
    """Gaussians scaled to longest side 1, their bounding box centred on the origin."""
    low, high = g.means.amin(0), g.means.amax(0)
    side = (high - low).max()
    return replace(g, means=(g.means - (low + high) / 2) / side, scales=g.scales / side)


def distance_and_normal(field: Field, p: Float[Tensor, "n 3"], step: float = 1e-3) -> tuple[Tensor, Tensor]:
    """First-order distance to the surface (n,) and unit gradient (n, 3), by finite differences over a tetrahedron."""
    corners = torch.tensor([[1.0, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]])
    values = torch.stack([field(p + step * corner) for corner in corners], 1)
    gradient = values @ corners / (4 * step)
    size = gradient.norm(dim=1).clamp_min(1e-3)
    return values.mean(1) / size, gradient / size[:, None]


def sample_surface(field: Field, half: Vec, n: int, skin: float) -> Surface:
    """n random points, uniformly distributed over the surface of a field with a gradient norm between 1/2 and 2.

    Points in a thin band of half width `skin` around the surface are projected onto it along the gradient. Candidates
    are drawn only from cells of a coarse grid that the band may intersect.
    """
    generator = torch.Generator().manual_seed(n)
    cell = 2 * max(half) / GRID_CELLS
    corners = torch.cartesian_prod(*(torch.arange(-h - cell, h + cell, cell) for h in half))
    near = corners[field(corners + cell / 2).abs() < 2 * (0.87 * cell + skin)]  # 0.87: half the diagonal of a cell
    found, count = [], 0
    while count < n:
        which = torch.randint(len(near), (4 * n,), generator=generator)
        p = near[which] + cell * torch.rand(4 * n, 3, generator=generator)
        p = p[field(p).abs() < 2 * skin]
        distance, normal = distance_and_normal(field, p)
        found.append((p - distance[:, None] * normal)[distance.abs() < skin])
        count += len(found[-1])
    return project_to_surface(field, torch.cat(found)[:n])


def project_to_surface(field: Field, p: Float[Tensor, "n 3"], steps: int = 2) -> Surface:
    """Points near the surface projected onto it by Newton steps, with the normals before the last step."""
    for _ in range(steps):
        distance, normal = distance_and_normal(field, p)
        p = p - distance.clamp(-0.01, 0.01)[:, None] * normal
    return Surface(p, normal)


def relax_points(field: Field, surface: Surface, rounds: int = 5) -> Surface:
    """Even out the spacing: points repel neighbours on the same side and are projected back onto the surface."""
    for last in [False] * (rounds - 1) + [True]:
        p, normal = surface.points, surface.normals
        distance, index = knn(p, p, 8)
        distance, index = distance[:, 1:], index[:, 1:]
        radius = 1.1 * float(distance[:, 4].median())  # unlike a mean, the median does not depend on the thread count
        push = (1 - distance / radius).clamp_min(0) * (normal[:, None] * normal[index]).sum(-1).clamp_min(0)
        away = (p[:, None] - p[index]) / distance.clamp_min(1e-9)[..., None]
        step = 0.35 * radius * (push[..., None] * away).sum(1)
        step = step - (step * normal).sum(1, keepdim=True) * normal
        surface = project_to_surface(field, p + step, 2 if last else 1)
    return surface


def diffuse_light(surface: Surface) -> Float[Tensor, "n"]:
    """Brightness under soft light from above and a key light from the upper front left."""
    n = surface.normals
    return 0.66 + 0.16 * (n @ SKY_LIGHT) + 0.26 * (n @ KEY_LIGHT).clamp_min(0)


def ambient_occlusion(field: Field, surface: Surface) -> Float[Tensor, "n"]:
    """Ambient light factor from field values along the normal: 1 on open surfaces, less in creases.

    Source: Evans 2006, "Fast approximations for global illumination on dynamic scenes".
    """
    hidden = torch.zeros(len(surface.points))
    for i, h in enumerate((0.015, 0.03, 0.06, 0.12)):
        distance = field(surface.points + h * surface.normals)
        hidden += (1 - distance / h).clamp(0, 1) * 0.5**i
    return 1 - 0.42 * (hidden / 1.875).clamp(0, 1)


def add_highlight(sh: Float[Tensor, "n 1 3"], normals: Tensor, gloss: Float[Tensor, "n"]) -> Float[Tensor, "n 9 3"]:
    """SH coefficients of degree 2 with a broad white highlight, the reflection of the key light.

    By the addition theorem, a lobe f(cos) around direction r has the coefficients f_l 4 pi / (2 l + 1) Y_lm(r), where
    f_l are its Legendre coefficients. SH are evaluated along the viewing direction, so r is the negated reflection.
    """
    mirrored = 2 * (normals @ KEY_LIGHT)[:, None] * normals - KEY_LIGHT
    lit = gloss * ((normals @ KEY_LIGHT) * 2).clamp(0, 1)
    weights = torch.tensor([f * 4 * torch.pi / (2 * l + 1) for l, f in enumerate(HIGHLIGHT_LEGENDRE)])
    lobe = basis(-mirrored, 2) * weights[torch.tensor([0, 1, 1, 1, 2, 2, 2, 2, 2])]
    out = torch.nn.functional.pad(sh, (0, 0, 0, 8)) + (lit[:, None] * lobe)[..., None]
    out[:, 0] -= (lit * HIGHLIGHT_LEGENDRE[0] / C0)[:, None]  # keeps the mean over all view directions
    return out
