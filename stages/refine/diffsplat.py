"""Completion by a generator: DiffSplat generates the whole object from the photo that shows it best.

The photo's camera gives an approximate pose, which registration refines. Gaussians seen in the photos are kept; the
generated object provides the unseen ones, with colours adapted to the seen part.
"""

from __future__ import annotations

import logging
from functools import lru_cache
from pathlib import Path

from stages.core.backends import choose, pick_device
from stages.core.models.diffsplat.download import download as fetch
from stages.core.models.diffsplat.weights import find, load
from stages.core.models.hub import find_or_download
from stages.core.perception.observed_space import ObservedSpace
from stages.core.perception.support import Support
from stages.core.scene.gaussians import SURFACE_OPACITY, Gaussians
from stages.core.scene.scene import Scene
from stages.refine.disc_gaussians import empty_like
from stages.refine.library import matched_hints, opaque_gaussians, place_whole
from stages.refine.object_crop import TRAINED_ELEVATIONS, crop_object
from stages.refine.options import UPSCALERS, RefineOptions
from stages.refine.registration import MIN_REGISTRATION_POINTS, register
from stages.refine.upscale import RESTORED_SIDE, upscaled

log = logging.getLogger(__name__)
MIN_FIT = 0.5  # fit below which it is another object; true output maps reach 0.95, those of random weights 0.01


def complete(
    scene: Scene, number: int, observed: ObservedSpace, support: Support | None, options: RefineOptions
) -> Gaussians:
    """The completer "diffsplat": Gaussians of the generated object on the unseen sides, if it fits."""
    device = pick_device(options.device)
    upscaler = choose(UPSCALERS, "--upscale", options.upscale)(options)
    model = _model(options.weights, options.download, device)
    own, name = opaque_gaussians(scene, number), scene.name_of(number)
    side = RESTORED_SIDE if upscaler else model.side
    crop = crop_object(scene, own, side, options.photos) if len(own) >= MIN_REGISTRATION_POINTS else None
    if crop is None:
        log.info("  %d  %s: unchanged, as no photo shows enough of the object", number, name)
        return empty_like(own)
    if not TRAINED_ELEVATIONS[0] <= crop.elevation <= TRAINED_ELEVATIONS[1]:
        log.info("  %d  %s: seen from %.0f degrees above in %s, outside DiffSplat's training range of %.0f to "
                 "%.0f degrees",
                 number, name, crop.elevation, crop.name, *TRAINED_ELEVATIONS)  # fmt: skip
    prompt = "" if name == f"object_{number}" else name.replace("_", " ")  # a number is not a prompt
    if upscaler:
        crop = upscaled(crop, upscaler, model.side, prompt, options.seed)
        log.info("  %d  %s: image of %s restored by %s at %d pixels", number, name, crop.name, options.upscale, side)
    generated = model.generate(crop.image, crop.elevation, prompt, options.seed)
    generated = generated[generated.opacities > SURFACE_OPACITY]
    hints = [crop.place, *matched_hints(options, crop, own, generated)]
    registration = (
        register(own.to(device), generated.to(device), options.seed, hints)
        if len(generated) >= MIN_REGISTRATION_POINTS
        else None
    )
    if registration is None:
        log.info(
            "  %d  %s: unchanged, as the object generated from %s has too few opaque Gaussians", number, name, crop.name
        )
        return empty_like(own)
    added, verdict = place_whole(generated, registration, own, observed, MIN_FIT)
    log.info("  %d  %s: the object generated from %s %s", number, name, crop.name, verdict)
    return added


@lru_cache(maxsize=1)
def _model(weights: Path | None, download: bool, device: str):
    """The network, loaded once for all objects; downloaded first if that was requested and it is missing."""
    return load(find_or_download(find, fetch, weights, download), device)


def weights_file() -> Path:
    """Path of DiffSplat's decoder weights, as one of its files. Raises InputError if any file is missing."""
    return find().gsvae
