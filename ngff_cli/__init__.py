"""The command lines: each command parses its options and calls one run().

The scripts start here, before anything is imported.
"""

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
        import_module(module).main()
    except KeyboardInterrupt:  # during imports, before main handles it
        print("ngff: interrupted", file=sys.stderr)
        sys.exit(130)
