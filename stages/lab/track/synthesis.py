"""Rendering of a scene with its objects at given poses, with the object and 3D point seen in each pixel."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.core.geometry.cameras import centres, resize
from stages.core.geometry.harmonics import C0, rotate_sh
from stages.core.geometry.rotations import multiply, quaternion
from stages.core.physics.keypoints import farthest_points
from stages.core.raster.rasterise import rasterise, visibility
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.scene import Scene
from stages.lab.track.poses import Poses

MIN_ALPHA = 0.5  # opacity above which a pixel counts as covered
FAR = 1e6  # depth of empty pixels [scene units]
PALETTE, PALETTE_ROUNDS = 24, 10  # number of colour clusters of an object, and of k-means iterations
MASK_CONTRAST = 0.5  # contrast between an object and its surroundings in label channels; colours range from 0 to 1
BEHIND = 0.02  # how far behind the background's depth an object is still drawn [fraction of that depth]


@dataclass(frozen=True)
class Camera:
    """A camera at one resolution, with a rendering of the static background."""

    viewmat: Float[Tensor, "4 4"]
    K: Float[Tensor, "3 3"]
    background: Float[Tensor, "h w 3"]
    background_depth: Float[Tensor, "h w"]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [px]."""
        return self.background.shape[1], self.background.shape[0]

    def in_front(
        self, rgb: Float[Tensor, "h w 3"], alpha: Float[Tensor, "h w"], depth: Float[Tensor, "h w"]
    ) -> tuple[Float[Tensor, "h w 3"], Bool[Tensor, "h w"]]:
        """Composite objects, rendered over black, over the background; also return the mask where they are in front."""
        front = (alpha > 0) & (depth < self.background_depth * (1 + BEHIND))
        return torch.where(front[..., None], rgb + (1 - alpha)[..., None] * self.background, self.background), front


@dataclass(frozen=True)
class Synthesis:
    """An image, and for each pixel the object whose motion changes it and the 3D point of it that is seen there."""

    image: Float[Tensor, "h w c"]  # RGB, followed by painted labels if there are label images
    label: Int[Tensor, "h w"]  # row of the object, -1: background
    moving: Int[Tensor, "h w"]  # like `label`, but on outlines the nearest object among the neighbouring pixels
    point: Float[Tensor, "h w 3"]  # visible point of the object in `moving`, in world coordinates
    depth: Float[Tensor, "h w"]  # depth of the object or background in `label`


class Synthesiser:
    """Renders the objects of a scene at any poses in front of its background.

    With `labelled`, images have three more channels for label images, in which each object has a distinct value, so
    that outlines and occlusions are compared in the same way as colours.
    """

    def __init__(self, scene: Scene, device: str, labelled: bool = False):
        g = scene.gaussians.to(device)
        self.background = g[g.object_id == 0]
        self.rest_gaussians = g[g.object_id > 0]
        ids = torch.tensor([o.id for o in scene.objects], device=device)
        self.row = (self.rest_gaussians.object_id[:, None] == ids).int().argmax(1)
        means = [self.rest_gaussians.means[self.row == i] for i in range(len(ids))]
        self.rest = torch.stack([_middle(x) for x in means])
        self.sizes = torch.stack([(x - c).norm(dim=1).quantile(0.9) for x, c in zip(means, self.rest, strict=True)])
        self.arm = self.rest_gaussians.means - self.rest[self.row]
        self.colour = torch.tensor(scene.background or (0.0, 0.0, 0.0), device=device)
        self.device = device
        self.paint = MASK_CONTRAST * spread_directions(len(ids)).to(device) if labelled else None

    def painted(self, label: Int[Tensor, "h w"]) -> Float[Tensor, "h w 3"]:
        """The channels of a label image of object rows; -1: background, -2: unknown (becomes nan)."""
        values = torch.cat([self.paint, self.paint.new_full((1, 3), torch.nan), self.paint.new_zeros(1, 3)])
        return values[label.long()]

    @property
    def colours(self) -> Float[Tensor, "n 3"]:
        """Colours of the Gaussians of the objects, without view-dependent terms."""
        return C0 * self.rest_gaussians.sh[:, 0] + 0.5

    def palette(self, i: int) -> Float[Tensor, "k 3"]:
        """The most frequent colours of an object."""
        return _palette(self.colours[self.row == i])

    def recolour(self, rows: Int[Tensor, "m"], colours: Float[Tensor, "m 3"]) -> None:
        """Set the colours of Gaussians of the objects, equal for all view directions."""
        sh = self.rest_gaussians.sh.clone()
        sh[rows] = 0.0
        sh[rows, 0] = (colours - 0.5) / C0
        self.rest_gaussians = replace(self.rest_gaussians, sh=sh)

    def at_rest(self) -> Poses:
        """The poses of the scene file."""
        return Poses(torch.eye(3, device=self.device).repeat(len(self.rest), 1, 1), self.rest.clone())

    def camera(self, viewmat: Tensor, K: Tensor, width: int, height: int) -> Camera:
        """A camera with a rendering of the scene without its objects."""
        K, viewmat = K.to(self.device), viewmat.to(self.device)
        drawn = rasterise(self.background, viewmat[None], K[None], width, height, self.colour)
        depth = torch.where(drawn.alpha[0] > MIN_ALPHA, drawn.depth[0], FAR)
        return Camera(viewmat, K, drawn.rgb[0], depth)

    def objects(self, poses: Poses) -> Gaussians:
        """The Gaussians of all objects at these poses."""
        g, R, means = self.rest_gaussians, poses.rotation[self.row], poses.place(self.arm, self.row)
        sh = g.sh if g.sh.shape[1] == 1 else rotate_sh(g.sh, R)
        return replace(g, means=means, quats=multiply(quaternion(poses.rotation)[self.row], g.quats), sh=sh)

    def draw(self, camera: Camera, poses: Poses, reduction: int = 1) -> Synthesis:
        """What a camera sees with the objects at these poses, at its resolution divided by `reduction`."""
        g, (width, height) = self.objects(poses), camera.size
        rgb, alpha, depth, index, _ = visibility(g, camera.viewmat, camera.K, width, height)
        image, front = camera.in_front(rgb, alpha, depth)
        seen = front & (alpha > MIN_ALPHA) & (index >= 0)
        label = torch.where(seen, self.row[index.clamp_min(0)], -1)
        image = image if self.paint is None else torch.cat([image, self.painted(label)], -1)
        depth = torch.where(seen, depth, camera.background_depth)
        middle = slice(reduction // 2, None, reduction)
        label, depth = label[middle, middle], depth[middle, middle]
        # pixels on an outline move with the object in front
        nearest, source = F.max_pool2d(-depth[None, None], 3, 1, 1, return_indices=True)
        source = source[0, 0]
        K = resize(camera.K, 1 / reduction, 1 / reduction)
        point = _points(camera.viewmat, K, -nearest[0, 0], source)
        return Synthesis(reduced(image, reduction), label, label.flatten()[source], point, depth)


def reduced(image: Float[Tensor, "h w c"], reduction: int) -> Float[Tensor, "h2 w2 c"]:
    """Averages of square blocks of pixels."""
    return F.avg_pool2d(image.permute(2, 0, 1), reduction).permute(1, 2, 0) if reduction > 1 else image


def _palette(colours: Float[Tensor, "n 3"]) -> Float[Tensor, "k 3"]:
    """Cluster centres of an object's colours (k-means), without clusters of only a few outliers."""
    centre = colours[farthest_points(colours, PALETTE).to(colours.device)]
    for _ in range(PALETTE_ROUNDS):
        nearest = torch.cdist(colours, centre).argmin(1)
        total = torch.zeros_like(centre).index_add_(0, nearest, colours)
        count = torch.bincount(nearest, minlength=len(centre))[:, None]
        centre = torch.where(count > 0, total / count.clamp_min(1), centre)
    return centre[count[:, 0] >= len(colours) / len(centre) ** 2].clamp(0, 1)


def spread_directions(count: int) -> Float[Tensor, "n 3"]:
    """Evenly distributed unit vectors: a Fibonacci lattice on the sphere."""
    i = torch.arange(count)
    z, turn = 1 - (2 * i + 1) / count, i * torch.pi * (3 - 5**0.5)
    r = (1 - z * z).sqrt()
    return torch.stack([r * turn.cos(), r * turn.sin(), z], 1)


def _middle(points: Float[Tensor, "n 3"]) -> Float[Tensor, "3"]:
    return (points.quantile(0.02, dim=0) + points.quantile(0.98, dim=0)) / 2


def _points(
    viewmat: Float[Tensor, "4 4"], K: Float[Tensor, "3 3"], depth: Float[Tensor, "h w"], pixel: Int[Tensor, "h w"]
) -> Float[Tensor, "h w 3"]:
    """The world points at these depths [scene units] in these pixels."""
    width = depth.shape[1]
    x, y = (pixel % width) + 0.5, (pixel // width) + 0.5
    ray = torch.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], torch.ones_like(depth)], -1)
    return centres(viewmat[None])[0] + depth[..., None] * ray @ viewmat[:3, :3]
