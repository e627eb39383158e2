"""Command lines only: parse, make one Options, call one run(). The scripts start here, before anything is imported."""

import sys
from importlib import import_module


def ngff() -> None:
    """Entry point of the script `ngff`."""
    _start("ngff_cli.app")


def ngff_lab() -> None:
    """Entry point of the script `ngff-lab`."""
    _start("ngff_cli.lab")


def _start(module: str) -> None:
    try:
        main = import_module(module).main
    except KeyboardInterrupt:  # later ones are caught by main
        print("ngff: interrupted", file=sys.stderr)
        sys.exit(130)
    main()
