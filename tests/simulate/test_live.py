"""Live sessions: recordings are repeated exactly, hostile clients change nothing, and a page can drag objects."""

import json
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from stages.core.backends import load
from stages.core.errors import InputError, MissingPackage
from stages.core.physics.forces import Change, ForcePrompts
from stages.core.physics.keypoints import choose_keypoints, pull_range
from stages.core.scene.scene_ply import write_scene
from stages.core.scene.trajectory import read_trajectory
from stages.render.options import RenderOptions
from stages.render.stage import run as render
from stages.simulate.live import server as live_server
from stages.simulate.live.loop import FLUSH_TIME, MAX_LAG
from stages.simulate.live.messages import BadMessage, parse_message
from stages.simulate.live.server import MAX_CLIENTS, LiveServer
from stages.simulate.live.session import Session
from stages.simulate.options import AUTO, ENGINES, QUALITIES, MpmQuality, SimulateOptions
from stages.simulate.setup import parse_box
from stages.simulate.stage import run
from tests.browser import LONGEST, drag_up, until
from tests.conftest import two_balls_scene

connect = pytest.importorskip("websockets.sync.client").connect
exceptions = pytest.importorskip("websockets.exceptions")

FIND_RED = """() => {
  for (let y = 20; y < 340; y += 8) for (let x = 200; x < 470; x += 8)
    if (player.pick(x, y)?.object === 1) return [x + 8, y + 16];
}"""  # returns a point of object 1 in the part of the page without the panel [px]
RED_HEIGHT = """() => {
  const ids = player.film.arrays.keypoint_object, own = [...ids.keys()].filter((k) => ids[k] === 1);
  return own.reduce((sum, k) => sum + player.positions[3 * k + 2] - player.rest[3 * k + 2], 0) / own.length;
}"""  # returns the mean rise of object 1
ROOT = Path(__file__).resolve().parents[2]


# --- messages ---


def test_messages_are_those_of_the_table():
    assert parse_message('{"do": "step"}') == {"do": "step"}
    push = {"do": "push", "object": 1, "point": [0, 0, 1], "direction": [0, 3, 4], "strength": 2}
    assert parse_message(json.dumps(push))["direction"] == (0.0, 0.6, 0.8)


@pytest.mark.parametrize("text", [
    "", "{", "[]", "null", "7", b"\x00\x01", '{"do": 3}', '{"do": "exec"}', '{"do": "step", "more": 1}',
    '{"do": "move"}', '{"do": "move", "target": [1, 2]}', '{"do": "move", "target": [1, 2, NaN]}',
    '{"do": "move", "target": [1, 2, 10001]}',
    '{"do": "pause", "value": 1}', '{"do": "gravity", "value": "9"}', '{"do": "gravity", "value": true}',
    '{"do": "drop", "object": -1}', '{"do": "drop", "object": 1.5}', '{"do": "speed", "value": 0}',
    '{"do": "material", "object": 1, "name": "sand"}', '{"do": "push", "object": 1, "point": [0, 0, 0], "direction": '
    '[0, 0, 0], "strength": 1}', "[" * 2000, " " * 3000,
])  # fmt: skip
def test_other_messages_are_refused(text):
    with pytest.raises(BadMessage):
        parse_message(text)


@pytest.mark.parametrize(("do", "name", "low", "high"), [
    ("push", "strength", 0, 100), ("lift", "height", -100, 100), ("gravity", "value", -100, 100),
    ("friction", "value", 0, 10), ("speed", "value", 0.01, 4),
])  # fmt: skip
def test_numbers_of_messages_up_to_their_limits(do, name, low, high):
    others = {"push": {"object": 1, "point": [0, 0, 1e4], "direction": [0, 0, -1e4]}, "lift": {"object": 2**31 - 1}}
    for limit, beyond in ((low, low - 0.001), (high, high + 0.001)):
        assert parse_message(json.dumps({"do": do, **others.get(do, {}), name: limit}))[name] == limit
        with pytest.raises(BadMessage, match="a number from"):
            parse_message(json.dumps({"do": do, **others.get(do, {}), name: beyond}))
    for wrong in ({"object": 0}, {"object": 2**31}):
        with pytest.raises(BadMessage, match="number of an object"):
            parse_message(json.dumps({"do": "drop", **wrong}))


# --- recording ---


@pytest.fixture(scope="module")
def world():
    return two_balls_scene()


def live_session(world, engine, monkeypatch, actions, frames=26, box="-1,-1,0,1,1,2"):
    """Keypoints of a session with messages in some frames, the session, and a function that repeats given prompts."""
    monkeypatch.setitem(QUALITIES, "draft", MpmQuality(particles=800, step=0.017))
    contact = "learned" if engine == "ngff" else AUTO
    options = SimulateOptions(engine=engine, contact=contact, quality="draft", steps=frames, keypoints=32, box=box)
    keypoints = choose_keypoints(world, 32)
    rollout = load(ENGINES[engine].rollout)
    walls = parse_box(box)
    session = Session(
        ForcePrompts(), keypoints, [1, 2], options.gravity, 1.0, *pull_range(keypoints, walls.low, walls.high)
    )
    live = []
    for n, state in enumerate(rollout(world, keypoints, session.prompts(), options)):
        live.append(state.positions)
        session.observe(state)
        for message in actions(n, state):
            session.handle(message)
    return (
        torch.stack(live),
        keypoints,
        session,
        lambda prompts: torch.stack([state.positions for state in rollout(world, keypoints, prompts, options)]),
    )


def a_busy_user(n, state):
    """Drag the red ball up, push the green one, change gravity, friction and a material, and pin an object."""
    red = [-0.3, 0.0, 0.3]
    return {
        2: [{"do": "grab", "object": 1, "point": red, "target": red}],
        4: [{"do": "move", "target": [-0.3, 0.0, 0.6]}],
        12: [{"do": "push", "object": 2, "point": [0.3, 0.0, 0.3], "direction": [0.0, 1.0, 0.0], "strength": 1.0}],
        14: [{"do": "release"}, {"do": "lift", "object": 2, "height": 0.1}],
        16: [{"do": "gravity", "value": 3.0}, {"do": "friction", "value": 0.2}],
        18: [{"do": "material", "object": 1, "name": "jelly"}, {"do": "drop", "object": 2}],
        20: [{"do": "pin", "object": 1, "value": True}, {"do": "drop", "object": 99}],
    }.get(n, [])


@pytest.fixture(scope="module")
def busy_session(world):
    """Function that returns the session of a busy user, cached by engine."""
    with pytest.MonkeyPatch.context() as patch:
        yield cache(lambda engine: live_session(world, engine, patch, a_busy_user))


@pytest.mark.parametrize("engine", ["ngff", pytest.param("mpm", marks=pytest.mark.slow), "rigid"])
def test_a_record_repeats_the_motion_exactly(busy_session, engine):
    live, keypoints, session, motion_of = busy_session(engine)
    record = ForcePrompts.from_dicts(json.loads(json.dumps(session.record)))
    assert torch.equal(live, motion_of(record))
    red = keypoints.object_id == 1
    assert (live[14, red] - live[2, red]).mean(0)[2] > 0.05  # it was dragged up
    assert (live[20:, red] - live[21, red]).norm(dim=-1)[1:].max() < 1e-5  # it was pinned
    assert {row.get("what") for row in session.record} == {None, "gravity", "friction", "material", "pinned"}


def test_what_is_held_hangs_where_the_cursor_is(world, monkeypatch):
    goal = torch.tensor([-0.3, 0.0, 0.5])

    def hold(n, state):
        return [{"do": "grab", "object": 1, "point": [-0.3, 0.0, 0.3], "target": goal.tolist()}] if n == 0 else []

    live, _, session, _ = live_session(world, "ngff", monkeypatch, hold, frames=45)
    _, k = session.dragged
    assert (live[-1, k] - goal).norm() < 0.03


PAGE_SESSION = """async ([frames, actions]) => {
  const { engineInput } = await import("player/local.js"), { FieldEngine } = await import("player/engine.js");
  const { Session } = await import("player/session.js");
  const session = new Session(new FieldEngine(engineInput(player.film, player.rest)));
  for (let n = 0; n < frames - 1; n++) {
    for (const message of actions[n] ?? []) session.handle(message);
    session.advance();
  }
  return Array.from(session.now.positions);
}"""


@pytest.mark.usefixtures("device")
def test_a_page_without_server_answers_alike(busy_session, tmp_path, open_page):
    """The engine and the page of a playable film respond to the same messages with the same motion."""
    live, *_ = busy_session("ngff")
    assert (page_session(tmp_path, open_page, a_busy_user) - live[-1]).norm(dim=1).max() < 1e-3


def page_session(folder, open_page, actions, frames=26, box="-1,-1,0,1,1,2"):
    """Keypoints after a session like `live_session`, in a page without a server."""
    write_scene(folder / "scene.ply", two_balls_scene())
    options = SimulateOptions(engine="ngff", contact="learned", quality="draft", steps=2, keypoints=32, box=box)
    run(folder / "scene.ply", folder / "traj.h5", options)
    page = open_page(render(folder / "traj.h5", folder / "film.html", RenderOptions(playable=True)))
    messages = {n: actions(n, None) for n in range(frames)}
    return torch.tensor(page.evaluate(PAGE_SESSION, [frames, messages])).view(-1, 3)


def a_user_against_the_walls(n, state):
    """Pull the red ball far beyond a wall, throw the green one at another wall, and lift it above the ceiling."""
    return {
        0: [{"do": "grab", "object": 1, "point": [-0.3, 0.0, 0.3], "target": [-3.0, 0.1, 0.4]}],
        2: [{"do": "push", "object": 2, "point": [0.3, 0.0, 0.3], "direction": [0.0, 1.0, 0.0], "strength": 3.0}],
        12: [{"do": "lift", "object": 2, "height": 5.0}],
    }.get(n, [])


@pytest.mark.usefixtures("device")
def test_walls_stop_what_is_pulled_and_pushed_in_the_page_as_in_the_engine(world, tmp_path, monkeypatch, open_page):
    box = "-0.7,-0.5,0,0.7,0.5,1"
    live, keypoints, *_ = live_session(world, "ngff", monkeypatch, a_user_against_the_walls, 30, box)
    end = page_session(tmp_path, open_page, a_user_against_the_walls, 30, box)
    assert (end - live[-1]).norm(dim=1).max() < 1e-3
    radius, walls = 0.15, parse_box(box)
    assert live[:, keypoints.object_id == 1].mean(1)[:, 0].min() < -0.7 + 2 * radius  # it was pulled to the wall
    inside = (end > torch.tensor(walls.low) - 0.1 * radius) & (end < torch.tensor(walls.high) + 0.1 * radius)
    assert inside.all()


def test_changes_come_back_from_json():
    prompts = ForcePrompts(changes=(Change("gravity", 1.6, 0.5), Change("pinned", True, 0.7, 2)), lift={1: 0.2})
    assert ForcePrompts.from_dicts(json.loads(json.dumps(prompts.as_dicts()))) == prompts
    for wrong in ({"kind": "spell"}, {"kind": "change", "what": "colour", "value": 1, "start": 0, "object_id": None}):
        with pytest.raises((KeyError, ValueError)):
            ForcePrompts.from_dicts([wrong])


# --- the server ---


@pytest.fixture
def server():
    with LiveServer("<p>page</p>") as server:
        yield server


def client(server, **options):
    origin = f"http://127.0.0.1:{server.port}"
    address = server.url.replace("http", "ws") + "live"
    return connect(**{"uri": address, "origin": origin, "compression": None, "max_size": None, **options})


def say(socket, **message):
    socket.send(json.dumps(message))


def heard(server, seconds=LONGEST):
    """The next messages of the controlling client."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if messages := server.messages(wait=0.1):
            return messages
    return []


def eventually(condition, seconds=LONGEST):
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.01)
    return condition()


def answer(server, request: bytes) -> bytes:
    with socket.create_connection(("127.0.0.1", server.port), timeout=LONGEST) as raw:
        raw.sendall(request)
        raw.settimeout(LONGEST)
        try:
            return b"".join(iter(lambda: raw.recv(65536), b""))
        except (TimeoutError, ConnectionError):
            return b""


def test_page_needs_the_token_and_the_host(server):
    path = server.url.partition(str(server.port))[2]
    host = f"127.0.0.1:{server.port}"
    assert answer(server, f"GET {path} HTTP/1.1\r\nHost: {host}\r\n\r\n".encode()).endswith(b"<p>page</p>")
    for wrong in (f"GET / HTTP/1.1\r\nHost: {host}\r\n\r\n", f"GET /{'A' * 32}/ HTTP/1.1\r\nHost: {host}\r\n\r\n",
                  f"GET {path} HTTP/1.1\r\nHost: evil.example\r\n\r\n", f"GET {path} HTTP/1.1\r\n\r\n",
                  "POST / HTTP/1.1\r\n\r\n", f"GET /../../etc/passwd HTTP/1.1\r\nHost: {host}\r\n\r\n"):  # fmt: skip
        assert b"page" not in answer(server, wrong.encode())
    assert b"page" not in answer(server, os.urandom(5000))
    with pytest.raises(OSError):  # other addresses of this machine do not work
        socket.create_connection(("127.0.0.2", server.port), timeout=1)


def test_socket_needs_token_and_origin(server):
    wrong = server.url.replace("http", "ws").replace(server.url.split("/")[-2], "A" * 32) + "live"
    for options in ({"uri": wrong}, {"origin": "http://evil.example"}, {"origin": None}, {"origin": "null"}):
        with pytest.raises(exceptions.InvalidStatus) as refused:
            client(server, **options)
        assert refused.value.response.status_code in (403, 404)
    with client(server) as good:
        assert json.loads(good.recv(timeout=LONGEST)) == {"control": True}


def test_a_port_that_is_taken_and_an_absent_package_are_named(server, monkeypatch):
    with pytest.raises(InputError, match=f"--port {server.port}: the port cannot be opened .*; choose another"):
        LiveServer("<p>page</p>", server.port)
    monkeypatch.setitem(sys.modules, "websockets.asyncio.server", None)
    with pytest.raises(MissingPackage, match="--live needs the package websockets: `pip install websockets`"):
        LiveServer("<p>page</p>")


def test_one_client_controls_and_the_next_takes_over(server):
    with client(server) as first, client(server) as next_one:
        assert json.loads(next_one.recv(timeout=LONGEST)) == {"control": False}
        say(next_one, do="step")
        say(first, do="pause", value=True)
        assert heard(server) == [{"do": "pause", "value": True}]
        first.close()
        assert json.loads(next_one.recv(timeout=LONGEST)) == {"control": True}
        assert {"do": "release"} in heard(server)
        say(next_one, do="save")
        assert {"do": "save"} in heard(server)


def test_frames_wait_until_the_last_is_drawn(server):
    with client(server) as page:
        page.recv(timeout=LONGEST)
        server.publish(b"first")
        say(page, do="drawn")
        assert page.recv(timeout=LONGEST) == b"first"
        for i in range(5):
            server.publish(b"%d" % i)
        with pytest.raises(TimeoutError):
            page.recv(timeout=0.2)
        say(page, do="drawn")
        assert page.recv(timeout=LONGEST) == b"4"


def test_hostile_clients_are_closed_and_others_go_on(server, monkeypatch):
    # all messages arrive within one second
    monkeypatch.setattr(live_server, "time", SimpleNamespace(monotonic=lambda: 7.0))
    with client(server) as good:
        good.recv(timeout=LONGEST)
        for hostility in (["garbage"] * 20, [b"\x00" * 100] * 20, ["x" * 10_000_000], ['{"do": "drawn"}'] * 2000):
            bad = client(server)
            with pytest.raises((exceptions.ConnectionClosed, ConnectionError)):
                for text in hostility:
                    bad.send(text)
                while True:
                    bad.recv(timeout=LONGEST)
            bad.close()
        with socket.create_connection(("127.0.0.1", server.port)) as raw:
            raw.sendall(b"\x00" * 100_000)
        say(good, do="step")
        assert heard(server) == [{"do": "step"}]
    assert eventually(lambda: len(server._clients) == 0)


def test_a_message_that_is_too_long_ends_the_connection_before_it_is_read(server):
    with client(server) as page:
        page.recv(timeout=LONGEST)
        page.send('{"do": "drawn"}'.ljust(2048))
        server.publish(b"frame")
        assert page.recv(timeout=LONGEST) == b"frame"
        page.send('{"do": "drawn"}'.ljust(2049))
        with pytest.raises(exceptions.ConnectionClosed) as closed:
            page.recv(timeout=LONGEST)
        assert closed.value.rcvd.code == 1009


def test_errors_of_the_event_loop_are_no_tracebacks(server, caplog):
    """An example is a connection for which no file descriptor is left."""
    server._loop.call_soon_threadsafe(lambda: 1 / 0)
    with client(server) as good:
        assert json.loads(good.recv(timeout=LONGEST)) == {"control": True}
    assert not caplog.records


def test_two_hundred_connections_leave_nothing_behind(server):
    before = len(os.listdir("/proc/self/fd")) if Path("/proc/self/fd").exists() else 0

    def attempt(_):
        try:
            return client(server)
        except (exceptions.InvalidStatus, OSError, EOFError):
            return None

    with ExitStack() as stack, ThreadPoolExecutor(16) as pool:
        connected = [stack.enter_context(c) for c in pool.map(attempt, range(200)) if c is not None]
        assert len(connected) >= 1 and len(server._clients) <= MAX_CLIENTS
    assert eventually(lambda: len(server._clients) == 0)
    if before:
        assert eventually(lambda: len(os.listdir("/proc/self/fd")) <= before)
    server.messages()
    with client(server) as good:
        say(good, do="step")
        assert heard(server) == [{"do": "step"}]


# --- a complete session ---


def test_an_engine_that_fails_at_the_start_ends_the_command(tmp_path, monkeypatch):
    def failing(*_):
        raise InputError("no engine here")
        yield

    monkeypatch.setattr("stages.simulate.learned.rollout", failing)
    write_scene(tmp_path / "scene.ply", two_balls_scene())
    options = SimulateOptions(engine="ngff", live=True, browser=False, keypoints=32)
    with pytest.raises(InputError, match="no engine here"):
        run(tmp_path / "scene.ply", tmp_path / "traj.h5", options)
    assert [p.name for p in tmp_path.iterdir()] == ["scene.ply"]


def start_session(folder: Path, *options: str):
    """Start the command in a separate process on the CPU, where motions are exactly repeatable; and its address."""
    code = "from ngff_cli import ngff; ngff()"
    words = ["simulate", "scene.ply", "-o", "traj.h5", "--live", "--no-browser", "--device", "cpu", *options]
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    process = subprocess.Popen([sys.executable, "-c", code, *words], cwd=folder, stdout=subprocess.PIPE, text=True,
                               env={**os.environ, "PYTHONPATH": path})  # fmt: skip
    return process, process.stdout.readline().strip()


@pytest.fixture
def session(tmp_path):
    write_scene(tmp_path / "scene.ply", two_balls_scene())
    process, url = start_session(tmp_path, "--keypoints", "32")
    yield process, url, tmp_path
    if process.poll() is None:
        process.kill()
    process.wait()


def next_frame(page) -> dict:
    """The header of the next frame."""
    say(page, do="drawn")
    while not isinstance(data := page.recv(timeout=LONGEST), bytes):
        pass
    (length,) = struct.unpack("<I", data[:4])
    return json.loads(data[4 : 4 + length])


@pytest.mark.slow
def test_the_mouse_drags_an_object_and_the_file_repeats_it(session, open_page):
    process, url, folder = session
    page = open_page(url)
    until(page, "player.live.state !== null && player.live.control")
    until(page, f"({FIND_RED})() !== undefined")  # after the splats have been sorted for the first time
    drag_up(page, page.evaluate(FIND_RED), 24, 5)
    until(page, f"player.live.state.arrows.length === 1 && ({RED_HEIGHT})() > 0.05")
    page.mouse.up()
    page.keyboard.press("Space")
    until(page, "player.live.state.paused")
    page.close()
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=LONGEST) == 0
    t = read_trajectory(folder / "traj.h5")
    red = t.keypoints.object_id == 1
    assert (t.positions[:, red] - t.positions[0, red]).mean(1)[:, 2].max() > 0.05
    assert all(f["object_id"] == 1 for f in t.info.forces) and len(t.info.forces) > 5
    run(folder / "scene.ply", folder / "again.h5", SimulateOptions(forces=folder / "traj.h5", device="cpu"))
    assert torch.equal(read_trajectory(folder / "again.h5").positions, t.positions)


@pytest.mark.slow
def test_a_killed_session_leaves_its_recording(session):
    process, url, folder = session
    port = int(url.split(":")[2].split("/")[0])
    with connect(url.replace("http", "ws") + "live", origin=f"http://127.0.0.1:{port}") as page:
        say(page, do="gravity", value=2.0)
        while (shown := next_frame(page))["gravity"] != 2.0:
            pass
        until_written = shown["frames"] + (FLUSH_TIME + MAX_LAG) / SimulateOptions.dt  # frames in this time at most
        while next_frame(page)["frames"] <= until_written + 1:
            pass
    process.kill()
    process.wait()
    t = read_trajectory(next(folder.glob(".part-*-traj.h5")))
    assert len(t) > 5 and t.info.forces[0]["what"] == "gravity"


@pytest.mark.slow
def test_reset_starts_a_new_recording_and_save_keeps_the_old(session):
    process, url, folder = session
    port = int(url.split(":")[2].split("/")[0])
    with connect(url.replace("http", "ws") + "live", origin=f"http://127.0.0.1:{port}") as page:
        say(page, do="pause", value=True)
        say(page, do="lift", object=2, height=0.1)
        for _ in range(3):
            say(page, do="step")
        say(page, do="save")
        say(page, do="reset")
        assert eventually((folder / "traj-1.h5").exists)
        while next_frame(page)["frames"] > 1:
            pass
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=LONGEST) == 0
    kept, last = read_trajectory(folder / "traj-1.h5"), read_trajectory(folder / "traj.h5")
    assert len(kept) > 3 and {f["kind"] for f in kept.info.forces} == {"force"}
    assert len(last) < len(kept) + 3 and not last.info.forces
    assert replace(last.info, forces=()) == replace(kept.info, forces=())
