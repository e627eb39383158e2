"""`ngff-lab`: making data, training, benchmarks, and what works on this machine."""

import typer

from ngff_cli.options import Commands

app = typer.Typer(cls=Commands, no_args_is_help=True, rich_markup_mode=None, add_completion=False)


@app.callback()
def lab() -> None:
    """Beside the pipeline: make example data, and see what works on this machine."""


@app.command()
def doctor() -> None:
    """Say what works on this machine, and what to do about what does not."""
    from stages.lab.doctor import examine

    for line in examine():
        print(line)


def main() -> None:
    app()
