"""Unseen sides from a generator: DiffSplat makes the whole object from the photo that shows it best.

Where it belongs is known from that photo's camera, and found exactly by registration. What the photos saw stays as
they showed it; the generated object gives the rest, its colours shifted to agree at the seam.
"""

from __future__ import annotations

import logging
from functools import lru_cache
from pathlib import Path

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.models.diffsplat.weights import Files, find, load
from stages.core.perception.support import Support
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.scene import Scene
from stages.refine.disc_gaussians import empty_like
from stages.refine.library import MIN_SURFACE_OPACITY, opaque_gaussians, place_whole
from stages.refine.object_crop import TRAINED_ELEVATIONS, crop_object
from stages.refine.observed_space import ObservedSpace
from stages.refine.options import RefineOptions
from stages.refine.registration import MIN_REGISTRATION_POINTS, register

log = logging.getLogger(__name__)
FIT = 0.5  # a lower fit is another object; true maps in the network's place reach 0.95, those of random weights 0.01


def complete(
    scene: Scene, number: int, sight: ObservedSpace, support: Support | None, options: RefineOptions
) -> Gaussians:
    """Gaussians of the generated object where the photos did not see it; none when it does not fit what they saw."""
    device = pick_device(options.device)
    model = _model(options.weights, options.download, device)
    own, name = opaque_gaussians(scene, number), scene.name_of(number)
    shown = crop_object(scene, own, model.side, options.photos) if len(own) >= MIN_REGISTRATION_POINTS else None
    if shown is None:
        log.info("  %d  %s: left alone: no photo shows enough of it", number, name)
        return empty_like(own)
    if not TRAINED_ELEVATIONS[0] <= shown.elevation <= TRAINED_ELEVATIONS[1]:
        log.info("  %d  %s: seen from %.0f degrees above in %s; DiffSplat learned from %.0f to %.0f, so it may err",
                 number, name, shown.elevation, shown.name, *TRAINED_ELEVATIONS)  # fmt: skip
    said = "" if name == f"object_{number}" else name.replace("_", " ")  # a number says nothing
    made = model.generate(shown.image, shown.elevation, said, options.seed)
    made = made[made.opacities > MIN_SURFACE_OPACITY]
    how = (
        register(own.to(device), made.to(device), options.seed, shown.place)
        if len(made) >= MIN_REGISTRATION_POINTS
        else None
    )
    if how is None:
        log.info("  %d  %s: left alone: what DiffSplat made of %s is no solid object", number, name, shown.name)
        return empty_like(own)
    gained, verdict = place_whole(made, how, own, sight, FIT)
    log.info("  %d  %s: what DiffSplat made of %s %s", number, name, shown.name, verdict)
    return gained


@lru_cache(maxsize=1)
def _model(weights: Path | None, download: bool, device: str):
    """The network, once for all objects; fetched first when the user asked for that and it is not there."""
    return load(_files(weights, download), device)


def weights_file() -> Path:
    """Path of DiffSplat's decoder weights, as an example of its files; raises InputError where some are missing."""
    return find().gsvae


def _files(weights: Path | None, download: bool) -> Files:
    try:
        return find(weights)
    except InputError:
        if not download or weights is not None:
            raise
    from stages.core.models.diffsplat.download import download as fetch

    return fetch()
