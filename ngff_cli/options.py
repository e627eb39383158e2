"""What the two command lines share: argument types, and how errors reach the user."""

import logging
import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from stages.core.errors import InputError

SceneIn = Annotated[Path, typer.Argument(metavar="SCENE.ply", help="scene to read (.ply)", show_default=False)]
Device = Annotated[str, typer.Option(help="auto | cpu | cuda")]
Seed = Annotated[int, typer.Option(help="same seed, same device: same result")]
Verbose = Annotated[bool, typer.Option("-v", "--verbose", help="say more about what is done")]


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
