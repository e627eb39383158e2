"""The loop of a live session with a simulated clock: speed, pauses, delays, failures and recordings."""

import errno
import json
import os
import struct
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import h5py
import pytest
import torch

from stages.core.errors import InputError
from stages.core.physics.forces import ForcePrompts
from stages.core.physics.keypoints import bind_gaussians, choose_keypoints
from stages.core.physics.materials import MATERIALS, MaterialChoice
from stages.core.physics.state import FrameState
from stages.core.scene.trajectory import SimulationInfo, TrajectoryWriter, read_trajectory
from stages.simulate.live import loop
from stages.simulate.options import SimulateOptions
from tests.conftest import two_balls_scene

DT = 0.04
UP = torch.tensor([0.0, 0.0, 1e-3])  # displacement per frame


@pytest.fixture(scope="module")
def still():
    scene = two_balls_scene()
    keypoints = choose_keypoints(scene, 16)
    return scene, keypoints, bind_gaussians(scene, keypoints)


class Played:
    """A session whose server returns `messages` in the next turn, and whose frames take `cost` [s]."""

    def __init__(self, files, still, folder, monkeypatch, cost=lambda n: 0.0, fail_at=None):
        scene, self.keypoints, binding = still
        self.now, self.waited, self.sent, self.messages = 100.0, [], [], []
        monkeypatch.setattr(loop, "time", SimpleNamespace(monotonic=lambda: self.now))

        def rollout(world, keypoints, prompts, options):
            for n in range(options.steps):
                if n == fail_at:
                    raise InputError("it diverged.")
                self.now += cost(n)
                turn = torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1)
                yield FrameState(keypoints.rest + n * UP, torch.zeros(2, 3), turn, torch.ones(2))
                prompts.during(n * DT, (n + 1) * DT)

        self.out = folder / "traj.h5"
        options = SimulateOptions(dt=DT, keypoints=16)
        info = SimulationInfo(DT, (0.0, 0.0, -9.81), "ngff")
        self.files = files
        self.writer = files.enter_context(TrajectoryWriter(self.out, scene, info, self.keypoints, binding))
        live = loop.LiveScene(scene, self.keypoints, ForcePrompts(), options, rollout)
        self.live = loop._Live(live, None, SimpleNamespace(messages=self.take, publish=self.publish), self.writer,
                               self.out)  # fmt: skip

    def take(self, wait):
        self.now += wait + 1e-5
        self.waited.append(wait)
        taken, self.messages = self.messages, []
        return taken

    def publish(self, data):
        (length,) = struct.unpack("<I", data[:4])
        assert length % 4 == 0  # numbers must be aligned
        header = json.loads(data[4 : 4 + length])
        self.sent.append((header, torch.frombuffer(bytearray(data[4 + length :]), dtype=torch.float32).view(-1, 3)))

    @property
    def header(self):
        return self.sent[-1][0]

    def go_on(self, seconds: float, *messages: dict) -> int:
        """Run turns for so much time, the first one with these messages; returns the number of new frames."""
        end, before, self.messages = self.now + seconds, self.writer.frames, list(messages)
        while self.now < end - 1e-9:
            self.live.turn()
        return self.writer.frames - before


@pytest.fixture
def play(still, tmp_path, monkeypatch):
    with ExitStack() as files:
        yield lambda **options: Played(files, still, tmp_path, monkeypatch, **options)


def test_frames_follow_the_clock_at_the_speed_that_is_chosen(play):
    played = play()
    assert played.header["frames"] == 1 and played.header["time"] == 0 and played.header["rate"] == 0
    assert played.go_on(2.0) == pytest.approx(2 / DT, abs=1)
    assert played.header["rate"] == pytest.approx(1 / DT, rel=0.05) and played.header["paused"] is False
    assert played.go_on(2.0, {"do": "speed", "value": 0.5}) == pytest.approx(1 / DT, abs=1)
    assert played.header["rate"] == pytest.approx(0.5 / DT, rel=0.1) and played.header["speed"] == 0.5
    header, positions = played.sent[-1]
    assert header["time"] == pytest.approx((header["frames"] - 1) * DT)
    torch.testing.assert_close(positions, played.keypoints.rest + (header["frames"] - 1) * UP)


def test_a_pause_lasts_until_it_is_ended_but_for_steps(play):
    played = play()
    played.go_on(0.4)
    shown, frames = len(played.sent), played.writer.frames
    assert played.go_on(1.0, {"do": "pause", "value": True}) == 0 and played.header["paused"] is True
    assert len(played.sent) - shown == pytest.approx(1.0 / loop.IDLE_TIME, abs=2)  # the state is still sent
    assert played.header["rate"] == 0
    assert played.go_on(0.2, {"do": "step"}, {"do": "step"}) == 2
    assert played.header["time"] == pytest.approx((frames + 1) * DT)
    assert played.go_on(0.4, {"do": "pause", "value": False}) == pytest.approx(0.4 / DT, abs=1)
    assert played.go_on(0.4, {"do": "step"}) == pytest.approx(0.4 / DT, abs=1)  # steps have an effect only while paused


def test_a_slow_engine_is_followed_by_a_quarter_of_a_second_at_most(play):
    """While frames take three times their duration, the clock is delayed by 0.25 s and a frame, not by 39 frames."""
    played = play(cost=lambda n: 3 * DT if n < 40 else 0.0)
    frames = played.go_on(39 * 3 * DT)
    assert frames == pytest.approx(39, abs=1)
    assert max(played.waited) <= DT
    assert played.go_on(0.4) == pytest.approx((0.4 + 0.25 + 3 * DT) / DT, abs=1)
    assert played.go_on(0.4) == pytest.approx(0.4 / DT, abs=1)


def test_a_failing_engine_pauses_with_a_note_and_a_new_start_helps(play):
    played = play(fail_at=3)
    assert played.go_on(0.4) == 2 and played.header["paused"] is True
    assert played.header["note"] == "it diverged. Start again with R."
    assert played.go_on(0.2, {"do": "step"}) == 0  # the engine has ended
    played.go_on(0.05, {"do": "reset"})
    assert played.header["frames"] == 1 and played.header["note"] == ""
    with pytest.raises(InputError, match="it diverged"):
        play(fail_at=0)


def test_engines_that_tell_no_masses_are_refused(play):
    played = play()
    state = played.live.session.state
    with pytest.raises(InputError, match="--live: this engine does not report the masses of the objects"):
        played.live.session.observe(replace(state, mass=None))
    assert played.live.session.state is state


def test_what_the_user_does_is_recorded_and_saved_copies_are_numbered(play):
    played = play()
    played.go_on(0.2, {"do": "lift", "object": 2, "height": 0.5}, {"do": "gravity", "value": 3.0})
    assert played.header["lifted"] == [2] and played.header["gravity"] == 3.0
    played.go_on(0.1, {"do": "save"})
    assert played.header["note"].startswith("traj-1.h5: ")
    saved = read_trajectory(played.out.with_name("traj-1.h5"))
    assert f"{len(saved)} frames" in played.header["note"]
    assert {row["kind"] for row in saved.info.forces} == {"force", "change"}
    played.go_on(0.1, {"do": "reset"}, {"do": "pin", "object": 1, "value": True}, {"do": "save"})
    assert played.header["lifted"] == [] and played.header["pinned"] == [1]
    assert not read_trajectory(played.out.with_name("traj-2.h5")).info.forces  # the reset started a new recording
    played.writer.store_prompts(played.live.session.record)
    played.files.close()
    whole = read_trajectory(played.out)
    assert len(whole) == played.header["frames"] and whole.info.forces[0]["what"] == "pinned"
    torch.testing.assert_close(whole.positions[-1], played.sent[-1][1])


def test_a_copy_that_cannot_be_written_is_noted_and_the_session_goes_on(play, monkeypatch):
    def full(source, target):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    played = play()
    monkeypatch.setattr(loop.shutil, "copyfile", full)
    played.go_on(0.1, {"do": "save"})
    assert played.header["note"].endswith("traj-1.h5: cannot be written (No space left on device)")
    assert [p.name for p in played.out.parent.iterdir()] == [played.writer.part.name]
    monkeypatch.undo()
    assert played.live.writer.frames > 1
    played.files.close()
    assert len(read_trajectory(played.out)) == played.header["frames"]


def test_the_recording_is_on_the_disk_within_a_second(play):
    played = play()
    played.go_on(1.2)
    with h5py.File(played.writer.part) as file:
        assert len(file["keypoints/positions"]) == pytest.approx(1 / DT, abs=2)


def test_the_page_begins_with_the_scene_at_rest(still, monkeypatch):
    scene, keypoints, binding = still
    films = []
    monkeypatch.setattr(loop, "pack_film", lambda world, motion, settings, shadows: films.append((motion, settings)))
    monkeypatch.setattr(loop, "film_page", lambda film, title: title)
    monkeypatch.setattr(loop, "find_shadows", lambda world, keypoints: None)
    options = SimulateOptions(dt=DT, keypoints=16, engine="rigid", gravity=3.0)
    live = loop.LiveScene(scene, keypoints, ForcePrompts(), options, None)
    materials = {o.id: MaterialChoice(f"m{o.id}", MATERIALS["wood"]) for o in scene.objects}
    assert loop._page(live, binding, SimpleNamespace(materials=materials), Path("a/traj.h5")) == "traj live"
    ((motion, settings),) = films
    assert torch.equal(motion.positions, keypoints.rest[None]) and motion.dt == DT
    assert motion.com.shape == (1, 2, 3) and motion.rotation.shape == (1, 2, 4)
    live = settings["live"]
    assert (live["dt"], live["gravity"], live["engine"], live["out"]) == (DT, 3.0, "rigid", "a/traj.h5")
    assert live["material"] == {1: "m1", 2: "m2"}


def test_a_push_acts_for_a_frame_and_its_arrow_is_shown_for_two_fifths_of_a_second(play):
    played = play()
    tip = played.keypoints.rest[(played.keypoints.object_id == 1).nonzero()[0, 0]]
    push = {"do": "push", "object": 1, "point": tip.tolist(), "direction": (0.0, 1.0, 0.0), "strength": 2.0}
    played.go_on(0.1)
    first = len(played.sent)
    played.go_on(1.0, push)
    arrows = [header["arrows"] for header, _ in played.sent[first:]]
    shown = [a[0] for a in arrows if a]
    assert len(shown) == pytest.approx(0.4 / DT, abs=1) and not arrows[-1]
    tail, end = torch.tensor(shown[0])
    torch.testing.assert_close(end - tail, torch.tensor([0.0, 0.5, 0.0]))  # 0.25 per unit per second
    torch.testing.assert_close(end, tip + (first - 1) * UP, atol=2e-3, rtol=0)
    (force,) = [row for row in played.live.session.record if row["kind"] == "force"]
    impulse = force["force"][1] * (force["end"] - force["start"])
    assert impulse == pytest.approx(2.0, rel=1e-3)  # 2 units per second for 1 kg
