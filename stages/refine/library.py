"""Unseen sides from a library of whole objects: the asset that fits what was seen is put in its place.

What the photos saw stays as they showed it; the asset gives the rest, its colours shifted to agree at the seam.
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
from stages.core.perception.support import Support
from stages.core.scene.gaussians import Gaussians, transformed
from stages.core.scene.scene import Scene
from stages.core.scene.scene_ply import read_scene
from stages.refine.disc_gaussians import empty_like
from stages.refine.observed_space import ObservedSpace
from stages.refine.options import RefineOptions
from stages.refine.registration import (
    MIN_REGISTRATION_POINTS,
    Registration,
    coarse_fit,
    coarse_registration,
    fine_registration,
)
from stages.refine.registration_cloud import RegistrationCloud

log = logging.getLogger(__name__)
FIT = 0.8  # a lower fit is another object
THROUGH = 0.1  # share of an asset that cameras may see through before it cannot be the object
TRIED = 2  # assets that are registered exactly, of those that fit best roughly
SEEN = 0.02  # distance from the part within which the asset is not needed [diameters]
MIN_SURFACE_OPACITY = 0.1  # opacity of Gaussians that count as surface


def complete(
    scene: Scene, number: int, sight: ObservedSpace, support: Support | None, options: RefineOptions
) -> Gaussians:
    """Gaussians of the best asset of `options.library` where the object was not seen; none when nothing fits."""
    own = opaque_gaussians(scene, number)
    found = best_asset(own, options) if len(own) >= MIN_REGISTRATION_POINTS else None
    if found is None:
        log.info("  %d  %s: left alone: too little of it to compare with the library", number, scene.name_of(number))
        return empty_like(own)
    asset, whole, how = found
    gained, verdict = place_whole(whole, how, own, sight, FIT)
    log.info("  %d  %s: %s of the library %s", number, scene.name_of(number), asset, verdict)
    return gained


def opaque_gaussians(scene: Scene, number: int) -> Gaussians:
    """The Gaussians of an object that count as its surface."""
    g = scene.gaussians
    return g[(g.object_id == number) & (g.opacities > MIN_SURFACE_OPACITY) & g.means.isfinite().all(1)]


def place_whole(
    whole: Gaussians, how: Registration, own: Gaussians, sight: ObservedSpace, least: float
) -> tuple[Gaussians, str]:
    """What a registered whole adds to its part, and why: nothing when it fits less than `least` or is seen through."""
    placed = transformed(whole, how.similarity.to(whole.means.device))
    through = _seen_through(placed, sight)
    fits = how.fit >= least and through <= THROUGH
    verdict = "put in its place" if fits else f"left alone: {least} and at most {THROUGH:.0%} are needed"
    gained = unseen_gaussians(own, placed, int(own.object_id[0])) if fits else empty_like(own)
    return gained, f"fits to {how.fit:.2f}, {100 * through:.0f} % of it is seen through; {verdict}"


@lru_cache(maxsize=1)
def load_library(folder: Path, device: str) -> dict[str, tuple[Gaussians, RegistrationCloud]]:
    """Whole objects by name: FOLDER/NAME.ply, or FOLDER/NAME/.../*.ply as trainers and `ngff-lab objects` write.

    Their clouds are on `device`, ready to be registered; their Gaussians stay on the CPU.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: is no folder; --library takes whole objects, such as `ngff-lab objects` writes")
    files = {p.stem: p for p in sorted(folder.glob("*.ply"))}
    files.update({p.relative_to(folder).parts[0]: p for p in sorted(folder.glob("*/**/*.ply"))})  # the last iteration
    if not files:
        raise InputError(f"{folder}: holds no .ply; --library takes whole objects, such as `ngff-lab objects` writes")
    out = {}
    for name, path in files.items():
        g = read_scene(path).gaussians
        g = g[(g.opacities > MIN_SURFACE_OPACITY) & g.scales.isfinite().all(1)]
        if len(g) < 100:
            raise InputError(f"{path}: {len(g)} solid Gaussians are no object; take it out of the library")
        out[name] = g, RegistrationCloud.of(g.to(device))
    return out


def best_asset(own: Gaussians, options: RefineOptions) -> tuple[str, Gaussians, Registration] | None:
    """Name, Gaussians and registration of the asset that fits best: all roughly, the most promising exactly."""
    device, seed = pick_device(options.device), options.seed
    assets, part = load_library(options.library, device), RegistrationCloud.of(own.to(device), seed)
    rough = {name: coarse_registration(part, cloud, seed) for name, (_, cloud) in assets.items()}
    fits = {name: coarse_fit(poses, part, assets[name][1]) for name, poses in rough.items() if len(poses)}
    promising = sorted(fits, key=fits.get, reverse=True)[:TRIED]
    settled = {name: fine_registration(rough[name], part, assets[name][1], seed) for name in promising}
    if not settled:
        return None
    winner = max(settled, key=lambda name: settled[name].fit)
    return winner, assets[winner][0], settled[winner]


def _seen_through(placed: Gaussians, sight: ObservedSpace) -> float:
    """Share of the Gaussians where the cameras see nothing."""
    if not sight.views:
        return 0.0
    size = float((placed.means.amax(0) - placed.means.amin(0)).norm())
    return float(sight.empty(placed.means, 0.03 * size).float().mean())


def unseen_gaussians(own: Gaussians, placed: Gaussians, number: int) -> Gaussians:
    """The asset's Gaussians away from those of the object, in the light of the photos."""
    size = float((placed.means.amax(0) - placed.means.amin(0)).norm())
    near = knn(own.means, placed.means, 1)[0][:, 0] < SEEN * size
    if not near.any():
        return empty_like(own)
    sh = placed.sh.clone()
    sh[:, 0] += _shift(own, placed[near], placed.means)
    rest = replace(placed, sh=sh, object_id=torch.full((len(placed),), number, dtype=own.object_id.dtype))
    return rest[~near]


def _shift(own: Gaussians, seen: Gaussians, at: Float[Tensor, "n 3"], among: int = 64) -> Float[Tensor, "n 3"]:
    """What the photos make of the asset's colours, averaged over the nearest places where both are known."""
    _, mine = knn(own.means, seen.means, 8)
    difference = own.sh[mine, 0].mean(1) - seen.sh[:, 0]
    distance, index = knn(seen.means, at, among)
    weight = 1 / distance.clamp_min(1e-9)
    return (difference[index] * weight[..., None]).sum(1) / weight.sum(1, keepdim=True)
