"""ALIKED: keypoints and descriptors of an image by a small network with deformable convolutions.

Source: Zhao et al. 2023, "ALIKED: A lighter keypoint and descriptor extraction network via deformable
transformation", aliked-n16 and -n16rot. Modules have the published names, so that the published weights load.
Deformable convolution is implemented with grid_sample, which is part of PyTorch.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

WIDTHS = (16, 32, 64, 128)  # channels of the four blocks, at 1, 1/2, 1/8 and 1/32 of the resolution
DIM, SAMPLES = 128, 16  # length of a descriptor, and number of sampling positions that it is gathered from
RADIUS = 2  # radius of non-maximum suppression and of subpixel refinement [px]
TEMPERATURE = 0.1  # temperature of the soft argmax in subpixel refinement
MULTIPLE = 32  # image sides are padded to a multiple of this [px]


class DeformableConv(nn.Module):
    """3x3 convolution whose nine taps are displaced by predicted offsets. Source: Dai et al. 2017."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.offset_conv = nn.Conv2d(inputs, 18, 3, padding=1)
        self.regular_conv = nn.Conv2d(inputs, outputs, 3, padding=1, bias=False)

    def forward(self, x: Float[Tensor, "1 i h w"]) -> Float[Tensor, "1 o h w"]:
        """Return the convolution of `x`, with offsets of at most a quarter of the longer side [px]."""
        h, w = x.shape[2:]
        limit = max(h, w) / 4
        offsets = self.offset_conv(x).clamp(-limit, limit).reshape(9, 2, h, w)  # dy, dx of each tap
        ys, xs = torch.meshgrid(torch.arange(h, device=x.device), torch.arange(w, device=x.device), indexing="ij")
        taps = torch.cartesian_prod(*[torch.arange(-1, 2, device=x.device)] * 2)
        at = torch.stack([xs + taps[:, 1, None, None] + offsets[:, 1], ys + taps[:, 0, None, None] + offsets[:, 0]], -1)
        sampled = sample(x, at.reshape(1, 9 * h, w, 2)).reshape(-1, 9, h, w)
        return torch.einsum("ithw,oit->ohw", sampled, self.regular_conv.weight.flatten(2))[None]


def sample(x: Float[Tensor, "1 c h w"], at: Float[Tensor, "1 a b 2"]) -> Float[Tensor, "1 c a b"]:
    """Bilinear samples at (x, y) [px], pixel centres at integers; zero outside."""
    size = torch.tensor([x.shape[3] - 1, x.shape[2] - 1], device=x.device)
    return F.grid_sample(x, 2 * at / size - 1, align_corners=True)


class ConvBlock(nn.Module):
    """Two convolutions with SELU, optionally with a shortcut."""

    def __init__(self, inputs: int, outputs: int, shortcut: bool, deformable: bool):
        super().__init__()
        conv = DeformableConv if deformable else lambda i, o: nn.Conv2d(i, o, 3, padding=1, bias=False)
        self.conv1, self.bn1 = conv(inputs, outputs), nn.BatchNorm2d(outputs)
        self.conv2, self.bn2 = conv(outputs, outputs), nn.BatchNorm2d(outputs)
        self.downsample = nn.Conv2d(inputs, outputs, 1) if shortcut else None

    def forward(self, x: Tensor) -> Tensor:
        """Map features (1, i, h, w) to (1, o, h, w)."""
        out = self.bn2(self.conv2(F.selu(self.bn1(self.conv1(x)))))
        return F.selu(out if self.downsample is None else out + self.downsample(x))


class Descriptor(nn.Module):
    """Descriptors gathered from SAMPLES positions around each keypoint, predicted from its 3x3 neighbourhood."""

    def __init__(self):
        super().__init__()
        self.offset_conv = nn.Sequential(
            nn.Conv2d(DIM, 2 * SAMPLES, 3), nn.SELU(), nn.Conv2d(2 * SAMPLES, 2 * SAMPLES, 1)
        )  # fmt: skip
        self.sf_conv = nn.Conv2d(DIM, DIM, 1, bias=False)
        self.agg_weights = nn.Parameter(torch.zeros(SAMPLES, DIM, DIM))

    def forward(self, x: Float[Tensor, "1 c h w"], keypoints: Float[Tensor, "k 2"]) -> Float[Tensor, "k c"]:
        """Return unit-length descriptors of keypoints (x, y) [px] in the feature maps `x`."""
        h, w = x.shape[2:]
        corner = (keypoints.long() - 1).clamp_min(0)
        corner = torch.minimum(corner, torch.tensor([w - 4, h - 4], device=x.device))
        step = torch.arange(3, device=x.device)
        rows, columns = corner[:, 1, None, None] + step[:, None], corner[:, 0, None, None] + step
        patches = x[0][:, rows, columns].transpose(0, 1)
        limit = max(h, w) / 4
        offsets = self.offset_conv(patches).clamp(-limit, limit).reshape(-1, 2, SAMPLES).mT
        samples = sample(x, (keypoints[:, None] + offsets)[None])
        samples = F.selu(self.sf_conv(samples))[0]
        return F.normalize(torch.einsum("ckp,pcd->kd", samples, self.agg_weights), dim=1)


class ALIKED(nn.Module):
    """The network; `keypoints_of` is its public method."""

    def __init__(self):
        super().__init__()
        a, b, c, d = WIDTHS
        self.block1, self.block2 = ConvBlock(3, a, False, False), ConvBlock(a, b, True, False)
        self.block3, self.block4 = ConvBlock(b, c, True, True), ConvBlock(c, d, True, True)
        self.conv1, self.conv2, self.conv3, self.conv4 = (nn.Conv2d(n, DIM // 4, 1, bias=False) for n in WIDTHS)
        widths = (DIM, 8, 4, 4, 1)
        layers = [nn.Conv2d(i, o, k, padding=k // 2, bias=False)
                  for i, o, k in zip(widths, widths[1:], (1, 3, 3, 3))]  # fmt: skip # noqa: B905
        self.score_head = nn.Sequential(*[m for conv in layers for m in (conv, nn.SELU())][:-1])
        self.desc_head = Descriptor()

    def maps(self, image: Float[Tensor, "1 3 h w"]) -> tuple[Float[Tensor, "1 c h w"], Float[Tensor, "1 1 h w"]]:
        """Unit-length features and a score for every pixel."""
        h, w = image.shape[2:]
        down, across = -h % MULTIPLE, -w % MULTIPLE
        left, top = across // 2, down // 2
        x1 = self.block1(F.pad(image, (left, across - left, top, down - top), mode="replicate"))
        x2 = self.block2(F.avg_pool2d(x1, 2))
        x3 = self.block3(F.avg_pool2d(x2, 4))
        x4 = self.block4(F.avg_pool2d(x3, 4))
        levels = [F.selu(conv(x)) for conv, x in zip((self.conv1, self.conv2, self.conv3, self.conv4),
                                                     (x1, x2, x3, x4), strict=True)]  # fmt: skip
        size = x1.shape[2:]
        joint = torch.cat([F.interpolate(x, size=size, mode="bilinear", align_corners=True) for x in levels], 1)
        inside = (..., slice(top, top + h), slice(left, left + w))
        return F.normalize(joint, dim=1)[inside], self.score_head(joint).sigmoid()[inside]

    @torch.no_grad()
    def keypoints_of(
        self, image: Float[Tensor, "h w 3"], maximum: int, min_score: float = 0.2
    ) -> tuple[Float[Tensor, "k 2"], Float[Tensor, "k 128"]]:
        """Find up to `maximum` keypoints [px] of an RGB image in 0..1, pixel centres at +0.5, and unit descriptors."""
        features, scores = self.maps(image.permute(2, 0, 1)[None])
        keypoints = peaks(scores, maximum, min_score)
        return keypoints + 0.5, self.desc_head(features, keypoints)


def peaks(scores: Float[Tensor, "1 1 h w"], maximum: int, threshold: float) -> Float[Tensor, "k 2"]:
    """Find up to `maximum` highest local maxima (x, y) [px] of scores above `threshold`, pixel centres at integers.

    Positions are refined to subpixel accuracy by a soft argmax.
    """
    suppressed = suppress_nonmaxima(scores)[0, 0]
    for edge in (suppressed[:RADIUS], suppressed[-RADIUS:], suppressed[:, :RADIUS], suppressed[:, -RADIUS:]):
        edge.zero_()
    found = torch.nonzero(suppressed > threshold)
    value = suppressed[found[:, 0], found[:, 1]]
    found = found[value.topk(min(maximum, len(value))).indices]
    step = torch.arange(-RADIUS, RADIUS + 1, device=scores.device)
    around = scores[0, 0][found[:, 0, None, None] + step[:, None], found[:, 1, None, None] + step]
    weight = (around.flatten(1) / TEMPERATURE).softmax(1).unflatten(1, (len(step), len(step)))
    shift = torch.stack([(weight.sum(1) * step).sum(1), (weight.sum(2) * step).sum(1)], 1)
    return found.flip(1) + shift


def suppress_nonmaxima(scores: Float[Tensor, "1 1 h w"]) -> Float[Tensor, "1 1 h w"]:
    """Non-maximum suppression: keep the scores of maxima within RADIUS, and set the others to zero.

    Two further rounds restore maxima whose only higher neighbours were themselves suppressed.
    """

    def local_maximum(x: Tensor) -> Tensor:
        return F.max_pool2d(x, 2 * RADIUS + 1, 1, RADIUS)

    kept = scores == local_maximum(scores)
    for _ in range(2):
        near = local_maximum(kept.float()) > 0
        rest = scores.masked_fill(near, 0)
        kept |= (rest == local_maximum(rest)) & ~near
    return torch.where(kept, scores, 0)
