"""Search for the parameters over increasingly long initial segments of the track, and estimate of their uncertainty.

Over the whole track, collisions give the cost many local minima, whereas the first frames depend on few parameters.
Each segment is fitted starting from the result of the previous one, as in an iterated Kalman filter; a normal prior
keeps parameters that a segment does not determine near their initial values. Because contacts make the motion a rough
function of the parameters, derivatives are finite differences about as large as the uncertainty, in uncorrelated
directions. If residuals larger than the noise remain, CMA-ES searches the region left by the previous segments. An
engine may be unable to reproduce the track that closely: when the search stops improving, the remaining residual is
attributed to the engine, accepted for longer segments, and added to the uncertainty.
Source: Bell and Cathey 1993, "The iterated Kalman filter update as a Gauss-Newton method"; Sarkka 2013, "Bayesian
filtering and smoothing", chapter 5 (statistical linearisation); Hansen 2016, "The CMA evolution strategy: a tutorial".
"""

from __future__ import annotations

import logging
import math
import multiprocessing
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, suppress
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import least_squares
from tqdm import tqdm

from stages.core.errors import MissingPackage
from stages.lab.fit.options import MaterialFitOptions
from stages.lab.fit.problem import Problem

log = logging.getLogger(__name__)
SMALLEST_ERROR = 1e-3  # lower bound of the standard deviation of a residual: the accuracy of the engines [tolerances]
PRIOR = 1 / 12**0.5  # standard deviation of the prior: that of a uniform distribution over the range [ranges]
FIRST, GROWTH = 4, 1.15  # length of the first segment [frames], and ratio of the lengths of successive segments
# sizes of finite differences in the search, and for intervals [standard deviations]
NEAR, FAR = (0.7, 2.0), (0.7, 2.0, 5.0)
ONE_SIDED = 3.0  # ratio of forward to backward change (or the reverse) above which only the smaller one is used
STEPS = 6  # iterations of the Levenberg-Marquardt method
PRECISION, FALL = 1e-2, 1e-3  # step [standard deviations] and relative decrease of the cost at which a method stops
SPREADS = (0.5, 1.0, 0.2, 1.5)  # initial step sizes of CMA-ES, in turn [standard deviations]; stops if all fail
GAIN = 0.05  # smallest relative decrease of the cost that counts as an improvement
GENERATIONS = 15  # generations of each CMA-ES run
ENOUGH = 1.15, 0.0005  # a fit stops at this factor times the cost of the track's noise plus this constant
SMALLEST = 0.002  # lower bound of the standard deviation of a parameter [ranges]
SETTLING = 2  # final estimates of the uncertainty, each with differences scaled by the previous estimate
# Factor on the uncertainty of the search from which the final estimates start: where the motion is a rough function of
# a parameter, small differences underestimate its uncertainty.
WIDER = 3.0
OUTCOME = 2  # final simulations compared with the track: one with the initial values, one with the result


class OutOfTime(Exception):
    """No further simulation may start: the time is over, or the rest is reserved."""


def descent_simulations(parameters: int) -> int:
    """Upper bound of the simulations that `descend` runs."""
    return STEPS * (1 + 1 + 2 * parameters) + 2


def interval_simulations(parameters: int) -> int:
    """Number of simulations that `with_intervals` runs."""
    return SETTLING * (1 + 2 * len(FAR) * parameters)


def final_simulations(parameters: int) -> int:
    """Upper bound of the simulations at the end of a fit: the error, a descent, the intervals and the outcome."""
    return 1 + descent_simulations(parameters) + interval_simulations(parameters) + OUTCOME


class Estimate(NamedTuple):
    """Parameters and their uncertainty [ranges]."""

    x: Float[np.ndarray, "p"]
    root: Float[np.ndarray, "p p"]  # the covariance is root @ root.T; finite differences are along its columns

    @property
    def deviations(self) -> Float[np.ndarray, "p"]:
        """Standard deviations of the parameters, at most that of the prior."""
        return np.minimum(np.linalg.norm(self.root, axis=1), PRIOR)


class Simulations:
    """Simulates the problem at many points in parallel and counts the simulations; `map_` is that of a process pool.

    No simulation starts after `until`, a time of `time.perf_counter` [s]. Before that, time is reserved for `reserved`
    simulations of the whole track, estimated from those so far, but at most half of the initial time.
    """

    def __init__(self, problem: Problem, map_: Callable, until: float = math.inf):
        self.problem, self._map, self.count = problem, map_, 0
        self.start = np.array([p.coordinate(p.start) for p in problem.parameters])
        self.until, self.reserved = until, 0
        self._half = max(0.0, until - time.perf_counter()) / 2
        # totals over all simulations but the first ones, whose time includes the start of the processes
        self._seconds, self._frames = 0.0, 0

    def residuals(self, points: list[np.ndarray], frames: int) -> list[np.ndarray]:
        """Residuals in the first frames, at points clamped to the ranges. Raises OutOfTime."""
        found: list[np.ndarray] = []
        self._check()  # before any work is submitted to the pool
        begun, measured = time.perf_counter(), self.count > 0
        for residuals in self._map(_residuals, [np.clip(x, 0, 1) for x in points], [frames] * len(points)):
            found.append(residuals)
            self.count += 1
            if measured:
                self._frames += frames
                self._seconds, begun = self._seconds + time.perf_counter() - begun, time.perf_counter()
            if len(found) < len(points):
                self._check()
        return found

    def _check(self) -> None:
        each = self._seconds / max(self._frames, 1) * len(self.problem.track)
        if time.perf_counter() >= self.until - min(self.reserved * each, self._half):
            raise OutOfTime

    def costs(self, points: list[np.ndarray], frames: int) -> list[float]:
        """Costs over the first frames at several points."""
        part = self.problem.first_frames(frames)
        return [part.cost(residuals) for residuals in self.residuals(points, frames)]

    def cost(self, x: np.ndarray, frames: int) -> float:
        """Cost over the first frames at one point."""
        return self.costs([x], frames)[0]

    def error(self, x: np.ndarray, frames: int) -> float:
        """Standard deviation of a residual in the first frames [tolerances], from the residuals at x."""
        return max(self.problem.first_frames(frames).error(self.residuals([x], frames)[0]), SMALLEST_ERROR)

    @property
    def noise(self) -> float:
        """Standard deviation of a residual at the true parameters [tolerances]."""
        return max(self.problem.noise_level, SMALLEST_ERROR)


_problem: Problem | None = None  # problem of this worker process


def _set_problem(problem: Problem, threads: int) -> None:
    global _problem  # noqa: PLW0603 -- pools can pass arguments to workers in no other way
    _problem = problem
    torch.set_num_threads(threads)


def _residuals(x: np.ndarray, frames: int) -> np.ndarray:
    part = _problem.first_frames(frames)
    return part.residuals(part.motion(x))


@contextmanager
def simulations(problem: Problem, workers: int, until: float = math.inf) -> Iterator[Simulations]:
    """Simulations of a problem until a time, in a pool of `workers` processes, or in this process if there is one."""
    if workers == 1:
        _set_problem(problem, torch.get_num_threads())
        yield Simulations(problem, map, until)
        return
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _set_problem, (problem, 1)) as pool:
        yield Simulations(problem, pool.map, until)


def search(sims: Simulations, options: MaterialFitOptions) -> Estimate:
    """Fit increasingly long initial segments of the track, in the time that is not reserved for the end of the fit.

    Raises MissingPackage without the package cma.
    """
    total, sims.reserved = len(sims.problem.track), final_simulations(len(sims.problem.parameters))
    known = Estimate(sims.start, np.diag([p.step for p in sims.problem.parameters]))  # result of the previous segments
    x, lengths = known.x, [min(FIRST, total)]
    while lengths[-1] < total:
        lengths.append(min(total, max(lengths[-1] + 1, int(GROWTH * lengths[-1]))))
    of_noise = enough = ENOUGH[0] * sims.problem.noise_cost + ENOUGH[1]
    with suppress(OutOfTime):
        for k, frames in enumerate(tqdm(lengths, unit="segment")):
            if sims.count > options.evaluations:
                break
            if sims.cost(x, frames) < enough:
                continue
            x = descend(sims, frames, Estimate(x, known.root), sims.noise)
            # allow three times an equal share of the evaluations, since few segments need CMA-ES
            share = sims.count + 3 * (options.evaluations - sims.count) / (len(lengths) - k)
            cost, attempt, idle = sims.cost(x, frames), 0, 0
            while cost > enough and idle < len(SPREADS) and sims.count < share:
                x = _evolve(sims, frames, x, known, attempt, options)
                before, cost = cost, sims.cost(x, frames)
                idle = 0 if cost < (1 - GAIN) * before else idle + 1
                attempt += 1
            enough = max(enough, ENOUGH[0] * cost)
            error = sims.noise if cost < of_noise else sims.error(x, frames)
            known = narrowed(sims, frames, Estimate(x, known.root), error)
            log.debug("%d frames, cost %.3g, %d motions: %s", frames, cost, sims.count, x.round(3))
    return Estimate(x, known.root)


def with_intervals(sims: Simulations, frames: int, known: Estimate, error: float) -> Estimate:
    """The estimate with its uncertainty, given the error of a residual [tolerances]. Raises OutOfTime.

    One parameter is varied at a time: along a direction that combines parameters, of which one changes the motion
    roughly and another smoothly, differences say nothing about either.
    """
    deviations = WIDER * known.deviations
    for _ in tqdm(range(SETTLING), desc="intervals", unit="pass"):
        known = narrowed(sims, frames, Estimate(known.x, np.diag(np.minimum(deviations, PRIOR))), error, FAR)
        deviations = known.deviations
    return known


def descend(sims: Simulations, frames: int, known: Estimate, error: float) -> np.ndarray:
    """The minimum near `known`, by the Levenberg-Marquardt method; `known.x` if the cost does not decrease.

    `error` is the standard deviation of a residual [tolerances], which sets the weight of the prior. Returns the best
    point so far if the time runs out.
    """
    weight, part, tried = error / PRIOR, sims.problem.first_frames(frames), [(math.inf, known.x)]

    def point(z: np.ndarray) -> np.ndarray:
        return known.x + known.root @ z

    def errors(z: np.ndarray) -> np.ndarray:
        residuals = sims.residuals([point(z)], frames)[0]
        tried.append((part.cost(residuals), np.clip(point(z), 0, 1)))
        return np.append(np.nan_to_num(residuals), weight * (point(z) - sims.start))

    def derivatives(z: np.ndarray) -> np.ndarray:
        return np.vstack([_derivatives(sims, frames, Estimate(point(z), known.root)), weight * known.root])

    try:
        found = least_squares(errors, np.zeros(len(known.x)), derivatives, max_nfev=STEPS, xtol=PRECISION, ftol=FALL)
        x = np.clip(point(found.x), 0, 1)
        before, after = sims.costs([known.x, x], frames)
    except OutOfTime:
        return min(tried, key=lambda t: t[0])[1]
    return x if after < before else known.x


def _evolve(
    sims: Simulations, frames: int, x: np.ndarray, known: Estimate, attempt: int, options: MaterialFitOptions
) -> np.ndarray:
    """The best point of a few generations of CMA-ES, with steps in units of the uncertainty.

    Even attempts start from `x`, odd ones from `known.x`. Returns the best point so far if the time runs out.
    """
    try:
        import cma  # noqa: PLC0415 -- only a fit needs it
    except ImportError as error:
        raise MissingPackage("a fit needs the package cma: `pip install 'ngff[fit]'`") from error

    # the default population size of CMA-ES, rounded up to a multiple of the workers
    size = options.workers * -(-(4 + int(3 * np.log(len(x)))) // options.workers)
    middle = known.x if attempt % 2 else x
    strategy = cma.CMAEvolutionStrategy(np.zeros(len(x)), SPREADS[attempt % len(SPREADS)], {
        "popsize": size, "seed": options.seed + attempt + 1, "verbose": -9, "maxiter": GENERATIONS, "tolx": PRECISION,
        "tolfunhist": FALL, "tolfun": FALL,
    })  # fmt: skip
    best, lowest = x, sims.costs([x], frames)[0]
    with suppress(OutOfTime):
        while not strategy.stop():
            steps = strategy.ask()
            points = [np.clip(middle + known.root @ z, 0, 1) for z in steps]
            costs = sims.costs(points, frames)
            strategy.tell(steps, costs)
            if min(costs) < lowest:
                best, lowest = points[int(np.argmin(costs))], min(costs)
    return best


def narrowed(
    sims: Simulations, frames: int, known: Estimate, error: float, distances: Sequence[float] = NEAR
) -> Estimate:
    """The estimate with the uncertainty that remains given the first frames and the prior.

    `error` is the standard deviation of a residual [tolerances]. All keypoints of an object in a frame count as one
    observation, since their errors are correlated. Contacts make derivatives larger for small differences than for
    large ones, so the smallest over the `distances` [standard deviations] is used along each direction.
    """
    ends = [np.clip(known.x + sign * far * column, 0, 1)
            for column in known.root.T for far in distances for sign in (1, -1)]  # fmt: skip
    middle, *moved = sims.residuals([known.x, *ends], frames)
    moved = np.nan_to_num(np.array(moved) - middle).reshape(len(known.x), -1, len(middle))
    slopes = (moved[:, 0] - moved[:, 1]).T / (2 * distances[0])
    steps = np.linalg.norm(np.array(ends) - known.x, axis=1).reshape(len(known.x), -1)
    steps = steps / np.linalg.norm(known.root, axis=0)[:, None]  # below `distances` where clamped to the range
    rises = np.linalg.norm(moved, axis=2) / np.maximum(steps, 1e-9)
    least = np.where(steps > distances[0] / 2, rises, np.inf).min(1)
    slopes = slopes * np.minimum(1, least / np.maximum(np.linalg.norm(slopes, axis=0), 1e-12)) / error
    covariance = np.linalg.inv(slopes.T @ slopes + known.root.T @ known.root / PRIOR**2)
    square, directions = np.linalg.eigh(known.root @ covariance @ known.root.T)
    return Estimate(known.x, directions * np.sqrt(square.clip(0) + SMALLEST**2))


def _derivatives(sims: Simulations, frames: int, known: Estimate) -> Float[np.ndarray, "n p"]:
    """Derivatives of the residuals along the columns of the root, by finite differences within the ranges.

    One-sided differences are biased by the curvature of the residuals, which is large when images are compared: the
    search would end beside the minimum, displaced along parameters that compensate each other. Differences are central,
    therefore, unless the motion changes qualitatively on one side, for example because a collision is missed; then only
    the other side is used.
    """
    ends = [np.clip(known.x + step, 0, 1) for column in NEAR[0] * known.root.T for step in (column, -column)]
    middle, *moved = sims.residuals([known.x, *ends], frames)
    lengths = np.linalg.norm(np.array(ends) - known.x, axis=1) / np.linalg.norm(known.root, axis=0).repeat(2)
    signs = np.tile([1.0, -1.0], len(known.x))
    slopes = np.nan_to_num(np.array(moved) - middle) * (signs / np.maximum(lengths, 1e-9))[:, None]
    rises = np.where(lengths > NEAR[0] / 2, np.linalg.norm(slopes, axis=1), np.inf).reshape(-1, 2)
    weight = (rises <= ONE_SIDED * rises.min(1, keepdims=True)).astype(float).reshape(-1, 1)
    return ((weight * slopes).reshape(len(known.x), 2, -1).sum(1) / weight.reshape(-1, 2).sum(1, keepdims=True)).T
