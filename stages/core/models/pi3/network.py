"""The π³ network: maps an unordered set of photos to a point and a confidence per pixel, and a camera per photo."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from stages.core.models.pi3.config import Pi3Config
from stages.core.models.pi3.dinov2 import PATCH, REGISTERS, DinoV2
from stages.core.models.pi3.heads import CameraHead, LinearMap, TransformerDecoder, local_points
from stages.core.models.pi3.layers import ViTBlock
from stages.core.models.pi3.rope import RotaryEmbedding, patch_positions, rotary_embedding

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # mean and standard deviation of the colours of ImageNet
CAMERA_REGISTERS = 5  # register tokens of each view, before its patches


@dataclass(frozen=True)
class Geometry:
    """Network output for v views; all lengths are in the same unknown unit."""

    points: Float[Tensor, "v h w 3"]  # point of each pixel, in its camera's frame
    confidence: Float[Tensor, "v h w"]  # 0..1
    poses: Float[Tensor, "v 4 4"]  # camera-to-world: x right, y down, z forward


class Pi3(nn.Module):
    """The π³ network, with the parameter names of the published weights.

    Inputs are the views of one scene, with sides that are multiples of 14 px.
    """

    def __init__(self, config: Pi3Config = Pi3Config()):  # noqa: B008 -- frozen
        super().__init__()
        c = self.config = config
        self.register_token = nn.Parameter(torch.zeros(1, 1, CAMERA_REGISTERS, c.width))
        self.register_buffer("image_mean", torch.tensor(MEAN).view(1, 3, 1, 1))
        self.register_buffer("image_std", torch.tensor(STD).view(1, 3, 1, 1))
        self.encoder = DinoV2(c.width, c.head, c.encoder_depth, c.table)
        self.decoder = nn.ModuleList(ViTBlock(c.width, c.head, True, True) for _ in range(c.decoder_depth))
        self.point_decoder = self._decoder(c.width)
        self.point_head = LinearMap(c.width, 3)
        self.conf_decoder = self._decoder(c.width)
        self.conf_head = LinearMap(c.width, 1)
        self.camera_decoder = self._decoder(c.camera_width)
        self.camera_head = CameraHead(c.camera_width)

    def _decoder(self, width_out: int) -> TransformerDecoder:
        c = self.config
        return TransformerDecoder(2 * c.width, c.width, width_out, c.head, c.head_depth)

    def forward(self, images: Float[Tensor, "v 3 h w"], at_once: int = 8) -> Geometry:
        """Return the geometry of RGB views in 0..1; per-view parts process `at_once` views at a time."""
        hidden, positions = self.tokens(images, at_once)
        return self.geometry(hidden, positions, images.shape[2:], at_once)

    def tokens(self, images: Float[Tensor, "v 3 h w"], at_once: int) -> tuple[Float[Tensor, "v t c"], RotaryEmbedding]:
        """Return multi-view tokens, registers before patches, and their rotary embedding."""
        views, _, height, width = images.shape
        positions = patch_positions(views, height // PATCH, width // PATCH, CAMERA_REGISTERS, images.device)
        positions = rotary_embedding(positions, self.config.head)
        return alternate(self.decoder, by_views(self._encode_views, at_once, images), positions, at_once), positions

    def _encode_views(self, images: Float[Tensor, "v 3 h w"]) -> Float[Tensor, "v t c"]:
        """Tokens of each view, encoded separately: registers, then patches."""
        patches = self.encoder((images - self.image_mean) / self.image_std)[:, 1 + REGISTERS :]
        return torch.cat([self.register_token[0].expand(len(images), -1, -1).to(patches.dtype), patches], 1)

    def geometry(self, hidden: Float[Tensor, "v t c"], positions: RotaryEmbedding, size, at_once: int) -> Geometry:
        """Return the outputs of the three heads.

        Their last layers are in 32 bit, since depth is an exponential of the output.
        """
        grid = size[0] // PATCH, size[1] // PATCH

        def one_part(hidden: Tensor, cos: Tensor, sin: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            near = RotaryEmbedding(cos, sin)
            parts = [d(hidden, near) for d in (self.point_decoder, self.conf_decoder, self.camera_decoder)]
            point, confidence, camera = (part[:, CAMERA_REGISTERS:].float() for part in parts)
            with torch.autocast(hidden.device.type, enabled=False):
                points = local_points(self.point_head(point, *grid))
                return points, self.conf_head(confidence, *grid)[..., 0].sigmoid(), self.camera_head(camera)

        return Geometry(*by_views(one_part, at_once, hidden, *positions))


def halve(model: nn.Module) -> nn.Module:
    """Convert linear layers and convolutions to bfloat16 in place, except the last layers of the heads.

    For inference under autocast to bfloat16, where it does not change results, but saves the memory and time of casts.
    """
    for name, module in model.named_modules():
        last = {"point_head", "conf_head", "camera_head"} & set(name.split("."))
        if isinstance(module, (nn.Linear, nn.Conv2d, nn.ConvTranspose2d)) and not last:
            module.to(torch.bfloat16)
    return model


def alternate(blocks: nn.ModuleList, x: Float[Tensor, "v t c"], positions: RotaryEmbedding, at_once: int) -> Tensor:
    """Apply blocks that attend within a view (even) and over all views (odd); concatenates the last two outputs.

    The result is (v, t, 2 c).
    """
    joint = RotaryEmbedding(*(part.transpose(0, 1).flatten(1, 2)[None] for part in positions))
    last = []
    for i, block in enumerate(blocks):
        if i % 2 == 0:
            x = by_views(lambda x, cos, sin, block=block: block(x, RotaryEmbedding(cos, sin)), at_once, x, *positions)
        else:
            x = block(x.flatten(0, 1)[None], joint).view_as(x)
        last = [*last[-1:], x]
    return torch.cat(last, -1)


def by_views(function: Callable, at_once: int, *inputs: Tensor):
    """Apply a function to `at_once` views at a time, to bound memory; views must not depend on each other."""
    if len(inputs[0]) <= at_once:
        return function(*inputs)
    parts = [function(*part) for part in zip(*(x.split(at_once) for x in inputs), strict=True)]
    if isinstance(parts[0], Tensor):
        return torch.cat(parts)
    return tuple(torch.cat(part) for part in zip(*parts, strict=True))
