"""The example scene: a table with four toys, two of them in the air."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.scene.gaussians import Gaussians, concatenate
from stages.core.scene.scene import Scene, SceneObject
from stages.lab.assets.shapes import Surface, box, ellipsoid, noise, sheet, superellipsoid, to_gaussians, union

TOYS = (
    SceneObject(1, "ball", "rubber"),
    SceneObject(2, "block", "wood"),
    SceneObject(3, "duck", "rubber"),
    SceneObject(4, "cushion", "foam"),
)


def falling_toys() -> Scene:
    """The scene in metres with the table top at z = 0: a ball above a block, a duck above a cushion."""
    parts = [_table(), _ball((-0.13, -0.06, 0.27)), _block((-0.16, -0.05, 0.0601)), _duck((0.16, 0.06, 0.22)),
             _cushion((0.17, 0.06, 0.0401))]  # fmt: skip
    return Scene(concatenate(parts), TOYS, None, 0.0, {"metres_per_unit": 1.0, "source": "made in code"})


def mix(a: tuple, b: tuple, t: Float[Tensor, "n"]) -> Float[Tensor, "n 3"]:
    """Linear interpolation between the colours a (t = 0) and b (t = 1)."""
    return torch.tensor(a) + (torch.tensor(b) - torch.tensor(a)) * t[:, None]


def speckled(points: Tensor, rgb: Tensor, seed: int, size: float = 0.006, depth: float = 0.45) -> Tensor:
    """Colours with brightness noise at two scales, so that image features can be detected."""
    grain = 0.6 * noise(points, size, seed) + 0.4 * noise(points, 3.1 * size, seed + 1)
    return rgb * (1 + depth * (2 * grain[:, None] - 1))


def _table() -> Gaussians:
    """A table of planks with grain and dark stains."""
    s = sheet(1.5, 1.3, 0.0055)
    p = s.points
    plank = (p[:, 1] / 0.13).floor()
    shade = ((plank * 0.618).remainder(1.0) - 0.5) * 0.18
    stretched = p * torch.tensor([0.18, 1.0, 1.0]) + plank[:, None] * torch.tensor([0.7, 0.0, 0.0])
    grain = noise(stretched, 0.007, 3) * 0.5 + noise(stretched, 0.02, 4) * 0.5
    rgb = mix((0.38, 0.24, 0.13), (0.78, 0.58, 0.38), (grain + shade).clamp(0, 1))
    joint = ((p[:, 1] / 0.13).remainder(1.0) - 0.5).abs() > 0.47
    rgb = torch.where(joint[:, None], rgb * 0.5, rgb)
    stain = (noise(p, 0.045, 9) > 0.72) & (noise(p, 0.011, 10) > 0.4)
    rgb = torch.where(stain[:, None], rgb * torch.tensor([0.55, 0.6, 0.75]), rgb)
    return to_gaussians(s, speckled(p, rgb, 5, 0.012, 0.3), 0)


def _ball(centre: tuple) -> Gaussians:
    """A ball with six coloured sectors between white poles."""
    s = ellipsoid((0.07, 0.07, 0.07), 9000)
    p = s.points
    sector = ((torch.atan2(p[:, 1], p[:, 0]) / torch.pi + 1) * 3).floor().long().remainder(6)
    paint = torch.tensor([[0.85, 0.1, 0.1], [0.95, 0.9, 0.85], [0.1, 0.25, 0.75], [0.95, 0.75, 0.1], [0.1, 0.55, 0.25],
                          [0.95, 0.45, 0.1]])  # fmt: skip
    rgb = torch.where((p[:, 2].abs() > 0.062)[:, None], torch.tensor([0.95, 0.95, 0.92]), paint[sector])
    return to_gaussians(s.moved(centre), speckled(p, rgb, 20), 1)


def _block(centre: tuple) -> Gaussians:
    """A toy block with a frame and a ring on every face."""
    s = box((0.14, 0.14, 0.12), 0.0026)
    p = s.points
    face = torch.where(s.normals.abs() > 0.5, torch.tensor(9.0), (p / torch.tensor([0.07, 0.07, 0.06])).abs())
    edge = face.clamp_max(1.0).where(face < 2, torch.zeros(())).amax(1)
    on_face = (p * (1 - s.normals.abs())).norm(dim=1)
    axis = s.normals.abs().argmax(1)
    paint = torch.tensor([[0.75, 0.15, 0.15], [0.15, 0.35, 0.7], [0.2, 0.5, 0.25]])[axis]
    wood = mix((0.7, 0.5, 0.28), (0.9, 0.75, 0.5), noise(p * torch.tensor([1.0, 1.0, 0.2]), 0.006, 30))
    ring = ((on_face - 0.033).abs() < 0.009) | (edge > 0.85)
    rgb = torch.where(ring[:, None], paint, wood)
    return to_gaussians(s.moved(centre), speckled(p, rgb, 31), 2)


def _duck(centre: tuple) -> Gaussians:
    """A duck: body, raised tail, head, orange beak and dark eyes."""
    parts = [
        _part((0.075, 0.052, 0.048), (0, 0, 0), 7000),
        _part((0.03, 0.028, 0.02), (0.068, 0, 0.028), 1500),
        _part((0.038, 0.036, 0.036), (-0.048, 0, 0.062), 4200),
        _part((0.022, 0.02, 0.008), (-0.086, 0, 0.055), 900),
    ]
    s = union(*parts)
    p = s.points
    rgb = torch.tensor([0.95, 0.78, 0.12]).expand(len(p), 3)
    rgb = torch.where((p[:, 0] < -0.083)[:, None], torch.tensor([0.93, 0.42, 0.08]), rgb)
    for side in (-1, 1):
        eye = (p - torch.tensor([-0.072, 0.022 * side, 0.074])).norm(dim=1) < 0.009
        rgb = torch.where(eye[:, None], torch.tensor([0.06, 0.05, 0.05]), rgb)
    wing = ((p[:, 0] / 0.045) ** 2 + ((p[:, 2] - 0.004) / 0.022) ** 2 < 1) & (p[:, 1].abs() > 0.03)
    rgb = torch.where(wing[:, None], rgb * torch.tensor([0.9, 0.72, 0.6]), rgb)
    return to_gaussians(s.moved(centre), speckled(p, rgb, 40), 3)


def _part(radii: tuple, centre: tuple, n: int):
    """An ellipsoid sampled by up to n points, and its inside test."""
    c, r = torch.tensor(centre), torch.tensor(radii)
    return ellipsoid(radii, n).moved(centre), lambda p: ((p - c) / r).norm(dim=1) < 0.985


def _cushion(centre: tuple) -> Gaussians:
    """A striped cushion, blue and white."""
    s: Surface = superellipsoid((0.13, 0.11, 0.04), 5.0, 16000)
    p = s.points
    stripe = (p[:, 0] / 0.022).floor().remainder(2) == 0
    rgb = torch.where(stripe[:, None], torch.tensor([0.16, 0.3, 0.62]), torch.tensor([0.88, 0.88, 0.84]))
    return to_gaussians(s.moved(centre), speckled(p, rgb, 50, 0.005), 4)
