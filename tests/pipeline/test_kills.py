"""Commands that are killed, interrupted, or run out of disk space or memory at random moments leave no partial files.

`NGFF_KILLS=200 python -m pytest -s -m slow tests/pipeline/test_kills.py` tests 200 moments and prints a table.
"""

import multiprocessing
import os
import random
import resource
import shutil
import signal
import sys
import time
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from ngff_cli.app import app
from ngff_cli.lab import app as lab
from ngff_cli.options import interrupt, run_command_line
from stages.core.scene.images import video_info
from stages.core.scene.scene_ply import write_scene
from stages.lab.dataset.keypoint_motions import write_motions
from stages.reconstruct.options import QUALITY_PRESETS
from tests.conftest import two_balls_scene
from tests.lab.small_world import shrink_process
from tests.lab.training.test_train import falling
from tests.reconstruct.raycast import arc, write_set

MOMENTS = int(os.environ.get("NGFF_KILLS", 16))
HOWS = ("SIGKILL", "SIGINT", "SIGTERM", "full disk", "no memory")
HANGING = 600.0  # a process that takes this long counts as hanging [s]
NO_LIMIT = resource.RLIM_INFINITY
SIMULATE = "simulate scene.ply --keypoints 16 --steps 20 --lift 0.2"
COMMANDS = {  # arguments of ngff or ngff-lab; `--resume` is added to the run after the disturbed one
    "reconstruct": "reconstruct images -o out/scene.ply --cameras transforms.json --quality draft",
    "segment": "segment scene.ply -o out/labelled.ply",
    "refine": "refine scene.ply -o out/refined.ply",
    "simulate": f"{SIMULATE} --engine ngff -o out/traj.h5",
    "simulate rigid": f"{SIMULATE} --engine rigid -o out/traj.h5",
    "render": "render traj.h5 --resolution 64 -o out/film.mp4",
    "render html": "render traj.h5 -o out/film.html",
    "evaluate": "evaluate traj.h5 --against traj.h5 -o out/metrics.json",
    "train": "train gcn --data data -o out/w.safetensors --steps 12 --batch 2 --keypoints 8 --horizons 2,3 --width 8 "
             "--groups 3_0..3_1",
    "dataset": "dataset out --groups 3_9 --parts scenes,motions --frames 3 --keypoints 64 --dx .08 --spacing .04 "
               "--substep 2e-3 --exact",
}  # fmt: skip
RESUMED = {"reconstruct": ".steps-scene.ply", "train": "w.ckpt"}  # only if the file exists


def memory(key: str, process: int | str = "self") -> int:
    """Memory of a process [bytes]: VmSize is the currently mapped size, VmPeak the largest so far."""
    try:
        lines = Path(f"/proc/{process}/status").read_text().splitlines()
    except (FileNotFoundError, ProcessLookupError):  # its parent, the fork server, has just collected its exit status
        return 0
    # 0 after the process has ended
    return next((int(line.split()[1]) << 10 for line in lines if line.startswith(key)), 0)


def work(begun, command: str, words: list[str], folder: Path, largest: int, more: int) -> None:
    """Run a command in a separate process that can write `largest` bytes per file and map `more` bytes."""
    try:
        begun.set()
        run(command, words, folder, largest, more)
    except KeyboardInterrupt:  # raised before the command line catches it
        sys.exit(130)


def run(command: str, words: list[str], folder: Path, largest: int, more: int) -> None:
    """Set the limits of this process, reduce the amount of work, and run the command."""
    os.chdir(folder)
    os.environ["TMPDIR"] = str(folder / "tmp")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    os.dup2(os.open("errors" if largest == NO_LIMIT else os.devnull, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 2)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # background processes of a shell ignore it by default
    small = {"gaussians": 1000, "iterations": 5}
    QUALITY_PRESETS["draft"] = replace(QUALITY_PRESETS["draft"], **small)
    sys.dont_write_bytecode = True  # Python before 3.12.8 would keep truncated bytecode
    resource.setrlimit(resource.RLIMIT_FSIZE, (largest, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
    shrink_process()
    if more != NO_LIMIT:
        resource.setrlimit(resource.RLIMIT_AS, (memory("VmSize") + more, resource.getrlimit(resource.RLIMIT_AS)[1]))
    run_command_line(lab if command in ("train", "dataset") else app, words)


@dataclass(frozen=True)
class Undisturbed:
    """Results of a command without disturbance: its files, duration, and mapped memory beyond that of its parent."""

    inputs: Path
    files: dict[str, bytes]
    seconds: float
    mapped: int  # memory [bytes]


def files_in(folder: Path) -> dict[str, bytes]:
    """The files below a folder; for videos and training times, which differ between runs, only their constant part."""
    found = {}
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        name = str(path.relative_to(folder))
        if path.suffix == ".mp4" and not name.startswith("."):
            found[name] = repr(video_info(path)).encode()
        else:
            found[name] = b"" if name in ("w.json", "w.ckpt") else path.read_bytes()
    return found


def start(command: str, folder: Path, resume: bool = False, largest: int = NO_LIMIT, more: int = NO_LIMIT):
    """Start a process that runs a command in a folder, and wait until it begins; its limits are those of `work`."""
    (folder / "out").mkdir(exist_ok=True)
    (folder / "tmp").mkdir(exist_ok=True)
    resume = resume and command in RESUMED and (folder / "out" / RESUMED[command]).exists()
    words = COMMANDS[command].split() + ["--resume"] * resume
    begun = CONTEXT.Event()
    process = CONTEXT.Process(target=work, args=(begun, command, words, folder, largest, more))
    process.start()
    begun.wait(HANGING)  # signals during the start of Python cannot be caught by the command
    return process


CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload([__name__, "stages.reconstruct.classic", "stages.simulate.stage"])


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("inputs")
    write_set(folder, arc(4, (96, 72), sweep=40.0))
    write_scene(folder / "scene.ply", two_balls_scene())
    (folder / "data" / "motions").mkdir(parents=True)
    for seed, name in enumerate(("3_0", "3_1")):
        write_motions(folder / "data" / "motions" / f"{name}.h5", falling(frames=6, seed=seed), {"command": name})
    process = start("simulate", folder)
    process.join()
    (folder / "out" / "traj.h5").rename(folder / "traj.h5")
    return folder


def disturbed(command: str, how: str, rng: random.Random, known: Undisturbed, folder: Path) -> tuple[str, str]:
    """Run a command, disturb it, and run it again; returns how it ended, and errors in the files that it left."""
    shutil.copytree(known.inputs, folder)
    if how == "full disk":
        process = start(command, folder, largest=int(rng.uniform(0, 1.05 * max(map(len, known.files.values())))))
    elif how == "no memory":
        process = start(command, folder, more=int(rng.uniform(0, 1.05 * known.mapped)))
    else:
        process = start(command, folder)
        time.sleep(rng.uniform(0, 1.05 * known.seconds))
        if process.is_alive():
            os.kill(process.pid, getattr(signal, how))
    process.join(HANGING)
    process.kill()  # in case it hangs
    process.join()
    code, wrong, errors = process.exitcode, [], folder / "errors"
    errors = errors.read_text(errors="replace") if errors.exists() else ""
    left = {name: data for name, data in files_in(folder / "out").items() if not name.split("/")[-1].startswith(".")
            and ".steps-" not in name and not name.endswith((".ckpt", ".partial.h5"))}  # fmt: skip
    partial = [name for name in left if left[name] != known.files.get(name)]
    if partial:
        wrong.append(f"{partial} not as undisturbed")
    allowed = {"SIGKILL": (0, -9), "full disk": (0, 2), "no memory": (0, 1, 2)}.get(how, (0, 130, -2, -15))
    if code not in allowed or how == "no memory" and "Traceback" in errors:
        wrong.append(f"exit status {code}: {errors[-300:]}")
    again = start(command, folder, resume=True)
    again.join()
    if again.exitcode != 0:
        wrong.append(f"exit status {again.exitcode} of the next run")
    after = files_in(folder / "out")
    if after != known.files:
        other = sorted({name for name, _ in after.items() ^ known.files.items()})
        wrong.append(f"after the next run {other} are not as undisturbed")
    temporary = [path.name for path in (folder / "tmp").iterdir() if not path.name.startswith("torchinductor")]
    if temporary and how != "SIGKILL":
        wrong.append(f"temporary files {temporary}")
    shutil.rmtree(folder)
    return "complete" if code == 0 else "ended", "; ".join(wrong)


def run_undisturbed(command: str, inputs: Path, folder: Path) -> Undisturbed:
    """Run a command without disturbance."""
    shutil.copytree(inputs, folder)
    begun = time.monotonic()
    process = start(command, folder)
    first = peak = memory("VmSize", process.pid)
    while process.is_alive():
        peak = max(peak, memory("VmPeak", process.pid))
        time.sleep(0.02)
    files = files_in(folder / "out")
    assert process.exitcode == 0 and files, (command, (folder / "errors").read_text())
    return Undisturbed(inputs, files, time.monotonic() - begun, peak - first)


@pytest.mark.slow
def test_nothing_is_left_in_parts(inputs, tmp_path):
    rng, counts, failures, known = random.Random(MOMENTS), Counter(), [], {}
    for n in range(MOMENTS):
        command, how = list(COMMANDS)[n % len(COMMANDS)], HOWS[(n // len(COMMANDS) + n) % len(HOWS)]
        if command not in known:
            known[command] = run_undisturbed(command, inputs, tmp_path / command)
        result, wrong = disturbed(command, how, rng, known[command], tmp_path / f"{n}")
        counts[command, how, "wrong" if wrong else result] += 1
        if wrong:
            failures.append(f"{command}, {how}: {wrong}")
    for command in known:
        row = ", ".join(f"{how}: {sum(counts[command, how, r] for r in ('ended', 'complete', 'wrong'))} "
                        f"({counts[command, how, 'complete']} had ended, {counts[command, how, 'wrong']} wrong)"
                        for how in HOWS)  # fmt: skip
        print(f"{command:15s} {row}", file=sys.stderr)
    assert not failures, "\n".join(failures)


def test_an_interrupt_waits_until_an_import_has_ended(monkeypatch):
    """In a callback of the import system it would be ignored, and the lock of imports would not be released."""
    before, alarms = signal.getsignal(signal.SIGALRM), []
    monkeypatch.setattr(signal, "setitimer", lambda *alarm: alarms.append(alarm))
    importing = SimpleNamespace(f_code=SimpleNamespace(co_filename="<frozen importlib._bootstrap>"), f_back=None)
    imported = SimpleNamespace(f_code=SimpleNamespace(co_filename="library.py"), f_back=importing)
    running = SimpleNamespace(f_code=run_command_line.__code__, f_back=importing)  # in a script that is being imported
    try:
        for frame in (sys._getframe(), running):
            with pytest.raises(KeyboardInterrupt):
                interrupt(signal.SIGINT, frame)
        for frame in (importing, imported):
            interrupt(signal.SIGINT, frame)
            assert alarms.pop() == (signal.ITIMER_REAL, 0.01) and signal.getsignal(signal.SIGALRM) is interrupt
    finally:
        signal.signal(signal.SIGALRM, before)
