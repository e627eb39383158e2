"""Benchmark of the engines against textbook physics, run through the stage `simulate`."""

from __future__ import annotations

import contextlib
import io
import json
import logging
import tempfile
import time
from collections.abc import Iterator, Mapping
from datetime import datetime, timezone
from fnmatch import fnmatch
from pathlib import Path

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.scene.files import replacing
from stages.core.scene.scene_ply import write_scene
from stages.core.scene.trajectory import Trajectory, read_trajectory
from stages.lab.bench.common import machine, write_json
from stages.lab.bench.experiments.bodies import Run
from stages.lab.bench.experiments.catalogue import experiments
from stages.lab.bench.experiments.experiment import Experiment
from stages.lab.bench.motion_options import PhysicsBenchOptions
from stages.simulate.options import AUTO, ENGINES, SimulateOptions
from stages.simulate.stage import run as simulate

FAILED = "failed"  # stored in place of a value if the engine raised an error


def chosen(only: str) -> list[Experiment]:
    """The experiments selected by --only, or all. Raises InputError if a pattern matches none."""
    table, patterns = experiments(), [pattern.strip() for pattern in only.split(",") if pattern.strip()]
    for pattern in patterns:
        if not any(_fits(name, pattern) for name in table):
            groups = ", ".join(sorted({name.partition("/")[0] for name in table}))
            raise InputError(f"--only {pattern}: matches no experiment; the groups are {groups}")
    return [e for name, e in table.items() if not patterns or any(_fits(name, p) for p in patterns)]


def _fits(name: str, pattern: str) -> bool:
    return fnmatch(name, pattern) or fnmatch(name.partition("/")[0], pattern)


def measure(experiment: Experiment, engine: str, options: PhysicsBenchOptions) -> dict:
    """Value measured with one engine, whether it agrees with theory, and the wall time of all runs [s].

    For `auto` also the engines that were chosen; its tolerances are those of `rigid`, the narrowest.
    """
    start = time.perf_counter()
    try:
        found = [trajectory(run, engine, options) for run in experiment.runs]
        value = experiment.measure(*found)
    except InputError as error:
        return {"value": FAILED, "passes": False, "seconds": time.perf_counter() - start, "error": str(error)}
    taken = {"engines": sorted({t.info.engine for t in found})} if engine == AUTO else {}
    passes = experiment.passes("rigid" if engine == AUTO else engine, value)
    return {"value": value, "passes": passes, "seconds": time.perf_counter() - start, **taken}


def trajectory(run: Run, engine: str, options: PhysicsBenchOptions) -> Trajectory:
    """Write the scene, simulate it, and read the trajectory."""
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stderr(io.StringIO()), _quiet():
        scene, materials, out = (Path(folder) / name for name in ("scene.ply", "materials.json", "traj.h5"))
        write_scene(scene, run.scene())
        materials.write_text(json.dumps({str(i + 1): body.material() for i, body in enumerate(run.bodies)}))
        contact = options.contact if engine == "ngff" else AUTO
        weights = options.weights if engine != AUTO and ENGINES[engine].weights else None
        simulate(scene, out, SimulateOptions(
            engine=engine, materials=materials, quality=options.quality, keypoints=options.keypoints, weights=weights,
            contact=contact, device=options.device, **run.options,
        ))  # fmt: skip
        return read_trajectory(out)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Suppress the messages of the stage, which would be repeated for every run."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(before)


def run(out: Path, options: PhysicsBenchOptions) -> Iterator[str]:
    """Yield a line for each experiment and engine; rows already in `out` are kept and not measured again.

    Also writes the table as Markdown next to `out`. Raises InputError if `out` has rows of another quality or contact.
    """
    table, device = experiments(), pick_device(options.device)
    facts = _before(Path(out)) or {"command": "ngff-lab bench physics", "rows": {}, "quality": options.quality,
                                    "contact": options.contact}  # fmt: skip
    for name, default in (("quality", None), ("contact", "learned")):  # defaults for tables of older versions
        if (before := facts.get(name, default)) != getattr(options, name):
            raise InputError(f"{out}: contains rows measured with --{name} {before}; name another file (-o)")
    facts |= {"machine": machine(device), "quality": options.quality}
    for experiment in chosen(options.only):
        row = facts["rows"].setdefault(experiment.name, {})
        for engine in options.engines:
            if engine not in row:
                row[engine] = measure(experiment, engine, options)
                facts["rows"] = {name: facts["rows"][name] for name in table if name in facts["rows"]}
                facts["date"] = datetime.now(timezone.utc).date().isoformat()
                write_json(Path(out), facts)
                with replacing(Path(out).with_suffix(".md")) as part:
                    part.write_text("\n".join(markdown(facts)) + "\n")
            yield _line(experiment, engine, row[engine])
    for engine in options.engines:
        rows = [row[engine] for row in facts["rows"].values() if engine in row]
        yield f"{engine}: {sum(row['passes'] for row in rows)} of {len(rows)} agree with theory"


def _before(out: Path) -> dict | None:
    """Results of an earlier run, or None."""
    if not out.exists():
        return None
    try:
        facts = json.loads(out.read_text())
        facts["rows"].items()
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{out}: contains no results of `ngff-lab bench physics` ({error!r}); name another file"
        ) from error
    return facts


def _line(experiment: Experiment, engine: str, row: Mapping) -> str:
    verdict = "ok" if row["passes"] else "--"
    engine = " ".join([engine, *row.get("engines", ())])
    return (f"{verdict}  {experiment.name:34} {engine:10} {_number(row['value']):>8}  analytic "
            f"{_number(experiment.value):>7}  {experiment.what}  ({row['seconds']:.0f} s)")  # fmt: skip


def _number(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:.3f}"


def markdown(facts: Mapping) -> Iterator[str]:
    """The results as a Markdown page; values that disagree with theory are in brackets."""
    table, rows = experiments(), facts["rows"]
    engines = [name for name in (AUTO, "rigid", "mpm", "ngff") if any(name in row for row in rows.values())]
    yield "# Textbook physics"
    yield ""
    yield "    ngff-lab bench physics"
    yield ""
    yield (
        f"{facts['machine']}, {facts['date']}; MPM at quality {facts['quality']}. Each experiment is a scene file and "
        "a call of the stage `simulate`. Values in brackets differ from theory by more than the engine's tolerance: "
        "5 % for `rigid` and `auto`, 10 % for `mpm` and `ngff` (slides of `ngff` 15 %); gaps of -3 to 5 % of the upper "
        "body's height (`mpm` -10 to 10 %)."
    )
    yield ""
    agree = (f"`{e}` {sum(r[e]['passes'] for r in rows.values() if e in r)} of {sum(e in r for r in rows.values())}"
             for e in engines)  # fmt: skip
    yield f"Rows that agree with theory: {', '.join(agree)}."
    yield ""
    yield f"| experiment | measured | analytic | {' | '.join(f'`{name}`' for name in engines)} |"
    yield "| --- | --- | --- |" + " --- |" * len(engines)
    for name, row in rows.items():
        e = table[name]
        cells = (_cell(row.get(engine)) for engine in engines)
        yield f"| {name} | {e.what} | {_number(e.value)} | {' | '.join(cells)} |"


def _cell(row: Mapping | None) -> str:
    if row is None:
        return ""
    return _number(row["value"]) if row["passes"] else f"({_number(row['value'])})"
