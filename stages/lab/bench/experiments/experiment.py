"""Definition of an experiment: scenes, measured quantity, analytic value, and the error allowed for each engine.

Tolerances are relative to `scale`. They state what is required of the engines, not what they achieve.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from stages.lab.bench.experiments.bodies import Run

G = 9.81  # gravitational acceleration [m/s^2]
TOLERANCES = {"rigid": 0.05, "mpm": 0.1, "ngff": 0.1}  # default relative errors allowed
SLIDES = TOLERANCES | {"ngff": 0.15}  # errors allowed for slides
GAPS = {"rigid": (-0.03, 0.05), "mpm": (-0.1, 0.1), "ngff": (-0.03, 0.05)}  # largest penetration and gap [heights]


@dataclass(frozen=True)
class Experiment:
    """Simulation runs, what is measured in their trajectories, and the value predicted by theory."""

    name: str  # group/case
    runs: tuple[Run, ...]
    measure: Callable[..., float]  # function of the trajectories of the runs
    value: float  # analytic
    what: str  # value predicted by theory
    scale: float  # error that counts as 1
    tolerance: Mapping  # for each engine: largest error, or lowest and highest signed error

    def passes(self, engine: str, measured: float) -> bool:
        """Whether a value agrees with theory within the tolerance of the engine."""
        allowed = self.tolerance[engine]
        low, high = allowed if isinstance(allowed, tuple) else (-allowed, allowed)
        return low <= (measured - self.value) / self.scale <= high
