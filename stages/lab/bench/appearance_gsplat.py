"""gsplat's default training recipe: that of its published simple_trainer without options.

The loop is ours, with gsplat's rasteriser and DefaultStrategy inside. Gaussians start at the sparse points with opacity
0.1 and the distance to their three nearest neighbours as scale. The SH degree grows every 1,000 steps, up to 3.
Gaussians are densified every 100 steps from 500 to 15,000. The learning rate of the means decays to a hundredth over
30,000 steps. With fewer steps all of these numbers are scaled alike, as by the trainer's steps_scaler. SSIM is our own
implementation, as in our recipe. The strategy is unchanged: 1.5.3 never resets opacities, since `0 & step > 0` is
false.
Source: Ye et al. 2025, "gsplat: an open-source library for Gaussian splatting", and its examples at version 1.5.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from stages.core.geometry.cameras import centres
from stages.core.geometry.harmonics import rgb_to_sh
from stages.core.geometry.neighbours import spacing
from stages.core.kernels.splat.ssim import ssim
from stages.core.scene.gaussians import Gaussians
from stages.lab.bench.common import import_gsplat
from stages.reconstruct.photos import Views

FULL_STEPS = 30_000  # length of the published schedule
# parameters of DefaultStrategy for FULL_STEPS [steps]
SCHEDULE = {"refine_start_iter": 500, "refine_stop_iter": 15_000, "reset_every": 3000, "refine_every": 100}
DEGREE_EVERY = 1000  # steps between increases of the SH degree
LEARNING_RATES = {"means": 1.6e-4, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3, "shN": 2.5e-3 / 20}
SEED = 0
SSIM_WEIGHT = 0.2  # weight of 1 - SSIM in the loss; L1 has the rest


class ColouredPoints(NamedTuple):
    """Sparse points from which training starts."""

    points: Float[Tensor, "m 3"]
    colours: Float[Tensor, "m 3"]  # 0..1


def train(
    views: Views,
    start: ColouredPoints,
    steps: int,
    device: str = "cuda",
    draw: Callable | None = None,
    going: Callable[[int], bool] = lambda done: True,
) -> tuple[Gaussians, int]:
    """Train for `steps` steps of one photo each; return the Gaussians and the number of steps done.

    Training stops early when `going(steps done)` is false. `draw` replaces gsplat.rasterization in tests.
    """
    gsplat = import_gsplat()
    torch.manual_seed(SEED)  # the strategy uses PyTorch's global generator
    draw, scale = draw or gsplat.rasterization, steps / FULL_STEPS
    eyes = centres(views.cameras.viewmats)
    size = 1.1 * float((eyes - eyes.mean(0)).norm(dim=1).max())
    values = initial_parameters(start, device)
    optimisers = {
        name: torch.optim.Adam(
            [value], lr=LEARNING_RATES[name] * (size if name == "means" else 1), eps=1e-15, fused=True
        )
        for name, value in values.items()
    }
    strategy = gsplat.DefaultStrategy(**{name: max(1, int(count * scale)) for name, count in SCHEDULE.items()})
    strategy.check_sanity(values, optimisers)
    state = strategy.initialize_state(scene_scale=size)
    photos = [image.to(device) for image in views.images]
    viewmats, Ks = views.cameras.viewmats.to(device), views.cameras.Ks.to(device)
    order: list[int] = []
    for step in tqdm(range(steps), desc="gsplat's recipe", unit="step", leave=False):
        if not going(step):
            return to_gaussians(values), step
        order = order or torch.randperm(len(views)).tolist()
        i, degree = order.pop(), min(3, int(step / (DEGREE_EVERY * scale)))
        photo = photos[i].float() / 255
        image, _, info = draw(
            values["means"], values["quats"], values["scales"].exp(), values["opacities"].sigmoid(),
            torch.cat([values["sh0"], values["shN"]], 1), viewmats[[i]], Ks[[i]], photo.shape[1], photo.shape[0],
            sh_degree=degree, packed=False,
        )  # fmt: skip
        strategy.step_pre_backward(values, optimisers, state, step, info)
        loss = (1 - SSIM_WEIGHT) * (image[0] - photo).abs().mean() + SSIM_WEIGHT * (1 - ssim(image[0], photo))
        loss.backward()
        for optimiser in optimisers.values():
            optimiser.step()
            optimiser.zero_grad(set_to_none=True)
        optimisers["means"].param_groups[0]["lr"] *= 0.01 ** (1 / steps)
        strategy.step_post_backward(values, optimisers, state, step, info)
    return to_gaussians(values), steps


def initial_parameters(start: ColouredPoints, device: str) -> dict[str, torch.nn.Parameter]:
    """Initial parameters, grouped by learning rate."""
    points, colours = start
    n = len(points)
    values = {
        "means": points,
        "scales": spacing(points).log()[:, None].repeat(1, 3),
        "quats": torch.rand(n, 4),
        "opacities": torch.full((n,), 0.1).logit(),
        "sh0": rgb_to_sh(colours),
        "shN": torch.zeros(n, 15, 3),
    }
    return {name: torch.nn.Parameter(value.to(device)) for name, value in values.items()}


def to_gaussians(values: dict[str, torch.nn.Parameter]) -> Gaussians:
    """The optimised parameters as Gaussians on the CPU."""
    v = {name: value.detach().cpu() for name, value in values.items()}
    return Gaussians(
        v["means"], F.normalize(v["quats"], dim=1), v["scales"].exp(), v["opacities"].sigmoid(),
        torch.cat([v["sh0"], v["shN"]], 1), torch.zeros(len(v["means"]), dtype=torch.int64),
    )  # fmt: skip
