"""Images and per-pixel state of compositing, shared by the kernels of `compositing` and `compositing_cuda`."""

from __future__ import annotations

import warp as wp
from torch import Tensor

from stages.core.kernels.interop import with_arrays


@wp.struct
class Canvas:
    """The images of a view over their background, and the final state of each pixel, from which the adjoint starts."""

    behind: wp.array[float]  # the background: a colour (3,) or an image (h * w * 3,)
    mean: int  # whether the fourth channel is divided by alpha
    rgb: wp.array3d[float]  # (h, w, 3)
    fourth: wp.array2d[float]  # (h, w)
    alpha: wp.array2d[float]  # (h, w)
    left: wp.array[float]  # final transmittance of each pixel; on a CPU ordered by block and lane
    stops: wp.array[int]  # position in the list of its bin or tile at which each pixel was finished


@wp.struct
class ImageGradients:
    """Gradients of the loss with respect to the images of a canvas."""

    rgb: wp.array3d[float]  # (h, w, 3)
    fourth: wp.array2d[float]  # (h, w)
    alpha: wp.array2d[float]  # (h, w)


def canvas_over(behind: Tensor, mean: bool, **arrays: Tensor) -> Canvas:
    """Return a canvas with these arrays over a background colour (3,) or image (h, w, 3).

    With `mean` the fourth channel is divided by alpha.
    """
    canvas = with_arrays(Canvas(), {"behind": behind.view(-1), **arrays})
    canvas.mean = int(mean)
    return canvas


def image_gradients(*gradients: Tensor) -> ImageGradients:
    """Return the gradients of the images rgb, fourth channel and alpha, for kernels."""
    return with_arrays(ImageGradients(), dict(zip(ImageGradients.vars, gradients, strict=True)))
