"""The search for the parameters, over increasingly long initial segments of the track, and their uncertainty.

Over the whole track at once, collisions give the cost many local minima; the first frames depend on few parameters.
Each segment is fitted from the result of the one before, as an iterated Kalman filter does: what it does not determine
stays near its initial value, by a normal prior. Derivatives are by differences about as large as the uncertainty, in
independent directions: contacts make the motion a rough function of the parameters. Where residuals larger than the
noise remain, CMA-ES searches the region which the segments before have left. An engine need not be able to follow the
track that closely: where the search no longer gains, what remains is taken for the error of the engine, which is then
expected of longer segments and widens the uncertainty.
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
SMALLEST_ERROR = 1e-3  # of a residual [tolerances]: the accuracy of the engines
PRIOR = 1 / 12**0.5  # standard deviation of the prior: that of a uniform distribution over the range
FIRST, GROWTH = 4, 1.15  # frames of the first segment, and factor from one to the next
NEAR, FAR = (0.7, 2.0), (0.7, 2.0, 5.0)  # differences [standard deviations], in the search and for intervals
ONE_SIDED = 3.0  # ratio of the changes to both sides above which the smaller one gives a derivative
STEPS = 6  # iterations of Levenberg and Marquardt's method
PRECISION, FALL = 1e-2, 1e-3  # step [standard deviations] and relative fall of the cost at which a method ends
SPREADS = (0.5, 1.0, 0.2, 1.5)  # of CMA-ES, in turn [standard deviations]; it ends when none of them gains
GAIN = 0.05  # least relative fall of the cost that counts as one
GENERATIONS = 15  # of CMA-ES at a time
ENOUGH = 1.15, 0.0005  # cost at which a fit ends: a factor on that of the track's noise, and a constant
SMALLEST = 0.002  # standard deviation of a parameter [ranges]
SETTLING = 2  # times that the uncertainty is estimated at the end, each with differences of the size of the last
WIDER = 3.0  # factor on that of the search, from which they start: what is rough looks known by small differences
OUTCOME = 2  # simulations whose motions are compared with the track at the end: of the initial values and of the result


class OutOfTime(Exception):
    """No simulation begins any more, as its time is over or kept for others."""


def descent_simulations(parameters: int) -> int:
    """The most that `descend` makes."""
    return STEPS * (1 + 1 + 2 * parameters) + 2


def interval_simulations(parameters: int) -> int:
    """Those that `with_intervals` makes."""
    return SETTLING * (1 + 2 * len(FAR) * parameters)


def final_simulations(parameters: int) -> int:
    """The most that the end of a fit takes: the error, a descent, the intervals and the outcome."""
    return 1 + descent_simulations(parameters) + interval_simulations(parameters) + OUTCOME


class Estimate(NamedTuple):
    """Parameters and their uncertainty [ranges]."""

    x: Float[np.ndarray, "p"]
    root: Float[np.ndarray, "p p"]  # of the covariance, root @ root.T; its columns are the directions of differences

    @property
    def deviations(self) -> Float[np.ndarray, "p"]:
        """Standard deviations of the parameters, at most those of the prior."""
        return np.minimum(np.linalg.norm(self.root, axis=1), PRIOR)


class Simulations:
    """Simulates the problem at many points at once and counts them; `map` is that of a pool of processes.

    `until` is the time of `time.perf_counter` from which none begins [s]. Time for `reserved` simulations of the whole
    track is kept before, as measured on those so far, but no more than half of what there was.
    """

    def __init__(self, problem: Problem, map_: Callable, until: float = math.inf):
        self.problem, self._map, self.count = problem, map_, 0
        self.start = np.array([p.coordinate(p.start) for p in problem.parameters])
        self.until, self.reserved = until, 0
        self._half = max(0.0, until - time.perf_counter()) / 2
        self._seconds, self._frames = 0.0, 0  # of all simulations after the first ones, which wait for the processes

    def residuals(self, points: list[np.ndarray], frames: int) -> list[np.ndarray]:
        """Residuals in the first frames, at points that are moved into the ranges. Raises OutOfTime."""
        found: list[np.ndarray] = []
        self._check()  # before the pool has anything to do
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
        """Costs of the first frames."""
        part = self.problem.first_frames(frames)
        return [part.cost(residuals) for residuals in self.residuals(points, frames)]

    def cost(self, x: np.ndarray, frames: int) -> float:
        """Cost of the first frames."""
        return self.costs([x], frames)[0]

    def error(self, x: np.ndarray, frames: int) -> float:
        """Standard deviation of a residual in the first frames [tolerances], from those that remain at x."""
        return max(self.problem.first_frames(frames).error(self.residuals([x], frames)[0]), SMALLEST_ERROR)

    @property
    def noise(self) -> float:
        """Standard deviation of a residual at the true parameters [tolerances]."""
        return max(self.problem.noise_level, SMALLEST_ERROR)


_problem: Problem | None = None  # of this process


def _set_problem(problem: Problem, threads: int) -> None:
    global _problem  # noqa: PLW0603 -- pools can pass arguments to workers in no other way
    _problem = problem
    torch.set_num_threads(threads)


def _residuals(x: np.ndarray, frames: int) -> np.ndarray:
    part = _problem.first_frames(frames)
    return part.residuals(part.motion(x))


@contextmanager
def simulations(problem: Problem, workers: int, until: float = math.inf) -> Iterator[Simulations]:
    """Simulations of a problem until a time, in `workers` processes if several."""
    if workers == 1:
        _set_problem(problem, torch.get_num_threads())
        yield Simulations(problem, map, until)
        return
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _set_problem, (problem, 1)) as pool:
        yield Simulations(problem, pool.map, until)


def search(sims: Simulations, options: MaterialFitOptions) -> Estimate:
    """Fit increasingly long initial segments of the track, in the time that is not kept for the end of the fit.

    Raises MissingPackage without the package cma.
    """
    total, sims.reserved = len(sims.problem.track), final_simulations(len(sims.problem.parameters))
    known = Estimate(sims.start, np.diag([p.step for p in sims.problem.parameters]))  # before the present segment
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
            share = sims.count + 3 * (options.evaluations - sims.count) / (len(lengths) - k)  # few segments need it
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
    """The estimate with its uncertainty for an error of a residual [tolerances]. Raises OutOfTime.

    Differences are by one parameter at a time: directions of several, of which one changes the motion roughly and the
    other steadily, tell nothing about each.
    """
    deviations = WIDER * known.deviations
    for _ in tqdm(range(SETTLING), desc="intervals", unit="pass"):
        known = narrowed(sims, frames, Estimate(known.x, np.diag(np.minimum(deviations, PRIOR))), error, FAR)
        deviations = known.deviations
    return known


def descend(sims: Simulations, frames: int, known: Estimate, error: float) -> np.ndarray:
    """The minimum near `known`, by Levenberg and Marquardt's method, or `known.x` itself where the cost does not fall.

    `error` is the standard deviation of a residual [tolerances], against which the prior is weighed. Where the time
    ends, the best point so far.
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
    """The best of some generations of CMA-ES in units of the uncertainty, from `x` and from `known.x` in turn.

    Where the time ends, the best so far.
    """
    try:
        import cma  # noqa: PLC0415 -- only a fit needs it
    except ImportError as error:
        raise MissingPackage("a fit needs the package cma: `pip install 'ngff[fit]'`") from error

    size = options.workers * -(-(4 + int(3 * np.log(len(x)))) // options.workers)  # the usual one, for all workers
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
    """The estimate with the uncertainty that is left after the first frames, and the prior.

    `error` is the standard deviation of a residual [tolerances]. Keypoints of one object in one frame count as one
    observation, since their errors are not independent. Contacts make derivatives for small differences larger than
    those for large ones: along each direction the smallest for the `distances` [standard deviations] counts.
    """
    ends = [np.clip(known.x + sign * far * column, 0, 1)
            for column in known.root.T for far in distances for sign in (1, -1)]  # fmt: skip
    middle, *moved = sims.residuals([known.x, *ends], frames)
    moved = np.nan_to_num(np.array(moved) - middle).reshape(len(known.x), -1, len(middle))
    slopes = (moved[:, 0] - moved[:, 1]).T / (2 * distances[0])
    steps = np.linalg.norm(np.array(ends) - known.x, axis=1).reshape(len(known.x), -1)
    steps = steps / np.linalg.norm(known.root, axis=0)[:, None]  # shorter at the ends of the ranges
    rises = np.linalg.norm(moved, axis=2) / np.maximum(steps, 1e-9)
    least = np.where(steps > distances[0] / 2, rises, np.inf).min(1)
    slopes = slopes * np.minimum(1, least / np.maximum(np.linalg.norm(slopes, axis=0), 1e-12)) / error
    covariance = np.linalg.inv(slopes.T @ slopes + known.root.T @ known.root / PRIOR**2)
    square, directions = np.linalg.eigh(known.root @ covariance @ known.root.T)
    return Estimate(known.x, directions * np.sqrt(square.clip(0) + SMALLEST**2))


def _derivatives(sims: Simulations, frames: int, known: Estimate) -> Float[np.ndarray, "n p"]:
    """Derivatives of the residuals along the columns of the root, by differences within the ranges.

    Those to one side only are biased by the curvature of the residuals, which is large where pictures are compared: the
    search would end beside the minimum, along the parameters that trade against each other. So they are central, but
    where the motion becomes another one to one side, as after a collision that is missed, and the other side counts.
    """
    ends = [np.clip(known.x + step, 0, 1) for column in NEAR[0] * known.root.T for step in (column, -column)]
    middle, *moved = sims.residuals([known.x, *ends], frames)
    lengths = np.linalg.norm(np.array(ends) - known.x, axis=1) / np.linalg.norm(known.root, axis=0).repeat(2)
    signs = np.tile([1.0, -1.0], len(known.x))
    slopes = np.nan_to_num(np.array(moved) - middle) * (signs / np.maximum(lengths, 1e-9))[:, None]
    rises = np.where(lengths > NEAR[0] / 2, np.linalg.norm(slopes, axis=1), np.inf).reshape(-1, 2)
    weight = (rises <= ONE_SIDED * rises.min(1, keepdims=True)).astype(float).reshape(-1, 1)
    return ((weight * slopes).reshape(len(known.x), 2, -1).sum(1) / weight.reshape(-1, 2).sum(1, keepdims=True)).T
