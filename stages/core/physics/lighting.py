"""Estimate the light of a scene from the shadows that its objects cast on the supporting surface."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.geometry.harmonics import C0
from stages.core.kernels.sphere_shadows import Spheres
from stages.core.perception.support import Support, cell_medians, find_support
from stages.core.raster.shadows import GAMMA, OVERHEAD, Light, blocked
from stages.core.scene.gaussians import SURFACE_OPACITY
from stages.core.scene.scene import Scene

ELEVATIONS, AZIMUTHS, SPREADS = (25.0, 40.0, 55.0, 70.0), 12, (0.1, 0.3)  # candidate lamps [degrees], number, [tangent]
SURFACE_MARGIN = 3.0  # width of the examined surface around an object [radii of the object]
BENEATH = 0.6  # fraction of the sky blocked above which a cell is beneath an object, where no photo shows it
MIN_CELLS = 60  # minimum number of visible cells around the objects
MAX_SHARE = 0.95  # largest fraction of the irradiance from sky and lamp together
MIN_SHARE = 0.1  # minimum fraction of the irradiance from sky and lamp: fainter shadows are lost in the texture
MIN_ODDS = 0.1  # minimum ratio of the variance of log colour that the shadows explain to the residual variance
MIN_RATIO = 4.0  # minimum ratio of the odds of the shadows, as in MIN_ODDS, to those of displaced shadows
MIN_NOISE = 0.01  # lower bound of the residual scale [log colour]
MIN_BENEATH = 0.05  # smallest Light.beneath
MAX_CELLS = 4000  # maximum number of cells in the fit
DARKEST = 0.01  # linear colour below which values are noise
CONTROLS, CONTROL_SHIFT = 8, 0.7  # number of displaced shadows, and their shift [mean distance of cells from centre]
STEPS = 6  # iterations of the robust fit


def estimate_light(scene: Scene, spheres: Spheres, device: str = "cpu") -> Light:
    """The light whose shadows of the objects at rest best explain the colours of the surface; OVERHEAD if none does.

    The log colours of the cells of the supporting surface around the objects are fitted by the surface's own colour and
    the shadows of a sky and of one of many candidate lamps. The fit is accepted if the same shadows, displaced, explain
    much less. `spheres` approximate the objects.
    """
    support = find_support(scene)
    if support is None:
        return OVERHEAD
    points, colours = (t.to(device) for t in _surface_cells(scene, support, spheres.to("cpu")))
    spheres = spheres.to(device)
    beneath = _hidden(points, spheres, OVERHEAD)[:, 0] > BENEATH
    if int((~beneath).sum()) < MIN_CELLS:
        return OVERHEAD
    brightness, terms = _surface_terms(points, colours)
    seen, y, A = points[~beneath], brightness[~beneath], terms[~beneath]
    lamps = _lamps()
    best = _best_fit(A, torch.stack([_hidden(seen, spheres, lamp) for lamp in lamps]), y, lamps)
    reach = float((seen[:, :2] - seen[:, :2].mean(0)).norm(dim=1).mean())
    shifts = CONTROL_SHIFT * reach * seen.new_tensor([(x, y, 0.0) for x, y in _all_around(CONTROLS)])
    displaced = torch.stack([_hidden(seen + shift, spheres, best.light) for shift in shifts])
    chance = _best_fit(A, displaced, y, [best.light] * CONTROLS)
    if best.odds < max(MIN_ODDS, MIN_RATIO * chance.odds):
        return OVERHEAD
    if not bool(beneath.any()):
        return best.light
    left = (brightness[beneath] - terms[beneath] @ best.own.float()).exp().median()
    return replace(best.light, beneath=min(max(float(left), MIN_BENEATH), 1.0))


def _hidden(points: Tensor, spheres: Spheres, light: Light) -> Float[Tensor, "n 2"]:
    """Fractions of the sky and of the lamp that are blocked at points on the surface."""
    return torch.stack(blocked(points, torch.zeros(len(points)).to(spheres.object_id), spheres, light), 1)


def _surface_cells(
    scene: Scene, support: Support, spheres: Spheres
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Centres of the cells of the uncovered surface around the objects, and the logarithm of their linear colours."""
    g = scene.gaussians.to("cpu")
    near = torch.zeros(len(g), dtype=torch.bool)
    for id in spheres.object_id.unique():
        own = spheres.object_id == id
        middle = spheres.centres[own].mean(0)
        radius = float(((spheres.centres[own] - middle).norm(dim=1) + spheres.radii[own]).max())
        near |= (g.means - middle)[:, :2].norm(dim=1) < (1 + SURFACE_MARGIN) * radius
    heights = support.heights(g.means)
    on = near & (g.object_id == 0) & (g.opacities > SURFACE_OPACITY)
    on &= (heights.abs() < support.tolerance) & support.inside(g.means)
    rows = on.nonzero()[:, 0]
    if not len(rows):
        return torch.zeros(0, 3), torch.zeros(0, 3)
    rgb = g.sh[rows, 0] * C0 + 0.5
    cells = cell_medians(support, g.means[rows], torch.cat([g.means[rows], rgb], 1)).reshape(-1, 6)
    cells = cells[cells.isfinite().all(1)]
    points, colours = cells[:, :3], GAMMA * cells[:, 3:].clamp_min(DARKEST ** (1 / GAMMA)).log()
    step = 1 + len(points) // MAX_CELLS
    return points[::step], colours[::step]


def _surface_terms(points: Tensor, colours: Tensor) -> tuple[Float[Tensor, "n"], Float[Tensor, "n k"]]:
    """Log brightness, and regressors for the surface's own colour: quadratic in x and y, and in log chromaticity.

    Shadows leave the chromaticity unchanged, so it distinguishes texture from shadow.
    """
    x, y = ((points[:, :2] - points[:, :2].mean(0)) / points[:, :2].std().clamp_min(1e-9)).unbind(1)
    brightness = colours.mean(1)
    u, v = (colours[:, :2] - brightness[:, None]).unbind(1)
    u, v = ((c - c.mean()) / c.std().clamp_min(1e-3) for c in (u, v))
    return brightness, torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y, u, v, u * u, u * v, v * v], 1)


def _all_around(count: int) -> list[tuple[float, float]]:
    """Unit vectors at equal angles."""
    angles = [2 * math.pi * i / count for i in range(count)]
    return [(math.cos(a), math.sin(a)) for a in angles]


def _lamps() -> list[Light]:
    """The candidate lamps; their strengths are fitted."""
    directions = [(0.0, 0.0, 1.0)]
    for elevation in map(math.radians, ELEVATIONS):
        level = math.cos(elevation)
        directions += [(level * x, level * y, math.sin(elevation)) for x, y in _all_around(AZIMUTHS)]
    return [Light(0.0, 0.0, d, spread, in_colours=True) for d in directions for spread in SPREADS]


class _LampFit(NamedTuple):
    odds: float  # variance that the shadows explain over the residual variance
    light: Light
    own: Tensor  # coefficients of the surface's own colour


def _best_fit(A: Tensor, hidden: Float[Tensor, "l n 2"], y: Tensor, lamps: list[Light]) -> _LampFit:
    """Fit the log colours y with each lamp by Tukey's biweight, and return the best fit.

    y = A a + log(1 - hidden s) is linearised about the fractions s of sky and lamp in each step, for all lamps at once.
    """
    A, y, hidden = A.double().expand(len(lamps), -1, -1), y.double().expand(len(lamps), -1), hidden.double()
    weights, s = torch.ones_like(y), y.new_zeros(len(lamps), 2)
    for _ in range(STEPS):
        left = (1 - _times(hidden, s)).clamp_min(1 - MAX_SHARE)
        J = -hidden / left[..., None]
        s = _solve(torch.cat([A, J], 2), y - left.log() + _times(J, s), weights)[:, -2:].clamp_min(0)
        s = s * (MAX_SHARE / s.sum(1, keepdim=True).clamp_min(1e-9)).clamp_max(1)
        shadow = (1 - _times(hidden, s)).log()
        own = _solve(A, y - shadow, weights)
        residual = y - shadow - _times(A, own)
        scale = (1.4826 * residual.abs().median(1, keepdim=True).values).clamp_min(MIN_NOISE)
        weights = (1 - (residual / (4.685 * scale)) ** 2).clamp_min(0) ** 2
    without = y - _times(A, _solve(A, y, weights))
    before, after = ((weights * r**2).sum(1) for r in (without, residual))
    odds = torch.where(s.sum(1) >= MIN_SHARE, before / after.clamp_min(1e-12) - 1, 0)
    i = int(odds.argmax())
    sky, strength = s[i].tolist()
    return _LampFit(float(odds[i]), replace(lamps[i], sky=sky, lamp=strength), own[i])


def _times(A: Float[Tensor, "l n k"], x: Float[Tensor, "l k"]) -> Float[Tensor, "l n"]:
    return (A @ x[..., None])[..., 0]


def _solve(A: Float[Tensor, "l n k"], y: Float[Tensor, "l n"], weights: Float[Tensor, "l n"]) -> Float[Tensor, "l k"]:
    """Weighted least squares with a small ridge."""
    normal = A.mT @ (weights[..., None] * A)
    ridge = 1e-6 * weights.sum(1)[:, None, None] * torch.eye(A.shape[2]).to(A)
    return torch.linalg.solve(normal + ridge, (A.mT @ (weights * y)[..., None]))[..., 0]
