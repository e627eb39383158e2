"""What the two command lines share: argument types, and how errors reach the user."""

import logging
import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from stages.core.errors import InputError

# Threads that wait for each other sleep instead of spinning: OpenMP and OpenBLAS read these when they are loaded.
# With other work on the machine a spinning thread takes the core from the one it waits for.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("OPENBLAS_THREAD_TIMEOUT", "4")

SceneIn = Annotated[Path, typer.Argument(metavar="SCENE.ply", help="scene to read (.ply)", show_default=False)]
Device = Annotated[str, typer.Option(help="auto | cpu | cuda")]
Seed = Annotated[int, typer.Option(help="same seed, same device: same result")]
Threads = Annotated[int | None, typer.Option(help="CPU threads; default: all cores", show_default=False)]
Verbose = Annotated[bool, typer.Option("-v", "--verbose", help="say more about what is done")]


def limit_threads(count: int | None) -> None:
    """Use at most `count` CPU threads in PyTorch, OpenMP, OpenBLAS and our own kernels; None keeps their defaults.

    They read these variables when they are first imported, which no command has done yet.
    """
    if count is None:
        return
    if count < 1:
        raise InputError(f"--threads {count}: give 1 or more")
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[name] = str(count)


class StderrHandler(logging.Handler):
    """Writes to what sys.stderr is at that moment: a stream kept from an earlier call may be closed by then."""

    def emit(self, record: logging.LogRecord) -> None:
        print(self.format(record), file=sys.stderr)


def set_up_logging(verbose: bool) -> None:
    """Messages to stderr, past any progress bar; results alone go to stdout."""
    if not sys.stderr.isatty():  # in a log, a line of progress now and then will do
        os.environ.setdefault("TQDM_MININTERVAL", "10")
    logging.basicConfig(handlers=[StderrHandler()], format="%(message)s", level=logging.WARNING, force=True)
    for name in ("stages", "ngff_cli"):
        logging.getLogger(name).setLevel(logging.DEBUG if verbose else logging.INFO)


class Commands(typer.core.TyperGroup):
    """Commands in the order of the pipeline; a user's mistake is one sentence and status 2."""

    def list_commands(self, ctx) -> list[str]:
        return list(self.commands)

    def invoke(self, ctx):
        try:
            return super().invoke(ctx)
        except InputError as error:
            fail(str(error), 2)
        except OSError as error:
            if error.filename is None and error.errno is None:
                raise
            where = f"{error.filename}: " if error.filename else ""
            fail(f"{where}{error.strerror or error}", 2)
        except KeyboardInterrupt:
            fail("stopped; nothing half-written is left behind", 130)


def fail(message: str, status: int) -> None:
    """Leave with one line on stderr."""
    print(f"ngff: {message}", file=sys.stderr)
    sys.exit(status)
