"""Photometric loss of a rendered photo (L1, SSIM and inverse depth) and its gradient.

Takes eight launches on CUDA instead of eighty: one thread per value applies the exposure, and one thread per pixel sums
the loss and its gradients. On a CPU, where launches are cheap, the reference is used.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import NamedTuple

import torch
import warp as wp
from jaxtyping import Float, UInt8
from torch import Tensor

from stages.core.kernels.interop import device_of, launch, view, with_arrays
from stages.core.kernels.splat.ssim import ssim
from stages.core.kernels.splat.ssim_pixel import ssim_backward, ssim_forward

wp.set_module_options({"enable_backward": False})

MIN_DEPTH_ALPHA = 0.5  # smallest alpha of pixels that contribute to the depth term


@dataclass(frozen=True)
class LossTerms:
    """Weights and units of the terms of the loss."""

    ssim: float  # weight of 1 - SSIM; the weight of L1 is 1 - ssim
    depth: float  # weight of the error in inverse depth [1 / camera distance]
    camera_distance: float  # unit of the depth term [scene units]
    min_depth: float  # rendered depth is clamped to this in the depth term [scene units]


class PhotoTarget(NamedTuple):
    """The photo that a render is compared with, and its depth if known."""

    photo: UInt8[Tensor, "h w 3"]
    inverse: Float[Tensor, "h w"] | None  # camera distance / depth, not finite where unknown; None: no depth


@wp.struct
class RenderedPhoto:
    """A render and the exposure of the photo."""

    rgb: wp.array2d[float]  # (h, w * 3)
    gain: wp.array[float]  # (3,)
    depth: wp.array2d[float]  # (h, w)
    alpha: wp.array2d[float]  # (h, w)


@wp.struct
class PhotoComparison:
    """The render after exposure, the photo, and their similarity."""

    image: wp.array2d[float]  # (h, w * 3), rgb * gain
    photo: wp.array2d[float]  # (h, w * 3), 0..1
    ssim: wp.array2d[float]  # (h, w * 3)
    ssim_grads: wp.array2d[float]  # (h, w * 3), gradient of the mean SSIM with respect to `image`
    inverse: wp.array2d[float]  # (h, w) as in `PhotoTarget`, empty without depth


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
    terms: wp.vec4, render: RenderedPhoto, compared: PhotoComparison, v_rgb: wp.array2d[float],
    v_depth: wp.array2d[float], sums: wp.array3d[float],
):  # fmt: skip
    """Compute the loss of each pixel and its gradients.

    `terms` are the values of `LossTerms`; `sums` holds the loss of each pixel and its derivatives with respect to the
    gains.
    """
    i, j = wp.tid()
    ssim_weight, depth_weight, distance, min_depth = terms[0], terms[1], terms[2], terms[3]
    depth = render.depth[i, j]
    pixels = float(render.depth.shape[0] * render.depth.shape[1])
    loss = 0.0
    for c in range(3):
        k = 3 * j + c
        error = compared.image[i, k] - compared.photo[i, k]
        loss += ((1.0 - ssim_weight) * wp.abs(error) - ssim_weight * compared.ssim[i, k]) / (3.0 * pixels)
        v = (1.0 - ssim_weight) * _sign(error) / (3.0 * pixels) - ssim_weight * compared.ssim_grads[i, k]
        v_rgb[i, k] = v * render.gain[c]
        sums[i, j, 1 + c] = v * render.rgb[i, k]
    v_depth[i, j] = 0.0
    if compared.inverse.shape[0] > 0 and render.alpha[i, j] > wp.static(MIN_DEPTH_ALPHA):
        inverse = compared.inverse[i, j]
        if wp.isfinite(inverse):
            z = wp.max(depth, min_depth)
            error = distance / z - inverse
            loss += depth_weight * wp.abs(error) / pixels
            if depth >= min_depth:
                v_depth[i, j] = -depth_weight * _sign(error) * distance / (z * z * pixels)
    sums[i, j, 0] = loss


class _Loss(torch.autograd.Function):
    @staticmethod
    def forward(ctx, rgb, alpha, depth, gain, target, terms):
        x, device, shape = rgb.flatten(1).contiguous(), device_of(rgb), rgb.shape
        image, photo, v_rgb, v_depth = torch.empty_like(x), torch.empty_like(x), torch.empty_like(x), depth.clone()
        render = with_arrays(RenderedPhoto(), {"rgb": x, "gain": gain, "depth": depth, "alpha": alpha})
        inputs = [view(x), view(gain), view(target.photo.flatten(1))]
        launch(_expose, x.shape, inputs, [view(image), view(photo)], device)
        ssim_map, derivatives = ssim_forward(image.view(shape), photo.view(shape))
        ssim_grads = ssim_backward(image.view(shape), photo.view(shape), derivatives).flatten(1)
        sums = depth.new_empty(*depth.shape, 4)
        compared = {"image": image, "photo": photo, "ssim": ssim_map, "ssim_grads": ssim_grads}
        if target.inverse is not None:
            compared["inverse"] = target.inverse
        inputs = [wp.vec4(*astuple(terms)), render, with_arrays(PhotoComparison(), compared)]
        launch(_add_up, depth.shape, inputs, [view(v_rgb), view(v_depth), view(sums)], device)
        loss, v_gain = sums.flatten(0, 1).sum(0).split([1, 3])
        ctx.save_for_backward(v_rgb.view(shape), v_depth, v_gain)
        return loss[0] + terms.ssim

    @staticmethod
    def backward(ctx, v):
        v_rgb, v_depth, v_gain = ctx.saved_tensors
        return v * v_rgb, None, v * v_depth, v * v_gain, None, None


def photometric_loss(
    rgb: Float[Tensor, "h w 3"], alpha: Float[Tensor, "h w"], depth: Float[Tensor, "h w"], gain: Float[Tensor, "3"],
    target: PhotoTarget, terms: LossTerms,
) -> Float[Tensor, ""]:  # fmt: skip
    """Return the loss of the image rgb * gain, and of its depth where the depth of the photo is known.

    Differentiable in rgb, depth and gain; alpha only selects the pixels that contribute to the depth term.
    """
    if not rgb.is_cuda:
        return photometric_loss_reference(rgb, alpha, depth, gain, target, terms)
    return _Loss.apply(rgb, alpha, depth, gain, target, terms)


def photometric_loss_reference(
    rgb: Float[Tensor, "h w 3"], alpha: Float[Tensor, "h w"], depth: Float[Tensor, "h w"], gain: Float[Tensor, "3"],
    target: PhotoTarget, terms: LossTerms,
) -> Float[Tensor, ""]:  # fmt: skip
    """`photometric_loss` in PyTorch."""
    image, photo = rgb * gain, target.photo.float() / 255
    loss = (1 - terms.ssim) * (image - photo).abs().mean() + terms.ssim * (1 - ssim(image, photo))
    if target.inverse is not None:
        error = terms.camera_distance / depth.clamp_min(terms.min_depth) - target.inverse
        known = error.isfinite() & (alpha > MIN_DEPTH_ALPHA)
        loss = loss + terms.depth * torch.where(known, error, torch.zeros_like(error)).abs().mean()
    return loss
