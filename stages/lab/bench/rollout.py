"""Benchmark of rollout time: our force field, compared with the published model and MPM in the same run.

Ellipsoids in stacks of three fall onto each other and onto the floor for 100 steps of 0.02 s. The time covers all work
from the keypoints of a new scene at rest to its keypoints in every frame: precomputation, contact search, networks and
integration, but not skinning of Gaussians. The operations of the networks are given as a fraction of the rate of a
float32 matrix product. Recording a CUDA graph, once per model and problem size, is reported separately.
"""

from __future__ import annotations

import copy
import json
import time
from collections.abc import Callable, Iterator
from datetime import datetime, timezone
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from stages.core.backends import pick_device
from stages.core.models import checkpoints
from stages.core.models.dynamics import FRAME, Dynamics
from stages.core.models.initial_conditions import InitialConditions
from stages.core.models.rollout import TimeStepper, record_frames
from stages.lab.bench import common as bench
from stages.lab.bench import mpm as bench_mpm
from stages.lab.bench.speed_options import RolloutBenchOptions

PILE, PILE_WIDTH = 3, 0.7  # objects in a stack, and distance between stacks [m]
PEER = "ngff-paper, step by step"  # the baseline, as published


def ellipsoids(scenes: int, keypoints: int, objects: int = PILE) -> InitialConditions:
    """Copies of one scene of ellipsoidal shells, stacked in threes above the floor in a row."""
    rng = torch.Generator().manual_seed(0)
    ball = torch.nn.functional.normalize(torch.randn(objects, keypoints, 3, generator=rng), dim=-1)
    offsets = torch.tensor([[0.0, 0.0, -0.7], [0.1, 0.05, -0.35], [-0.1, 0.0, 0.02]])
    mass, E = torch.tensor([0.5, 2.0, 1.0]), torch.tensor([1e5, 1e4, 8e5])
    number = torch.arange(objects)
    pile, place = number // PILE, number % PILE
    at = offsets[place] + PILE_WIDTH * pile[:, None] * torch.tensor([1.0, 0.0, 0.0])
    points, mass, E = ball * torch.tensor([0.25, 0.2, 0.15]) + at[:, None], mass[place], E[place]
    return InitialConditions.of(points.repeat(scenes, 1, 1, 1), mass=mass, E=E)


def run(out: Path, options: RolloutBenchOptions) -> Iterator[str]:
    """Yield the lines of the report; results go to the JSON file `out`, which keeps those of other devices."""
    device = pick_device(options.device)
    model, card = checkpoints.load(checkpoints.find("ngff", options.weights), device)
    torch.manual_seed(0)
    paper = checkpoints.build("ngff-paper").to(device).eval()  # untrained, which does not change the time of a step
    yield bench.machine(device)
    facts = {
        "machine": bench.machine(device), "threads": torch.get_num_threads(),
        "date": datetime.now(timezone.utc).date().isoformat(), "weights": card["sha256"], "objects": options.objects,
        "keypoints": options.keypoints, "steps": options.steps, "rows": [],
    }  # fmt: skip
    rate, out = bench.float32_rate(device), Path(out)
    facts |= {"float32_rate": rate, "operations": _operations(model, options, device)}
    yield f"float32 matrix product {rate / 1e12:.3g} TFLOP/s"
    known = json.loads(out.read_text()) if out.is_file() else {}
    for scenes in options.scenes or ((1, 64) if device != "cpu" else (1,)):
        group = list(_measured(model, paper, scenes, device, options))
        for row in (r for r in group if r["what"].startswith("ngff, ")):
            row["arithmetic"] = _rounded(facts["operations"] * scenes / row["seconds"] / rate)
        yield from table(group)
        facts["rows"] += group
        bench.write_json(out, {**known, device.partition(":")[0]: facts})


def _measured(
    model: Dynamics, paper: Dynamics, scenes: int, device: str, options: RolloutBenchOptions
) -> Iterator[dict]:
    """A row for each model and method of rolling out a batch of scenes."""
    start, count = ellipsoids(scenes, options.keypoints, options.objects).to(device), options.steps + 1
    plain = rollout_stepwise(model, start, count)
    yield _row("ngff, step by step", scenes, lambda: rollout_stepwise(model, start, count), device, options.repeat)
    for precision in ("highest", "high") if device != "cpu" else ():  # FP32 or TF32 matrix products
        torch.set_float32_matmul_precision(precision)
        began = time.perf_counter()
        stepper = TimeStepper(model, start)
        _again(stepper, start, 2)  # captures both CUDA graphs
        ready = time.perf_counter() - began
        name = f"ngff, {'in tf32, ' * (precision == 'high')}replayed"
        yield {
            **_row(name, scenes, lambda s=stepper: _again(s, start, count), device, options.repeat),
            "ready_seconds": round(ready, 2),
            "prepare_seconds": _rounded(bench.median_seconds(lambda s=stepper: s.restart(start), device)),
            "strays_m": float((_again(stepper, start, count) - plain).abs().max()),
        }  # fmt: skip
        del stepper
    torch.set_float32_matmul_precision("highest")
    yield _row(PEER, scenes, lambda: rollout_stepwise(paper, start, count), device, options.repeat)
    if device != "cpu":
        stepper = TimeStepper(paper, start)
        yield _row("ngff-paper, replayed", scenes, lambda: _again(stepper, start, count), device, options.repeat)
    particles = options.objects * options.keypoints
    mpm = bench_mpm.measure(particles, scenes, device, 2)
    seconds = 1e-6 * mpm["substep_us"] * bench_mpm.SUBSTEPS * options.steps
    yield {"what": f"MPM, {mpm['particles']:,} particles", "scenes": scenes, "seconds": _rounded(seconds)}


def _operations(model: Dynamics, options: RolloutBenchOptions, device: str) -> int:
    """Operations of the matrix products in a rollout of one scene.

    Autograd is enabled because it disables the fused kernels, whose operations PyTorch does not count. No parameter
    requires a gradient, so no autograd graph is kept.
    """
    model, start = (
        copy.deepcopy(model).requires_grad_(False),
        ellipsoids(1, options.keypoints, options.objects).to(device),
    )
    with FlopCounterMode(display=False) as counter, torch.enable_grad():
        model.rollout(start, options.steps + 1, FRAME)
    return counter.get_total_flops()


@torch.no_grad()
def rollout_stepwise(model: Dynamics, start: InitialConditions, count: int) -> Float[Tensor, "b t o n 3"]:
    """A rollout step by step, without a CUDA graph [m]."""
    return model.rollout(start, count, FRAME)


def _again(stepper: TimeStepper, start: InitialConditions, count: int) -> Float[Tensor, "b t o n 3"]:
    stepper.restart(start)
    return record_frames(stepper, count)


def _row(what: str, scenes: int, function: Callable[[], object], device: str, repeat: int) -> dict:
    """A row with the median wall time and, on a CPU, the minimum CPU time [s]."""
    function()
    wall, cpu = [], []
    for _ in range(repeat):
        began = time.process_time()
        wall.append(bench.median_seconds(function, device, 1))
        cpu.append(time.process_time() - began)
    row = {"what": what, "scenes": scenes, "seconds": _rounded(sorted(wall)[repeat // 2])}
    return row if device != "cpu" else {**row, "processor_seconds": _rounded(min(cpu))}


def table(rows: list[dict]) -> list[str]:
    """A line for each row; speeds are relative to the published model, step by step."""
    peer = next(row["seconds"] for row in rows if row["what"] == PEER)
    lines = []
    for row in rows:
        more = []
        if "processor_seconds" in row:
            more.append(f"{row['processor_seconds']:.2f} s of CPU time")
        if "arithmetic" in row:
            more.append(f"matrix products at {100 * row['arithmetic']:.2g} % of the float32 rate")
        if "ready_seconds" in row:
            more.append(f"set-up: {row['ready_seconds']:.1f} s; deviates by {row['strays_m']:.1e} m")
        lines.append(
            f"{row['scenes']:>4} x {row['what']:32}{row['seconds']:10.4f} s {peer / row['seconds']:8.2f}x the speed of "
            f"{PEER}" + "".join(f"; {text}" for text in more)
        )
    return lines


def _rounded(seconds: float) -> float:
    return float(f"{seconds:.4g}")
