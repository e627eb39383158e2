"""A block and a ball on a floor, lit by a sky and a lamp: exact irradiance by ray casting, at rest and moved."""

from dataclasses import dataclass

import torch

from stages.core.geometry.harmonics import rgb_to_sh
from stages.core.geometry.rotations import matrix
from stages.core.raster.shadows import GAMMA, Light
from stages.core.scene.gaussians import Gaussians, concatenate
from stages.core.scene.scene import Scene, SceneObject
from tests.reconstruct.raycast import arc, rays_of

LIGHT = Light(0.35, 0.4, (0.48, -0.36, 0.8), 0.15, in_colours=True)
HALF = torch.tensor([0.13, 0.1, 0.1])  # half sides of the block [m]
RADIUS = 0.1  # radius of the ball [m]
BACKGROUND = torch.tensor([0.5, 0.6, 0.7])


@dataclass(frozen=True)
class Poses:
    """Positions of the block, which is rotated about z by an angle [rad], and of the ball."""

    block: tuple[float, float, float]
    angle: float
    ball: tuple[float, float, float]

    @property
    def turn(self) -> torch.Tensor:
        half = torch.tensor(self.angle / 2)
        return matrix(torch.stack([half.cos(), torch.zeros(()), torch.zeros(()), half.sin()]))


REST = Poses((0.0, 0.0, 0.1), 0.0, (0.42, 0.12, 0.1))
MOVED = Poses((-0.12, 0.05, 0.32), 0.6, (0.45, -0.3, 0.12))


def sample_directions(light: Light, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Directions to the sky, cosine-distributed, and directions to the lamp."""
    u, v = torch.quasirandom.SobolEngine(2).draw(count + 1)[1:].unbind(1)
    angle, radius = 2 * torch.pi * u, v.sqrt()
    disc = radius[:, None] * torch.stack([angle.cos(), angle.sin()], 1)
    sky = torch.cat([disc, (1 - v)[:, None].sqrt()], 1)
    d = torch.tensor(light.direction)
    a = torch.nn.functional.normalize(torch.linalg.cross(d, torch.tensor([0.3, 0.9, 0.1])), dim=0)
    across = torch.stack([a, torch.linalg.cross(d, a)])
    return sky, torch.nn.functional.normalize(d + light.spread * disc @ across, dim=1)


def hits(points: torch.Tensor, directions: torch.Tensor, poses: Poses) -> tuple[torch.Tensor, torch.Tensor]:
    """Distances along rays to the block and to the ball, infinite for rays that miss them."""
    o, d = (points - torch.tensor(poses.block)) @ poses.turn, directions @ poses.turn
    one, two = (-HALF - o) / d, (HALF - o) / d
    enter, leave = torch.minimum(one, two).amax(-1), torch.maximum(one, two).amin(-1)
    block = torch.where((enter < leave) & (leave > 0), enter, torch.inf)
    o = points - torch.tensor(poses.ball)
    b, c = (o * directions).sum(-1), (o * o).sum(-1) - RADIUS**2
    a = (directions * directions).sum(-1)
    root = (b * b - a * c).clamp_min(0).sqrt()
    ball = torch.where((b * b > a * c) & (root > b), (-b - root) / a, torch.inf)
    return block, ball


def floor_irradiance(xy: torch.Tensor, poses: Poses, light: Light = LIGHT, count: int = 128) -> torch.Tensor:
    """Irradiance of floor points (n, 2), exact up to the sampling of directions."""
    points = torch.cat([xy, torch.zeros(len(xy), 1)], 1)[:, None]
    seen = []
    for directions in sample_directions(light, count):
        blocked = [torch.isfinite(torch.minimum(*hits(p, directions[None], poses))) for p in points.split(4000)]
        seen.append(1 - torch.cat(blocked).float().mean(1))
    return 1 - light.sky * (1 - seen[0]) - light.lamp * (1 - seen[1])


def texture(xy: torch.Tensor) -> torch.Tensor:
    """Linear colour of the floor, with smooth and irregular stripes."""
    x, y = xy.unbind(1)
    phases = torch.stack([9 * x + 2 * torch.sin(5 * y), 7 * y - 4 * x, 11 * x + 6 * y], 1)
    return torch.tensor([0.55, 0.45, 0.35]) + 0.1 * torch.sin(phases)


def lit_scene(light: Light = LIGHT, spacing: float = 0.015) -> Scene:
    """Gaussians of the world at rest, with the colours of its photos."""
    line = torch.arange(-0.9, 0.9, spacing)
    xy = torch.cartesian_prod(line, line)
    colours = (texture(xy) * floor_irradiance(xy, REST, light)[:, None]) ** (1 / GAMMA)
    floor = _surfels(torch.cat([xy, torch.zeros(len(xy), 1)], 1), colours, 0, (0.7 * spacing, 0.7 * spacing, 1e-4))
    rng = torch.Generator().manual_seed(0)
    ball = torch.nn.functional.normalize(torch.randn(1500, 3, generator=rng), dim=1) * RADIUS + torch.tensor(REST.ball)
    u = 2 * torch.rand(3000, 3, generator=rng) - 1
    face = u.abs().argmax(1, keepdim=True)
    block = u.scatter(1, face, u.gather(1, face).sign()) * HALF + torch.tensor(REST.block)
    objects = [_surfels(block, _colour(block, 1), 1, (0.008,) * 3), _surfels(ball, _colour(ball, 2), 2, (0.008,) * 3)]
    names = SceneObject(1, "block", "wood"), SceneObject(2, "ball", "rubber")
    return Scene(concatenate([floor, *objects]), names, arc(), 0.0, background=tuple(BACKGROUND.tolist()))


def _colour(points: torch.Tensor, id: int) -> torch.Tensor:
    return torch.tensor([[0.7, 0.3, 0.2], [0.2, 0.3, 0.7]])[id - 1].expand(len(points), 3)


def _surfels(means, colours, id: int, scales: tuple) -> Gaussians:
    n = len(means)
    return Gaussians(
        means, torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1), torch.tensor([scales]).repeat(n, 1), torch.full((n,), 0.95),
        rgb_to_sh(colours), torch.full((n,), id),
    )  # fmt: skip


def moved_points(points: torch.Tensor, ids: torch.Tensor, poses: Poses) -> torch.Tensor:
    """Points given for the objects at rest, moved with the objects to other poses."""
    block = (points - torch.tensor(REST.block)) @ poses.turn.T + torch.tensor(poses.block)
    ball = points - torch.tensor(REST.ball) + torch.tensor(poses.ball)
    return torch.where((ids == 1)[:, None], block, torch.where((ids == 2)[:, None], ball, points))


def photograph(cameras, index: int, poses: Poses, light: Light = LIGHT) -> tuple[torch.Tensor, torch.Tensor]:
    """The true photo (h, w, 3), and the floor point (h, w, 2) in each pixel, nan where no floor is visible."""
    eye, rays = rays_of(cameras, index)
    block, ball = hits(eye.expand_as(rays), rays, poses)
    t = torch.where(rays[..., 2] < 0, -eye[2] / rays[..., 2], torch.inf)
    xy = (eye + t[..., None] * rays)[..., :2]
    nearest = torch.minimum(block, ball)
    floor = (t < nearest) & (xy.abs() < 0.88).all(-1)
    image = BACKGROUND.expand(*t.shape, 3).clone()
    image[floor] = (texture(xy[floor]) * floor_irradiance(xy[floor], poses, light)[:, None]) ** (1 / GAMMA)
    for id, distance in ((1, block), (2, ball)):
        front = (distance == nearest) & (distance < t)
        image[front] = _colour(image[front], id)
    return image, torch.where(floor[..., None], xy, torch.nan)
