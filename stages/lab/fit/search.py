"""The search for the parameters, over increasingly long initial segments of the track, and their intervals.

Over the whole track at once, collisions give the cost many local minima; the first frames depend on few parameters.
Each segment is fitted from the result of the one before: by Levenberg and Marquardt's method and, where residuals
larger than the noise remain, by CMA-ES, which samples the parameters that the segment hardly determines over their
whole range.
Source of CMA-ES: Hansen 2016, "The CMA evolution strategy: a tutorial".
"""

from __future__ import annotations

import logging
import multiprocessing
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import least_squares
from tqdm import tqdm

from stages.core.errors import MissingPackage
from stages.lab.fit.options import MaterialFitOptions
from stages.lab.fit.problem import Problem

log = logging.getLogger(__name__)
PRIOR = 1 / 12**0.5  # standard deviation of a uniform distribution over the range
FIRST, GROWTH = 8, 1.25  # frames of the first segment, and factor from one to the next
STEP, STEPS = 0.004, 10  # differences [ranges] and iterations of Levenberg and Marquardt's method
REGULARISATION = 0.01  # weight of the distance from the start, for parameters that a segment does not determine
PRECISION, FALL = 1e-3, 1e-3  # of CMA-ES: step [ranges] and change of the cost at which it ends
GENERATIONS = 15  # of CMA-ES for a segment
ENOUGH = 1.3, 0.0005  # cost at which a fit ends: a factor on that of the track's noise, and a constant
SPANS = 0.01, (0.002, 0.1), 0.2  # first, second (bounds) and large differences for intervals [ranges]


class Found(NamedTuple):
    """The best point of a search."""

    x: np.ndarray
    motions: int
    seconds: float


class Simulations:
    """Simulates the problem at many points at once and counts them; `map` is that of a pool of processes."""

    def __init__(self, problem: Problem, map_: Callable):
        self.problem, self._map, self.count = problem, map_, 0

    def motions(self, points: list[np.ndarray], frames: int) -> list[torch.Tensor]:
        """Keypoints in the first frames."""
        self.count += len(points)
        return list(self._map(_motion, points, [frames] * len(points)))

    def costs(self, points: list[np.ndarray], frames: int) -> list[float]:
        """Costs of the first frames."""
        part = self.problem.first_frames(frames)
        return [part.cost(motion) for motion in self.motions(points, frames)]


_problem: Problem | None = None  # of this process


def _set_problem(problem: Problem, threads: int) -> None:
    global _problem  # noqa: PLW0603 -- pools can pass arguments to workers in no other way
    _problem = problem
    torch.set_num_threads(threads)


def _motion(x: np.ndarray, frames: int) -> torch.Tensor:
    return _problem.first_frames(frames).motion(x)


@contextmanager
def simulations(problem: Problem, workers: int) -> Iterator[Simulations]:
    """Simulations of a problem, in `workers` processes if several."""
    if workers == 1:
        _set_problem(problem, torch.get_num_threads())
        yield Simulations(problem, map)
        return
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _set_problem, (problem, 1)) as pool:
        yield Simulations(problem, pool.map)


def search(sims: Simulations, options: MaterialFitOptions) -> Found:
    """Fit increasingly long initial segments of the track. Raises MissingPackage without the package cma."""
    begun, total = time.perf_counter(), len(sims.problem.track)
    x = np.array([p.coordinate(p.start) for p in sims.problem.parameters])
    lengths = [min(FIRST, total)]
    while lengths[-1] < total:
        lengths.append(min(total, int(GROWTH * lengths[-1])))
    for frames in tqdm(lengths, unit="segment"):
        left = 60 * options.minutes - (time.perf_counter() - begun)
        if left <= 0 or sims.count > options.evaluations:
            break
        if not _within_noise(sims, frames, x):
            x = _descend(sims, frames, x)
        if not _within_noise(sims, frames, x):
            x = _descend(sims, frames, _evolve(sims, frames, x, left, options))
        log.debug("%d frames, cost %.3g, %d motions: %s", frames, sims.costs([x], frames)[0], sims.count, x.round(3))
    return Found(_descend(sims, frames, x), sims.count, time.perf_counter() - begun)


def _within_noise(sims: Simulations, frames: int, x: np.ndarray) -> bool:
    """Whether the residual is about the noise of the track."""
    expected = torch.log1p(3 * (sims.problem.noise / sims.problem.tolerance) ** 2).mean()
    return sims.costs([x], frames)[0] < ENOUGH[0] * float(expected) + ENOUGH[1]


def _descend(sims: Simulations, frames: int, x: np.ndarray) -> np.ndarray:
    """The minimum near `x`, by Levenberg and Marquardt's method with derivatives by differences, or `x` itself."""
    part, start = sims.problem.first_frames(frames), x
    damping = REGULARISATION * np.eye(len(x))

    def errors(x: np.ndarray) -> np.ndarray:
        return np.append(part.weighted(sims.motions([x], frames)[0] - part.track), REGULARISATION * (x - start))

    found = least_squares(
        errors, np.clip(x, 1e-6, 1 - 1e-6), lambda x: np.vstack([_derivatives(sims, frames, x, STEP), damping]),
        bounds=(0, 1), max_nfev=STEPS, xtol=PRECISION / 10, ftol=FALL,
    )  # fmt: skip
    before, after = sims.costs([x, found.x], frames)
    return found.x if after < before else x


def _evolve(sims: Simulations, frames: int, x: np.ndarray, seconds: float, options: MaterialFitOptions) -> np.ndarray:
    """The best of some generations of CMA-ES, whose initial spread is the uncertainty after the segment."""
    try:
        import cma  # noqa: PLC0415 -- only a fit needs it
    except ImportError as error:
        raise MissingPackage("a fit needs the package cma, which is not installed; `pip install cma`") from error

    until = time.perf_counter() + seconds
    size = options.workers * -(-(4 + int(3 * np.log(len(x)))) // options.workers)  # the usual one, for all workers
    spread = np.maximum(deviations(sims, frames, x, 1.0), 0.02)
    strategy = cma.CMAEvolutionStrategy(x, 1.0, {
        "CMA_stds": spread.tolist(), "bounds": [0, 1], "popsize": size, "seed": options.seed + 1, "verbose": -9,
        "maxiter": GENERATIONS, "tolx": PRECISION, "tolfunhist": FALL, "tolfun": FALL,
    })  # fmt: skip
    best, lowest = x, sims.costs([x], frames)[0]
    while not strategy.stop() and time.perf_counter() < until and sims.count < options.evaluations:
        points = strategy.ask()
        costs = sims.costs(points, frames)
        strategy.tell(points, costs)
        if min(costs) < lowest:
            best, lowest = np.array(points[int(np.argmin(costs))]), min(costs)
    return best


def deviations(sims: Simulations, frames: int, x: np.ndarray, error: float) -> np.ndarray:
    """Standard deviations of the parameters at `x` [ranges], by the curvature of the squared error (Gauss and Newton).

    `error` is the standard deviation of a coordinate [tolerances]. Keypoints of one object in one frame count as one
    observation, since their errors are not independent; the ranges count as a prior. Near a contact,
    the derivatives for small differences may be larger than those for large ones; the deviation is increased by that
    ratio.
    """
    step = np.full(len(x), SPANS[0])
    for _ in range(2):
        near = _derivatives(sims, frames, x, step) / error
        deviation = np.sqrt(np.diag(np.linalg.inv(near.T @ near + np.eye(len(x)) / PRIOR**2)))
        step = np.clip(2 * deviation, *SPANS[1])
    far = _derivatives(sims, frames, x, SPANS[2]) / error
    weaker = np.linalg.norm(near, axis=0) / np.maximum(np.linalg.norm(far, axis=0), 1e-12)
    return np.minimum(deviation * np.maximum(weaker, 1.0), PRIOR)


def _derivatives(sims: Simulations, frames: int, x: np.ndarray, step: np.ndarray | float) -> np.ndarray:
    """Derivatives of the weighted coordinates by each parameter, central where the range allows it."""
    ends = [np.clip(x + sign * step * unit, 0, 1) for unit in np.eye(len(x)) for sign in (1, -1)]
    moved = sims.motions(ends, frames)
    spans = [float((a - b).sum()) for a, b in zip(ends[::2], ends[1::2], strict=True)]
    columns = [sims.problem.weighted((a - b) / span) for a, b, span in zip(moved[::2], moved[1::2], spans, strict=True)]
    return np.stack(columns, 1)
