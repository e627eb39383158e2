"""Gaussians fitted to the photos by gradient descent through the rasteriser.

Loss, learning rates and the reasons for them follow Kerbl et al. 2023, "3D Gaussian Splatting", sec. 5 and
its code; unlike there the Gaussians already lie on matched surfaces, so some hundred steps are enough on a CPU.
What no photo needs shrinks, as in Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo", sec. 4:
many steps on few photos would else fit their noise with it. Opacities are left alone: what stages to come find and move
should be solid.
The number of steps is fixed beforehand, never by the clock, so a seed gives the same scene again.
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

SSIM_WEIGHT = 0.2  # weight of 1 - SSIM against L1
LEARNING_RATES = {"scales": 5e-3, "quats": 2e-3, "opacities": 3e-2, "base": 5e-3, "rest": 2.5e-4, "gains": 2e-3}
DEPTH_WEIGHT = 0.1  # weight of the error in inverse depth, in units of one over the cameras' distance
SCALE_WEIGHT = 0.01  # weight of the mean scale over the cameras' distance
MEANS_RATE = 2e-4  # of the means, times the cameras' distance; falls to a hundredth of it
MIN_OPACITY = 0.02  # Gaussians of less opacity are dropped
SPLIT_TIMES = (0.2, 0.4)  # after these shares of the steps, Gaussians where detail is missing are split
SPLIT_FRACTION = 0.08  # of the Gaussians, each time


@dataclass
class _Fit:
    """What is optimised: one tensor for each learning rate, and Adam's moments for them."""

    values: dict[str, Tensor]
    optimiser: torch.optim.Optimizer
    reach: float  # of the cameras [scene units]
    own: Float[Tensor, "c c"]  # takes from exposures what their cameras explain

    @classmethod
    def start(cls, gaussians: Gaussians, cameras: Cameras, reach: float) -> _Fit:
        device = gaussians.means.device
        values = {
            "means": gaussians.means,
            "scales": gaussians.scales.log(),
            "quats": gaussians.quats,
            "opacities": gaussians.opacities.clamp(1e-4, 1 - 1e-4).logit(),
            "base": gaussians.sh[:, :1],
            "rest": gaussians.sh[:, 1:],
            "gains": torch.zeros(len(cameras), 3, device=device),  # logarithms, one a photo and channel
        }
        values = {name: value.clone().requires_grad_() for name, value in values.items() if value.numel()}
        rates = {**LEARNING_RATES, "means": MEANS_RATE * reach}
        groups = [{"params": [value], "lr": rates[name], "name": name} for name, value in values.items()]
        optimiser = torch.optim.Adam(groups, eps=1e-15, fused=True)
        return cls(values, optimiser, reach, _exposure_projection(cameras).to(device))

    def gaussians(self) -> Gaussians:
        """As the rasteriser wants them, with gradients."""
        v = self.values
        sh = torch.cat([v["base"], v["rest"]], 1) if "rest" in v else v["base"]
        ids = torch.zeros(len(sh), dtype=torch.int64, device=sh.device)
        quats = F.normalize(v["quats"], dim=1)
        return Gaussians(v["means"], quats, v["scales"].exp(), v["opacities"].sigmoid(), sh, ids)

    def gain(self, view: int) -> Float[Tensor, "3"]:
        """Exposure of a photo, as far as it is not what photos from there have: that is what harmonics are for."""
        return (self.own[view] @ self.values["gains"]).exp()

    def rows(self, index: Int[Tensor, "m"], fresh: Int[Tensor, "k"] | None = None) -> None:
        """Keeps (or repeats) these Gaussians with their moments; those at positions `fresh` start with none."""
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
    gaussians: Gaussians,
    views: Views,
    steps: int,
    reach: float,
    seed: int = 0,
    device: str = "cpu",
    depths: Sequence[Float[Tensor, "h w"]] = (),
) -> Gaussians:
    """Gaussians that render more like the photos.

    One photo a step, in random order without repeats. `reach` is the cameras' typical distance [scene units].
    `depths` of the views, 0 where unknown, hold the surfaces where matching found them.
    The background is a random grey in every step, so what the photos show opaque becomes opaque.
    """
    if not steps:
        return gaussians
    fit = _Fit.start(gaussians.to(device), views.cameras, reach)
    near = _to_device(views, device)
    inverse = [(reach / depth).to(device) for depth in depths]
    generator = torch.Generator().manual_seed(seed)
    splits = {round(share * steps) for share in SPLIT_TIMES if steps >= 200}
    pull = torch.zeros(len(gaussians), device=device)
    order: list[int] = []
    with tqdm(range(steps), desc="fitting photos", unit="step", leave=False) as bar:
        for step in bar:
            order = order or torch.randperm(len(views), generator=generator).tolist()
            view, grey = order.pop(), float(torch.rand((), generator=generator))
            loss = _backward(fit, near, view, grey, device, inverse[view] if inverse else None)
            pull += fit.values["means"].grad.norm(dim=1)
            fit.optimiser.step()
            fit.optimiser.param_groups[0]["lr"] = MEANS_RATE * reach * 0.01 ** (step / steps)
            if step in splits:
                _split(fit, pull, generator)
                pull = torch.zeros(len(fit.values["means"]), device=device)
            if step % 20 == 0:
                bar.set_postfix(loss=f"{loss.item():.4f}")
    return _prune(fit, views, pull > 0, reach)


def _exposure_projection(cameras: Cameras) -> Float[Tensor, "c c"]:
    """The projection that leaves of numbers, one a camera, nothing constant or linear in its place and direction.

    With few cameras only in their main directions, so that most of what the numbers tell stays.
    """
    count = len(cameras)
    place, ahead = (x.double().cpu() for x in (centres(cameras.viewmats), cameras.viewmats[:, 2, :3]))
    place, ahead = ((x - x.mean(0)) / (x - x.mean(0)).norm().clamp_min(1e-9) for x in (place, ahead))
    main, size, _ = torch.linalg.svd(torch.cat([place, ahead], 1), full_matrices=False)
    main = main[:, size > 1e-3 * size[0]][:, : count // 4]
    basis = torch.cat([torch.full((count, 1), count**-0.5, dtype=main.dtype), main], 1)
    return (torch.eye(count, dtype=main.dtype) - basis @ basis.T).float()


def _to_device(views: Views, device: str) -> Views:
    """All at once: a copy a step would wait for the GPU."""
    cameras = views.cameras
    cameras = replace(cameras, viewmats=cameras.viewmats.to(device), Ks=cameras.Ks.to(device))
    return Views(tuple(image.to(device) for image in views.images), cameras)


def _backward(
    fit: _Fit, views: Views, view: int, grey: float, device: str, inverse: Float[Tensor, "h w"] | None = None
) -> Float[Tensor, ""]:
    """The loss on one photo, and its gradients; `inverse` is its inverse depth times the reach, inf where unknown."""
    photo = views.image(view, device)
    height, width = photo.shape[:2]
    background = torch.full((3,), grey, device=device)
    one = slice(view, view + 1)
    gaussians = fit.gaussians()
    rendering = rasterise(gaussians, views.cameras.viewmats[one], views.cameras.Ks[one], width, height, background)
    image = rendering.rgb[0] * fit.gain(view)
    loss = (1 - SSIM_WEIGHT) * (image - photo).abs().mean() + SSIM_WEIGHT * (1 - ssim(image, photo))
    loss = loss + SCALE_WEIGHT * gaussians.scales.mean() / fit.reach
    if inverse is not None:
        error = fit.reach / rendering.depth[0].clamp_min(0.1 * fit.reach) - inverse
        known = error.isfinite() & (rendering.alpha[0] > 0.5)
        loss = loss + DEPTH_WEIGHT * torch.where(known, error, torch.zeros_like(error)).abs().mean()
    fit.optimiser.zero_grad(set_to_none=True)
    loss.backward()
    return loss.detach()  # a number in Python would wait for the GPU


def _split(fit: _Fit, pull: Float[Tensor, "n"], generator: torch.Generator) -> None:
    """Drops faint Gaussians and splits those pulled about most into two smaller ones, as in sec. 5.2 of the source.

    The pull, in image space, is the gradient on the mean times the Gaussian's size: how much the photos
    would gain if it moved by its own width.
    """
    v = {name: value.detach() for name, value in fit.values.items()}
    alive = v["opacities"].sigmoid() > MIN_OPACITY
    size = v["scales"].exp().max(1).values
    count = int(SPLIT_FRACTION * int(alive.sum()))
    chosen = torch.where(alive, pull * size, -torch.ones_like(pull)).topk(count).indices
    keep = torch.cat([alive.nonzero()[:, 0], chosen])
    first = torch.searchsorted(alive.nonzero()[:, 0], chosen)  # where the kept halves now are
    second = torch.arange(len(keep) - count, len(keep), device=keep.device)
    offset = torch.randn(count, 3, generator=generator).to(size.device) * v["scales"][chosen].exp()
    offset = _rotate(v["quats"][chosen], offset)
    fit.rows(keep, torch.cat([first, second]))
    with torch.no_grad():
        fit.values["means"][first] += 0.7 * offset
        fit.values["means"][second] -= 0.7 * offset
        for rows in (first, second):
            fit.values["scales"][rows] -= 0.47  # 1.6 times smaller


def _rotate(quats: Float[Tensor, "n 4"], vectors: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    return (matrix(quats) @ vectors[..., None])[..., 0]


def _prune(fit: _Fit, views: Views, touched: Bool[Tensor, "n"], reach: float) -> Gaussians:
    """Without what is faint, what no photo saw, what grew out of proportion, and what hangs before a lens."""
    done = fit.gaussians()
    done = Gaussians(*(getattr(done, field.name).detach().cpu() for field in fields(Gaussians)))
    eyes = centres(views.cameras.viewmats)
    close = torch.cdist(done.means, eyes).min(1).values < 0.1 * reach
    distance = (done.means - eyes.mean(0)).norm(dim=1)
    huge = done.scales.max(1).values > 0.1 * distance.clamp_min(reach)
    keep = (done.opacities > MIN_OPACITY) & touched.cpu() & ~close & ~huge
    return done[keep & done.means.isfinite().all(1)]


def score_views(
    gaussians: Gaussians, views: Views, index: list[int], device: str = "cpu", exposed: bool = False,
    background: Sequence[float] = (0.0, 0.0, 0.0),
) -> tuple[float, float]:
    """Mean PSNR [dB] and SSIM of the renders of these views against their photos.

    `exposed`: each render is first exposed as its photo, by the factor for each channel that fits best.
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
