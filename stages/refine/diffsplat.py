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
from stages.refine.library import SOLID, put, solid
from stages.refine.options import RefineOptions
from stages.refine.patches import none_like
from stages.refine.portrait import LEARNED, portrait
from stages.refine.register import LEAST, register
from stages.refine.sight import Sight

log = logging.getLogger(__name__)
FIT = 0.5  # a lower fit is another object; true maps in the network's place reach 0.95, those of random weights 0.01


def complete(scene: Scene, number: int, sight: Sight, support: Support | None, options: RefineOptions) -> Gaussians:
    """Gaussians of the generated object where the photos did not see it; none when it does not fit what they saw."""
    device = pick_device(options.device)
    model = _model(options.weights, options.download, device)
    own, name = solid(scene, number), scene.name_of(number)
    shown = portrait(scene, own, model.side, options.photos) if len(own) >= LEAST else None
    if shown is None:
        log.info("  %d  %s: left alone: no photo shows enough of it", number, name)
        return none_like(own)
    if not LEARNED[0] <= shown.elevation <= LEARNED[1]:
        log.info("  %d  %s: seen from %.0f degrees above in %s; DiffSplat learned from %.0f to %.0f, so it may err",
                 number, name, shown.elevation, shown.name, *LEARNED)  # fmt: skip
    said = "" if name == f"object_{number}" else name.replace("_", " ")  # a number says nothing
    made = model.generate(shown.image, shown.elevation, said, options.seed)
    made = made[made.opacities > SOLID]
    how = register(own.to(device), made.to(device), options.seed, shown.place) if len(made) >= LEAST else None
    if how is None:
        log.info("  %d  %s: left alone: what DiffSplat made of %s is no solid object", number, name, shown.name)
        return none_like(own)
    gained, verdict = put(made, how, own, sight, FIT)
    log.info("  %d  %s: what DiffSplat made of %s %s", number, name, shown.name, verdict)
    return gained


@lru_cache(maxsize=1)
def _model(weights: Path | None, download: bool, device: str):
    """The network, once for all objects; fetched first when the user asked for that and it is not there."""
    return load(_files(weights, download), device)


def _files(weights: Path | None, download: bool) -> Files:
    try:
        return find(weights)
    except InputError:
        if not download or weights is not None:
            raise
    from stages.core.models.diffsplat.download import download as fetch

    return fetch()
