"""Common parts of both command lines: option types, --json, logging and error reports."""

import errno
import gc
import logging
import math
import os
import re
import signal
import sys
from collections.abc import Callable, Iterable
from dataclasses import Field, fields, is_dataclass
from functools import partial, wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import typer

from stages.core.backends import load
from stages.core.errors import InputError

SceneIn = Annotated[Path, typer.Argument(metavar="SCENE.ply", help="scene to read (.ply)", show_default=False)]
Device = Annotated[str, typer.Option(help="device to compute on: auto | cpu | cuda | cuda:N")]
Threads = Annotated[int | None, typer.Option(
    help="number of CPU threads; default: all cores. If the environment variable OMP_WAIT_POLICY is ACTIVE, waiting "
         "threads spin, which is faster on an idle machine and slower on a busy one", show_default=False)]  # fmt: skip

Out = Annotated[Path | None, typer.Option("-o", "--out", help="JSON file to write the results to")]
OutKept = Annotated[Path, typer.Option("-o", "--out", help="JSON file of results; existing results are kept")]
OutWithTable = Annotated[
    Path, typer.Option("-o", "--out", help="results (.json); existing results are kept; also writes a table (.md)")
]
AsJson = Annotated[bool, typer.Option("--json", help="print the results as JSON instead of a table")]
SIZE_OPTIONS = ("--quality", "--resolution", "--keypoints", "--max-objects", "--batch", "--views", "--side", "--size",
                "--particles", "--scenes")  # options that determine memory, most effective first  # fmt: skip
INTERRUPTED = "interrupted; no incomplete file is left"
OUT_OF_MEMORY = "{} is out of memory: close other programs that use it"
NO_MEMORY = ("can't allocate memory", "Insufficient memory", "can't start new thread", "bad alloc", "bad_alloc",
             "failed to map segment")  # in messages of PyTorch, OpenCV, Python, C++ and the loader  # fmt: skip
NEW_OBJECTS = 20_000  # threshold of the garbage collector; Python's default of 700 costs 2 to 5 % of a command's time


class StderrHandler(logging.Handler):
    """Writes to the current sys.stderr, which may have been replaced since the handler was installed."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print one record."""
        print(self.format(record), file=sys.stderr)


def with_options(command: Callable) -> Callable:
    """Decorate a command for typer: each `option` field of the option classes among its parameters becomes an option.

    The command is called with objects of these classes. A field that several classes have becomes one option, that of
    the first class.
    """
    hints = get_type_hints(command, include_extras=True)
    classes = {name: hint for name, hint in hints.items() if is_dataclass(hint)}
    exposed = {name: [f for f in fields(cls) if "help" in f.metadata] for name, cls in classes.items()}
    parameters: dict[str, Parameter] = {}
    for name, parameter in signature(command).parameters.items():
        if name in classes:
            kinds = get_type_hints(classes[name])
            for f in exposed[name]:
                parameters.setdefault(f.name, _parameter(f, kinds[f.name]))
        else:
            parameters[name] = parameter.replace(annotation=hints[name])

    @wraps(command)
    def call(**values):
        for name, value in values.items():
            _check_number(name, value)
        given = {name: tuple(v) if isinstance(v, list) else v for name, v in values.items()}
        built = {name: cls(**{f.name: given[f.name] for f in exposed[name]}) for name, cls in classes.items()}
        return command(**{n: v for n, v in values.items() if n in hints and n not in classes}, **built)

    call.__signature__ = Signature(list(parameters.values()))
    call.__annotations__ = {name: p.annotation for name, p in parameters.items()}
    return call


def _check_number(name: str, value: Any) -> None:
    """Raise InputError for NaN, which would pass range checks, and for integers beyond 64 bits.

    Option classes check ranges.
    """
    if isinstance(value, float) and math.isnan(value) or isinstance(value, int) and not -(2**63) <= value < 2**63:
        raise InputError(f"--{name.replace('_', '-')} {value}: give {'a' if value != value else 'a smaller'} number")


def _parameter(field: Field, kind: type) -> Parameter:
    """The parameter from which typer makes an option, for a field of this type."""
    words = dict(field.metadata)
    flags = words.pop("flags")
    if kind is bool and field.default is False and not flags:
        flags = ("--" + field.name.replace("_", "-"),)
    if get_origin(kind) is tuple:
        kind = list[get_args(kind)[0]]
    annotation = Annotated[kind, typer.Option(*flags, **words)]
    return Parameter(field.name, Parameter.KEYWORD_ONLY, default=field.default, annotation=annotation)


def run_command_line(app: typer.Typer, words: list[str] | None = None) -> None:
    """Run the command in `words`, by default the arguments of this process. Does not return.

    SIGTERM ends it like Ctrl-C, without leaving temporary files.
    """
    signal.signal(signal.SIGTERM, interrupt)
    if signal.getsignal(signal.SIGINT) == signal.default_int_handler:  # not if a shell made the process ignore it
        signal.signal(signal.SIGINT, interrupt)
    gc.set_threshold(NEW_OBJECTS)
    _replace_closed_streams()
    try:
        app(words)
    except KeyboardInterrupt:  # before the command began
        fail(INTERRUPTED, 130)
    except Exception as error:  # before the command began
        if _is_out_of_memory(error):
            fail(OUT_OF_MEMORY.format("the machine"), 1)
        if isinstance(error, OSError) and error.errno == errno.ENOSPC:  # while printing --help
            fail(f"standard output: {error.strerror}", 2)
        raise
    finally:
        gc.freeze()  # otherwise Python collects the objects of all modules at exit, which takes most of a second


def _replace_closed_streams() -> None:
    """Open the null device for each standard stream that the caller has closed, such as by `2>&-` in a shell.

    Otherwise a file opened later would get its descriptor, and messages of libraries would be written into that file.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):  # os.open takes the lowest free descriptor
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), mode))


def interrupt(number: int, frame) -> None:
    """Signal handler that raises KeyboardInterrupt; during an import or a write by HDF5, it retries 10 ms later.

    In the import system the exception could be lost with a lock held, which blocks all threads that import (CPython's
    _get_module_lock), and a library that is interrupted during its import may report that it is not installed. HDF5
    loses exceptions of the file object to which it writes, and with them the data.
    """
    while frame is not None and not (
        frame.f_code.co_filename.startswith("<frozen importlib")
        or frame.f_code.co_filename.endswith("error_deferring_file.py")
    ):
        # the command may run during the import of a script: frames outside the command do not count
        frame = None if frame.f_code is run_command_line.__code__ else frame.f_back
    if frame is None:
        raise KeyboardInterrupt
    if hasattr(signal, "setitimer"):
        signal.signal(signal.SIGALRM, interrupt)
        signal.setitimer(signal.ITIMER_REAL, 0.01)


def set_up(threads: int | None, verbose: bool = False) -> None:
    """Set up logging to stderr, with debug messages if `verbose`, and limit CPU threads to `threads` (None: all cores).

    PyTorch, OpenMP and our own kernels read the number of threads when they are first imported, so this must be called
    before. Raises InputError if the number is below 1.
    """
    if hasattr(sys.stdout, "reconfigure"):  # print paths that are not UTF-8 unchanged
        sys.stdout.reconfigure(errors="surrogateescape")
    if not sys.stderr.isatty():  # in a log file, a progress line every 10 s is sufficient
        os.environ.setdefault("TQDM_MININTERVAL", "10")
    logging.basicConfig(handlers=[StderrHandler()], format="%(message)s", level=logging.WARNING, force=True)
    for name in ("stages", "ngff_cli"):
        logging.getLogger(name).setLevel(logging.DEBUG if verbose else logging.INFO)
    if threads is None:
        return
    if threads < 1:
        raise InputError(f"--threads {threads}: give 1 or more")
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = str(threads)


def new_app() -> typer.Typer:
    """A command line, or a group of its commands; see CommandGroup."""
    return typer.Typer(cls=CommandGroup, no_args_is_help=True, rich_markup_mode=None, pretty_exceptions_enable=False)


def print_results(run: Callable[[Path | None], Iterable[str]], out: Path | None, as_json: bool) -> None:
    """Print the table lines of `run(out)` or, with --json, the JSON file that it writes.

    `out` is the requested path of that file, if any. With --json the table lines go to stderr as progress.
    """
    if not as_json:
        for line in run(out):
            print(line, flush=True)
        return
    with TemporaryDirectory() as folder:
        path = out or Path(folder) / "results.json"
        for line in run(path):
            print(line, file=sys.stderr, flush=True)
        print(path.read_text().rstrip())


def add_benchmark(
    app: typer.Typer, name: str, run: str, options: type, help: str, out: Any = Out, default: Path | None = None
) -> None:
    """Add the command `name` that prints the results of `run`, a "module:function" of (path, options).

    `out` and `default` are type and default of its option --out.
    """

    def benchmark(*, options, out=default, as_json=False) -> None:
        print_results(lambda path: load(run)(path, options), out, as_json)

    benchmark.__doc__, benchmark.run = help, run
    benchmark.__annotations__ = {"options": options, "out": out, "as_json": AsJson}
    app.command(name)(with_options(benchmark))


class CommandGroup(typer.core.TyperGroup):
    """A group of commands, listed in the order of their definition.

    InputError and OSError exit with one line and status 2; running out of memory, with one line and status 1.
    """

    def list_commands(self, ctx) -> list[str]:
        """Names in the order of definition."""
        return list(self.commands)

    def get_command(self, ctx, cmd_name: str):
        """The command, with its whole first paragraph as help in the group's list instead of 45 characters."""
        command = super().get_command(ctx, cmd_name)
        if command is not None and not command.short_help:
            command.short_help = (command.help or "").split("\n\n")[0]
        return command

    def resolve_command(self, ctx, args):
        """The command to run; it rejects empty paths, which Path would convert to the current folder."""
        name, command, rest = super().resolve_command(ctx, args)
        kinds = get_type_hints(command.callback) if command is not None and command.callback else {}
        for parameter in command.params if kinds else []:
            if Path in (kinds[parameter.name], *get_args(kinds[parameter.name])):
                parameter.process_value = partial(_path_of, parameter)
        return name, command, rest

    def invoke(self, ctx):
        """Run the command; report errors that a user can correct as one line on stderr."""
        try:
            return super().invoke(ctx)
        except InputError as error:
            if isinstance(error.__cause__, Exception) and _is_out_of_memory(error.__cause__):
                fail(_less_memory("the machine", self.commands[ctx.invoked_subcommand], []), 1)  # not the file's fault
            fail(str(error), 2)
        except KeyboardInterrupt:
            fail(INTERRUPTED, 130)
        except Exception as error:
            command = self.commands.get(ctx.invoked_subcommand, self)  # the group, if there is no such command
            if _is_gpu_out_of_memory(error):
                fail(_less_memory("the GPU", command, ["use --device cpu"]), 1)
            if _is_out_of_memory(error):
                fail(_less_memory("the machine", command, []), 1)
            if not isinstance(error, OSError) or error.filename is None and error.errno is None:
                raise
            where = f"{error.filename}: " if error.filename else ""
            fail(f"{where}{error.strerror or error}", 2)


def _path_of(parameter, ctx, value):
    """Process the value of a parameter of type Path, or the values of a repeatable one. Raises InputError if empty."""
    if "" in (value if isinstance(value, (list, tuple)) else [value]):
        name = parameter.metavar if parameter.param_type_name == "argument" else parameter.opts[-1]
        raise InputError(f"{name}: the path is empty; give the path of a file or folder, or . for the current folder")
    return type(parameter).process_value(parameter, ctx, value)


def _is_gpu_out_of_memory(error: Exception) -> bool:
    """Whether PyTorch, CUDA or Warp failed to allocate memory on a GPU."""
    torch = sys.modules.get("torch")  # without importing it, which takes a second
    if torch is not None and isinstance(error, torch.cuda.OutOfMemoryError):
        return True
    text = str(error)
    return "CUDA error: out of memory" in text or ("Failed to allocate" in text and "cuda" in text)


def _is_out_of_memory(error: Exception) -> bool:
    """Whether an allocation failed in Python, NumPy, PyTorch, OpenCV, a thread's start or the dynamic loader."""
    known = isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM
    known = known or any(text in str(error) for text in NO_MEMORY)
    return known or isinstance(error.__cause__, Exception) and _is_out_of_memory(error.__cause__)


def _less_memory(what: str, command, remedies: list[str]) -> str:
    """Message for a command that ran out of memory: which of its options to lower, and other remedies."""
    options = {option for parameter in command.params for option in parameter.opts}
    sizes = [option for option in SIZE_OPTIONS if option in options]
    lower = [f"lower {' or '.join(sizes)}"] if sizes else []
    remedies = remedies if "--device" in options else []
    return ", ".join([OUT_OF_MEMORY.format(what), *lower, *remedies])


def fail(message: str, status: int) -> None:
    """Exit with one line on stderr, after closing the progress bars that the error left open."""
    if "tqdm" in sys.modules:
        for bar in list(sys.modules["tqdm"].tqdm._instances):
            bar.close()
    print("ngff: " + re.sub(r"[\x00-\x1f\x7f]", "?", message), file=sys.stderr)  # file names may contain line breaks
    sys.exit(status)
