"""Catalogue of all experiments, in the order of the report."""

from collections.abc import Mapping
from functools import cache
from types import MappingProxyType

from stages.lab.bench.experiments.experiment import Experiment
from stages.lab.bench.experiments.friction import (
    compound_slides,
    creep,
    grooves,
    ladders,
    levers,
    rocking,
    rolls,
    slides,
    slopes,
    wedges,
)
from stages.lab.bench.experiments.impacts import bounces, collisions, falls, invariance, rebounds, torques, tumbling
from stages.lab.bench.experiments.stacks import arches, boxes, piles, stacks, towers


@cache
def experiments() -> Mapping[str, Experiment]:
    """All experiments by name."""
    groups = (slides, compound_slides, wedges, slopes, rolls, grooves, rocking, ladders, levers, creep, falls, torques,
              tumbling, towers, invariance, collisions, rebounds, bounces, stacks, arches, piles, boxes)  # fmt: skip
    return MappingProxyType({e.name: e for group in groups for e in group()})
