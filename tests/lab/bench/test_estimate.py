"""Estimates of materials by a model, with a local test server."""

import base64
import json

import cv2
import numpy as np
import pytest
import torch

from ngff_cli.lab import app
from stages.core.errors import InputError
from stages.core.models.chat_completions import InvalidReply
from stages.core.physics.materials import choose_materials
from stages.core.scene.images import VideoWriter, sample_frames
from stages.core.scene.scene import SceneObject
from stages.core.scene.scene_ply import write_scene
from stages.lab.assets.objects import OBJECTS
from stages.lab.bench import estimate_materials as estimate
from stages.lab.bench.dynamics_baselines import VLM_MATERIALS
from stages.lab.bench.estimate_materials import RANGES, parse_reply, run
from stages.lab.bench.motion_options import EstimateOptions
from tests.chat_server import KEY
from tests.conftest import CliRunner

GOOD = {"duck": {"material": "rubber", "E": 3e5, "density": 300}, "ball": {"material": "foam", "E": 1e5, "density": 50}}


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    """A video of 40 frames; frame n has brightness n / 40."""
    path = tmp_path_factory.mktemp("video") / "v.mp4"
    with VideoWriter(path, 20.0) as out:
        for n in range(40):
            out.append(torch.full((64, 96, 3), n / 40))
    return path


def test_estimates_are_read_by_simulate(chat_server, video, tmp_path):
    chat_server.script = [json.dumps(GOOD)]
    out = tmp_path / "materials.json"
    lines = run(video, out, EstimateOptions(objects="duck, ball"))
    assert lines == ["duck: rubber, E 3e+05 Pa, 300 kg/m^3", "ball: foam, E 1e+05 Pa, 50 kg/m^3"]
    chosen = choose_materials([SceneObject(1, "ball"), SceneObject(2, "duck")], file=out)
    assert (chosen[2].material.E, chosen[2].material.density, chosen[1].material.E) == (3e5, 300, 1e5)
    facts = json.loads((tmp_path / "materials.json.json").read_text())
    assert facts["model"] == "seer" and facts["inputs"][0]["name"] == "v.mp4" and facts["materials"]["duck"] == "rubber"
    assert KEY not in json.dumps(facts) and facts["replies"] == [json.dumps(GOOD)]


def test_ten_evenly_spaced_frames_are_sent(chat_server, video, tmp_path):
    chat_server.script = [json.dumps(GOOD)]
    run(video, tmp_path / "m.json", EstimateOptions(objects="duck,ball"))
    path, body = chat_server.asked[0]
    assert path == "/v1/chat/completions" and body["model"] == "seer" and chat_server.keys == [f"Bearer {KEY}"]
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
    ("It is a duck.", "not a JSON object"), ("{}", "an entry for each object"),
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


def test_invalid_reply_is_sent_back_with_the_reason(chat_server, video, tmp_path):
    negative = {"duck": {**GOOD["duck"], "E": -1}}
    chat_server.script = ["a duck, I think", json.dumps(negative), json.dumps({"duck": GOOD["duck"]})]
    run(video, tmp_path / "m.json", EstimateOptions(objects="duck"))
    last = chat_server.asked[2][1]["messages"]
    assert [m["role"] for m in last] == ["user", "assistant", "user", "assistant", "user"]
    assert last[1]["content"] == "a duck, I think" and "not a JSON object" in last[2]["content"]
    assert "E of duck is -1 Pa" in last[4]["content"]
    assert len(json.loads((tmp_path / "m.json.json").read_text())["replies"]) == 3


def test_three_invalid_replies_are_an_error(chat_server, video, tmp_path):
    chat_server.script = ["no", "no", "no"]
    with pytest.raises(InputError, match="seer at http.*: 3 answers could not be used, the last because it is not"):
        run(video, tmp_path / "m.json", EstimateOptions(objects="duck"))
    assert not list(tmp_path.iterdir())


def test_a_failing_server_leaves_no_file(chat_server, video, tmp_path):
    chat_server.script = [401]
    with pytest.raises(InputError, match="401 .*; check OPENAI_API_KEY"):
        run(video, tmp_path / "m.json", EstimateOptions(objects="duck"))
    assert not list(tmp_path.iterdir())


def test_names_are_read_from_a_scene(two_balls, tmp_path):
    write_scene(tmp_path / "s.ply", two_balls)
    assert estimate.object_names(str(tmp_path / "s.ply")) == ["red ball", "green ball"]
    with pytest.raises(InputError, match="'duck' occurs twice"):
        estimate.object_names("duck,ball,duck")


def test_the_command(chat_server, video, tmp_path):
    chat_server.script = [json.dumps({"duck": GOOD["duck"]})]
    args = ["estimate-materials", str(video), "-o", str(tmp_path / "m.json"), "--objects", "duck", "--model", "other"]
    done = CliRunner().invoke(app, args)
    assert done.exit_code == 0 and done.stdout == "duck: rubber, E 3e+05 Pa, 300 kg/m^3\n", done.stderr
    assert chat_server.asked[0][1]["model"] == "other" and json.loads((tmp_path / "m.json").read_text()) == \
        {"duck": {"E": 3e5, "density": 300.0}}  # fmt: skip
    done = CliRunner().invoke(app, ["estimate-materials", str(tmp_path / "no.mp4"), "--objects", "duck"])
    assert done.exit_code == 2 and "no.mp4: no such file" in done.stderr


def test_the_published_estimates_are_of_the_ten_objects():
    assert VLM_MATERIALS.keys() == OBJECTS.keys()
    for E, density in VLM_MATERIALS.values():
        assert RANGES["E"][0] < E < RANGES["E"][1] and RANGES["density"][0] < density < RANGES["density"][1]
