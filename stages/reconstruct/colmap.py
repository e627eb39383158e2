"""Access to COLMAP by the package pycolmap; long steps run in a separate process (colmap_worker.py).

If memory or disk space runs out, a thread of COLMAP aborts its process. In a separate process this is only an error.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

from stages.core.errors import InputError

WORKER = "import sys; sys.path[:] = sys.argv[1:]; from stages.reconstruct.colmap_worker import main; main()"
_open: list[subprocess.Popen] = []  # process of the current `colmap_process` context, if any


def import_pycolmap() -> ModuleType:
    """Import pycolmap and restore the SIGTERM handler, which pycolmap replaces by one that prints a stack trace.

    Raises ImportError if the package is absent.
    """
    handler = signal.getsignal(signal.SIGTERM)
    import pycolmap

    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)
    return pycolmap


@contextmanager
def colmap_process() -> Iterator[subprocess.Popen]:
    """Context manager or decorator that provides a process for `run_colmap`; nested contexts share one process."""
    if _open:
        yield _open[0]
        return
    with _started() as process:
        _open.append(process)
        try:
            yield process
        finally:
            _open.remove(process)


@contextmanager
def _started() -> Iterator[subprocess.Popen]:
    process = subprocess.Popen([sys.executable, "-c", WORKER, *map(str, sys.path)], stdin=subprocess.PIPE,
                               stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)  # fmt: skip
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


class SecondProcess(NamedTuple):
    """A process for tasks in parallel to those of `colmap_process`, and the thread that waits for it."""

    thread: ThreadPoolExecutor
    process: subprocess.Popen


@contextmanager
def second_process() -> Iterator[SecondProcess]:
    """Context manager with a second process, which takes a second to start; its task ends with the context."""
    with ThreadPoolExecutor(1) as thread, _started() as process:
        yield SecondProcess(thread, process)


def run_colmap(
    task: str, folder: Path, progress: Callable[[int], object] | None = None, process: subprocess.Popen | None = None,
    **arguments: object,
) -> None:  # fmt: skip
    """Run a task of colmap_worker.TASKS with JSON-serialisable arguments; it writes its results to `folder`.

    It runs in `process`, or in that of `colmap_process` if none is given. `progress` is called with the number of newly
    finished photos. Raises RuntimeError if COLMAP fails, MemoryError if it runs out of memory, and InputError if its
    process ends.
    """
    with nullcontext(process) if process else colmap_process() as process:
        try:
            process.stdin.write(json.dumps([task, {"folder": str(folder), **arguments}]) + "\n")
            process.stdin.flush()
        except BrokenPipeError:
            pass
        for line in process.stdout:
            kind, value = json.loads(line)
            if kind == "done":
                return
            if kind == "progress" and progress is not None:
                progress(value)
            elif kind == "error":
                raise MemoryError(value) if "bad_alloc" in value else RuntimeError(value)
        raise InputError(
            f"{folder}: COLMAP ended without a result ({_ending(process.wait())}); memory or the disk is "
            "probably full: "
            "close other programs, or set TMPDIR to a folder on a disk with more free space"
        )


def _ending(status: int) -> str:
    return f"signal {signal.Signals(-status).name}" if status < 0 else f"exit status {status}"
