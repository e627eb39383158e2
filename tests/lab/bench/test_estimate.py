"""Estimates of materials, with a local test server."""

import base64
import json
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np
import pytest
import torch

from ngff_cli.lab import app
from stages.core.errors import InputError
from stages.core.physics.materials import choose_materials
from stages.core.scene.images import VideoWriter
from stages.core.scene.scene import SceneObject
from stages.core.scene.scene_ply import write_scene
from stages.lab.assets.objects import OBJECTS
from stages.lab.bench import chat_completions
from stages.lab.bench import estimate_materials as estimate
from stages.lab.bench.dynamics_baselines import VLM_MATERIALS
from stages.lab.bench.estimate_materials import RANGES, EstimateOptions, InvalidReply, parse_reply, run, sample_frames
from tests.conftest import CliRunner

GOOD = {"duck": {"material": "rubber", "E": 3e5, "density": 300}, "ball": {"material": "foam", "E": 1e5, "density": 50}}
KEY = "not-a-real-key"


class Server(ThreadingHTTPServer):
    """Replies with the entries of `script`, one per request: a text, a status, bytes, or seconds of silence."""

    daemon_threads = True

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.script, self.asked, self.keys = [], [], []
        self.url = f"http://127.0.0.1:{self.server_address[1]}/v1"


class Handler(BaseHTTPRequestHandler):
    def do_POST(self):
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        self.server.asked.append((self.path, body))
        self.server.keys.append(self.headers.get("Authorization"))
        reply = self.server.script.pop(0)
        if isinstance(reply, float):
            time.sleep(reply)
            return
        status, data = 200, reply
        if isinstance(reply, int):
            status, data = reply, json.dumps({"error": {"message": "so it is"}}).encode()
        elif isinstance(reply, str):
            data = json.dumps({"choices": [{"message": {"role": "assistant", "content": reply}}]}).encode()
        self.send_response(status)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, *_):
        pass


@pytest.fixture
def server(monkeypatch):
    made = Server()
    thread = threading.Thread(target=made.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    for name, value in {"BASE_URL": made.url, "API_KEY": KEY, "MODEL": "seer"}.items():
        monkeypatch.setenv(f"OPENAI_{name}", value)
    monkeypatch.setattr(chat_completions, "PAUSE", 0.01)
    yield made
    made.shutdown()
    thread.join()
    made.server_close()


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    """40 frames, the n-th of brightness n / 40."""
    path = tmp_path_factory.mktemp("video") / "v.mp4"
    with VideoWriter(path, 20.0) as out:
        for n in range(40):
            out.append(torch.full((64, 96, 3), n / 40))
    return path


def test_estimates_are_read_by_simulate(server, video, tmp_path):
    server.script = [json.dumps(GOOD)]
    out = tmp_path / "materials.json"
    lines = run(video, out, EstimateOptions(objects="duck, ball"))
    assert lines == ["duck: rubber, E 3e+05 Pa, 300 kg/m^3", "ball: foam, E 1e+05 Pa, 50 kg/m^3"]
    chosen = choose_materials([SceneObject(1, "ball"), SceneObject(2, "duck")], file=out)
    assert (chosen[2].material.E, chosen[2].material.density, chosen[1].material.E) == (3e5, 300, 1e5)
    facts = json.loads((tmp_path / "materials.json.json").read_text())
    assert facts["model"] == "seer" and facts["inputs"][0]["name"] == "v.mp4" and facts["materials"]["duck"] == "rubber"
    assert KEY not in json.dumps(facts) and facts["replies"] == [json.dumps(GOOD)]


def test_ten_evenly_spaced_frames_are_sent(server, video, tmp_path):
    server.script = [json.dumps(GOOD)]
    run(video, tmp_path / "m.json", EstimateOptions(objects="duck,ball"))
    path, body = server.asked[0]
    assert path == "/v1/chat/completions" and body["model"] == "seer" and server.keys == [f"Bearer {KEY}"]
    text, *pictures = body["messages"][0]["content"]
    assert "duck, ball" in text["text"] and "kg/m^3" in text["text"] and len(pictures) == 10
    light = []
    for part in pictures:
        head, data = part["image_url"]["url"].split(",")
        assert head == "data:image/jpeg;base64"
        light.append(cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR).mean() / 255)
    assert light == pytest.approx([round(i * 39 / 9) / 40 for i in range(10)], abs=0.02)


def test_frames_are_downscaled(tmp_path, video):
    small = sample_frames(video, 3, 48)
    assert [cv2.imdecode(np.frombuffer(j, np.uint8), 1).shape for j in small] == [(32, 48, 3)] * 3
    with VideoWriter(tmp_path / "short.mp4", 20.0) as out:
        for _ in range(4):
            out.append(torch.zeros(64, 96, 3))
    assert len(sample_frames(tmp_path / "short.mp4", 10, 512)) == 4


@pytest.mark.parametrize(("reply", "says"), [
    ("It is a duck.", "is not JSON"), ("[1]", "a JSON object"), ("{}", "a JSON object"),
    ('{"duck": 3}', "no entry for ball"), (json.dumps({**GOOD, "cat": GOOD["duck"]}), "cat was not asked for"),
    (json.dumps({**GOOD, "duck": {"E": 1e5, "density": 3e2}}), "exactly material, E and density"),
    (json.dumps({**GOOD, "duck": {**GOOD["duck"], "nu": 0.3}}), "exactly material, E and density"),
    (json.dumps({**GOOD, "duck": {**GOOD["duck"], "material": " "}}), "material of duck"),
    (json.dumps({**GOOD, "duck": {**GOOD["duck"], "E": "3e5"}}), "plain number in Pa, not \"3e5\""),
    (json.dumps({**GOOD, "duck": {**GOOD["duck"], "E": True}}), "plain number"),
    (json.dumps({**GOOD, "duck": {**GOOD["duck"], "E": 0.3}}), "0.3 Pa, which is not within 100 to 1e\\+12"),
    (json.dumps({**GOOD, "duck": {**GOOD["duck"], "density": 10**400}}), "kg/m\\^3, which is not within"),
    (json.dumps(GOOD).replace("50", "NaN"), "NaN is not a number"),
    ('{"duck": 1, "duck": 2, "ball": 3}', "twice"),
])  # fmt: skip
def test_invalid_replies(reply, says):
    with pytest.raises(InvalidReply, match=says):
        parse_reply(reply, ["duck", "ball"])


def test_markdown_fence_is_accepted_and_names_are_optional():
    assert list(parse_reply("```json\n" + json.dumps(GOOD) + "\n```", ["ball", "duck"])) == ["ball", "duck"]
    assert parse_reply(json.dumps(GOOD), [])["duck"]["density"] == 300.0


def test_invalid_reply_is_sent_back_with_the_reason(server, video, tmp_path):
    negative = {"duck": {**GOOD["duck"], "E": -1}}
    server.script = ["a duck, I think", json.dumps(negative), json.dumps({"duck": GOOD["duck"]})]
    run(video, tmp_path / "m.json", EstimateOptions(objects="duck"))
    last = server.asked[2][1]["messages"]
    assert [m["role"] for m in last] == ["user", "assistant", "user", "assistant", "user"]
    assert last[1]["content"] == "a duck, I think" and "not JSON" in last[2]["content"]
    assert "E of duck is -1 Pa" in last[4]["content"]
    assert len(json.loads((tmp_path / "m.json.json").read_text())["replies"]) == 3


def test_three_invalid_replies_are_an_error(server, video, tmp_path):
    server.script = ["no", "no", "no"]
    with pytest.raises(InputError, match="seer at http.*: 3 answers could not be used, the last because it is not"):
        run(video, tmp_path / "m.json", EstimateOptions(objects="duck"))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("script", "says"), [
    ([401], "401 .*so it is.*; check OPENAI_API_KEY"), ([404], "404 .*has the model 'seer'"), ([400], "accepts images"),
    ([503, 500, 429], "429 .*, 3 times; try later"), ([b"<html>"], "choices\\[0\\]"), ([b"{}"], "choices\\[0\\]"),
    ([1.0, 1.0, 1.0], "no answer within 0.2 s, 3 times"),
])  # fmt: skip
def test_failing_servers(server, video, tmp_path, script, says):
    server.script = list(script)
    with pytest.raises(InputError, match=says) as caught:
        run(video, tmp_path / "m.json", EstimateOptions(objects="duck", timeout=0.2))
    assert KEY not in str(caught.value) and "\n" not in str(caught.value) and not list(tmp_path.iterdir())
    assert len(server.asked) == len(script)


def test_busy_and_silent_servers_are_retried(server, video, tmp_path):
    server.script = [503, 1.0, json.dumps({"duck": GOOD["duck"]})]
    run(video, tmp_path / "m.json", EstimateOptions(objects="duck", timeout=0.3))
    assert len(server.asked) == 3 and (tmp_path / "m.json").exists()


def test_missing_environment_variables_are_reported(server, video, tmp_path, monkeypatch):
    monkeypatch.delenv("OPENAI_API_KEY")
    server.script = [401]
    with pytest.raises(InputError, match="set OPENAI_API_KEY"):
        run(video, tmp_path / "m.json", EstimateOptions(objects="duck"))
    assert server.keys == [None]  # and no key was sent
    monkeypatch.setenv("OPENAI_BASE_URL", "localhost:1/v1")
    with pytest.raises(InputError, match="must begin with http"):
        run(video, tmp_path / "m.json")
    monkeypatch.setenv("OPENAI_BASE_URL", "http://127.0.0.1:9/v1")  # nobody listens there
    with pytest.raises(InputError, match="no connection"):
        run(video, tmp_path / "m.json")
    monkeypatch.delenv("OPENAI_MODEL")
    with pytest.raises(InputError, match="--model or OPENAI_MODEL"):
        run(video, tmp_path / "m.json")


def test_names_are_read_from_a_scene(two_balls, tmp_path):
    write_scene(tmp_path / "s.ply", two_balls)
    assert estimate.object_names(str(tmp_path / "s.ply")) == ["red ball", "green ball"]
    with pytest.raises(InputError, match="'duck' is there twice"):
        estimate.object_names("duck,ball,duck")


def test_the_command(server, video, tmp_path):
    server.script = [json.dumps({"duck": GOOD["duck"]})]
    args = ["estimate-materials", str(video), "-o", str(tmp_path / "m.json"), "--objects", "duck", "--model", "other"]
    done = CliRunner().invoke(app, args)
    assert done.exit_code == 0 and done.stdout == "duck: rubber, E 3e+05 Pa, 300 kg/m^3\n", done.stderr
    assert server.asked[0][1]["model"] == "other" and json.loads((tmp_path / "m.json").read_text()) == \
        {"duck": {"E": 3e5, "density": 300.0}}  # fmt: skip
    done = CliRunner().invoke(app, ["estimate-materials", str(tmp_path / "no.mp4"), "--objects", "duck"])
    assert done.exit_code == 2 and "no.mp4: no such file" in done.stderr


def test_the_published_estimates_are_of_the_ten_objects():
    assert VLM_MATERIALS.keys() == OBJECTS.keys()
    for E, density in VLM_MATERIALS.values():
        assert RANGES["E"][0] < E < RANGES["E"][1] and RANGES["density"][0] < density < RANGES["density"][1]
