"""The learned backends: π³, whose points become Gaussians, and Pi3-splat, which gives Gaussians itself."""

from __future__ import annotations

import logging

import torch
from jaxtyping import Float
from torch import Tensor, nn

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.geometry.cameras import centres
from stages.core.models.pi3 import memory
from stages.core.models.pi3.network import Geometry, halve
from stages.core.models.pi3.splat import Pi3Splat, splat
from stages.core.models.pi3.weights import find, load
from stages.core.scene.gaussians import Gaussians
from stages.reconstruct import network_input, pointmaps, world_frame
from stages.reconstruct.build_scene import SceneGeometry, build_scene
from stages.reconstruct.merge import merge_gaussians
from stages.reconstruct.options import ReconstructOptions
from stages.reconstruct.photos import Photos, Reconstruction
from stages.reconstruct.step_cache import StepCache

log = logging.getLogger(__name__)


def pi3(photos: Photos, options: ReconstructOptions, steps: StepCache) -> Reconstruction:
    """One to a hundred photos through π³; Gaussians start on its points."""
    return _reconstruct("pi3", photos, options, steps)


def pi3_splat(photos: Photos, options: ReconstructOptions, steps: StepCache) -> Reconstruction:
    """The same, but Gaussians are those of the network's splat head."""
    return _reconstruct("pi3-splat", photos, options, steps)


def _reconstruct(name: str, photos: Photos, options: ReconstructOptions, steps: StepCache) -> Reconstruction:
    if options.cameras is not None:
        raise InputError(f"--cameras: --backend {name} finds cameras itself; use --backend classic with known ones")
    device = pick_device(options.device)
    cropped = network_input.crop_photos(photos, options.resolution)
    images = network_input.make_batch(cropped, network_input.common_size(photos, options.resolution))
    geometry, raw = steps.cached("network", lambda: _predict_geometry(name, images, options, device), (Geometry,))
    return assemble(photos, cropped, geometry, raw, options, steps, device)


def _predict_geometry(
    name: str, images: Float[Tensor, "v 3 h w"], options: ReconstructOptions, device: str
) -> tuple[Geometry, Tensor | None]:
    """What the network says of the images; the raw numbers of Gaussians where it gives those."""
    model = load(_weights(name, options), name)
    return predict(model, images, device)


def _weights(name: str, options: ReconstructOptions):
    """The file of weights, fetched first when the user asked for that and it is not there."""
    try:
        return find(name, options.weights)
    except InputError:
        if not options.download or options.weights is not None:
            raise
    from stages.core.models.pi3.download import download

    return download(name)


@torch.no_grad()
def predict(model: nn.Module, images: Float[Tensor, "v 3 h w"], device: str) -> tuple[Geometry, Tensor | None]:
    """Run the network, in 16 bit on a GPU, over as many views at once as fit; results on the CPU.

    Raises InputError beforehand where they cannot fit.
    """
    half, splats = device != "cpu", isinstance(model, Pi3Splat)
    config = model.encoder.config if splats else model.config
    if half:
        model = halve(model)
        room = memory.free(device)
        if memory.weights(model) > room:
            raise InputError(f"the network needs {memory.weights(model) / 1e9:.1f} GB and the GPU has {room / 1e9:.1f} "
                             "GB free; use --device cpu")  # fmt: skip
        model = model.to(device)
    views, _, *size = images.shape
    at_once = memory.plan(config, views, tuple(size), splats, half, memory.free(device))
    need = memory.activations(config, views, *size, at_once, splats, half) + memory.weights(model)
    log.info("%d photos at %dx%d, about %.1f GB of memory, %d at once", views, *size[::-1], need / 1e9, at_once)
    with torch.autocast(torch.device(device).type, torch.bfloat16, enabled=half):
        said = model(images.to(device), at_once)
    geometry, raw = said if splats else (said, None)
    on_cpu = (x.cpu() for x in (geometry.points, geometry.confidence, geometry.poses))
    return Geometry(*on_cpu), None if raw is None else raw.half().cpu()  # 70 bytes a pixel


def assemble(
    photos: Photos,
    cropped: list[Tensor],
    geometry: Geometry,
    raw: Float[Tensor, "v h w k"] | None,
    options: ReconstructOptions,
    steps: StepCache,
    device: str,
) -> Reconstruction:
    """A scene from what a network says about the middles of the photos."""
    sure = pointmaps.confident_pixels(geometry)
    log.info("the network is sure of %.0f %% of the pixels", 100 * float(sure.float().mean()))
    cameras = pointmaps.cameras_from_pointmaps(geometry, sure, photos.names)
    trained, held = split_holdout(len(photos), options.holdout)
    depth = geometry.points[..., 2]
    maps = pointmaps.depth_maps(depth[trained], sure[trained], cameras[trained])
    views = pointmaps.views_at_size(cropped, cameras, options.max_side)
    maps = [pointmaps.upsample(m, views.images[i].shape[:2]) for i, m in zip(trained, maps, strict=True)]
    distances = torch.stack([d[s].median() if s.any() else d.median() for d, s in zip(depth, sure, strict=True)])
    focus = world_frame.focus_point(cameras.viewmats, distances)
    radius = float((centres(cameras.viewmats) - focus).norm(dim=1).median())
    gaussians = None if raw is None else _network_gaussians(geometry, raw, sure, trained, cameras, options)
    found = SceneGeometry(photos.source, views, trained, held, maps, 1, focus, radius, gaussians)
    return build_scene(found, options, steps, device)


def split_holdout(count: int, holdout: int) -> tuple[list[int], list[int]]:
    """Indices of the photos to learn from and of those kept out; a single photo is learned from."""
    held = [i for i in range(count) if holdout and i % holdout == 0] if count > 1 else []
    return [i for i in range(count) if i not in held], held


def _network_gaussians(geometry, raw, sure, trained: list[int], cameras, options: ReconstructOptions) -> Gaussians:
    """The network's Gaussians of the views to learn from where it is to be trusted, no more than the quality asks."""
    part = Geometry(geometry.points[trained], geometry.confidence[trained], geometry.poses[trained])
    keep = sure[trained].flatten()
    footprint = (part.points[..., 2] / cameras.Ks[trained][:, 0, 0, None, None]).flatten()
    return merge_gaussians(splat(part, raw[trained].float())[keep], footprint[keep], options.preset.gaussians)
