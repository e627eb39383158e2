"""Photometric fit: Gaussians optimised by gradient descent through the rasteriser.

Loss and learning rates follow Kerbl et al. 2023, "3D Gaussian Splatting", sec. 5 and its code; the Gaussians start on
matched surfaces, so a few hundred iterations are enough on a CPU. Sizes are regularised as in Kheradmand et al. 2024,
"3D Gaussian Splatting as Markov Chain Monte Carlo", sec. 4, against overfitting few photos. Opacities are not: later
stages segment and move the surfaces, which have to be opaque.
The number of iterations is fixed beforehand and independent of time, so a seed gives the same scene again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor
from tqdm import tqdm

from stages.core.geometry.cameras import centres
from stages.core.geometry.rotations import matrix
from stages.core.kernels.splat.ssim import ssim
from stages.core.raster.rasterise import rasterise
from stages.core.scene.cameras import Cameras
from stages.core.scene.gaussians import Gaussians
from stages.reconstruct.photos import Views

SSIM_WEIGHT = 0.2  # of 1 - SSIM; L1 has the rest
LEARNING_RATES = {"scales": 5e-3, "quats": 2e-3, "opacities": 3e-2, "base": 5e-3, "rest": 2.5e-4, "gains": 2e-3}
MEANS_RATE = 2e-4  # learning rate of the means [camera distances]
MEANS_DECAY = 0.01  # factor on this rate at the end of the exponential decay
DEPTH_WEIGHT = 0.1  # of the error in inverse depth [1 / camera distance]
MIN_DEPTH = 0.1  # rendered depth is clamped to this in the depth term [camera distances]
SCALE_WEIGHT = 0.01  # of the mean scale [camera distances]


@dataclass(frozen=True)
class DensityControl:
    """When Gaussians are split and pruned; compare the fields of gsplat's `DefaultStrategy`."""

    min_iterations: int = 200  # no splitting in shorter fits
    split_times: tuple[float, ...] = (0.2, 0.4)  # fractions of the iterations after which Gaussians are split
    split_fraction: float = 0.08  # of the Gaussians, each time
    split_offset: float = 0.7  # of the two halves from the mean, in random samples of the Gaussian
    split_log_scale: float = 0.47  # by which the log scales of the halves are reduced: 1.6 times smaller
    min_opacity: float = 0.02  # Gaussians of lower opacity are pruned
    min_lens_distance: float = 0.1  # Gaussians closer to a camera are pruned [camera distances]
    max_scale: float = 0.1  # larger Gaussians are pruned [distances from the mean camera centre]


DENSITY = DensityControl()


@dataclass(frozen=True)
class FitOptions:
    """Length and scale of a fit."""

    iterations: int  # each on one photo
    camera_distance: float  # typical distance of the cameras from the objects [scene units]
    seed: int = 0
    device: str = "cpu"


@dataclass
class _Fit:
    """Optimised tensors, one for each learning rate, and their optimiser."""

    values: dict[str, Tensor]
    optimiser: torch.optim.Optimizer
    camera_distance: float  # [scene units]
    exposure_projection: Float[Tensor, "c c"]

    @classmethod
    def start(cls, gaussians: Gaussians, cameras: Cameras, camera_distance: float) -> _Fit:
        """Parameters of these Gaussians, activations inverted, and zero log exposures."""
        device = gaussians.means.device
        values = {
            "means": gaussians.means,
            "scales": gaussians.scales.log(),
            "quats": gaussians.quats,
            "opacities": gaussians.opacities.clamp(1e-4, 1 - 1e-4).logit(),
            "base": gaussians.sh[:, :1],
            "rest": gaussians.sh[:, 1:],
            "gains": torch.zeros(len(cameras), 3, device=device),  # log exposure of each photo and channel
        }
        values = {name: value.clone().requires_grad_() for name, value in values.items() if value.numel()}
        rates = {**LEARNING_RATES, "means": MEANS_RATE * camera_distance}
        groups = [{"params": [value], "lr": rates[name], "name": name} for name, value in values.items()]
        optimiser = torch.optim.Adam(groups, eps=1e-15, fused=True)
        return cls(values, optimiser, camera_distance, _exposure_projection(cameras).to(device))

    def gaussians(self) -> Gaussians:
        """The Gaussians with activations applied, differentiable."""
        v = self.values
        sh = torch.cat([v["base"], v["rest"]], 1) if "rest" in v else v["base"]
        ids = torch.zeros(len(sh), dtype=torch.int64, device=sh.device)
        quats = F.normalize(v["quats"], dim=1)
        return Gaussians(v["means"], quats, v["scales"].exp(), v["opacities"].sigmoid(), sh, ids)

    def gain(self, view: int) -> Float[Tensor, "3"]:
        """Exposure factor of a photo per channel, without the part that its camera pose explains."""
        return (self.exposure_projection[view] @ self.values["gains"]).exp()

    def select(self, index: Int[Tensor, "m"], fresh: Int[Tensor, "k"] | None = None) -> None:
        """Keep (or repeat) these Gaussians with their Adam moments; moments at positions `fresh` are set to zero."""
        for group in self.optimiser.param_groups:
            if group["name"] == "gains":
                continue
            old = group["params"][0]
            new = old.detach()[index].clone().requires_grad_()
            state = self.optimiser.state.pop(old, None)
            if state:
                for key in ("exp_avg", "exp_avg_sq"):
                    state[key] = state[key][index].clone()
                    if fresh is not None:
                        state[key][fresh] = 0
                self.optimiser.state[new] = state
            group["params"][0] = self.values[group["name"]] = new


def fit_gaussians(
    gaussians: Gaussians, views: Views, options: FitOptions, depths: Sequence[Float[Tensor, "h w"]] = ()
) -> Gaussians:
    """Gaussians optimised to render like the photos.

    One photo per iteration, in random order without repeats. `depths` of the views, 0 where unknown, are a second
    target. The background is a random grey in every iteration, so surfaces become opaque.
    """
    steps, distance, device = options.iterations, options.camera_distance, options.device
    if not steps:
        return gaussians
    fit = _Fit.start(gaussians.to(device), views.cameras, distance)
    on_device = _to_device(views, device)
    inverse = [(distance / depth).to(device) for depth in depths]
    generator = torch.Generator().manual_seed(options.seed)
    splits = {round(time * steps) for time in DENSITY.split_times if steps >= DENSITY.min_iterations}
    gradients = torch.zeros(len(gaussians), device=device)
    order: list[int] = []
    with tqdm(range(steps), desc="fitting photos", unit="step", leave=False) as bar:
        for step in bar:
            order = order or torch.randperm(len(views), generator=generator).tolist()
            view, grey = order.pop(), float(torch.rand((), generator=generator))
            loss = _backward(fit, on_device, view, grey, device, inverse[view] if inverse else None)
            gradients += fit.values["means"].grad.norm(dim=1)
            fit.optimiser.step()
            fit.optimiser.param_groups[0]["lr"] = MEANS_RATE * distance * MEANS_DECAY ** (step / steps)
            if step in splits:
                _split(fit, gradients, generator)
                gradients = torch.zeros(len(fit.values["means"]), device=device)
            if step % 20 == 0:
                bar.set_postfix(loss=f"{loss.item():.4f}")
    return _prune(fit, views, gradients > 0)


def _exposure_projection(cameras: Cameras) -> Float[Tensor, "c c"]:
    """Projection that removes from one value per camera the part that is constant or linear in its pose.

    This part of the exposures is view-dependent colour, which the spherical harmonics represent. With few cameras only
    the main directions are removed, at most one for every four cameras.
    """
    count = len(cameras)
    position, forward = (x.double().cpu() for x in (centres(cameras.viewmats), cameras.viewmats[:, 2, :3]))
    position, forward = ((x - x.mean(0)) / (x - x.mean(0)).norm().clamp_min(1e-9) for x in (position, forward))
    main, singular, _ = torch.linalg.svd(torch.cat([position, forward], 1), full_matrices=False)
    main = main[:, singular > 1e-3 * singular[0]][:, : count // 4]
    basis = torch.cat([torch.full((count, 1), count**-0.5, dtype=main.dtype), main], 1)
    return (torch.eye(count, dtype=main.dtype) - basis @ basis.T).float()


def _to_device(views: Views, device: str) -> Views:
    """The views on a device, copied at once: a copy per iteration would wait for the GPU."""
    cameras = views.cameras
    cameras = replace(cameras, viewmats=cameras.viewmats.to(device), Ks=cameras.Ks.to(device))
    return Views(tuple(image.to(device) for image in views.images), cameras)


def _backward(
    fit: _Fit, views: Views, view: int, grey: float, device: str, inverse: Float[Tensor, "h w"] | None = None
) -> Float[Tensor, ""]:
    """The loss on one photo, with gradients computed.

    `inverse` is the inverse target depth times the camera distance, inf where unknown.
    """
    photo = views.image(view, device)
    height, width = photo.shape[:2]
    background = torch.full((3,), grey, device=device)
    one = slice(view, view + 1)
    gaussians = fit.gaussians()
    rendering = rasterise(gaussians, views.cameras.viewmats[one], views.cameras.Ks[one], width, height, background)
    image = rendering.rgb[0] * fit.gain(view)
    loss = (1 - SSIM_WEIGHT) * (image - photo).abs().mean() + SSIM_WEIGHT * (1 - ssim(image, photo))
    loss = loss + SCALE_WEIGHT * gaussians.scales.mean() / fit.camera_distance
    if inverse is not None:
        depth = rendering.depth[0].clamp_min(MIN_DEPTH * fit.camera_distance)
        error = fit.camera_distance / depth - inverse
        known = error.isfinite() & (rendering.alpha[0] > 0.5)
        loss = loss + DEPTH_WEIGHT * torch.where(known, error, torch.zeros_like(error)).abs().mean()
    fit.optimiser.zero_grad(set_to_none=True)
    loss.backward()
    return loss.detach()  # converting to a Python number would wait for the GPU


def _split(fit: _Fit, gradients: Float[Tensor, "n"], generator: torch.Generator) -> None:
    """Prune transparent Gaussians and split those with the largest gradients into two smaller ones.

    As sec. 5.2 of Kerbl et al. 2023, but ranked by the gradient of the mean times the size of the Gaussian: the change
    of the loss if it moved by its own width.
    """
    v = {name: value.detach() for name, value in fit.values.items()}
    alive = v["opacities"].sigmoid() > DENSITY.min_opacity
    size = v["scales"].exp().max(1).values
    count = int(DENSITY.split_fraction * int(alive.sum()))
    chosen = torch.where(alive, gradients * size, -torch.ones_like(gradients)).topk(count).indices
    keep = torch.cat([alive.nonzero()[:, 0], chosen])
    first = torch.searchsorted(alive.nonzero()[:, 0], chosen)  # new rows of the first halves
    second = torch.arange(len(keep) - count, len(keep), device=keep.device)
    offset = torch.randn(count, 3, generator=generator).to(size.device) * v["scales"][chosen].exp()
    offset = _rotate(v["quats"][chosen], offset)
    fit.select(keep, torch.cat([first, second]))
    with torch.no_grad():
        fit.values["means"][first] += DENSITY.split_offset * offset
        fit.values["means"][second] -= DENSITY.split_offset * offset
        for rows in (first, second):
            fit.values["scales"][rows] -= DENSITY.split_log_scale


def _rotate(quats: Float[Tensor, "n 4"], vectors: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    return (matrix(quats) @ vectors[..., None])[..., 0]


def _prune(fit: _Fit, views: Views, visible: Bool[Tensor, "n"]) -> Gaussians:
    """The Gaussians without those that are transparent, in no photo, too large, or right in front of a camera."""
    done = fit.gaussians()
    done = Gaussians(*(getattr(done, field.name).detach().cpu() for field in fields(Gaussians)))
    eyes = centres(views.cameras.viewmats)
    close = torch.cdist(done.means, eyes).min(1).values < DENSITY.min_lens_distance * fit.camera_distance
    distance = (done.means - eyes.mean(0)).norm(dim=1)
    huge = done.scales.max(1).values > DENSITY.max_scale * distance.clamp_min(fit.camera_distance)
    keep = (done.opacities > DENSITY.min_opacity) & visible.cpu() & ~close & ~huge
    return done[keep & done.means.isfinite().all(1)]


def score_views(
    gaussians: Gaussians, views: Views, index: list[int], device: str = "cpu", exposed: bool = False,
    background: Sequence[float] = (0.0, 0.0, 0.0),
) -> tuple[float, float]:
    """Mean PSNR [dB] and SSIM of the renders of the views `index` compared with their photos.

    `exposed`: each render is first multiplied by the factor per channel that fits its photo best.
    """
    psnrs, ssims = [], []
    gaussians = gaussians.to(device)
    with torch.no_grad():
        for i in index:
            photo, cameras = views.image(i, device), views.cameras[[i]]
            height, width = photo.shape[:2]
            behind = torch.tensor(background, device=device)
            rendering = rasterise(gaussians, cameras.viewmats.to(device), cameras.Ks.to(device), width, height, behind)
            image = rendering.rgb[0].clamp(0, 1)
            if exposed:
                image = image * (image * photo).sum((0, 1)) / image.square().sum((0, 1)).clamp_min(1e-9)
            psnrs.append(-10 * (image - photo).square().mean().clamp_min(1e-10).log10())
            ssims.append(ssim(image, photo))
    return float(torch.stack(psnrs).mean()), float(torch.stack(ssims).mean())
