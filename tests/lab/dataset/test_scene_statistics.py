"""Statistics and sensitivity of constructed motions whose values are known."""

import json
import math
from dataclasses import replace

import pytest
import torch

from ngff_cli.lab import app
from stages.core.errors import InputError
from stages.lab.dataset import scene_statistics, sensitivity
from stages.lab.dataset.keypoint_motions import KeypointMotions, concatenate_motions, write_motions
from stages.lab.dataset.scene_statistics import compute_statistics
from tests.conftest import CliRunner

T, N = 20, 300
BOX = ((-1.94, -1.94, -0.94), (1.94, 1.94, 2.94))


def shell(radius, low=-1.0, seed=0):
    """Points on a sphere whose height is above `low` radii."""
    rng = torch.Generator().manual_seed(seed)
    p = torch.nn.functional.normalize(torch.randn(20 * N, 3, generator=rng), dim=1)
    return radius * p[p[:, 2] > low][:N]


def cup(radius):
    """The lower half of a sphere."""
    return -shell(radius, low=0.0)


def still(points, at):
    return (points + torch.tensor(at)).expand(T, N, 3)


def moving(points, start, end, frames=12):
    """Points that move from `start` to `end` in `frames` frames and are then at rest."""
    u = (torch.arange(T) / frames).clamp_max(1)[:, None]
    path = torch.lerp(torch.tensor(start), torch.tensor(end), u)
    return points[None] + path[:, None]


def motions(*objects, ids):
    """Motions of one scene, given by points (t, n, 3) of each object."""
    points = torch.stack([torch.stack(objects, 1)])
    n = torch.ones(1, len(ids))
    return KeypointMotions(("a",), torch.tensor([ids]), points, n, n, 0.3 * n, n, 0.02, (0, 0, -5.0), BOX, n)


def test_ball_that_falls_into_a_bowl_is_contained():
    bowl, ball, duck = cup(0.25), shell(0.1, seed=1), shell(0.1, seed=2)
    m = motions(still(bowl, [0.0, 0.0, -0.67]), moving(ball, [0.0, 0, 0.4], [0.0, 0, -0.79]),
                still(duck, [0.8, 0.0, -0.82]), ids=[2, 0, 7])  # fmt: skip
    f = compute_statistics(m)
    assert f.falls.tolist() == [[0, 1, 0]] and f.contained.tolist() == [[0, 1, 0]]
    assert f.touch.tolist() == [[1, 0, 0]]  # pairs 0-1, 0-2 and 1-2
    assert f.at_rest.tolist() == [[1, 1, 1]] and f.stacked.tolist() == [[0, 1, 0]]
    assert f.deformation.max() < 1e-5 and f.tipped.tolist() == [[0, 0, 0]]
    assert float(f.spread[0]) == pytest.approx((2 * 0.8 / 3 + 4 * 0.8 / 3 / 2) / 3, rel=0.02)


def test_ball_above_a_bowl_or_under_a_tilted_one_is_not_contained():
    bowl, ball = cup(0.25), shell(0.1, seed=1)
    above = motions(still(bowl, [0.0, 0.0, -0.67]), still(ball, [0.0, 0.0, -0.5]), ids=[2, 0])
    assert compute_statistics(above).contained.tolist() == [[0, 0]]
    half = torch.tensor([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    over = moving(bowl, [0.0, 0, 0.2], [0.0, 0, -0.9])
    over = torch.cat([over[:1], (over[1:] - over[1:].mean(1, keepdim=True)) @ half.T + over[1:].mean(1, keepdim=True)])
    f = compute_statistics(motions(over, still(ball, [0.0, 0.0, -0.84]), ids=[2, 0]))
    assert f.contained.tolist() == [[0, 0]] and f.tipped.tolist() == [[1, 0]]


def test_deformation_tilt_and_speed_are_measured():
    p = shell(0.2, seed=3)
    angle = math.radians(40) * torch.arange(T) / (T - 1)
    c, s, zero, one = angle.cos(), angle.sin(), 0 * angle, 1 + 0 * angle
    R = torch.stack([one, zero, zero, zero, c, -s, zero, s, c], -1).reshape(T, 3, 3)
    rotated = p @ R.mT
    f = compute_statistics(motions(rotated, ids=[0]))
    assert f.tipped.item() == 1 and f.deformation.item() < 1e-5 and f.at_rest.item() == 0
    assert f.touch.shape == (1, 0)
    squashed = still(p, [0.0, 0, 0]).clone()
    squashed[10:, :, 2] *= 0.5
    # the best rotation is the identity, so the residual is half of each z
    q = p - p.mean(0)
    expected = ((0.5 * q[:, 2]).square().mean() / q.square().sum(1).mean()).sqrt()
    assert compute_statistics(motions(squashed, ids=[0])).deformation.item() == pytest.approx(float(expected), rel=1e-3)


def test_missing_objects_are_ignored(tmp_path):
    ball = shell(0.1)
    m = motions(moving(ball, [0.0, 0, 0.4], [0.0, 0, -0.8]), still(0 * ball, [0.0, 0.0, 0.0]), ids=[0, -1])
    f = compute_statistics(m)
    assert f.falls[0, 0] == 1 and f.falls[0, 1].isnan() and f.touch.isnan().all() and f.spread.item() < 1e-6


def test_command_writes_and_prints_statistics(tmp_path):
    (tmp_path / "motions").mkdir()
    m = motions(still(cup(0.25), [0.0, 0.0, -0.67]), moving(shell(0.1), [0.0, 0, 0.4], [0.0, 0, -0.79]), ids=[2, 0])
    write_motions(tmp_path / "motions" / "3_9.h5", m, {})
    out = tmp_path / "s.json"
    done = CliRunner().invoke(app, ["statistics", str(tmp_path), "-o", str(out)])
    assert done.exit_code == 0, done.stderr
    facts = json.loads(out.read_text())
    assert facts["groups"]["3_9"]["contained"] == 0.5 and facts["groups"]["3_9"]["scenes with touch"] == 1
    assert facts["objects"]["ball"]["falls"] == 1 and facts["objects"]["bowl"]["falls"] == 0
    assert "| 3_9 | 1 |" in done.stdout
    with pytest.raises(InputError, match="contains none of 4"):
        scene_statistics.run(tmp_path, None, ["4"], 512, "auto")


def test_sensitivity_is_the_error_between_two_runs(tmp_path):
    """One of two scenes is displaced by 0.1 m from frame 10 on; a third one exists in only one run."""
    path = moving(shell(0.1), [0.0, 0, 0.4], [0.0, 0, -0.8])
    aside = path + torch.tensor([1e-3, 0, 0])
    aside = torch.cat([aside[:10], aside[10:] + torch.tensor([0.0, 0.1, 0])])
    for name, tracks in (("a", (path, path, path)), ("b", (aside, path + torch.tensor([0, 1e-3, 0])))):
        scenes = [replace(motions(t, ids=[0]), names=(f"{i}_0",)) for i, t in enumerate(tracks)]
        (tmp_path / name).mkdir()
        write_motions(tmp_path / name / "3_9.h5", concatenate_motions(scenes), {})
    line = sensitivity.run(tmp_path / "a", tmp_path / "b", tmp_path / "p.json", 256, "auto")[2]
    row = json.loads((tmp_path / "p.json").read_text())["splits"]["spatial"]
    # scene 0 has 10 frames with 1 mm and 10 with 1 mm and 0.1 m, scene 1 has 1 mm; an RMSE is over three axes
    first, second = math.sqrt((1e-6 + 0.5 * 0.01) / 3), math.sqrt(1e-6 / 3)
    assert row["RMSE"] == pytest.approx((first + second) / 2, rel=1e-2) and row["scenes"] == 2
    assert row["FPE"] == pytest.approx((math.hypot(0.1, 1e-3) + 1e-3) / 2, rel=1e-2)
    assert row["start apart"] == pytest.approx(1e-3, rel=0.02) and line.startswith("| spatial | 2 | 0.00100 |")
    with pytest.raises(InputError, match="have the same initial positions as"):
        sensitivity.run(tmp_path / "a", tmp_path / "a", None, 256, "auto")
    with pytest.raises(InputError, match="has no group"):
        sensitivity.run(tmp_path / "a", tmp_path, None, 256, "auto")
