"""An experiment: scenes, what is measured in them, its analytic value, and the error allowed to each engine.

Tolerances are relative to `scale`: what the engines are required to reach, not what they do.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from stages.lab.bench.experiments.bodies import Run

G = 9.81
TOLERANCES = {"rigid": 0.05, "mpm": 0.1, "ngff": 0.1}
SLIDES = TOLERANCES | {"ngff": 0.15}
GAPS = {"rigid": (-0.03, 0.05), "mpm": (-0.1, 0.1), "ngff": (-0.03, 0.05)}  # penetration, gap in heights


@dataclass(frozen=True)
class Experiment:
    """Runs, what is measured in their trajectories, and the value that theory gives."""

    name: str  # group/case
    runs: tuple[Run, ...]
    measure: Callable[..., float]  # of the trajectories of the runs
    value: float
    what: str  # name and unit of what is measured
    scale: float  # error that counts as 1
    tolerance: Mapping  # by engine: largest error, or lowest and highest

    def passes(self, engine: str, measured: float) -> bool:
        """Whether a value agrees with theory within the tolerance of the engine."""
        allowed = self.tolerance[engine]
        low, high = allowed if isinstance(allowed, tuple) else (-allowed, allowed)
        return low <= (measured - self.value) / self.scale <= high
