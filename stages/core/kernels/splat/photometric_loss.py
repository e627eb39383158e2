"""Loss of a rendered photo (L1, SSIM and inverse depth) and its gradient: eight launches on CUDA instead of eighty.

One thread per value applies the exposure, and one per pixel adds up the loss and its gradients. On a CPU, where
launches cost little, the reference is used.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import warp as wp
from jaxtyping import Float, UInt8
from torch import Tensor

from stages.core.kernels.interop import device_of, launch, view
from stages.core.kernels.splat.ssim import ssim
from stages.core.kernels.splat.ssim_pixel import ssim_backward, ssim_forward

wp.set_module_options({"enable_backward": False})

MIN_DEPTH_ALPHA = 0.5  # of pixels whose depth counts


@dataclass(frozen=True)
class LossTerms:
    """Weights and units of the terms."""

    ssim: float  # weight of 1 - SSIM; L1 has the rest
    depth: float  # weight of the error in inverse depth [1 / camera distance]
    camera_distance: float  # unit of the depth term [scene units]
    min_depth: float  # rendered depth is clamped to this in the depth term [scene units]


@wp.kernel
def _expose(
    rgb: wp.array2d[float], gain: wp.array[float], photo: wp.array2d[wp.uint8], image: wp.array2d[float],
    target: wp.array2d[float],
):  # fmt: skip
    i, j = wp.tid()
    image[i, j] = rgb[i, j] * gain[j % 3]
    target[i, j] = float(photo[i, j]) / 255.0


@wp.func
def _sign(x: float) -> float:
    if x > 0.0:
        return 1.0
    if x < 0.0:
        return -1.0
    return 0.0


@wp.kernel
def _add_up(
    ssim_weight: float, depth_weight: float, distance: float, min_depth: float, has_depth: int,
    rgb: wp.array2d[float], gain: wp.array[float], image: wp.array2d[float], target: wp.array2d[float],
    ssim_map: wp.array2d[float], ssim_grads: wp.array2d[float], depth: wp.array2d[float], alpha: wp.array2d[float],
    inverse: wp.array2d[float], v_rgb: wp.array2d[float], v_depth: wp.array2d[float], sums: wp.array3d[float],
):  # fmt: skip
    """`sums` holds the loss of a pixel and its derivatives by the gains."""
    i, j = wp.tid()
    pixels = float(depth.shape[0] * depth.shape[1])
    loss = 0.0
    for c in range(3):
        k = 3 * j + c
        error = image[i, k] - target[i, k]
        loss += ((1.0 - ssim_weight) * wp.abs(error) - ssim_weight * ssim_map[i, k]) / (3.0 * pixels)
        v = (1.0 - ssim_weight) * _sign(error) / (3.0 * pixels) - ssim_weight * ssim_grads[i, k]
        v_rgb[i, k] = v * gain[c]
        sums[i, j, 1 + c] = v * rgb[i, k]
    v_depth[i, j] = 0.0
    if has_depth != 0 and alpha[i, j] > wp.static(MIN_DEPTH_ALPHA) and wp.isfinite(inverse[i, j]):
        z = wp.max(depth[i, j], min_depth)
        error = distance / z - inverse[i, j]
        loss += depth_weight * wp.abs(error) / pixels
        if depth[i, j] >= min_depth:
            v_depth[i, j] = -depth_weight * _sign(error) * distance / (z * z * pixels)
    sums[i, j, 0] = loss


class _Loss(torch.autograd.Function):
    @staticmethod
    def forward(ctx, rgb, alpha, depth, gain, photo, inverse, terms):
        x, device = rgb.flatten(1).contiguous(), device_of(rgb)
        image, target, v_rgb, v_depth = torch.empty_like(x), torch.empty_like(x), torch.empty_like(x), depth.clone()
        tensors = [view(t) for t in (x, gain.contiguous(), photo.flatten(1))]
        launch(_expose, x.shape, tensors, [view(image), view(target)], device)
        shape = rgb.shape
        ssim_map, derivatives = ssim_forward(image.view(shape), target.view(shape))
        ssim_grads = ssim_backward(image.view(shape), target.view(shape), derivatives).flatten(1)
        sums = depth.new_empty(*depth.shape, 4)
        given = [x, gain.contiguous(), image, target, ssim_map, ssim_grads, depth.contiguous(), alpha.contiguous(),
                 depth if inverse is None else inverse.contiguous()]  # fmt: skip
        numbers = [terms.ssim, terms.depth, terms.camera_distance, terms.min_depth, int(inverse is not None)]
        launch(_add_up, depth.shape, [*numbers, *(view(t) for t in given)],
               [view(v_rgb), view(v_depth), view(sums)], device)  # fmt: skip
        loss, v_gain = sums.flatten(0, 1).sum(0).split([1, 3])
        ctx.save_for_backward(v_rgb.view(shape), v_depth, v_gain)
        return loss[0] + terms.ssim

    @staticmethod
    def backward(ctx, v):
        v_rgb, v_depth, v_gain = ctx.saved_tensors
        return v * v_rgb, None, v * v_depth, v * v_gain, None, None, None


def photometric_loss(
    rgb: Float[Tensor, "h w 3"], alpha: Float[Tensor, "h w"], depth: Float[Tensor, "h w"], gain: Float[Tensor, "3"],
    photo: UInt8[Tensor, "h w 3"], inverse: Float[Tensor, "h w"] | None, terms: LossTerms,
) -> Float[Tensor, ""]:  # fmt: skip
    """Loss of the image rgb * gain of a photo, and of its depth where `inverse`, camera distance over depth, is finite.

    Differentiable in rgb, depth and gain; alpha only selects the pixels whose depth counts.
    """
    if not rgb.is_cuda:
        return photometric_loss_reference(rgb, alpha, depth, gain, photo, inverse, terms)
    return _Loss.apply(rgb, alpha, depth, gain, photo, inverse, terms)


def photometric_loss_reference(
    rgb: Float[Tensor, "h w 3"], alpha: Float[Tensor, "h w"], depth: Float[Tensor, "h w"], gain: Float[Tensor, "3"],
    photo: UInt8[Tensor, "h w 3"], inverse: Float[Tensor, "h w"] | None, terms: LossTerms,
) -> Float[Tensor, ""]:  # fmt: skip
    """`photometric_loss` in PyTorch."""
    image, photo = rgb * gain, photo.float() / 255
    loss = (1 - terms.ssim) * (image - photo).abs().mean() + terms.ssim * (1 - ssim(image, photo))
    if inverse is not None:
        error = terms.camera_distance / depth.clamp_min(terms.min_depth) - inverse
        known = error.isfinite() & (alpha > MIN_DEPTH_ALPHA)
        loss = loss + terms.depth * torch.where(known, error, torch.zeros_like(error)).abs().mean()
    return loss
