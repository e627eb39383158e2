"""The segment stage: scene.ply -> labelled.ply."""

from __future__ import annotations

import logging
import time
from dataclasses import replace
from pathlib import Path

from stages.core.backends import choose, pick_device
from stages.core.errors import InputError
from stages.core.scene.files import check_output, provenance, seconds_since
from stages.core.scene.scene import Scene
from stages.core.scene.scene_ply import read_scene, write_scene
from stages.core.scene.schema import quote, text
from stages.core.torch_state import standard_torch
from stages.segment.object_scale import parse_object_scale
from stages.segment.options import BACKENDS, SegmentOptions

log = logging.getLogger(__name__)


@standard_torch()
def run(scene: Path, out: Path, options: SegmentOptions = SegmentOptions()) -> None:  # noqa: B008 -- frozen
    """Label the Gaussians of each object: scene.ply -> labelled.ply. Logs one line per object.

    Raises InputError for invalid inputs; then nothing is written.
    """
    began, segment = time.monotonic(), choose(BACKENDS, "--backend", options.chosen)
    pick_device(options.device)  # raises InputError for an absent GPU, also for backends that do not use one
    whole = read_scene(scene)
    check_output(Path(out), "scene")
    labelled = rename_objects(segment(whole, options), options)
    reference = parse_object_scale(options.scale_reference)
    labelled = reference.applied(labelled) if reference else labelled
    facts = {**provenance("segment", [scene], options), **seconds_since(began), "scene": whole.provenance}
    write_scene(out, replace(labelled, provenance=facts))
    log_objects(labelled)
    log.info("%s: %d objects", out, len(labelled.objects))
    if not labelled.objects:
        log.warning(
            "%s: no objects were found; try --masks, or a smaller --min-size such as %g", scene, options.min_size / 2
        )


def rename_objects(scene: Scene, options: SegmentOptions) -> Scene:
    """Rename objects as the user asked. Raises InputError for an object that does not exist."""
    have = {o.id for o in scene.objects}
    for number in options.renamed:
        if number not in have:
            raise InputError(f"--names: there is no object {number}; objects found: {_listed(scene)}")
    names = {number: text(name, "--names") for number, name in options.renamed.items()}
    return replace(scene, objects=tuple(replace(o, name=names.get(o.id, o.name)) for o in scene.objects))


def _listed(scene: Scene) -> str:
    return quote(", ".join(f"{o.id} ({o.name})" for o in scene.objects) or "none", 300)


def log_objects(scene: Scene) -> None:
    """Log id, name, number of Gaussians and size of each object."""
    g = scene.gaussians
    for o in scene.objects:
        means = g.means[g.object_id == o.id].double().numpy()
        if not len(means):
            log.info("  %d  %s: no Gaussians", o.id, o.name)
            continue
        size = _quantile(means, 0.99) - _quantile(means, 0.01)
        log.info("  %d  %s: %d Gaussians, %s", o.id, o.name, len(means), _size_text(size, scene))


def _size_text(size, scene: Scene) -> str:
    """Three lengths in cm, or in scene units if the scale is unknown."""
    if scene.has_known_scale:
        return " x ".join(f"{100 * scene.metres_per_unit * side:.1f}" for side in size) + " cm"
    return " x ".join(f"{side:.3g}" for side in size) + " scene units"


def _quantile(values, fraction: float):
    import numpy as np

    return np.quantile(values, fraction, axis=0)
