"""The learned backends: π³, whose point maps are converted to Gaussians, and Pi3-splat, which predicts Gaussians.

Source of π³: Wang et al. 2025, arXiv:2507.13347.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.geometry.cameras import centres
from stages.core.models.hub import find_or_download
from stages.core.models.pi3 import memory
from stages.core.models.pi3.download import download
from stages.core.models.pi3.network import Geometry, halve
from stages.core.models.pi3.splat import Pi3Splat, splat
from stages.core.models.pi3.weights import find, load
from stages.core.scene.cameras import Cameras
from stages.core.scene.gaussians import Gaussians
from stages.reconstruct import network_input, pointmaps, world_frame
from stages.reconstruct.build_scene import SceneGeometry, build_scene
from stages.reconstruct.merge import merge_gaussians
from stages.reconstruct.options import ReconstructOptions
from stages.reconstruct.photos import Photos, Reconstruction, split_holdout
from stages.reconstruct.step_cache import StepCache

log = logging.getLogger(__name__)


class NetworkOutput(NamedTuple):
    """Output of a network for v views of the same size."""

    geometry: Geometry  # point maps, confidence and poses
    raw: Float[Tensor, "v h w k"] | None = None  # parameters of one Gaussian per pixel, before activation


def pi3(photos: Photos, options: ReconstructOptions, steps: StepCache) -> Reconstruction:
    """Backend `pi3`: cameras and point maps of 1 to 100 photos by π³; Gaussians are initialised at the points."""
    return _reconstruct("pi3", photos, options, steps)


def pi3_splat(photos: Photos, options: ReconstructOptions, steps: StepCache) -> Reconstruction:
    """Backend `pi3-splat`: as `pi3`, but the splat head predicts the Gaussians."""
    return _reconstruct("pi3-splat", photos, options, steps)


def _reconstruct(name: str, photos: Photos, options: ReconstructOptions, steps: StepCache) -> Reconstruction:
    if options.cameras is not None:
        raise InputError(
            f"--cameras: --backend {name} estimates the cameras itself; use --backend classic for known cameras"
        )
    device = pick_device(options.device)
    cropped = network_input.crop_photos(photos, options.resolution)
    images = network_input.make_batch(cropped, network_input.common_size(photos, options.resolution))
    geometry, raw = steps.cached("network", lambda: _predict_geometry(name, images, options, device), (Geometry,))
    return assemble(photos, cropped, NetworkOutput(geometry, raw), options, steps, device)


def _predict_geometry(
    name: str, images: Float[Tensor, "v 3 h w"], options: ReconstructOptions, device: str
) -> tuple[Geometry, Tensor | None]:
    """Load the network and run it; the raw Gaussian parameters are None for π³."""
    weights = find_or_download(partial(find, name), partial(download, name), options.weights, options.download)
    model = load(weights, name)
    return predict(model, images, device)


@torch.no_grad()
def predict(model: nn.Module, images: Float[Tensor, "v 3 h w"], device: str) -> tuple[Geometry, Tensor | None]:
    """Run the network, in bf16 on a GPU, in chunks of as many views as fit in memory; results are on the CPU.

    Raises InputError if the weights do not fit.
    """
    half, splats = device != "cpu", isinstance(model, Pi3Splat)
    config = model.encoder.config if splats else model.config
    if half:
        model = halve(model)
        room = memory.free(device)
        if memory.weights(model) > room:
            raise InputError(f"the network needs {memory.weights(model) / 1e9:.1f} GB of GPU memory, but "
                             f"{room / 1e9:.1f} GB "
                             "are free; use --device cpu")  # fmt: skip
        model = model.to(device)
    views, _, *size = images.shape
    at_once = memory.plan(config, views, tuple(size), splats, half, memory.free(device))
    need = memory.activations(config, views, tuple(size), at_once, splats, half) + memory.weights(model)
    log.info(
        "%d photos of %dx%d pixels, about %.1f GB of memory, %d photos at once", views, *size[::-1], need / 1e9, at_once
    )
    with torch.autocast(torch.device(device).type, torch.bfloat16, enabled=half):
        output = model(images.to(device), at_once)
    geometry, raw = output if splats else (output, None)
    on_cpu = (x.cpu() for x in (geometry.points, geometry.confidence, geometry.poses))
    return Geometry(*on_cpu), None if raw is None else raw.half().cpu()  # 70 bytes per pixel


def assemble(
    photos: Photos,
    cropped: list[Tensor],
    network: NetworkOutput,
    options: ReconstructOptions,
    steps: StepCache,
    device: str,
) -> Reconstruction:
    """Build the scene from the network's output for the cropped photos."""
    geometry = network.geometry
    confident = pointmaps.confident_pixels(geometry)
    log.info(
        "the network is confident of its prediction in %.0f %% of the pixels", 100 * float(confident.float().mean())
    )
    cameras = pointmaps.cameras_from_pointmaps(geometry, confident, photos.names)
    cameras = replace(cameras, photos=network_input.photo_intrinsics(photos, cameras))
    trained, held_out = split_holdout(len(photos), options.holdout)
    depth = geometry.points[..., 2]
    maps = pointmaps.depth_maps(depth[trained], confident[trained], cameras[trained])
    views = pointmaps.views_at_size(cropped, cameras, options.max_side)
    maps = [pointmaps.upsample(m, views.images[i].shape[:2]) for i, m in zip(trained, maps, strict=True)]
    distances = torch.stack([d[m].median() if m.any() else d.median() for d, m in zip(depth, confident, strict=True)])
    focus = world_frame.focus_point(cameras.viewmats, distances)
    radius = float((centres(cameras.viewmats) - focus).norm(dim=1).median())
    gaussians = None
    if network.raw is not None:
        part = NetworkOutput(
            Geometry(geometry.points[trained], geometry.confidence[trained], geometry.poses[trained]),
            network.raw[trained],
        )
        gaussians = _network_gaussians(part, confident[trained], cameras[trained], options.preset.gaussians)
    found = SceneGeometry(photos.source, views, trained, held_out, maps, 1, focus, radius, gaussians)
    return build_scene(found, options, steps, device)


def _network_gaussians(
    network: NetworkOutput, confident: Bool[Tensor, "v h w"], cameras: Cameras, target: int
) -> Gaussians:
    """The predicted Gaussians of confident pixels, merged to about `target`."""
    keep = confident.flatten()
    footprint = (network.geometry.points[..., 2] / cameras.Ks[:, 0, 0, None, None]).flatten()
    return merge_gaussians(splat(network.geometry, network.raw.float())[keep], footprint[keep], target)
