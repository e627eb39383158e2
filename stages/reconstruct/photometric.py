"""Photometric fit: optimises Gaussians by gradient descent through the rasteriser.

Loss and learning rates follow Kerbl et al. 2023, "3D Gaussian Splatting", sec. 5 and its code; the Gaussians start on
matched surfaces, so a few hundred iterations are enough on a CPU. Against overfitting few photos, sizes are regularised
as in Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo", sec. 4, and each step leaves out a
random part of the Gaussians (Park et al. 2025, "DropGaussian: Structural Regularization for Sparse-view Gaussian
Splatting"). Opacities are not regularised, since later stages segment and move the surfaces, which must be opaque.
The number of iterations does not depend on elapsed time, so that results are reproducible for a seed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor
from tqdm import tqdm

from stages.core.geometry.cameras import centres
from stages.core.geometry.rotations import matrix
from stages.core.kernels.adam import Moments, adam_step
from stages.core.kernels.cuda_graphs import captured
from stages.core.kernels.splat.photometric_loss import LossTerms, PhotoTarget, photometric_loss
from stages.core.kernels.splat.projection import pack_camera
from stages.core.kernels.splat.ssim import ssim
from stages.core.kernels.splat.tiles import Capacity
from stages.core.kernels.threads import small_operations
from stages.core.raster.rasterise import NEAR, count_pairs, rasterise, rasterise_packed
from stages.core.scene.cameras import Cameras
from stages.core.scene.gaussians import Gaussians
from stages.reconstruct.photos import Views

SSIM_WEIGHT = 0.2  # weight of 1 - SSIM in the loss; that of L1 is the rest
LEARNING_RATES = {"scales": 5e-3, "quats": 2e-3, "opacities": 3e-2, "base": 5e-3, "rest": 2.5e-4, "gains": 2e-3}
MEANS_RATE = 2e-4  # learning rate of the means [camera distances]
MEANS_DECAY = 0.01  # factor on MEANS_RATE at the end of a fit; the decay is exponential
DEPTH_WEIGHT = 0.1  # weight of the error of inverse depth [1 / camera distance] in the loss
MIN_DEPTH = 0.1  # lower bound of rendered depth in the depth term [camera distances]
SCALE_WEIGHT = 0.01  # weight of the mean scale [camera distances] in the loss
DROPOUT = 0.1  # fraction of the Gaussians left out of the last step of a fit; it grows linearly from 0


@dataclass(frozen=True)
class DensityControl:
    """When Gaussians are split and pruned; compare the fields of gsplat's `DefaultStrategy`."""

    min_iterations: int = 200  # shorter fits do not split Gaussians
    split_times: tuple[float, ...] = (0.2, 0.4)  # fractions of the iterations after which Gaussians are split
    split_fraction: float = 0.08  # fraction of the Gaussians that is split each time
    split_offset: float = 0.7  # offset of the two halves from the mean, relative to a random sample of the Gaussian
    split_log_scale: float = 0.47  # reduction of the log scales of the halves, which are thus 1.6 times smaller
    min_opacity: float = 0.02  # Gaussians of lower opacity are pruned
    min_lens_distance: float = 0.1  # Gaussians closer to a camera are pruned [camera distances]
    max_scale: float = 0.1  # larger Gaussians are pruned [distance from the mean camera centre]


DENSITY = DensityControl()


@dataclass(frozen=True)
class FitOptions:
    """Options of a fit."""

    iterations: int  # number of steps, each on one photo
    camera_distance: float  # typical distance of the cameras from the objects [scene units]
    seed: int = 0
    device: str = "cpu"


@dataclass
class _Fit:
    """Optimised tensors, one for each learning rate, with their Adam moments."""

    values: dict[str, Tensor]
    moments: dict[str, Moments]
    rates: dict[str, Float[Tensor, "1"]]  # learning rates, except that of the means, which decays
    steps: Float[Tensor, "1"]  # number of steps so far
    camera_distance: float  # [scene units]
    gradients: Float[Tensor, "n"]  # sum of the norms of the gradients of the means since the last split
    lots: Float[Tensor, "n"]  # random numbers in 0..1; a step leaves out the Gaussians in an interval of them

    @classmethod
    def start(cls, gaussians: Gaussians, views: int, camera_distance: float) -> _Fit:
        """Initial parameters: those of the Gaussians with inverted activations, and zero log exposures."""
        device = gaussians.means.device
        values = {
            "means": gaussians.means,
            "scales": gaussians.scales.log(),
            "quats": gaussians.quats,
            "opacities": gaussians.opacities.clamp(1e-4, 1 - 1e-4).logit(),
            "base": gaussians.sh[:, :1],
            "rest": gaussians.sh[:, 1:],
            "gains": torch.zeros(views, 3, device=device),  # log exposure of each photo and channel
        }
        values = {name: value.clone().requires_grad_() for name, value in values.items() if value.numel()}
        moments = {name: Moments.like(value) for name, value in values.items()}
        rates = {name: torch.full((1,), rate, device=device) for name, rate in LEARNING_RATES.items()}
        steps, gradients = torch.zeros(1, device=device), torch.zeros(len(gaussians), device=device)
        return cls(values, moments, rates, steps, camera_distance, gradients, _lots(len(gaussians), device))

    def gaussians(self) -> Gaussians:
        """The Gaussians with activations applied; differentiable. The projection normalises the quaternions."""
        v = self.values
        sh = torch.cat([v["base"], v["rest"]], 1) if "rest" in v else v["base"]
        ids = torch.zeros(len(sh), dtype=torch.int64, device=sh.device)
        with small_operations():  # exp and sigmoid round the last elements of each thread's part differently
            scales, opacities = v["scales"].exp(), v["opacities"].sigmoid()
        return Gaussians(v["means"], v["quats"], scales, opacities, sh, ids)

    def descend(self, grads: dict[str, Tensor], means_rate: Float[Tensor, "1"]) -> None:
        """One step of Adam."""
        self.steps += 1
        for name, value in self.values.items():
            rate = means_rate if name == "means" else self.rates[name]
            adam_step(value, grads[name], self.moments[name], rate, self.steps)

    def select(self, index: Int[Tensor, "m"], fresh: Int[Tensor, "k"]) -> None:
        """Keep (or repeat) these Gaussians with their Adam moments; moments at the new rows `fresh` are set to 0."""
        for name in self.values.keys() - {"gains"}:
            self.values[name] = self.values[name].detach()[index].clone().requires_grad_()
            old = self.moments[name]
            self.moments[name] = Moments(old.first[index], old.second[index])
            self.moments[name].first[fresh] = 0
            self.moments[name].second[fresh] = 0
        self.gradients = torch.zeros(len(index), device=index.device)
        self.lots = _lots(len(index), index.device)


def _lots(count: int, device: torch.device | str) -> Float[Tensor, "n"]:
    return torch.rand(count, generator=torch.Generator().manual_seed(0)).to(device)


class _Draw(NamedTuple):
    """Random and scheduled parameters of a step."""

    row: Int[Tensor, "1"]  # row of the photo in its group
    grey: Float[Tensor, "1"]  # grey level of the background, 0..1
    means_rate: Float[Tensor, "1"]  # learning rate of the means
    dropout: Float[Tensor, "1"]  # fraction of the Gaussians that are left out
    lot: Float[Tensor, "1"]  # 0..1, start of the interval of `lots` that is left out


@dataclass(frozen=True)
class _Targets:
    """Photos of one size with their cameras and target depths, on the device of the fit."""

    rows: tuple[int, ...]  # indices of the views
    images: UInt8[Tensor, "c h w 3"]
    cameras: Float[Tensor, "c 26"]  # packed by `pack_camera`
    exposures: Float[Tensor, "c v"]  # rows of `_exposure_projection`
    inverse: Float[Tensor, "c h w"] | None  # inverse depth times the camera distance; inf where unknown

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [px]."""
        return self.images.shape[2], self.images.shape[1]


def _targets(views: Views, depths: Sequence[Tensor], distance: float, device: str) -> list[_Targets]:
    """Group the views by size."""
    projection = _exposure_projection(views.cameras)
    groups: dict[tuple[int, int], list[int]] = {}
    for row, image in enumerate(views.images):
        groups.setdefault((image.shape[1], image.shape[0]), []).append(row)
    targets = []
    for (width, height), rows in groups.items():
        images = torch.stack([views.images[row] for row in rows])
        pairs = zip(views.cameras.viewmats[rows], views.cameras.Ks[rows], strict=True)
        cameras = torch.stack([pack_camera(V, K, width, height, NEAR) for V, K in pairs])
        inverse = torch.stack([distance / depths[row] for row in rows]).to(device) if depths else None
        tensors = (images.to(device), cameras.to(device), projection[rows].to(device))
        targets.append(_Targets(tuple(rows), *tensors, inverse))
    return targets


def fit_gaussians(
    gaussians: Gaussians, views: Views, options: FitOptions, depths: Sequence[Float[Tensor, "h w"]] = ()
) -> Gaussians:
    """Optimise Gaussians to render like the photos.

    Each iteration uses one photo; photos come in random order without repetition. `depths` of the views, 0 where
    unknown, are a second target. The background is a random grey in every iteration, so that surfaces become opaque.
    """
    steps, distance, device = options.iterations, options.camera_distance, options.device
    if not steps:
        return gaussians
    fit = _Fit.start(gaussians.to(device), len(views), distance)
    targets = _targets(views, depths, distance, device)
    kind = _CapturedSteps if fit.gradients.is_cuda else _Steps
    generator = torch.Generator().manual_seed(options.seed)
    splits = [round(time * steps) for time in DENSITY.split_times if steps >= DENSITY.min_iterations]
    rates = [MEANS_RATE * distance * MEANS_DECAY ** (max(step - 1, 0) / steps) for step in range(steps)]
    lots = _lots(steps, "cpu").tolist()
    order: list[int] = []
    first = 0
    with tqdm(total=steps, desc="fitting photos", unit="step", leave=False) as bar:
        for last in [*splits, steps - 1]:  # last step of each segment between splits
            schedule = []
            for step in range(first, last + 1):
                order = order or torch.randperm(len(views), generator=generator).tolist()
                grey = float(torch.rand((), generator=generator))
                schedule.append((order.pop(), grey, rates[step], DROPOUT * step / steps, lots[step]))
            kind(fit, targets, schedule).run(bar)
            if last in splits:
                with small_operations():  # as in `_Fit.gaussians`
                    _split(fit, generator)
            first = last + 1
    with small_operations():
        return _prune(fit, views, fit.gradients > 0)


def _exposure_projection(cameras: Cameras) -> Float[Tensor, "c c"]:
    """Projection matrix that removes from values per camera the part that is constant or linear in the camera's pose.

    This part of the exposures is view-dependent colour, which the spherical harmonics represent. With few cameras only
    the principal directions are removed, at most one for every four cameras.
    """
    count = len(cameras)
    position, forward = (x.double().cpu() for x in (centres(cameras.viewmats), cameras.viewmats[:, 2, :3]))
    position, forward = ((x - x.mean(0)) / (x - x.mean(0)).norm().clamp_min(1e-9) for x in (position, forward))
    main, singular, _ = torch.linalg.svd(torch.cat([position, forward], 1), full_matrices=False)
    main = main[:, singular > 1e-3 * singular[0]][:, : count // 4]
    basis = torch.cat([torch.full((count, 1), count**-0.5, dtype=main.dtype), main], 1)
    return (torch.eye(count, dtype=main.dtype) - basis @ basis.T).float()


class _Steps:
    """Consecutive steps of the fit, each on one photo.

    `schedule` has for each step the index of the view and the fields of `_Draw` after `row`.
    """

    def __init__(self, fit: _Fit, targets: Sequence[_Targets], schedule: Sequence[tuple[int | float, ...]]):
        self.fit, self.schedule, self.device = fit, schedule, fit.gradients.device
        place = {view: (group, row) for group in targets for row, view in enumerate(group.rows)}
        self.places = [place[view] for view, *_ in schedule]

    def run(self, bar: tqdm) -> None:
        """Take all steps."""
        for step, ((group, row), (_, *numbers)) in enumerate(zip(self.places, self.schedule, strict=True)):
            loss = _descend(self.fit, group, _Draw(*(torch.tensor([x]) for x in (row, *numbers))))
            bar.update()
            if step % 20 == 0:
                bar.set_postfix(loss=f"{float(loss):.4f}")


class _CapturedSteps(_Steps):
    """Consecutive steps on a GPU, as CUDA graphs.

    A step is one launch of a graph, which reads its row of the schedule on the GPU; each size of photos has a graph.
    """

    def run(self, bar: tqdm) -> None:
        """Take all steps."""
        device = self.device
        rows = torch.tensor([row for _, row in self.places], device=device)
        self.draws = _Draw(rows, *torch.tensor([s[1:] for s in self.schedule], device=device).T.contiguous())
        self.counter, self.loss = torch.zeros(1, dtype=torch.int64, device=device), torch.zeros((), device=device)
        self.pairs = self._count_pairs()
        self.graphs: dict[tuple[int, int], torch.cuda.CUDAGraph] = {}
        for step, (group, _) in enumerate(self.places):
            if group.size in self.graphs:
                self.graphs[group.size].replay()
            else:  # the first step loads kernels, which cannot be captured
                self._step(group)
                self._capture(group)
            bar.update()
            if step % 100 == 99:
                bar.set_postfix(loss=f"{float(self.loss):.4f}")
                if int(self.pairs.needed) > 0.9 * self.pairs.slots:
                    self.pairs = Capacity.at_least(int(self.pairs.needed), device)
                    self.graphs.clear()

    def _count_pairs(self) -> Capacity:
        """Capacity for the pairs of Gaussian and tile of any view of the present Gaussians, with a reserve."""
        with torch.no_grad():
            g, groups = self.fit.gaussians(), {group.size: group for group, _ in self.places}
            pairs = [count_pairs(g, camera, *size) for size, group in groups.items() for camera in group.cameras]
        return Capacity.at_least(max(pairs), self.device)

    def _capture(self, group: _Targets) -> None:
        self.graphs[group.size] = captured(lambda: self._step(group))

    def _step(self, group: _Targets) -> None:
        draw = _Draw(*(x.index_select(0, self.counter) for x in self.draws))
        self.loss.copy_(_descend(self.fit, group, draw, self.pairs))
        self.counter += 1


def _descend(fit: _Fit, group: _Targets, draw: _Draw, pairs: Capacity | None = None) -> Float[Tensor, ""]:
    """Take one step on the drawn photo of the group; returns the loss before the step."""
    loss = _loss(fit, group, draw, pairs)
    grads = dict(zip(fit.values, torch.autograd.grad(loss, list(fit.values.values())), strict=True))
    fit.gradients += grads["means"].norm(dim=1)
    fit.descend(grads, draw.means_rate)
    return loss.detach()


def _loss(fit: _Fit, group: _Targets, draw: _Draw, pairs: Capacity | None) -> Float[Tensor, ""]:
    """Loss of the render of one photo, with dropout, in front of a grey background."""
    photo, camera = group.images.index_select(0, draw.row)[0], group.cameras.index_select(0, draw.row)[0]
    gaussians, gain = fit.gaussians(), (group.exposures.index_select(0, draw.row)[0] @ fit.values["gains"]).exp()
    kept = ((fit.lots + draw.lot) % 1 >= draw.dropout) / (1 - draw.dropout)  # kept ones are more opaque
    shown = replace(gaussians, opacities=gaussians.opacities * kept)
    rgb, alpha, depth, *_ = rasterise_packed(shown, camera, *group.size, draw.grey.expand(3), pairs)
    inverse = None if group.inverse is None else group.inverse.index_select(0, draw.row)[0]
    terms = LossTerms(SSIM_WEIGHT, DEPTH_WEIGHT, fit.camera_distance, MIN_DEPTH * fit.camera_distance)
    loss = photometric_loss(rgb, alpha, depth, gain, PhotoTarget(photo, inverse), terms)
    return loss + SCALE_WEIGHT * gaussians.scales.mean() / fit.camera_distance


def _split(fit: _Fit, generator: torch.Generator) -> None:
    """Prune transparent Gaussians and split those with the largest gradients into two smaller ones.

    As in Kerbl et al. 2023, sec. 5.2, but ranked by the gradient of the mean times the size of the Gaussian, which is
    the change of the loss if it moved by its own width.
    """
    v = {name: value.detach() for name, value in fit.values.items()}
    alive = v["opacities"].sigmoid() > DENSITY.min_opacity
    size = v["scales"].exp().max(1).values
    count = int(DENSITY.split_fraction * int(alive.sum()))
    chosen = torch.where(alive, fit.gradients * size, -torch.ones_like(size)).topk(count).indices
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
    """Remove Gaussians that are transparent, not visible in any photo, too large or too close to a camera."""
    done = fit.gaussians()
    done = replace(done, quats=F.normalize(done.quats, dim=1))
    done = Gaussians(*(getattr(done, field.name).detach().cpu() for field in fields(Gaussians)))
    eyes = centres(views.cameras.viewmats)
    close = torch.cdist(done.means, eyes).min(1).values < DENSITY.min_lens_distance * fit.camera_distance
    distance = (done.means - eyes.mean(0)).norm(dim=1)
    huge = done.scales.max(1).values > DENSITY.max_scale * distance.clamp_min(fit.camera_distance)
    keep = (done.opacities > DENSITY.min_opacity) & visible.cpu() & ~close & ~huge
    return done[keep & done.means.isfinite().all(1)]


def score_views(
    gaussians: Gaussians,
    views: Views,
    index: list[int],
    device: str = "cpu",
    exposed: bool = False,
    background: Sequence[float] = (0.0, 0.0, 0.0),
) -> tuple[float, float]:
    """Mean PSNR [dB] and SSIM of the renders of the views `index`, compared with their photos.

    `exposed`: each render is first multiplied by the factor per channel that fits its photo best (least squares).
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
