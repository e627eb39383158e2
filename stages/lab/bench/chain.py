"""Benchmark of the pipeline from photos to a video: time of each stage, GPU utilisation, and repeatability.

The stages run repeatedly in one process, and then once as separate commands, which adds their start-up time. The files
of all runs are compared by sha256.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.scene.files import sha256
from stages.core.scene.scene_ply import read_scene
from stages.lab.bench.common import machine, write_results
from stages.lab.bench.speed_options import ChainBenchOptions

PAPER_SECONDS = {"without refine": 12, "with refine": 37}  # photos to video on one GPU, as stated in the paper
SAMPLE_SECONDS = 0.05  # interval between readings of the GPU utilisation


def command_lines(photos: Path, folder: Path, options: ChainBenchOptions) -> dict[str, list[str]]:
    """Command-line arguments of `ngff` for each stage, in order."""
    device, scene = ["--device", options.device], folder / "scene.ply"
    lines = {
        "reconstruct": [str(photos), "-o", str(scene), "--quality", options.quality, *device],
        "segment": [str(scene), "-o", str(folder / "labelled.ply"), *device],
    }
    last = folder / "labelled.ply"
    if options.refine:
        lines["refine"] = [str(last), "-o", str(folder / "refined.ply"), *device]
        last = folder / "refined.ply"
    lines["simulate"] = [str(last), "-o", str(folder / "traj.h5"), "--steps", str(options.steps), *device]
    lines["render"] = [str(folder / "traj.h5"), "-o", str(folder / "film.mp4"), "--view", "novel", *device]
    return {name: [name, *arguments] for name, arguments in lines.items()}


def stage_calls(photos: Path, folder: Path, options: ChainBenchOptions) -> dict[str, Callable[[], object]]:
    """The stages as Python calls, equivalent to `command_lines`."""
    from stages.reconstruct.options import ReconstructOptions
    from stages.reconstruct.stage import run as reconstruct
    from stages.refine.options import RefineOptions
    from stages.refine.stage import run as refine
    from stages.render.options import RenderOptions
    from stages.render.stage import run as render
    from stages.segment.options import SegmentOptions
    from stages.segment.stage import run as segment
    from stages.simulate.options import SimulateOptions
    from stages.simulate.stage import run as simulate

    at, last = options.device, "refined.ply" if options.refine else "labelled.ply"
    scene, labelled, trajectory = folder / "scene.ply", folder / "labelled.ply", folder / "traj.h5"
    calls = {
        "reconstruct": lambda: reconstruct(photos, scene, ReconstructOptions(quality=options.quality, device=at)),
        "segment": lambda: segment(scene, labelled, SegmentOptions(device=at)),
        "refine": lambda: refine(labelled, folder / "refined.ply", RefineOptions(device=at)),
        "simulate": lambda: simulate(folder / last, trajectory, SimulateOptions(steps=options.steps, device=at)),
        "render": lambda: render(trajectory, folder / "film.mp4", RenderOptions(view="novel", device=at)),
    }
    return {name: call for name, call in calls.items() if options.refine or name != "refine"}


def run(photos: Path, out: Path | None, options: ChainBenchOptions) -> Iterator[str]:
    """Yield the lines of the report; all results go to `out` as JSON."""
    device = pick_device(options.device)
    yield machine(device)
    rows, files, objects, commands = [], [], [], {}
    with tempfile.TemporaryDirectory() as temporary:
        for i in range(options.repeat):
            folder = Path(temporary) / str(i)
            folder.mkdir()
            rows.append({name: timed(call, device) for name, call in stage_calls(photos, folder, options).items()})
            files.append({path.name: sha256(path) for path in sorted(folder.iterdir()) if path.suffix != ".json"})
            objects.append(len(read_scene(folder / "labelled.ply").objects))
            yield from _lines(f"run {i + 1}, one process", rows[-1])
            yield f"  {objects[-1]} objects; scene.ply {files[-1]['scene.ply'][:12]}"
        if options.commands:
            folder = Path(temporary) / "commands"
            folder.mkdir()
            for name, line in command_lines(photos, folder, options).items():
                commands[name] = _command_seconds(line)
            yield from _lines("separate commands", {name: (seconds, None) for name, seconds in commands.items()})
    differing = sorted({name for other in files[1:] for name in other if other[name] != files[0][name]})
    yield f"files that differ between runs: {', '.join(differing) or 'none'}" if len(files) > 1 else "one run only"
    kind = "with refine" if options.refine else "without refine"
    yield f"the paper's figure {kind}: {PAPER_SECONDS[kind]} s"
    facts = {"photos": photos.resolve().name, "quality": options.quality, "frames": options.steps, "objects": objects}
    write_results(out, "chain", device, {**facts, "runs": rows, "commands": commands, "sha256": files,
                                         "paper_seconds": PAPER_SECONDS})  # fmt: skip


def _lines(title: str, row: dict[str, tuple[float, float | None]]) -> Iterator[str]:
    total = sum(seconds for seconds, _ in row.values())
    yield f"{title}: {total:.1f} s"
    for name, (seconds, busy) in row.items():
        yield f"  {name:12s} {seconds:6.2f} s" + ("" if busy is None else f", GPU busy {100 * busy:3.0f} %")


def timed(call: Callable[[], object], device: str) -> tuple[float, float | None]:
    """Wall time of a call [s], and the fraction of it in which the GPU was busy (None on a CPU)."""
    with _busy_samples(device) as samples:
        start = time.perf_counter()
        call()
        if device != "cpu":
            torch.cuda.synchronize(device)
        seconds = time.perf_counter() - start
    return seconds, sum(samples) / (100 * len(samples)) if samples else None


@contextmanager
def _busy_samples(device: str) -> Iterator[list[int]]:
    """GPU utilisation [%], sampled in a thread; stays empty on a CPU and without NVIDIA's management library."""
    samples: list[int] = []
    # CUDA's current device is set per thread, so it is read here
    done, gpu = threading.Event(), None if device == "cpu" else torch.cuda.current_device()

    def watch() -> None:
        while not done.wait(SAMPLE_SECONDS):
            try:
                samples.append(torch.cuda.utilization(gpu))
            except (ImportError, ModuleNotFoundError, RuntimeError):
                return

    thread = threading.Thread(target=watch, daemon=True)
    if device != "cpu":
        thread.start()
    try:
        yield samples
    finally:
        done.set()
        if device != "cpu":
            thread.join()


def _command_seconds(line: list[str]) -> float:
    """Wall time of one command in a separate process [s]. Raises InputError with its message if it fails."""
    start = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", "from ngff_cli import ngff; ngff()", *line],
                          capture_output=True, text=True)  # fmt: skip
    if done.returncode:
        raise InputError(f"ngff {line[0]} failed: {done.stderr.strip()[-300:]}")
    return time.perf_counter() - start
