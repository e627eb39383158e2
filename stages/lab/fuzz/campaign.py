"""Runs many fuzzing cases in a separate process, which may crash, hang or exhaust memory, and writes a JSON report."""

from __future__ import annotations

import json
import math
import multiprocessing
import os
import resource
import shutil
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, suppress
from multiprocessing.connection import Connection
from pathlib import Path

from tqdm import tqdm

from stages.core.errors import InputError, MissingPackage
from stages.core.scene.files import ngff_version, replacing
from stages.lab.fuzz.cases import GOOD, KINDS, Examples, quiet, result_of

RESULTS = (*GOOD, "nonsense", "traceback", "signal", "more than 10 s", "more than 2 GB")
MAX_SECONDS = 10.0  # time limit of a case
MAX_MEMORY = 2 << 30  # limit on the memory growth of a case [bytes]
START = 120.0  # time limit for a process to import modules and write the examples [s]


def run(out: Path, count: int, seed: int = 0, minutes: float = math.inf) -> Iterator[str]:
    """Run cases 0 to `count` - 1 of a seed and write OUT (.json); files of failures go to the folder NAME.cases.

    No case starts after `minutes`; the report's `count` is the number of cases that ran. Yields the lines of a table.
    Raises InputError for a count below 1 and for no time.
    """
    if count < 1:
        raise InputError(f"--count must be 1 or more, got {count}")
    if not minutes > 0:
        raise InputError(f"--minutes must be above 0, got {minutes:g}")
    kept, begun = out.with_suffix(".cases"), time.monotonic()
    counts: dict[str, Counter] = {kind.name: Counter() for kind in KINDS}
    failures = []
    with replacing(out) as part, tempfile.TemporaryDirectory(prefix="ngff-fuzz-") as folder:
        with closing(_results(Path(folder), count, seed)) as results, tqdm(results, total=count, unit="case") as cases:
            for number, kind, result, why, files in cases:
                counts[kind][result] += 1
                if result not in GOOD:
                    place = kept / f"{kind}-{seed}-{number}"
                    shutil.copytree(files, place, dirs_exist_ok=True)
                    failures.append({"kind": kind, "case": number, "result": result, "why": why, "files": str(place)})
                    cases.set_postfix(failures=len(failures))
                if time.monotonic() - begun > 60 * minutes:
                    break
        total = sum(counts.values(), Counter())
        seconds = round(time.monotonic() - begun, 1)
        report = {"ngff": ngff_version(), "seed": seed, "count": total.total(), "seconds": seconds,
                  "total": {r: total[r] for r in RESULTS}, "counts": counts, "failures": failures}  # fmt: skip
        part.write_text(json.dumps(report, indent=1) + "\n")
    for name, of_kind in [*counts.items(), ("total", total)]:
        yield f"{name:20s}" + ", ".join(f"{of_kind[r]} {r}" for r in RESULTS if of_kind[r])
    if failures:
        yield f"the files of {len(failures)} failures are in {kept}"


def _results(folder: Path, count: int, seed: int) -> Iterator[tuple[int, str, str, str, Path]]:
    """Number, kind, result, explanation and folder of each case, from worker processes restarted as needed."""
    context, number, failed = multiprocessing.get_context("spawn"), 0, 0
    while number < count:
        place = folder / f"process {failed}"
        ours, theirs = context.Pipe()
        process = context.Process(target=_work, args=(theirs, place, seed, number, count), daemon=True)
        process.start()
        theirs.close()
        try:
            _await_start(ours)
            while number < count:
                if not ours.poll(MAX_SECONDS):
                    result, why = "more than 10 s", ""
                else:
                    result, why = ours.recv()
                files = Examples.place_in(place, number)
                yield number, files.name, result, why, files
                number += 1
                if result.startswith("more than"):
                    break
                ours.send("next")
        except EOFError:  # the process has died
            process.join()
            files = Examples.place_in(place, number)
            yield number, files.name, "signal", f"exit status {process.exitcode}", files
            number += 1
        finally:
            ours.close()  # makes the process exit, unless it hangs
            process.join(1)
            process.kill()
            process.join()
        failed += 1
        shutil.rmtree(place, ignore_errors=True)


def _await_start(worker: Connection) -> None:
    """Wait until the worker process is ready. Raises InputError with its message if it is not."""
    answer = "has not started" if not worker.poll(START) else ""
    with suppress(EOFError):
        answer = answer or worker.recv()
    if answer != "ready":
        raise InputError(f"the process that reads the files {answer or 'ended before it was ready'}")


def _work(parent: Connection, folder: Path, seed: int, start: int, stop: int) -> None:
    """Run cases and send the result of each; wait for a reply, so that the files of the case can be copied first."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends this process
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # silences image and video libraries, which write to stderr
    try:
        examples = Examples(folder)
    except MissingPackage as error:
        parent.send(f"needs all packages: {error}")
        return
    for kind in KINDS:  # load all libraries before the memory limit, under which loading may crash without a message
        result_of(kind, examples.place(kind))
    size = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (size + 2 * MAX_MEMORY,) * 2)  # protects other processes on the machine
    parent.send("ready")
    with quiet():
        for number in range(start, stop):
            before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            _, result, why = examples.run(seed, number)
            grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) << 10
            parent.send(("more than 2 GB", f"{grown >> 20} MB") if grown > MAX_MEMORY else (result, why))
            try:
                parent.recv()
            except (EOFError, ConnectionError):
                return
