"""Completion from a library of whole objects: registers the asset that fits the seen part best.

Gaussians seen in the photos are kept; the asset provides the unseen ones, with colours adapted to the seen part.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.geometry.neighbours import knn
from stages.core.geometry.similarity import Similarity
from stages.core.models.matching.weights import Matcher, load_matcher
from stages.core.perception.observed_space import ObservedSpace
from stages.core.perception.support import Support
from stages.core.scene.gaussians import SURFACE_OPACITY, Gaussians, transformed
from stages.core.scene.scene import Scene
from stages.core.scene.scene_ply import read_scene
from stages.refine.disc_gaussians import empty_like
from stages.refine.object_crop import ObjectCrop, crop_object
from stages.refine.options import RefineOptions
from stages.refine.registration import (
    MIN_REGISTRATION_POINTS,
    Registration,
    coarse_fit,
    coarse_registration,
    fine_registration,
)
from stages.refine.registration_cloud import RegistrationCloud
from stages.refine.registration_matches import SIDE, matched_place, view_of

log = logging.getLogger(__name__)
MIN_FIT = 0.8  # fit below which the asset is another object
MAX_FREE_FRACTION = 0.1  # fraction of an asset in observed free space above which it is another object
FINE_CANDIDATES = 2  # number of assets with the best coarse fit that are registered accurately
SEEN_DISTANCE = 0.02  # distance from the seen part within which the asset is not used [diagonal of the asset's bounds]
MIN_ASSET_GAUSSIANS = 100  # fewest opaque Gaussians of an asset


def complete(
    scene: Scene, number: int, observed: ObservedSpace, support: Support | None, options: RefineOptions
) -> Gaussians:
    """The completer "library": Gaussians of the best asset on the unseen sides; none if no asset fits."""
    own = opaque_gaussians(scene, number)
    enough = len(own) >= MIN_REGISTRATION_POINTS
    crop = crop_object(scene, own, SIDE, options.photos) if enough and options.matcher != "none" else None
    found = best_asset(own, options, crop) if enough else None
    if found is None:
        log.info(
            "  %d  %s: unchanged, as it has too few Gaussians to be compared with the library",
            number,
            scene.name_of(number),
        )
        return empty_like(own)
    asset, whole, registration = found
    added, verdict = place_whole(whole, registration, own, observed, MIN_FIT)
    log.info("  %d  %s: %s of the library %s", number, scene.name_of(number), asset, verdict)
    return added


def opaque_gaussians(scene: Scene, number: int) -> Gaussians:
    """The Gaussians of an object whose opacity exceeds SURFACE_OPACITY."""
    g = scene.gaussians
    return g[(g.object_id == number) & (g.opacities > SURFACE_OPACITY) & g.means.isfinite().all(1)]


def place_whole(
    whole: Gaussians, registration: Registration, own: Gaussians, observed: ObservedSpace, min_fit: float
) -> tuple[Gaussians, str]:
    """Gaussians that a registered whole adds to its seen part `own`, and a message; none if the whole does not fit.

    The whole fits if its fit is at least `min_fit` and at most MAX_FREE_FRACTION of it is in observed free space.
    """
    placed = transformed(whole, registration.similarity.to(whole.means.device))
    free = _free_fraction(placed, observed)
    fits = registration.fit >= min_fit and free <= MAX_FREE_FRACTION
    verdict = "added" if fits else f"unchanged, as it needs {min_fit} and at most {MAX_FREE_FRACTION:.0%}"
    added = unseen_gaussians(own, placed, int(own.object_id[0])) if fits else empty_like(own)
    return added, f"has a fit of {registration.fit:.2f}, {100 * free:.0f} % of it in observed free space; {verdict}"


@lru_cache(maxsize=1)
def load_library(folder: Path, device: str) -> dict[str, tuple[Gaussians, RegistrationCloud]]:
    """Whole objects by name: FOLDER/NAME.ply, or FOLDER/NAME/.../*.ply as written by trainers and `ngff-lab objects`.

    Registration clouds are on `device`, Gaussians on the CPU. Raises InputError for an empty folder and for assets with
    too few Gaussians.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(
            f"{folder}: is not a folder; --library takes a folder of complete objects, as written by `ngff-lab objects`"
        )
    found = sorted(p for p in folder.rglob("*") if p.suffix.lower() == ".ply" and not p.name.startswith("."))
    files = {p.stem: p for p in found if p.parent == folder}
    # the last file of each folder, by path
    files.update({p.relative_to(folder).parts[0]: p for p in found if p.parent != folder})
    if not files:
        raise InputError(
            f"{folder}: contains no .ply; --library takes a folder of complete objects, as written "
            "by `ngff-lab objects`"
        )
    out = {}
    for name, path in files.items():
        g = read_scene(path).gaussians
        g = g[(g.opacities > SURFACE_OPACITY) & g.scales.isfinite().all(1)]
        if len(g) < MIN_ASSET_GAUSSIANS:
            raise InputError(
                f"{path}: has {len(g)} opaque Gaussians, too few for an object; remove the file from the library"
            )
        out[name] = g, RegistrationCloud.of(g.to(device))
    return out


def matched_hints(
    options: RefineOptions, crop: ObjectCrop | None, own: Gaussians, whole: Gaussians
) -> list[Similarity]:
    """The similarity of a whole by --matcher; empty without a matcher, an image of the object, or enough matches."""
    if crop is None or options.matcher == "none":
        return []
    device = pick_device(options.device)
    own, whole, image, V, K = (x.to(device) for x in (own, whole, crop.image, crop.viewmat, crop.K))
    place = matched_place(_matcher(device), view_of(own, image, V, K), whole, options.seed)
    return [] if place is None else [place]


@lru_cache(maxsize=1)
def _matcher(device: str) -> Matcher:
    return load_matcher(device)


def best_asset(
    own: Gaussians, options: RefineOptions, crop: ObjectCrop | None = None
) -> tuple[str, Gaussians, Registration] | None:
    """Name, Gaussians and registration of the asset that fits best; None if no asset could be registered.

    All assets are registered coarsely, and the best candidates accurately. With `crop`, an image of the object,
    --matcher matches it to each asset.
    """
    device, seed = pick_device(options.device), options.seed
    assets, part = load_library(options.library, device), RegistrationCloud.of(own.to(device), seed)
    coarse = {name: coarse_registration(part, cloud, seed, matched_hints(options, crop, own, whole))
              for name, (whole, cloud) in assets.items()}  # fmt: skip
    fits = {name: coarse_fit(poses, part, assets[name][1]) for name, poses in coarse.items() if len(poses)}
    candidates = sorted(fits, key=fits.get, reverse=True)[:FINE_CANDIDATES]
    fine = {name: fine_registration(coarse[name], part, assets[name][1], seed) for name in candidates}
    if not fine:
        return None
    winner = max(fine, key=lambda name: fine[name].fit)
    return winner, assets[winner][0], fine[winner]


def _free_fraction(placed: Gaussians, observed: ObservedSpace) -> float:
    """Fraction of the Gaussians in observed free space."""
    if not observed.views:
        return 0.0
    size = float((placed.means.amax(0) - placed.means.amin(0)).norm())
    return float(observed.is_free(placed.means, 0.03 * size).float().mean())


def unseen_gaussians(own: Gaussians, placed: Gaussians, number: int) -> Gaussians:
    """The asset's Gaussians that are not near Gaussians of the object, with colours adapted to the photos."""
    size = float((placed.means.amax(0) - placed.means.amin(0)).norm())
    near = knn(own.means, placed.means, 1)[0][:, 0] < SEEN_DISTANCE * size
    if not near.any():
        return empty_like(own)
    sh = placed.sh.clone()
    sh[:, 0] += _colour_shift(own, placed[near], placed.means)
    rest = replace(placed, sh=sh, object_id=torch.full((len(placed),), number, dtype=own.object_id.dtype))
    return rest[~near]


def _colour_shift(
    own: Gaussians, seen: Gaussians, at: Float[Tensor, "n 3"], neighbours: int = 64
) -> Float[Tensor, "n 3"]:
    """Difference of the base colours of photos and asset, averaged over the nearest points where both are known."""
    _, nearest_own = knn(own.means, seen.means, 8)
    difference = own.sh[nearest_own, 0].mean(1) - seen.sh[:, 0]
    distance, index = knn(seen.means, at, neighbours)
    weight = 1 / distance.clamp_min(1e-9)
    return (difference[index] * weight[..., None]).sum(1) / weight.sum(1, keepdim=True)
