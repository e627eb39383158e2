"""`ngff-lab fit`: scene.ply and a track or films -> materials.json."""

from __future__ import annotations

import json
import logging
import math
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stages.core.errors import InputError
from stages.core.scene.files import check_json_output, provenance, replacing
from stages.core.scene.formats import format_of
from stages.lab.fit.film import read_film_problem
from stages.lab.fit.options import MaterialFitOptions
from stages.lab.fit.parameters import AXES, QUANTITIES, Parameter, as_json, fitted
from stages.lab.fit.problem import Problem, read_problem
from stages.lab.fit.search import (
    OUTCOME,
    Estimate,
    OutOfTime,
    Simulations,
    descend,
    descent_simulations,
    final_simulations,
    search,
    simulations,
    with_intervals,
)
from stages.simulate.options import SimulateOptions

log = logging.getLogger(__name__)
PROBABLE = 1.0  # squared Mahalanobis distance from the estimate up to which initial values are kept


@dataclass(frozen=True)
class Fit:
    """Parameters fitted to a track, and their uncertainty."""

    problem: Problem
    found: Estimate  # the most probable point
    accepted: np.ndarray  # the same, with initial values where the motion does not determine a parameter [ranges]
    rmse: tuple[float, float]  # RMSE of the motion before and after the fit [unit of the problem]
    evaluations: int
    seconds: float
    determined: bool = True  # whether intervals were computed before the time ran out

    @property
    def half(self) -> np.ndarray:
        """Half widths of the 95 % intervals [ranges]; infinite if the intervals were not determined."""
        return 1.96 * self.found.deviations if self.determined else np.full(len(self.found.x), np.inf)

    def value(self, k: int) -> float:
        """Value of the k-th parameter; its log10 if the search is logarithmic."""
        return self.problem.parameters[k].value(float(self.found.x[k]))

    def half_width(self, k: int) -> float | None:
        """Half width of the 95 % interval of the k-th parameter; None if it was not determined."""
        p = self.problem.parameters[k]
        return float(self.half[k]) * (p.high - p.low) if self.determined else None

    def is_identifiable(self, k: int) -> bool:
        """Whether the motion determines the k-th parameter accurately enough."""
        name = self.problem.parameters[k].name
        return self.determined and (name in AXES or self.half_width(k) <= QUANTITIES[name].max_half_width)


def run(scene: Path, motion: Sequence[Path], out: Path, options: MaterialFitOptions) -> list[str]:
    """Write OUT for `ngff simulate --materials OUT`, and intervals to OUT with the suffix .fit.json; return a summary.

    `motion` is one trajectory, or films. Raises InputError if the motion does not match the scene, and MissingPackage
    without the package cma.
    """
    until = time.perf_counter() + 60 * options.minutes
    check_json_output(out)
    kinds = [format_of(path, "trajectory", "video").kind for path in motion]
    if kinds.count("trajectory") and len(kinds) > 1:
        raise InputError(
            f"{motion[kinds.index('trajectory')]}: a track cannot be combined with other tracks or "
            "films; give one track, or only films"
        )
    if options.align and kinds != ["trajectory"]:
        raise InputError("--align: films are of the scene's own cameras; only a track can be aligned with it")
    if kinds == ["trajectory"]:
        problem = read_problem(scene, motion[0], options)
    else:
        problem = read_film_problem(scene, motion, options)
    fit = solve(problem, options, until)
    materials, velocity = fitted(fit.problem.parameters, fit.accepted, fit.problem.materials)
    names = {o.id: o.name for o in fit.problem.scene.objects}
    with replacing(out) as part:
        part.write_text(json.dumps({str(i): as_json(materials[i]) for i in names}, indent=1) + "\n")
    rows = [{"object": p.object_id, "name": names[p.object_id], "quantity": p.name, "log10": _is_log(p),
             "value": fit.value(k), "half_width": fit.half_width(k), "identifiable": fit.is_identifiable(k)}
            for k, p in enumerate(fit.problem.parameters)]  # fmt: skip
    facts = {**provenance("fit", [scene, *motion], options), "engine": fit.problem.options.engine, "parameters": rows,
             "velocity": velocity, "rmse_before": fit.rmse[0], "rmse": fit.rmse[1], "rmse_unit": fit.problem.unit,
             "evaluations": fit.evaluations, "seconds": round(fit.seconds, 1)}  # fmt: skip
    with replacing(out.with_suffix(".fit.json")) as part:
        part.write_text(json.dumps(facts, indent=1) + "\n")
    return [*describe(fit), _command(scene, out, fit, velocity)]


def solve(problem: Problem, options: MaterialFitOptions, until: float | None = None) -> Fit:
    """Search for the parameters, and estimate how accurately the motion determines them.

    The track is fitted first. For films, which were tracked to obtain it, images are compared from that result on. No
    simulation starts after `until`, a time of `time.perf_counter` (default: --minutes from now), except the two that
    measure the outcome.
    """
    log.info("fitting %d parameters of %d objects with --engine %s to %d "
             "frames", len(problem.parameters), len(problem.moving),
             problem.options.engine, len(problem.track))  # fmt: skip
    begun = time.perf_counter()
    until = begun + 60 * options.minutes if until is None else until
    with simulations(problem.tracked, options.workers, until - _kept(problem, until - begun)) as sims:
        fit = _settled(sims, search(sims, options))
    found, count = fit.found, fit.evaluations
    for level in problem.levels:
        with simulations(level, options.workers, until) as sims:
            sims.reserved = final_simulations(len(problem.parameters))
            found = found._replace(x=descend(sims, len(problem.track), found, sims.noise))
            if level is problem:
                fit = _settled(sims, found)
            count += sims.count
    return replace(fit, evaluations=count, seconds=time.perf_counter() - begun)


def _kept(problem: Problem, left: float) -> float:
    """Time reserved for comparing images, based on timing one simulation, at most half of the remaining time [s]."""
    if not problem.levels or left <= 0:
        return 0.0
    begun, parameters = time.perf_counter(), problem.parameters
    problem.residuals(problem.motion([p.coordinate(p.start) for p in parameters]))
    count = len(problem.levels) * descent_simulations(len(parameters)) + final_simulations(len(parameters))
    return min(count * (time.perf_counter() - begun), left / 2)


def _settled(sims: Simulations, found: Estimate) -> Fit:
    """The fit refined from an estimate, with its uncertainty if time permits."""
    problem, frames, determined = sims.problem, len(sims.problem.track), False
    sims.reserved = OUTCOME
    with suppress(OutOfTime):
        error = sims.error(found.x, frames)
        found = found._replace(x=descend(sims, frames, found, error))
        found, determined = with_intervals(sims, frames, found, error), True
    sims.until = math.inf
    before, after = (problem.rmse(r) for r in sims.residuals([sims.start, found.x], frames))
    fit = Fit(problem, found, found.x, (before, after), sims.count, 0.0, determined)
    if not determined:
        return fit
    unknown = [k for k in np.argsort(-fit.half) if not fit.is_identifiable(k)]
    return replace(fit, accepted=with_initial(found, sims.start, unknown))


def with_initial(found: Estimate, start: np.ndarray, unknown: Sequence[int]) -> np.ndarray:
    """The estimate's point, with `unknown` parameters reset to their initial values where those are probable.

    The other parameters take their most probable values given the reset ones, so that the joint effect of parameters
    that only act together is preserved.
    """
    covariance, accepted = found.root @ found.root.T, found.x
    reset: list[int] = []
    for k in unknown:
        rows = [*reset, k]
        change = start[rows] - found.x[rows]
        weighed = np.linalg.solve(covariance[np.ix_(rows, rows)], change)
        if float(change @ weighed) < PROBABLE:
            reset, accepted = rows, np.clip(found.x + covariance[:, rows] @ weighed, 0, 1)
            accepted[rows] = start[rows]
    return accepted


def describe(fit: Fit) -> list[str]:
    """One line for each object, and one for the whole fit."""
    names = {o.id: o.name for o in fit.problem.scene.objects}
    lines = []
    for i in fit.problem.moving:
        found, unknown = [], []
        for k, p in enumerate(fit.problem.parameters):
            if p.object_id == i:
                (found if fit.is_identifiable(k) else unknown).append(_text(fit, k, p))
        if not fit.determined:
            lines.append(f"object {i} ({names[i]}): {', '.join(unknown)}; intervals not determined within --minutes")
            continue
        line = f"object {i} ({names[i]}): {', '.join(found) or 'nothing is identifiable from the motion'}"
        lines.append(line + (f"; not identifiable from the motion: {', '.join(unknown)}" if unknown else ""))
    lines.append(f"RMSE {fit.rmse[0]:.3g} before, {fit.rmse[1]:.3g} after [{fit.problem.unit}]; {fit.evaluations} "
                 f"motions in {fit.seconds:.0f} s")  # fmt: skip
    return lines


def _is_log(p: Parameter) -> bool:
    return p.name in QUANTITIES and QUANTITIES[p.name].log


def _text(fit: Fit, k: int, p: Parameter) -> str:
    name = f"velocity {p.name}" if p.name in AXES else f"log10 {p.name}" if _is_log(p) else p.name
    half = fit.half_width(k)
    return f"{name} {fit.value(k):.3g}" + (f" +- {half:.2g}" if half is not None else "")


def _command(scene: Path, out: Path, fit: Fit, velocity: dict) -> str:
    """The command line that reproduces the motion."""
    options = fit.problem.options
    contact, rest = ["--contact learned"] * (options.engine == "ngff"), ["--no-rest"] * (not options.rest)
    gravity = [f"--gravity {options.gravity:.4g}"] * (f"{options.gravity:.4g}" != f"{SimulateOptions.gravity:.4g}")
    words = [f"--engine {options.engine}", *contact, *rest, *gravity, f"--materials {out}"]
    words += [f'--velocity "object={i} {",".join(f"{c:.4g}" for c in v)}"' for i, v in velocity.items()]
    words += [f"--lift {i}={height:.4g}" for i, height in fit.problem.prompts.lift.items()]
    return f"ngff simulate {scene} {' '.join(words)}"
