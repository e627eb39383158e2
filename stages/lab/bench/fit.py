"""Benchmark of `ngff-lab fit` on synthetic scenes with known materials, including the prediction of another motion."""

from __future__ import annotations

import json
import math
import random
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

import torch

from stages.core.backends import load, pick_device
from stages.core.physics.forces import ForcePrompts
from stages.core.physics.keypoints import bind_gaussians, choose_keypoints
from stages.core.physics.materials import Material
from stages.core.scene.trajectory import Keypoints, SimulationInfo, Trajectory
from stages.lab.bench.common import write_results
from stages.lab.bench.experiments.bodies import Run, Specimen, ball, block, cube
from stages.lab.bench.motion_options import FIT_KINDS, FitBenchOptions
from stages.lab.fit.fit import Fit, solve
from stages.lab.fit.options import MaterialFitOptions
from stages.lab.fit.parameters import AXES, QUANTITIES, as_json, fitted
from stages.lab.fit.problem import pose_problem
from stages.lab.names import chosen_names
from stages.simulate.options import AUTO, ENGINES, SimulateOptions

KEYPOINTS, STEPS = 32, 50  # per object, and per motion
REQUIRED = {"friction": 0.1, "loss": 0.1, "density": 0.15, "E": 0.5}  # target accuracy of identifiable parameters


@dataclass(frozen=True)
class FitCase:
    """Objects with their true materials, the observed motion, and another motion to be predicted."""

    name: str
    engine: str
    things: tuple[Specimen, ...]
    materials: dict[int, Material]
    seen: ForcePrompts
    other: ForcePrompts


def fit_case(index: int, kind: str, seed: int) -> FitCase:
    """A random scene of a kind: two objects that slide, fall or collide, or a soft one that falls."""
    rng = random.Random(f"{seed} {index}")
    materials = {i: Material(10 ** rng.uniform(5.3, 6.7) if kind == "soft" else 1e7, 10 ** rng.uniform(2.4, 3.1),
                             friction=rng.uniform(0.1, 0.7), loss=rng.uniform(0.05, 0.5)) for i in (1, 2)}  # fmt: skip

    def speed(low: float, high: float) -> float:
        return rng.choice([-1, 1]) * rng.uniform(low, high)

    def both(make) -> ForcePrompts:
        (v1, h1), (v2, h2) = make(), make()
        return ForcePrompts(velocity={1: v1, 2: v2}, lift={i: h for i, h in ((1, h1), (2, h2)) if h})

    if kind == "slide":
        things = (block((0.3, 0.2, 0.1), (0, 0, 0.05)), block((0.2, 0.2, 0.08), (0, 5, 0.04)))
        motions = [both(lambda: ((speed(1, 2), speed(0, 1), 0.0), 0.0)) for _ in range(2)]
    elif kind == "bounce":
        things = (ball(0.1, (0, 0, 0.1)), cube(0.2, 3))
        motions = [both(lambda: ((speed(0, 1), speed(0, 1), 0.0), rng.uniform(0.1, 0.5))) for _ in range(2)]
    elif kind == "collision":
        things = (cube(0.2, 0), cube(0.16, -0.5))
        motions = [ForcePrompts(velocity={2: (rng.uniform(1.8, 3), 0.0, 0.0)}) for _ in range(2)]
    else:
        things, materials = (cube(0.3, 0),), {1: materials[1]}
        motions = [ForcePrompts(velocity={1: (speed(0, 1), speed(0, 1), 0.0)}, lift={1: rng.uniform(0.2, 0.5)})
                   for _ in range(2)]  # fmt: skip
    return FitCase(f"{kind} {index}", "ngff" if kind == "soft" else "rigid", things, materials, *motions)


def measure(case: FitCase, options: FitBenchOptions) -> dict:
    """Errors of the parameters, and of another motion predicted with fitted and with default materials."""
    scene = Run(case.things).scene()
    keypoints = choose_keypoints(scene, KEYPOINTS)
    contact = "learned" if case.engine == "ngff" else AUTO
    simulate = SimulateOptions(engine=case.engine, contact=contact, quality="draft", steps=STEPS, keypoints=KEYPOINTS,
                               device=options.device)  # fmt: skip
    rng = torch.Generator().manual_seed(options.seed)
    true = replace(simulate, engine=options.truth, contact=AUTO) if options.truth else simulate
    x = _motion(scene, keypoints, case.seen, case.materials, true)
    truth = Trajectory(scene, SimulationInfo(simulate.dt, (0.0, 0.0, -simulate.gravity), true.engine), keypoints,
                       bind_gaussians(scene, keypoints), x + options.noise * torch.randn(x.shape, generator=rng),
                       torch.zeros(STEPS, len(case.things), 3), torch.zeros(STEPS, len(case.things), 4),
                       Path())  # fmt: skip
    fit_options = MaterialFitOptions(engine=case.engine, keypoints=KEYPOINTS, evaluations=options.evaluations,
                             minutes=options.minutes, workers=options.workers, device=options.device)  # fmt: skip
    fit = solve(pose_problem(scene, truth, replace(case.seen, velocity={}), fit_options), fit_options)
    found, _ = fitted(fit.problem.parameters, fit.accepted, fit.problem.materials)
    other = _motion(scene, keypoints, case.other, case.materials, true)
    rmse = [float((_motion(scene, keypoints, case.other, m, simulate) - other).square().sum(-1).mean().sqrt())
            for m in (fit.problem.materials, found)]  # fmt: skip
    return {"rows": errors_of(fit, case), "default_rmse": rmse[0], "fitted_rmse": rmse[1], "fit_rmse": fit.rmse[1],
            "motions": fit.evaluations, "seconds": round(fit.seconds, 1)}  # fmt: skip


def _motion(scene, keypoints: Keypoints, prompts: ForcePrompts, materials: dict[int, Material], options):
    """Keypoint positions simulated by an engine."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "materials.json"
        file.write_text(json.dumps({str(i): as_json(m) for i, m in materials.items()}))
        states = load(ENGINES[options.engine].rollout)(scene, keypoints, prompts, replace(options, materials=file))
        return torch.stack([state.positions for state in states])


def errors_of(fit: Fit, case: FitCase) -> list[dict]:
    """Error, half width and identifiability of each fitted material constant.

    Density and stiffness are compared as ratios to the density of the first object, which is not fitted: the motion
    does not depend on a common factor.
    """
    ratio = fit.problem.materials[1].density / case.materials[1].density
    rows = []
    for k, p in enumerate(fit.problem.parameters):
        if p.name in AXES:
            continue
        true = getattr(case.materials[p.object_id], p.name) * (ratio if p.name in ("density", "E") else 1.0)
        true = math.log10(true) if QUANTITIES[p.name].log else true
        rows.append({"object": p.object_id, "quantity": p.name, "identifiable": fit.is_identifiable(k), "true": true,
                     "error": fit.value(k) - true, "half_width": fit.half_width(k)})  # fmt: skip
    return rows


def run(out: Path | None, options: FitBenchOptions) -> Iterator[str]:
    """Yield the lines of a table of all scenes; `out` receives the results as JSON."""
    device, results = pick_device(options.device), {}
    kinds = chosen_names(options.only, FIT_KINDS)
    yield f"{'scene':<14} identifiable: error +- half width of its interval"
    for index in range(options.scenes):
        case = fit_case(index, kinds[index % len(kinds)], options.seed)
        results[case.name] = row = measure(case, options)
        found = ", ".join(f"{r['quantity']}{r['object']} {r['error']:+.3f} +- {r['half_width']:.3f}"
                          for r in row["rows"] if r["identifiable"])  # fmt: skip
        yield (f"{case.name:<14} {found or 'nothing'}; another motion: RMSE {row['default_rmse']:.3f} by default, "
               f"{row['fitted_rmse']:.3f} fitted; {row['motions']} motions, {row['seconds']:.0f} s")  # fmt: skip
        write_results(out, "fit", device, {"noise": options.noise, "scenes": results})
    yield from ["", *summary(results)]


def summary(results: dict[str, dict]) -> list[str]:
    """A line for each quantity, and one for the predictions."""
    lines, rows = [], [r for row in results.values() for r in row["rows"]]
    for name, required in REQUIRED.items():
        mine = [r for r in rows if r["quantity"] == name]
        errors = [abs(r["error"]) for r in mine if r["identifiable"]]
        if errors:
            lines.append(
                f"{name}: {len(errors)} of {len(mine)} identifiable, median error {median(errors):.3f}, "
                f"largest {max(errors):.3f}; {sum(e <= required for e in errors)} within {required}"
            )  # fmt: skip
    gains = [row["fitted_rmse"] / max(row["default_rmse"], 1e-9) for row in results.values()]
    halved = sum(g <= 0.5 for g in gains)
    return [*lines, f"another motion: RMSE over that by default {median(gains):.2f} (median), {halved} of "
            f"{len(gains)} halved"]  # fmt: skip
