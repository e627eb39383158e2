"""The package pycolmap, imported so that it leaves the handling of signals as it was."""

import signal
import threading
from types import ModuleType


def import_pycolmap() -> ModuleType:
    """The package; ImportError where it is absent. It prints a stack trace at SIGTERM otherwise."""
    handler = signal.getsignal(signal.SIGTERM)
    import pycolmap

    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)
    return pycolmap
