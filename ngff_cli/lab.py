"""`ngff-lab`: making data, training, benchmarks, and what works on this machine."""

from pathlib import Path
from typing import Annotated

import typer

from ngff_cli.options import Commands, set_up_logging

app = typer.Typer(
    cls=Commands, no_args_is_help=True, rich_markup_mode=None, add_completion=False, pretty_exceptions_enable=False
)


@app.callback()
def lab() -> None:
    """Beside the pipeline: make example data, and see what works on this machine."""
    set_up_logging(False)


@app.command()
def doctor() -> None:
    """Say what works on this machine, and what to do about what does not."""
    from stages.lab.doctor import examine

    for line in examine():
        print(line)


@app.command()
def example(
    out: Annotated[Path, typer.Argument(metavar="FOLDER", help="where photos/, masks/ and the truth go")],
    photos: Annotated[int, typer.Option(help="how many photos to take")] = 26,
) -> None:
    """Make the example: photos of toys on a table, with true cameras, labels and motion beside them."""
    from stages.lab.example import make

    make(out, photos)


def main() -> None:
    app()
