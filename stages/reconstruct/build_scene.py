"""From cameras and depth maps, however they were found, to a scene: Gaussians, upright, fitted to the photos."""

from __future__ import annotations

import dataclasses
import logging
from dataclasses import dataclass, field
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.errors import InputError
from stages.core.scene.gaussians import Gaussians, concatenate, transformed
from stages.core.scene.scene import Scene
from stages.reconstruct import initialise, photometric, world_frame
from stages.reconstruct.advice import advise
from stages.reconstruct.depth import DepthMap
from stages.reconstruct.options import ReconstructOptions
from stages.reconstruct.photo_reader import sharpness
from stages.reconstruct.photos import Reconstruction, Views
from stages.reconstruct.scale import parse_scale
from stages.reconstruct.step_cache import StepCache

log = logging.getLogger(__name__)
FAR_DEPTH = 3.0  # what has no depth is put so many camera distances away
MAX_DISTANCE = 10.0  # Gaussians farther from the focus than so many camera distances are dropped


@dataclass(frozen=True)
class SceneGeometry:
    """What is known before there is a scene. `maps` are of the views in `trained`; lengths in any one unit."""

    source: Path  # of the photos, to be named in errors
    views: Views
    trained: list[int]
    held_out: list[int]
    maps: list[DepthMap]
    least: int  # support that a depth needs
    focus: Float[Tensor, "3"]  # what the cameras look at
    radius: float  # their median distance from it
    gaussians: Gaussians | None = None  # a network's, where depth is trusted; else they are made from the maps
    dropped: dict[str, str] = field(default_factory=dict)  # photos left out, and why


def build_scene(found: SceneGeometry, options: ReconstructOptions, steps: StepCache, device: str) -> Reconstruction:
    """The scene: z up, the cameras about 1 from the focus, or as far as cameras given say.

    The plane that things stand on is z = 0; where there is none, the lowest points are, and the scene has no floor.
    """
    used, least = found.views[found.trained], found.least
    known = parse_scale(options.scale_reference)
    length = known.in_scene_units(found.views.cameras, found.radius) if known else None
    with steps.timed("Gaussians"):
        cloud = initialise.fuse(used, found.maps, least)
        if len(cloud) < 1000:
            raise InputError(f"{found.source}: depth is sure at too few places ({len(cloud)}) of what the photos show; "
                             "give more, sharper photos, closer together and of things with some pattern")  # fmt: skip
        log.info("%d depth samples confirmed by %d or more other photos", len(cloud), least)
        cloud = initialise.downsample(cloud, options.preset.gaussians, found.focus, found.radius)
        ground = world_frame.find_ground(cloud.points, used.cameras.viewmats, found.focus, options.seed)
        ground = world_frame.refine_ground(ground, cloud.points, options.seed)
        if ground.plane is None:
            log.info("no supporting plane found: up is how the cameras were held, z = 0 is at the lowest points")
        else:
            log.info("the supporting plane holds %.0f %% of the points in focus", 100 * ground.inlier_fraction)
        move = world_frame.to_world(ground, cloud.points, used.cameras.viewmats, metric=options.cameras is not None)
        first = found.gaussians
        if first is None:
            first = initialise.to_gaussians(cloud, torch.full((len(cloud),), 0.8), options.preset.degree)
        gaussians = concatenate([first, *unmatched_gaussians(used, found.maps, cloud, ground, least, options, device)])
        log.info("%d Gaussians on surfaces, %d where none is known", len(first), len(gaussians) - len(first))
    focus, reach = move(ground.focus), move.scale * ground.radius
    views = dataclasses.replace(found.views, cameras=found.views.cameras.transformed(move))
    gaussians = transformed(gaussians, move)
    gaussians = gaussians[(gaussians.means - focus).norm(dim=1) < MAX_DISTANCE * reach]
    count = options.iteration_count(len(used), device)
    with steps.timed("fit"):
        depths = [torch.where(m.support >= least, m.depth * move.scale, torch.zeros_like(m.depth)) for m in found.maps]
        gaussians = photometric.fit_gaussians(
            gaussians, views[found.trained], count, reach, options.seed, device, depths
        )
    upright_by = {"scale": move.scale, "rotation": move.rotation.tolist(), "translation": move.translation.tolist()}
    facts = {"upright": upright_by, "supporting_plane": ground.plane is not None}
    scale = _scale(options, length and move.scale * length)
    floor = None if ground.plane is None else 0.0
    scene = Scene(gaussians, (), views.cameras, floor, scale, facts, mean_colour(used))
    confirmed = torch.stack([(m.support >= least).float().mean() for m in found.maps])
    sharp = torch.tensor([sharpness(image) for image in used.images])
    advice = advise(views.cameras[found.trained], focus, confirmed, sharp, ground.plane is not None, found.dropped)
    return Reconstruction(scene, views, found.trained, found.held_out, found.dropped, advice)


def unmatched_gaussians(
    views: Views, maps: list[DepthMap], cloud: initialise.OrientedPoints, ground: world_frame.Ground, least: int,
    options: ReconstructOptions, device: str,
) -> list[Gaussians]:  # fmt: skip
    """Fainter, sparser ones where the photos show something but no depth was confirmed; none where that is little."""
    more = initialise.fill_unmatched(views, maps, cloud, ground.plane, least, FAR_DEPTH * ground.radius, device=device)
    more = initialise.downsample(more, options.preset.gaussians // 4, ground.focus, ground.radius)
    return [initialise.to_gaussians(more, torch.full((len(more),), 0.5), 0)] if len(more) > 10 else []


def mean_colour(views: Views) -> tuple[float, float, float]:
    """Of all photos: the best guess at what none of them shows."""
    each = [views.image(i).mean((0, 1)) for i in range(len(views))]
    red, green, blue = torch.stack(each).mean(0).tolist()
    return red, green, blue


def _scale(options: ReconstructOptions, units: float | None) -> dict:
    """Metres a scene unit and where that is from; `units`: the user's reference length in scene units."""
    if units is not None:
        metres = parse_scale(options.scale_reference).distance
        return {"metres_per_unit": metres / units, "source": f"--scale-reference {options.scale_reference}"}
    if options.cameras is not None:
        return {"metres_per_unit": 1.0, "source": f"cameras in {Path(options.cameras).name}, taken as metres"}
    return {"metres_per_unit": 1.0, "source": "assumed: cameras about 1 m from the scene"}
