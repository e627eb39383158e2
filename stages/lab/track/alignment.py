"""Poses of objects from the difference between images and renderings, by coarse-to-fine Gauss-Newton.

A small motion of an object changes a rendering I as its pixels move: dI = -grad I . du, where du is the projected
motion of the point seen in the pixel. Pixels on an outline move with the object in front. Residuals have Geman-McClure
weights, so that pixels which the scene does not explain (a hand, a shadow) have little effect. The gradient is the mean
of the gradients of rendering and image, which converges in fewer steps. Both are reduced by the same block averaging;
renderings at a lower resolution would be biased.
Source: Baker and Matthews 2004, "Lucas-Kanade 20 years on"; Geman and McClure 1987, "Statistical methods for
tomographic image reconstruction"; Benhimane and Malis 2004, "Real-time image-based tracking of planes using efficient
second-order minimization".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.geometry.cameras import resize
from stages.lab.track.poses import Poses
from stages.lab.track.synthesis import Camera, Synthesis, Synthesiser

PRIOR = (0.5, 0.5)  # standard deviations of the predicted pose: rotation [rad] and displacement [object sizes]
PIXEL_NOISE = 0.05  # standard deviation of a colour channel (0..1) that weighs images against the predicted pose
CONVERGED = 0.05  # displacement of the last step below which iteration stops [px]


@dataclass(frozen=True)
class Observation:
    """An image at one resolution, and how far the objects have moved from their poses when it was taken."""

    film: int  # index of the film
    late: float  # delay of the image after the time of the poses [frames]
    camera: Camera
    reduction: int  # factor by which the image is reduced
    image: Float[Tensor, "h w c"]  # nan where unknown
    displacement: Float[Tensor, "o 6"]  # motion of each object during `late`: rotation [rad], translation [scene units]

    def draw(self, synthesiser: Synthesiser, poses: Poses) -> Synthesis:
        """The rendering that this image is compared with."""
        return synthesiser.draw(self.camera, poses.moved(self.displacement), self.reduction)

    def difference(self, drawn: Synthesis) -> Float[Tensor, "h w c"]:
        """Image minus rendering; 0 where the image is unknown."""
        return (self.image - drawn.image).nan_to_num(0.0)


@dataclass(frozen=True)
class PixelChanges:
    """The pixels of an image that show moving objects: their residuals, and derivatives by the objects' motion."""

    row: Tensor  # (p) object in each pixel
    residual: Float[Tensor, "p c"]
    jacobian: Float[Tensor, "p c 6"]  # derivative of the rendering by rotation [1/rad] and displacement [1/scene unit]


def change_of(seen: Observation, drawn: Synthesis, centre: Float[Tensor, "o 3"]) -> PixelChanges:
    """Residuals, and derivatives of the rendering by rotation about `centre` and displacement of the objects."""
    at = drawn.moving >= 0
    difference = seen.difference(drawn)
    mean = drawn.image + difference / 2
    gradient = torch.stack([_central(mean, 1), _central(mean, 0)], -1)[at]  # (p, c, 2)
    row, point = drawn.moving[at], drawn.point[at]
    V, K = seen.camera.viewmat, resize(seen.camera.K, 1 / seen.reduction, 1 / seen.reduction)
    p = point @ V[:3, :3].mT + V[:3, 3]
    z = p[:, 2].clamp_min(1e-6)
    zero = torch.zeros_like(z)
    projection = torch.stack([
        torch.stack([K[0, 0] / z, zero, -K[0, 0] * p[:, 0] / z**2], 1),
        torch.stack([zero, K[1, 1] / z, -K[1, 1] * p[:, 1] / z**2], 1),
    ], 1) @ V[:3, :3]  # fmt: skip  # (p, 2, 3), derivative by the motion of the point in the world
    by_place = -gradient @ projection  # (p, c, 3)
    arm = (point - centre[row])[:, None].expand_as(by_place)
    by_turn = torch.linalg.cross(arm, by_place)  # a . (w x r) = w . (r x a)
    return PixelChanges(row, difference[at], torch.cat([by_turn, by_place], -1))


def _central(image: Float[Tensor, "h w c"], dim: int) -> Float[Tensor, "h w c"]:
    """Derivative along rows (0) or columns (1) by central differences; 0 on the border."""
    out = torch.zeros_like(image)
    n = image.shape[dim]
    out.narrow(dim, 1, n - 2).copy_((image.narrow(dim, 2, n - 2) - image.narrow(dim, 0, n - 2)) / 2)
    return out


def robust_weights(residual: Float[Tensor, "p c"], scale: float) -> Float[Tensor, "p"]:
    """Geman-McClure weights of residuals, for the given scale."""
    return (scale**2 / (scale**2 + residual.square().mean(1))).square()


def robust_cost(residual: Float[Tensor, "*b c"], scale: float) -> float:
    """Mean of the Geman-McClure function, from 0 to 1."""
    square = residual.square().mean(-1)
    return float((square / (scale**2 + square)).mean())


def align(
    synthesiser: Synthesiser, levels: Sequence[tuple[list[Observation], int]], poses: Poses, scale: Sequence[float],
    fixed: Tensor | None = None,
) -> Poses:  # fmt: skip
    """The poses that explain the images best, starting from nearby poses.

    `levels` holds the observations at each resolution, coarse to fine, with the maximum number of steps; `scale` is the
    Geman-McClure scale of each object. Objects in the mask `fixed` keep their poses.
    """
    start = poses
    for observations, steps in levels:
        for _ in range(steps):
            step = _step(synthesiser, observations, poses, start, scale)
            if fixed is not None:
                step = torch.where(fixed[:, None], 0.0, step)
            poses = poses.moved(step)
            pixel = float(observations[0].camera.K[0, 0]) / observations[0].reduction
            reach = step[:, :3].norm(dim=1) * synthesiser.sizes + step[:, 3:].norm(dim=1)
            if float(reach.max()) * pixel < CONVERGED:
                break
    return poses


def _step(
    synthesiser: Synthesiser, observations: list[Observation], poses: Poses, predicted: Poses, scale: Sequence[float]
) -> Float[Tensor, "o 6"]:
    """One Gauss-Newton step of all objects, from the images of all cameras."""
    changes = [change_of(o, o.draw(synthesiser, poses), poses.centre) for o in observations]
    row = torch.cat([c.row for c in changes])
    residual, jacobian = torch.cat([c.residual for c in changes]), torch.cat([c.jacobian for c in changes])
    steps, off = [], poses.step_to(predicted)
    for i, size in enumerate(synthesiser.sizes):
        mine = row == i
        r, J = residual[mine], jacobian[mine]
        w = robust_weights(r, scale[i])
        H = torch.einsum("p,pci,pcj->ij", w, J, J)
        b = torch.einsum("p,pci,pc->i", w, J, r)
        prior = PIXEL_NOISE**2 / torch.cat([size.new_full((3,), PRIOR[0]), PRIOR[1] * size.expand(3)]).square()
        H = H + prior.diag() + 1e-4 * H.diagonal().diag()
        step = torch.linalg.solve(H.double(), (b + prior * off[i]).double()).float()
        # limit the step to half the size of the object
        reach = (step[:3].norm() * size + step[3:].norm()) / (0.5 * size)
        steps.append(step / reach.clamp_min(1.0))
    return torch.stack(steps)
