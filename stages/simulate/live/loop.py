"""`ngff simulate scene.ply --live`: runs the engine in real time, shows it on a page and records it."""

from __future__ import annotations

import itertools
import json
import logging
import shutil
import signal
import struct
import threading
import time
import webbrowser
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from stages.core.errors import InputError
from stages.core.physics.forces import ForcePrompts
from stages.core.physics.keypoints import bind_gaussians, pull_range
from stages.core.physics.materials import ELASTIC
from stages.core.physics.shadow_casting import find_shadows
from stages.core.physics.state import FrameState
from stages.core.player.film import Motion, film_page, pack_film
from stages.core.scene.files import replacing
from stages.core.scene.scene import Scene
from stages.core.scene.trajectory import Keypoints, SimulationInfo, TrajectoryWriter
from stages.simulate.live.server import LiveServer
from stages.simulate.live.session import Session
from stages.simulate.options import SimulateOptions
from stages.simulate.setup import SceneSetup, set_up_scene

log = logging.getLogger(__name__)
ENDLESS = 10**9  # number of frames asked of the engine
FLUSH_TIME = 1.0  # time between writes of the recording to the disk [s]
RATE_TIME = 1.0  # time over which the frame rate is measured [s]
IDLE_TIME = 0.1  # longest time between frames sent to the page, also while paused [s]
MAX_LAG = 0.25  # largest lag behind real time; beyond it simulated time runs more slowly instead of in jumps [s]


@dataclass(frozen=True)
class LiveScene:
    """A scene that is ready to be simulated, with its engine."""

    world: Scene
    keypoints: Keypoints
    prompts: ForcePrompts
    options: SimulateOptions
    rollout: object  # the engine, a function as in `stages.simulate.options.Engine`


def run_live(scene: LiveScene, out: Path, info: SimulationInfo, stop: threading.Event | None = None) -> None:
    """Simulate until Ctrl-C (or `stop`), and write the frames since the last start to `out`.

    Raises InputError for unusable options and if the engine fails in the first frame, and MissingPackage without the
    package websockets.
    """
    stop = _stop_on_signals() if stop is None else stop
    setup = set_up_scene(scene.world, scene.prompts, scene.options)
    binding = bind_gaussians(scene.world, scene.keypoints)
    page = _page(scene, binding, setup, out)
    with LiveServer(page, scene.options.port) as server, \
            TrajectoryWriter(out, scene.world, info, scene.keypoints, binding) as writer:  # fmt: skip
        print(server.url, flush=True)
        if scene.options.browser:
            webbrowser.open(server.url)
        log.info("the page is accessible from this machine only; Ctrl-C ends the session and writes %s", out)
        live = _Live(scene, setup, server, writer, out)
        while not stop.is_set():
            live.turn()
        writer.store_prompts(live.session.record)
    log.info("%s: %d frames; to repeat this motion, run ngff simulate SCENE.ply --forces %s", out, writer.frames, out)


class _Live:
    """The state of a session between iterations of its loop."""

    def __init__(self, scene: LiveScene, setup: SceneSetup, server: LiveServer, writer: TrajectoryWriter, out: Path):
        self.scene, self.setup, self.server, self.writer, self.out = scene, setup, server, writer, out
        self.dt, self.speed, self.paused, self.note = scene.options.dt, 1.0, False, ""
        self.flushed = self.shown = 0.0
        self.start()

    def start(self) -> None:
        """Start or restart the simulation, with a new recording."""
        self.session = _session(self.scene, self.setup)
        endless = replace(self.scene.options, steps=ENDLESS)
        self.states: Iterator[FrameState] = self.scene.rollout(
            self.scene.world, self.scene.keypoints, self.session.prompts(), endless
        )
        self.writer.restart()
        self.note, self.due = "", time.monotonic()
        self.turns: deque[tuple[float, int]] = deque()
        self.advance()

    def turn(self) -> None:
        """One iteration of the loop: handle messages, advance if a frame is due, send frames and write."""
        now = time.monotonic()
        for message in self.server.messages(wait=IDLE_TIME if self.paused else max(0.0, self.due - now)):
            self.take(message)
        now = time.monotonic()
        if not self.paused and now >= self.due:
            self.due = max(self.due + self.dt / self.speed, now - MAX_LAG)
            self.advance()
        elif now - self.shown > IDLE_TIME:
            self.show()
        if now - self.flushed > FLUSH_TIME:
            self.writer.store_prompts(self.session.record)
            self.flushed = now

    def take(self, message: dict) -> None:
        """Handle messages about time and the recording; pass the others to the session."""
        match message["do"]:
            case "pause":
                self.paused, self.due = message["value"], time.monotonic()
                self.turns.clear()
            case "step" if self.paused:
                self.advance()
            case "speed":
                self.speed, self.due = message["value"], time.monotonic()
                self.turns.clear()
            case "reset":
                self.start()
            case "save":
                self.save()
            case _:
                self.session.handle(message)

    def advance(self) -> None:
        """Advance by one frame; if the engine fails, pause with a note, since only a restart helps.

        Raises InputError if the engine fails in the first frame.
        """
        try:
            state = next(self.states)
        except InputError as error:
            if self.session.state is None:  # there is no frame to show
                raise
            log.warning("%s", error)
            self.note, self.paused = f"{error} Start again with R.", True
            return self.show()
        except StopIteration:  # the engine has failed before
            return self.show()
        self.session.observe(state)
        self.writer.append(state.positions, state.com, state.rotation)
        self.writer.store_field(state.start)
        self.turns.append((time.monotonic(), self.writer.frames))
        while self.turns[-1][0] - self.turns[0][0] > RATE_TIME:
            self.turns.popleft()
        self.show()

    def save(self) -> None:
        """Save a copy of the recording so far next to the output file: traj-1.h5, traj-2.h5, ...

        If it cannot be written, for example on a full disk, a note says so and the session goes on.
        """
        numbered = (self.out.with_name(f"{self.out.stem}-{i}{self.out.suffix}") for i in itertools.count(1))
        path = next(p for p in numbered if not p.exists())
        self.writer.store_prompts(self.session.record)
        try:
            with replacing(path) as part:
                shutil.copyfile(self.writer.part, part)
        except InputError as error:
            log.warning("%s", error)
            self.note = str(error)
            return
        self.note = f"{path.name}: {self.writer.frames} frames"
        log.info("saved %s", self.note)

    def show(self) -> None:
        """Send the present frame: length of the header (uint32), header (JSON, 4-byte padding), keypoints (float32)."""
        session = self.session
        self.shown = time.monotonic()
        span = self.turns[-1][0] - self.turns[0][0] if len(self.turns) > 1 else 0.0
        frames_per_second = (self.turns[-1][1] - self.turns[0][1]) / span if span > 0 else 0.0
        header = {
            "time": (self.writer.frames - 1) * self.dt, "frames": self.writer.frames, "paused": self.paused,
            "speed": self.speed, "rate": frames_per_second, "arrows": session.arrows, "pinned": sorted(session.pinned),
            "lifted": sorted(session.lifted), "gravity": session.gravity, "note": self.note,
        }  # fmt: skip
        text = json.dumps(header).encode()
        text += b" " * (-len(text) % 4)
        positions = session.state.positions.float().contiguous().numpy().tobytes()
        self.server.publish(struct.pack("<I", len(text)) + text + positions)


def _page(scene: LiveScene, binding, setup: SceneSetup, out: Path) -> str:
    """The HTML page of the session; its film has a single frame, with the keypoints at rest."""
    world, rest = scene.world, scene.keypoints.rest
    count = len(world.objects)
    motion = Motion(
        scene.keypoints, binding, rest[None], rest.new_zeros(1, count, 3), rest.new_zeros(1, count, 4), scene.options.dt
    )
    settings = {
        "live": {
            "dt": scene.options.dt, "gravity": scene.options.gravity, "materials": ELASTIC, "out": str(out),
            "material": {o.id: setup.materials[o.id].name for o in world.objects}, "engine": scene.options.engine,
        },
        "arrows": True,
    }  # fmt: skip
    film = pack_film(world, motion, settings, find_shadows(world, scene.keypoints))
    return film_page(film, f"{out.stem} live")


def _session(scene: LiveScene, setup: SceneSetup) -> Session:
    unit, room = scene.world.metres_per_unit, {}
    if scene.options.box:
        room = dict(zip(("low", "high"), pull_range(scene.keypoints, setup.box.low, setup.box.high), strict=True))
    ids = [o.id for o in scene.world.objects]
    return Session(scene.prompts, scene.keypoints, ids, scene.options.gravity, unit, **room)


def _stop_on_signals() -> threading.Event:
    """An event that is set by Ctrl-C and SIGTERM; a second Ctrl-C interrupts."""
    stop = threading.Event()

    def end(number, _frame) -> None:
        stop.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, end)
    return stop
