"""Ablation of the segmentation network: retrained without one of its inputs, classes or kinds of data.

Each network is trained from scratch on the same scenes for the same number of steps, and its scores on other scenes.
The objects that it finds in a third set are compared with the true ones, surfel by surfel, before outlines are cut.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.models.segmenter.network import CANDIDATE_FEATURES, Level, Prediction, Segmenter
from stages.core.models.segmenter.segment import best_objects, score_at
from stages.core.models.segmenter.voxels import FEATURES, LAB, SCALES
from stages.core.perception.object_limits import ObjectLimits
from stages.core.scene.files import replacing
from stages.evaluate.labels import LabelOverlap, PanopticScores
from stages.lab.bench import common as bench
from stages.lab.bench.scene_options import SegmentAblationData, SegmentAblationOptions
from stages.lab.clutter.examples import Example, read_example
from stages.lab.clutter.scenes import EXACT, OBSERVED, RECONSTRUCTED
from stages.lab.names import chosen_names
from stages.lab.training.distributed import ProcessGroup
from stages.lab.training.options import SegmenterTraining
from stages.lab.training.segmenter_data import Targets, find_examples
from stages.lab.training.segmenter_scores import MIN_SURFELS, fit_scores
from stages.lab.training.train_segmenter import fit_network

log = logging.getLogger(__name__)
COLOUR_INPUTS = tuple(range(FEATURES))[LAB]
SHAPE_INPUTS = tuple(i for i in range(FEATURES) if i not in COLOUR_INPUTS)
# columns of the colour contrasts of a candidate, which precede the contrasts of the embedding
COLOUR_CONTRASTS = (CANDIDATE_FEATURES - 6, CANDIDATE_FEATURES - 5, CANDIDATE_FEATURES - 4)
TRAINING = {"score_scenes": 100, "score_steps": 3000}  # settings shared by all trainings
HEADINGS = ["without", "recall", "PQ", "SQ", "RQ", "objects", "found", "pair loss"]


class _MaskedSegmenter(Segmenter):
    """The network with some voxel inputs and some candidate features set to 0."""

    def __init__(self, inputs: Sequence[int], features: Sequence[int], widths: tuple[int, ...], blocks: int):
        super().__init__(widths, blocks)
        self.inputs, self.features = list(inputs), list(features)

    def forward(self, features: Float[Tensor, "v f"], levels: list[Level]) -> Prediction:
        """Predictions with the ablated inputs set to 0."""
        return super().forward(_without(features, self.inputs), levels)

    def score(self, features: Float[Tensor, "k f"]) -> Float[Tensor, "k"]:
        """Scores with the ablated features set to 0."""
        return super().score(_without(features, self.features))


def _without(x: Float[Tensor, "n f"], columns: Sequence[int]) -> Float[Tensor, "n f"]:
    kept = torch.ones(x.shape[1], device=x.device)
    kept[list(columns)] = 0
    return x * kept


def _clutter_as_surface(t: Targets) -> Targets:
    """Targets with two classes: clutter is relabelled as surface."""
    return replace(t, classes=torch.where(t.classes == 2, 0, t.classes))


@dataclass(frozen=True)
class Variant:
    """An ablation: what the network is trained without."""

    without: str  # description for the table
    inputs: tuple[int, ...] = ()  # columns of voxel features that are set to 0
    features: tuple[int, ...] = ()  # columns of candidate features that are set to 0
    observation: str = RECONSTRUCTED  # kind of training examples
    change: Callable[[Targets], Targets] = lambda t: t


ABLATIONS = {
    "full": Variant("nothing"),
    "colour": Variant("colour", inputs=COLOUR_INPUTS, features=COLOUR_CONTRASTS),
    "shape": Variant("normals, heights and places in the voxel (only which voxels are occupied, and colour)",
                      inputs=SHAPE_INPUTS),
    "noise": Variant("noise of reconstruction (trained on the true Gaussians of the same scenes)", observation=EXACT),
    "clutter": Variant("the class of clutter (taught as surface)", change=_clutter_as_surface),
}  # fmt: skip


def run(data: SegmentAblationData, out: Path, options: SegmentAblationOptions, only: str = "") -> Iterator[str]:
    """Train each ablation, or those named in `only` (comma-separated); yield a line for each.

    OUT receives JSON; a table is written next to it.
    """
    names = chosen_names(only, ABLATIONS)
    device = pick_device(options.device)
    facts = {"options": asdict(options), "machine": bench.machine(device), "rows": {}}
    for name in names:
        facts["rows"][name] = measured(ABLATIONS[name], data, SegmenterTraining(**TRAINING, **asdict(options)), device)
        bench.write_json(out, facts)
        with replacing(out.with_suffix(".md")) as part:
            part.write_text("\n".join(_markdown(facts)) + "\n")
        yield _row(facts["rows"][name])


def measured(choice: Variant, data: SegmentAblationData, options: SegmenterTraining, device: str) -> dict:
    """Train one ablation and evaluate it."""
    torch.manual_seed(options.seed)
    model = _MaskedSegmenter(choice.inputs, choice.features, options.widths, options.blocks).to(device).train()
    curve: list[dict] = []
    train, scores = (_examples(folders, choice.observation) for folders in (data.train, data.scores))
    for line in fit_network(model, train, options, ProcessGroup(device=device), curve, choice.change):
        log.info("%s: %s", choice.without, line)
    fit_scores(model, scores, options.score_scenes, options.score_steps, options.seed, options.workers)
    found = panoptic_scores(model.to(device).eval(), _examples(data.judge, RECONSTRUCTED)).summary()
    kept = {key: found[key] for key in ("recall", "PQ", "SQ", "RQ", "objects", "found")}
    return {"without": choice.without, **kept, "pair": curve[-1]["pair"] if curve else None, "files": len(train)}


def panoptic_scores(model: Segmenter, files: Sequence[Path]) -> PanopticScores:
    """Recall, PQ and related scores of all objects of MIN_SURFELS or more in the examples, counted in surfels."""
    overlap = LabelOverlap()
    for k, file in enumerate(tqdm(files, desc="judged", unit="scene")):
        example = read_example(file)
        truth, found = _known(example), found_objects(model, example)
        first = 10_000 * k  # offset that keeps the objects of different scenes apart
        overlap.add(*(torch.where(x > 0, first + x, 0) for x in (truth, found)), example.labels >= 0)
    return overlap.scores()


def _known(example: Example) -> Tensor:
    """True object of each surfel; 0 for none and for objects with fewer than MIN_SURFELS."""
    labels = example.labels.clamp_min(0)
    return torch.where(labels.bincount()[labels] >= MIN_SURFELS, labels, 0)


@torch.no_grad()
def found_objects(model: Segmenter, example: Example) -> Tensor:
    """Object that the network assigns to each surfel, 0 for none, before outlines are cut."""
    scored = [score_at(example.surfels, scale, model) for scale in SCALES]
    return best_objects([s.best(ObjectLimits()) for s in scored])


def _examples(folders: Sequence[Path], observation: str) -> list[Path]:
    name = OBSERVED.format(observation)
    files = [file for file in find_examples(folders) if file.name == name]
    if not files:
        raise InputError(f"{folders[0]}: no scene contains {name}; generate it with `ngff-lab clutter "
                         f"--{'exact' if observation == EXACT else 'reconstruct'}`")  # fmt: skip
    return files


def _row(row: dict) -> str:
    cells = [row["without"], *(f"{row[k]:.3f}" for k in ("recall", "PQ", "SQ", "RQ")), row["objects"], row["found"],
             row["pair"]]  # fmt: skip
    return f"| {' | '.join(map(str, cells))} |"


def _markdown(facts: dict) -> Iterator[str]:
    o = facts["options"]
    yield "# Ablation of the segmentation network"
    yield ""
    yield f"`ngff-lab bench segment-ablation`, {facts['machine']}. Each row: {o['steps']} steps of {o['batch']} crops."
    yield ""
    yield f"| {' | '.join(HEADINGS)} |"
    yield f"| {' | '.join('---' for _ in HEADINGS)} |"
    yield from map(_row, facts["rows"].values())
