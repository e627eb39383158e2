"""The refine stage: labelled.ply -> refined.ply."""

from __future__ import annotations

import logging
import time
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Bool
from torch import Tensor
from tqdm import tqdm

from stages.core.backends import choose, pick_device
from stages.core.errors import InputError
from stages.core.geometry.neighbours import knn
from stages.core.kernels.threads import parallel_map
from stages.core.perception.observed_space import MAX_HIDDEN_WEIGHT, ObservedSpace, object_psnr
from stages.core.perception.region_growing import grow_objects
from stages.core.perception.support import Support, find_support, view_extent
from stages.core.perception.wall import find_wall, rotate_wall_to_floor
from stages.core.scene.files import check_output, provenance, seconds_since
from stages.core.scene.gaussians import Gaussians, concatenate, transformed
from stages.core.scene.scene import Scene
from stages.core.scene.scene_ply import read_scene, write_scene
from stages.core.torch_state import standard_torch
from stages.refine.background import fill_background
from stages.refine.disc_gaussians import empty_like
from stages.refine.options import BACKENDS, CONCURRENT, RefineOptions
from stages.refine.outliers import floaters

log = logging.getLogger(__name__)


@standard_torch()
def run(scene: Path, out: Path, options: RefineOptions = RefineOptions()) -> None:  # noqa: B008 -- frozen
    """Remove outliers, complete objects, and fill the background under them: labelled.ply -> refined.ply.

    Raises InputError for invalid inputs, such as a scene without objects; then nothing is written.
    """
    began = time.monotonic()
    device = pick_device(options.device)
    whole = read_scene(scene)
    if not bool((whole.gaussians.object_id > 0).any()):
        raise InputError(f"{scene}: has no objects; label them with `ngff segment {scene} -o labelled.ply` first")
    check_output(Path(out), "scene")
    refined = refine(whole, options)
    facts = {**provenance("refine", [scene], options), **seconds_since(began), "scene": whole.provenance}
    write_scene(out, replace(refined, provenance=facts))
    psnr = object_psnr(whole, refined, device=device)
    seen = "" if psnr is None else f"; PSNR against the input in the views of the photos {psnr:.1f} dB"
    log.info("%s: %d Gaussians, from %d%s", out, len(refined.gaussians), len(whole.gaussians), seen)


def refine(scene: Scene, options: RefineOptions = RefineOptions()) -> Scene:  # noqa: B008 -- frozen
    """Remove outliers, complete objects and fill the background; Gaussians are added only where photos show none.

    A scene with objects on a wall and no floor is rotated so that the wall becomes the floor, and rotated back.
    """
    wall = find_wall(scene, view_extent(scene), options.seed)
    if wall is None:
        return _refined(scene, find_support(scene, seed=options.seed), options)
    rotated = rotate_wall_to_floor(scene, wall)
    refined = _refined(rotated, find_support(rotated, seed=options.seed), options)
    gaussians = transformed(refined.gaussians, wall.inverse())
    return replace(refined, gaussians=gaussians, cameras=scene.cameras, floor=scene.floor)


def _refined(scene: Scene, support: Support | None, options: RefineOptions) -> Scene:
    """Run the three steps for objects on `support`."""
    completer = choose(BACKENDS, "--completer", options.chosen)
    g = scene.gaussians
    stray = floaters(g, options.outliers) if options.outliers else torch.zeros(len(g), dtype=torch.bool)
    observed = ObservedSpace.of(replace(scene, gaussians=g[~stray]), pick_device(options.device))
    g, hidden = _hidden_by_objects(g[~stray], support, observed)
    scene = replace(scene, gaussians=g[~hidden])
    numbers = [i for i in scene.gaussians.object_id.unique().tolist() if i > 0]
    with tqdm(total=len(numbers), unit="object") as bar:

        def complete(i: int) -> Gaussians:
            made = completer(scene, i, observed, support, options)
            bar.update()
            return made

        added = (parallel_map if options.chosen in CONCURRENT else map)(complete, numbers)
        added = concatenate([empty_like(scene.gaussians), *added])
    added = added[observed.is_hidden(scene.gaussians, added)]
    for i in numbers:
        count = int((added.object_id == i).sum())
        log.info("  %d  %s: %d Gaussians added to its unseen sides", i, scene.name_of(i), count)
    filled = scene
    if options.background and support is not None:
        filled = fill_background(scene, observed, support, options.seed)
    new = len(filled.gaussians) - len(scene.gaussians)
    log.info("  %d outliers and %d hidden Gaussians removed, %d added to the table", int(stray.sum()),
             int(hidden.sum()), new)  # fmt: skip
    whole = replace(filled, gaussians=concatenate([filled.gaussians, added]))
    return with_raw(whole, scene) if options.keep_raw else whole


def _hidden_by_objects(
    g: Gaussians, support: Support | None, observed: ObservedSpace
) -> tuple[Gaussians, Bool[Tensor, "n"]]:
    """The Gaussians, and a mask of the unlabelled Gaussians in and next to objects that no camera sees.

    Unlabelled Gaussians that a camera sees stay unlabelled, as `segment` has cut the outlines of objects in the views.
    Without cameras visibility is unknown: then the mask is empty, and Gaussians in and next to objects get the label of
    the object.
    """
    grown = grow_objects(g, support, _growth_radius(g))
    if not observed.views:
        return grown, torch.zeros(len(g), dtype=torch.bool)
    return g, (grown.object_id != g.object_id) & (observed.weight < MAX_HIDDEN_WEIGHT)


def with_raw(whole: Scene, raw: Scene) -> Scene:
    """Add the K objects of `raw` to `whole` as objects K + 1 to 2 K, with "(raw)" appended to their names."""
    g = raw.gaussians[raw.gaussians.object_id > 0]
    count = int(g.object_id.max())
    copies = tuple(replace(o, id=o.id + count, name=f"{o.name} (raw)") for o in whole.objects)
    both = concatenate([whole.gaussians, replace(g, object_id=g.object_id + count)])
    return replace(whole, gaussians=both, objects=whole.objects + copies)


def _growth_radius(g: Gaussians) -> float:
    """Radius of region growing: 3 times the median spacing of labelled Gaussians [scene units]."""
    labelled = g.means[(g.object_id > 0) & g.means.isfinite().all(1)]
    if len(labelled) < 5:
        return 0.0
    return 3 * float(knn(labelled, labelled[:: max(1, len(labelled) // 20_000)], 4)[0][:, -1].median())
