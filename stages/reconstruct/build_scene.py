"""The steps after cameras and depth, which all backends share: Gaussians, world frame, fit, scale and advice."""

from __future__ import annotations

import dataclasses
import logging
from dataclasses import dataclass, field
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.errors import InputError
from stages.core.geometry.similarity import Similarity
from stages.core.scene.gaussians import Gaussians, concatenate, transformed
from stages.core.scene.scene import Scene
from stages.reconstruct import initialise, photometric, world_frame
from stages.reconstruct.advice import advise
from stages.reconstruct.depth import DepthMap
from stages.reconstruct.initialise import DepthViews, OrientedPoints
from stages.reconstruct.options import ReconstructOptions
from stages.reconstruct.photo_reader import sharpness
from stages.reconstruct.photos import Reconstruction, Views
from stages.reconstruct.scale import parse_scale
from stages.reconstruct.step_cache import StepCache
from stages.reconstruct.world_frame import Ground

log = logging.getLogger(__name__)
MIN_DEPTH_SAMPLES = 1000  # fewest consistent depth samples of a scene
FAR_DEPTH = 3.0  # depth of pixels whose depth is unknown [camera distances]
MAX_SCENE_DISTANCE = 10.0  # Gaussians farther from the focus are dropped [camera distances]


@dataclass(frozen=True)
class SceneGeometry:
    """Cameras and depth of a photo set, in an arbitrary frame and unit of length."""

    source: Path  # of the photos, for error messages
    views: Views
    trained: list[int]  # views to which the Gaussians are fitted
    held_out: list[int]  # views that are kept out of the fit
    maps: list[DepthMap]  # depth maps of the views in `trained`
    min_support: int  # smallest support of a consistent depth, see DepthMap
    focus: Float[Tensor, "3"]  # the point that the cameras look at
    radius: float  # median distance of the cameras from `focus`
    gaussians: Gaussians | None = None  # predicted by a network; None: made from the depth maps
    dropped: dict[str, str] = field(default_factory=dict)  # photos left out -> reason


def build_scene(found: SceneGeometry, options: ReconstructOptions, steps: StepCache, device: str) -> Reconstruction:
    """Build the scene in the world frame: z up, camera distance about 1 unless cameras were given.

    The supporting plane is z = 0; without one, z = 0 is at the lowest points and the scene has no floor. Raises
    InputError if too little depth is consistent or the scale reference does not fit the photos.
    """
    observed = DepthViews(found.views[found.trained], found.maps, found.min_support)
    reference = parse_scale(options.scale_reference)
    length = reference.in_scene_units(found.views.cameras, found.radius) if reference else None
    with steps.timed("Gaussians"):
        cloud = _fused_points(observed, found, options, device)
        ground = _find_ground(cloud, observed.views, found, options)
        to_world = world_frame.to_world(
            ground, cloud.points, observed.views.cameras.viewmats, metric=options.cameras is not None
        )
        initial = found.gaussians
        if initial is None:
            initial = initialise.to_gaussians(cloud, torch.full((len(cloud),), 0.8), options.preset.degree)
        gaussians = concatenate([initial, *unmatched_gaussians(observed, cloud, ground, options, device)])
        log.info("%d Gaussians on surfaces, %d with uncertain depth", len(initial), len(gaussians) - len(initial))
    focus, distance = to_world(ground.focus), to_world.scale * ground.radius
    views = dataclasses.replace(found.views, cameras=found.views.cameras.transformed(to_world))
    gaussians = transformed(gaussians, to_world)
    gaussians = gaussians[(gaussians.means - focus).norm(dim=1) < MAX_SCENE_DISTANCE * distance]
    fit = photometric.FitOptions(options.iteration_count(len(found.trained), device), distance, options.seed, device)
    with steps.timed("fit"):
        depths = [_known_depth(observed, i, to_world.scale) for i in range(len(observed.maps))]
        gaussians = photometric.fit_gaussians(gaussians, views[found.trained], fit, depths)
    scene = Scene(
        gaussians, (), views.cameras, None if ground.plane is None else 0.0,
        _scale(options, length and to_world.scale * length), _provenance(to_world, ground), mean_colour(observed.views),
    )  # fmt: skip
    consistent = torch.stack([observed.consistent(i).float().mean() for i in range(len(observed.maps))])
    sharp = torch.tensor([sharpness(image) for image in observed.views.images])
    advice = advise(views.cameras[found.trained], focus, consistent, sharp, ground.plane is not None, found.dropped)
    return Reconstruction(scene, views, found.trained, found.held_out, found.dropped, advice)


def _fused_points(
    observed: DepthViews, found: SceneGeometry, options: ReconstructOptions, device: str
) -> OrientedPoints:
    """Points of consistent depth, about as many as the quality preset has Gaussians."""
    cloud = initialise.fuse(observed.to(device)).to("cpu")
    if len(cloud) < MIN_DEPTH_SAMPLES:
        raise InputError(f"{found.source}: the photos agree on the depth of too few points ({len(cloud)}); give "
                         "more and sharper "
                         "photos, taken closer together, of objects with visible texture")  # fmt: skip
    log.info("%d depth samples on which %d or more photos agree", len(cloud), observed.min_support)
    return initialise.downsample(cloud, options.preset.gaussians, found.focus, found.radius)


def _find_ground(cloud: OrientedPoints, views: Views, found: SceneGeometry, options: ReconstructOptions) -> Ground:
    ground = world_frame.find_ground(cloud.points, views.cameras.viewmats, found.focus, options.seed, options.up)
    ground = world_frame.refine_ground(ground, cloud.points, options.seed)
    if ground.plane is None:
        log.info(
            "no supporting plane was found: up is taken from how the cameras were held, and z = 0 from the "
            "lowest points"
        )
    else:
        log.info("the supporting plane contains %.0f %% of the points in focus", 100 * ground.inlier_fraction)
    if ground.up_side != "top" and options.up == "auto":
        log.info("the photos are turned: their %s side is up", ground.up_side)
    if ground.rival:
        log.warning("it is uncertain whether the %s or the %s side of the photos is up; the first is used; if "
                    "the scene comes out "
                    "tilted, give --up %s", ground.up_side, ground.rival, ground.rival)  # fmt: skip
    return ground


def unmatched_gaussians(
    observed: DepthViews, cloud: OrientedPoints, ground: Ground, options: ReconstructOptions, device: str
) -> list[Gaussians]:
    """Sparser, more transparent Gaussians for pixels without consistent depth; an empty list if there are few."""
    more = initialise.fill_unmatched(observed.to(device), cloud, ground.plane, FAR_DEPTH * ground.radius)
    more = initialise.downsample(more.to("cpu"), options.preset.gaussians // 4, ground.focus, ground.radius)
    return [initialise.to_gaussians(more, torch.full((len(more),), 0.5), 0)] if len(more) > 10 else []


def mean_colour(views: Views) -> tuple[float, float, float]:
    """Mean RGB of all photos, for pixels without Gaussians."""
    means = [views.image(i).mean((0, 1)) for i in range(len(views))]
    red, green, blue = torch.stack(means).mean(0).tolist()
    return red, green, blue


def _known_depth(observed: DepthViews, i: int, scale: float) -> Float[Tensor, "h w"]:
    """Consistent depth of view i times `scale`, 0 elsewhere."""
    depth = observed.maps[i].depth
    return torch.where(observed.consistent(i), depth * scale, torch.zeros_like(depth))


def _provenance(to_world: Similarity, ground: Ground) -> dict:
    """The transform to the world frame and whether there is a plane, for the provenance of the scene."""
    similarity = {
        "scale": to_world.scale, "rotation": to_world.rotation.tolist(), "translation": to_world.translation.tolist(),
    }  # fmt: skip
    return {"upright": similarity, "supporting_plane": ground.plane is not None}


def _scale(options: ReconstructOptions, units: float | None) -> dict:
    """Metres per scene unit and its source; `units` is the reference length in scene units, if there is one."""
    if units is not None:
        metres = parse_scale(options.scale_reference).distance
        return {"metres_per_unit": metres / units, "source": f"--scale-reference {options.scale_reference}"}
    if options.cameras is not None:
        return {"metres_per_unit": 1.0, "source": f"assumed: cameras in {Path(options.cameras).name} are in metres"}
    return {"metres_per_unit": 1.0, "source": "assumed: cameras about 1 m from the scene"}
