"""Training of Pi3-splat's Gaussian head, with the parts that estimate points and cameras frozen.

Gaussians are predicted from some views of a scene and rendered in one of these and in another view. The loss compares
renderings with the photos, and rendered depth with the depth of the Gaussians. Source: Li et al. 2026, "Learning
physics-grounded 4D dynamics with neural Gaussian force fields", section on reconstruction (its training code is not
public).
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import torch
from jaxtyping import Float
from safetensors.torch import save_file
from torch import Tensor, nn
from tqdm import tqdm

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.geometry.cameras import centres
from stages.core.geometry.similarity import umeyama
from stages.core.kernels.splat.ssim import ssim
from stages.core.models.pi3.config import Pi3Config
from stages.core.models.pi3.network import Geometry
from stages.core.models.pi3.splat import SCALE_FACTOR, Pi3Splat, splat
from stages.core.models.pi3.weights import find, load
from stages.core.raster.rasterise import Rendering, rasterise
from stages.core.scene.files import replacing, sha256
from stages.lab import plot
from stages.lab.training.options import SplatterOptions
from stages.lab.training.splatter_data import WHITE, PosedViews, read_training_scenes
from stages.reconstruct.depth import unproject

SSIM_WEIGHT, DEPTH_WEIGHT = 0.2, 0.1  # weights of 1 - SSIM (L1 has the rest) and of the relative depth error
CHECKS = 10  # number of validations in a run
TRAINED_MODULES = ("feature_decoder", "feature_head")  # modules of the Gaussian head


def run(data: Path, out: Path, options: SplatterOptions, weights: Path | None = None) -> Iterator[str]:
    """Train on a folder of scenes; write OUT.safetensors for --backend pi3-splat, history (.json) and curves (.png).

    Yields a line for each validation. Raises InputError for unusable data or weights.
    """
    device = pick_device(options.device)
    scenes = read_training_scenes(data, options.side, device)
    if options.depth == "given" and (bare := [s.name for s in scenes if s.depths is None]):
        raise InputError(
            f"--depth given: {bare[0]} is a set of photos without depth; use scenes (.ply) or --depth network"
        )
    torch.manual_seed(options.seed)
    model, fresh = load_network(weights, options)
    model = model.to(device)
    training, held_out = (scenes[:-1], scenes[-1:]) if len(scenes) > 3 else (scenes, scenes)
    if fresh:
        initialise_head(
            model, view_geometry(model, training[0][training[0].learned].to(device), options), training[0].Ks[0]
        )
    history = []
    for row in fit(model, training, held_out, options, device):
        best = max((r["psnr"] for r in history), default=-math.inf)
        history.append(row)
        if row["psnr"] > best:
            _save(out, model)
        loss = "" if row["loss"] is None else f"  loss {row['loss']:.4f}"
        yield f"step {row['step']:6d}{loss}  PSNR of held-out views {row['psnr']:.2f} dB"
    facts = {"options": asdict(options), "data": [s.name for s in scenes], "held out": [s.name for s in held_out]}
    with replacing(Path(out).with_suffix(".json")) as part:
        part.write_text(json.dumps({**facts, "history": history, "sha256": sha256(out)}, indent=1) + "\n")
    titles = {"loss": "loss against steps", "psnr": "PSNR of held-out views [dB] against steps"}
    curves = {key: [(float(r["step"]), r[key]) for r in history if r[key] is not None] for key in titles}
    plot.draw_panels(
        Path(out).with_suffix(".png"), [plot.Panel(titles[key], points) for key, points in curves.items()], 2
    )


def load_network(weights: Path | None, options: SplatterOptions) -> tuple[Pi3Splat, bool]:
    """The network with only the Gaussian head trainable, and whether that head is untrained.

    Weights are those of Pi3-splat, or of π³ if there are none.
    """
    fresh = True
    if options.width:
        small = Pi3Config(options.width, 16, 2, 4, 1, options.width, 8, (options.width,) * 3, options.width)
        model = Pi3Splat(small)
    else:
        try:
            model, fresh = load(find("pi3-splat", weights), "pi3-splat"), False
        except InputError:
            base = load(find("pi3", weights), "pi3")
            model = Pi3Splat(base.config)
            model.encoder.load_state_dict(base.state_dict(), strict=False)  # lacks the Gaussian head
    for name, parameter in model.encoder.named_parameters():
        parameter.requires_grad_(name.startswith(TRAINED_MODULES))
    return model.eval(), fresh


def initialise_head(model: Pi3Splat, geometry: Geometry, K: Float[Tensor, "3 3"]) -> None:
    """Make an untrained head predict grey, half opaque spheres of the size of a pixel."""
    last: nn.Linear = model.encoder.feature_head.down_proj
    pixel = float((geometry.points[..., 2] / K[0, 0]).median()) / SCALE_FACTOR
    with torch.no_grad():
        last.weight.mul_(0.1)
        last.bias.zero_()
        last.bias[1:4] = pixel if pixel > 20 else math.log(max(math.expm1(pixel), 1e-6))
        last.bias[7] = 1.0


def fit(
    model: Pi3Splat, training: list[PosedViews], held_out: list[PosedViews], options: SplatterOptions, device: str
) -> Iterator[dict]:
    """Train and yield validations {"step", "loss", "psnr"}, the first one before training."""
    generator = torch.Generator().manual_seed(options.seed)
    learned = [p for p in model.parameters() if p.requires_grad]
    optimiser = torch.optim.AdamW(learned, options.lr, weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, options.lr, options.steps + 1, pct_start=0.05)
    every, losses = max(1, options.steps // CHECKS), []
    for step in tqdm(range(options.steps + 1), desc="training", unit="step", leave=False):
        if step % every == 0 or step == options.steps:
            psnr = sum(held_out_psnr(model, s, options, device) for s in held_out) / len(held_out)
            yield {"step": step, "loss": sum(losses) / len(losses) if losses else None, "psnr": psnr}
            losses = []
        if step == options.steps:
            return
        scene = training[int(torch.randint(len(training), (), generator=generator))]
        chosen = torch.tensor(scene.learned)[torch.randperm(len(scene.learned), generator=generator)]
        chosen = chosen[: options.views + 1].tolist()
        loss = step_loss(model, scene[chosen].to(device), options)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(learned, 1.0)
        optimiser.step()
        schedule.step()
        losses.append(loss.item())


def step_loss(model: Pi3Splat, views: PosedViews, options: SplatterOptions) -> Tensor:
    """Loss of Gaussians predicted from all views but the last, rendered in the first and the last view."""
    model.encoder.feature_head.train()
    sources = list(range(len(views.images) - 1))
    geometry, drawn = _drawn(model, views, sources, [0, len(sources)], options)
    loss = torch.zeros((), device=views.images.device)
    for k, i in enumerate((0, len(sources))):
        image, photo = drawn.rgb[k], views.images[i].permute(1, 2, 0)
        loss = loss + (1 - SSIM_WEIGHT) * (image - photo).abs().mean() + SSIM_WEIGHT * (1 - ssim(image, photo))
    known = (geometry.points[0, ..., 2] > 0) & (drawn.alpha[0] > 0.5)
    wanted = geometry.points[0, ..., 2].clamp_min(1e-6)
    error = torch.where(known, (drawn.depth[0] - wanted).abs() / wanted, torch.zeros_like(wanted))
    return loss / 2 + DEPTH_WEIGHT * error.mean()


@torch.no_grad()
def held_out_psnr(model: Pi3Splat, scene: PosedViews, options: SplatterOptions, device: str) -> float:
    """Mean PSNR of the held-out views of a scene, rendered from Gaussians of training views [dB]."""
    model.encoder.feature_head.eval()
    sources = scene.learned[:: max(1, len(scene.learned) // options.views)][: options.views]
    views = scene[[*sources, *scene.held]].to(device)
    targets = list(range(len(sources), len(views.images)))
    _, drawn = _drawn(model, views, list(range(len(sources))), targets, options)
    error = (drawn.rgb.clamp(0, 1) - views.images[targets].permute(0, 2, 3, 1)).square().mean((1, 2, 3))
    return float((-10 * error.clamp_min(1e-10).log10()).mean())


def _autocast(device: torch.device) -> torch.autocast:
    """Autocast to bfloat16 on a GPU, for the network only; geometry needs single precision."""
    return torch.autocast(device.type, torch.bfloat16, enabled=device.type != "cpu")


def _drawn(model, views: PosedViews, sources: list[int], targets: list[int], options) -> tuple[Geometry, Rendering]:
    """3D points of the source views' pixels, and renderings of their Gaussians in the target views."""
    device = views.images.device
    used = views[sources]
    with _autocast(device):
        with torch.no_grad():
            hidden, positions = model.encoder.tokens(used.images, 8)
        raw = model.encoder.raw(used.images, hidden, positions, len(sources))
    geometry = view_geometry(model, used, options, hidden, positions)
    gaussians = splat(geometry, raw.float())[(geometry.points[..., 2] > 0).flatten()]
    size = views.images.shape[3], views.images.shape[2]
    white = torch.tensor(WHITE, device=device)
    return geometry, rasterise(gaussians, views.viewmats[targets], views.Ks[targets], *size, white)


@torch.no_grad()
def view_geometry(model, views: PosedViews, options: SplatterOptions, hidden=None, positions=None) -> Geometry:
    """3D points of all pixels in the given cameras, from true depth, or predicted depth scaled to these cameras."""
    if options.depth == "given":
        depths = views.depths
    else:
        with _autocast(views.images.device):
            if hidden is None:
                hidden, positions = model.encoder.tokens(views.images, 8)
            predicted = model.encoder.geometry(hidden, positions, views.images.shape[2:], 8)
        scale = umeyama(predicted.poses[:, :3, 3].float().cpu(), centres(views.viewmats).cpu()).scale
        depths = predicted.points[..., 2].float() * scale
    local = [unproject(d, K, torch.eye(4).to(d))[1] for d, K in zip(depths, views.Ks, strict=True)]
    return Geometry(torch.stack(local), torch.ones_like(depths), torch.linalg.inv(views.viewmats))


def _save(out: Path, model: Pi3Splat) -> None:
    with replacing(out) as part:
        save_file({k: v.detach().cpu().contiguous() for k, v in model.state_dict().items()}, part)
