"""Damaged and hostile files cause either a correct result or one clear sentence."""

import json
import multiprocessing
import os
import signal
import time
from collections import Counter
from contextlib import nullcontext
from pathlib import Path

import h5py
import pytest

from stages.core.errors import InputError, MissingPackage
from stages.core.scene.scene_ply import read_scene, write_scene
from stages.core.scene.schema import MAX_JSON_DEPTH, parse_json, quote, text
from stages.core.scene.trajectory import read_trajectory
from stages.lab.fuzz import campaign
from stages.lab.fuzz.cases import GOOD, Examples, quiet, result_of
from stages.lab.fuzz.examples import example_scene, write_trajectory
from stages.lab.fuzz.kinds import KINDS, Kind


def run_here(folder: Path, count: int, seed: int = 0) -> tuple[Counter, list[str]]:
    """Run the first `count` cases of a seed in this process: the number of each kind and result, and the failures."""
    counts, failures, examples = Counter(), [], Examples(folder)
    with quiet():
        for number in range(count):
            kind, result, why = examples.run(seed, number)
            counts[kind.name, result] += 1
            if result not in GOOD:
                failures.append(f"{kind.name}, case {number} of seed {seed}: {result}: {why}")
    return counts, failures


@pytest.mark.parametrize("count", [300, pytest.param(1000, marks=pytest.mark.slow)])
def test_damaged_files(tmp_path, count):
    counts, failures = run_here(tmp_path, count)
    assert not failures, "\n".join(failures[:5])
    assert sum(counts.values()) == count and {result for _, result in counts} == set(GOOD)
    assert {kind for kind, _ in counts} == {kind.name for kind in KINDS}
    assert sum(counts[kind.name, "right"] for kind in KINDS) > count / 10  # some of the changed files are still valid


@pytest.fixture(scope="module")
def examples(tmp_path_factory):
    return Examples(tmp_path_factory.mktemp("fuzz"))


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_valid_files_are_right(kind, examples):
    assert result_of(kind, examples.place(kind)) == ("right", "")


def test_results_that_are_not_good(tmp_path):
    def fail(error):
        def read(folder):
            raise error

        return Kind("x", None, {}, read)

    assert result_of(fail(KeyError("x")), tmp_path)[0] == "traceback"
    assert result_of(fail(AssertionError("x")), tmp_path)[0] == "nonsense"
    assert result_of(fail(InputError("x" * 2000)), tmp_path)[0] == "nonsense"
    assert result_of(fail(InputError("\x1b[31m")), tmp_path)[0] == "nonsense"
    assert result_of(fail(MemoryError()), tmp_path)[0] == "more than 2 GB"


def hostile_work(*arguments):
    """The work of a process that dies in case 2 and hangs in case 5."""
    run = Examples.run

    def hostile(self, seed, number):
        if number == 2:
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(60 if number == 5 else 0)
        return run(self, seed, number)

    Examples.run = hostile
    WORK(*arguments)


WORK = campaign._work


@pytest.mark.slow
def test_campaign_survives_crashes_and_hangs(tmp_path, monkeypatch):
    monkeypatch.setattr(campaign, "_work", hostile_work)
    lines = list(campaign.run(tmp_path / "r.json", 8))
    report = json.loads((tmp_path / "r.json").read_text())
    total = report["total"]
    assert (total["signal"], total["more than 10 s"], sum(total.values())) == (1, 1, 8) and "2 failures" in lines[-1]
    assert all(list(Path(failure["files"]).iterdir()) for failure in report["failures"])


@pytest.mark.slow
def test_a_campaign_ends_in_time_with_a_report(tmp_path):
    list(campaign.run(tmp_path / "r.json", 10**6, minutes=1e-6))
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["count"] == sum(report["total"].values()) == 1


@pytest.mark.parametrize("dtype", ["f2", "f8", ">f4", ">f8"])
def test_other_float_types_are_converted(tmp_path, dtype):
    write_trajectory(tmp_path / "t.h5")
    with h5py.File(tmp_path / "t.h5", "a") as file:
        for name in ("gaussians/means", "cameras/viewmats", "keypoints/positions", "binding/weight"):
            values = file[name][()]
            del file[name]
            file[name] = values.astype(dtype)
    assert read_trajectory(tmp_path / "t.h5").positions.dtype.is_floating_point


@pytest.mark.parametrize("target", [h5py.SoftLink("/gaussians/means"), h5py.ExternalLink("/etc/hostname", "/")])
def test_links_are_not_followed(tmp_path, target):
    write_trajectory(tmp_path / "t.h5")
    with h5py.File(tmp_path / "t.h5", "a") as file:
        del file["gaussians/means"]
        file["gaussians/means"] = target
    with pytest.raises(InputError, match="gaussians/means is a link"):
        read_trajectory(tmp_path / "t.h5")


def test_json_is_bounded_and_quoted_text_too():
    assert parse_json("[" * (MAX_JSON_DEPTH - 1) + "]" * (MAX_JSON_DEPTH - 1))
    for data in ("[" * (MAX_JSON_DEPTH + 1) + "]" * (MAX_JSON_DEPTH + 1), "[" * 10**5, "NaN", "1e999", "9" * 20):
        with pytest.raises(ValueError) as caught:
            parse_json(data)
        assert len(str(caught.value)) < 120
    assert quote("\x1b[31m\n" + "x" * 100) == "?[31m?" + "x" * 71 + "..."
    assert text("x" * 200, "a name") == "x" * 200 and text("x" * 201, "a name") == "x" * 197 + "..."
    with pytest.raises(ValueError, match="too large a number"):
        parse_json("9" * 20)
    assert parse_json("9" * 18) == 10**18 - 1


@pytest.mark.parametrize("line", ["property", "property list uchar int ids", "element", "element vertex 1_0"])
def test_headers_of_ply_that_say_nothing_are_refused(tmp_path, line):
    write_scene(tmp_path / "s.ply", example_scene())
    data = (tmp_path / "s.ply").read_bytes().replace(b"property float x\n", f"{line}\nproperty float x\n".encode())
    (tmp_path / "s.ply").write_bytes(data)
    with pytest.raises(InputError, match="s.ply"):
        read_scene(tmp_path / "s.ply")


@pytest.mark.parametrize(("name", "value", "message"), [
    ("field/nu", 0.51, "nu must be from -1 to 0.5"), ("field/solidity", 0.9, "solidity must be from 1"),
    ("field/mass_fraction", 1.01, "mass_fraction must be from 0"), ("binding/weight", 1.01, "weight must be from"),
    ("binding/index", 12, "binding"), ("field/awake", 2, "awake must be from 0 to 1"),
])  # fmt: skip
def test_values_out_of_range_are_refused(tmp_path, name, value, message):
    write_trajectory(tmp_path / "t.h5")
    with h5py.File(tmp_path / "t.h5", "a") as file:
        file[name][...] = value
    with pytest.raises(InputError, match=message):
        read_trajectory(tmp_path / "t.h5")


@pytest.mark.parametrize(("weight", "right"), [(0.0, True), (0.5, False)])
def test_what_is_bound_to_nothing_has_no_weights(tmp_path, weight, right):
    write_trajectory(tmp_path / "t.h5")
    with h5py.File(tmp_path / "t.h5", "a") as file:
        file["binding/index"][3], file["binding/weight"][3] = -1, weight
    with nullcontext() if right else pytest.raises(InputError, match="t.h5"):
        read_trajectory(tmp_path / "t.h5")


def test_files_that_are_absent_are_named(tmp_path):
    with pytest.raises(InputError, match="absent.h5: no such file; a trajectory"):
        read_trajectory(tmp_path / "absent.h5")


def test_a_worker_that_cannot_start_says_why(tmp_path, monkeypatch):
    def examples(folder):
        raise MissingPackage("videos need PyAV; `pip install av`")

    monkeypatch.setattr(campaign, "Examples", examples)
    monkeypatch.setattr(campaign.os, "dup2", lambda *_: None)
    monkeypatch.setattr(campaign.signal, "signal", lambda *_: None)
    ours, theirs = multiprocessing.Pipe()
    campaign._work(theirs, tmp_path, 0, 0, 1)
    with pytest.raises(InputError, match="needs all packages: videos need PyAV"):
        campaign._await_start(ours)
    theirs.close()
    with pytest.raises(InputError, match="ended before it was ready"):
        campaign._await_start(ours)
