"""Keypoints and the skinning of Gaussians."""

from dataclasses import replace

import pytest
import torch

from stages.core.geometry.harmonics import evaluate_sh
from stages.core.geometry.rotations import covariance, matrix
from stages.core.physics.keypoints import bind_gaussians, choose_keypoints, farthest_points, nearest_weights
from stages.core.physics.skinning import KeypointDeformation, Skinning, fit_rotations, object_rotations
from stages.core.scene.gaussians import Gaussians, concatenate
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.trajectory import Binding, Keypoints
from tests.conftest import deform, random_gaussians

TURN = matrix(torch.tensor([0.3, 0.5, -0.2, 0.7]))


def scene_of(kind: str) -> Scene:
    """Two objects and a background; the first object is a cloud, a flat sheet, a line, two points or one point."""
    g = random_gaussians(900, degree=2)
    g = replace(g, object_id=torch.arange(900) % 3)
    flat = {"cloud": (1, 1, 1), "sheet": (1, 1, 0), "line": (1, 0, 0), "two": (1, 1, 1), "one": (1, 1, 1)}[kind]
    mine = g.object_id == 1
    g = replace(g, means=torch.where(mine[:, None], g.means * torch.tensor(flat), g.means))
    few = {"two": 2, "one": 1}.get(kind)
    if few:
        g = concatenate([g[~mine], g[mine][:few]])
    return Scene(g, (SceneObject(1, "a"), SceneObject(2, "b")))


def prepared(scene: Scene, count: int = 64) -> tuple:
    keypoints = choose_keypoints(scene, count)
    return scene.gaussians, bind_gaussians(scene, keypoints), keypoints


@pytest.mark.parametrize("kind", ["cloud", "sheet", "line", "two", "one"])
def test_rest_pose_is_the_input_bit_by_bit(kind):
    g, binding, keypoints = prepared(scene_of(kind))
    still = deform(g, binding, keypoints, keypoints.rest.clone())
    for name in ("means", "quats", "scales", "opacities", "sh", "object_id"):
        assert torch.equal(getattr(still, name), getattr(g, name)), name


@pytest.mark.parametrize("kind", ["cloud", "sheet"])
def test_rigid_motion_is_reproduced(kind):
    g, binding, keypoints = prepared(scene_of(kind))
    shift = torch.tensor([0.3, -0.2, 0.9])
    moved = deform(g, binding, keypoints, keypoints.rest @ TURN.mT + shift)
    mine = g.object_id > 0
    torch.testing.assert_close(moved.means[mine], g.means[mine] @ TURN.mT + shift, rtol=0, atol=1e-5)
    before, after = covariance(g.quats, g.scales), covariance(moved.quats, moved.scales)
    torch.testing.assert_close(after[mine], TURN @ before[mine] @ TURN.mT, rtol=0, atol=2e-5 * float(before.max()))
    dirs = torch.nn.functional.normalize(torch.randn(len(g), 3, generator=torch.Generator().manual_seed(1)), dim=1)
    seen = evaluate_sh(moved.sh, dirs @ TURN.mT)[mine]
    torch.testing.assert_close(seen, evaluate_sh(g.sh, dirs)[mine], rtol=0, atol=1e-4)
    for name in ("means", "quats", "scales", "sh"):
        assert torch.equal(getattr(moved, name)[~mine], getattr(g, name)[~mine])


def test_gaussians_on_a_device_with_keypoints_on_the_cpu(device):
    """Binding and keypoints read from a file are on the CPU, also when the Gaussians are on a GPU."""
    g, binding, keypoints = prepared(scene_of("cloud"))
    positions = keypoints.rest @ TURN.mT
    moved = deform(g.to(device), binding, keypoints, positions)
    assert moved.means.device.type == device
    moved, expected = moved.to("cpu"), deform(g, binding, keypoints, positions)
    for name in ("means", "scales", "sh"):
        torch.testing.assert_close(getattr(moved, name), getattr(expected, name), rtol=0, atol=1e-5)
    # the axes of a Gaussian with two nearly equal scales are ill-conditioned, its covariance is not
    ours, theirs = covariance(moved.quats, moved.scales), covariance(expected.quats, expected.scales)
    torch.testing.assert_close(ours, theirs, rtol=0, atol=2e-5 * float(theirs.abs().max()))


def test_a_line_rotates_with_its_direction():
    # points on a line do not define the rotation about it, so only positions and lengths are tested
    g, binding, keypoints = prepared(scene_of("line"))
    moved = deform(g, binding, keypoints, keypoints.rest @ TURN.mT + 1)
    mine = g.object_id == 1
    torch.testing.assert_close(moved.means[mine], g.means[mine] @ TURN.mT + 1, rtol=0, atol=1e-5)
    lengths = [part.scales.sort(1).values[mine] for part in (moved, g)]
    torch.testing.assert_close(*lengths, rtol=1e-4, atol=1e-6)


def test_uniform_stretch():
    # the ridge that keeps sheets rigid costs RIDGE of the strain; the strain here is 0.2
    g, binding, keypoints = prepared(scene_of("cloud"), 200)
    stretch = torch.diag(torch.tensor([1.2, 0.9, 1.0]))
    moved = deform(g, binding, keypoints, keypoints.rest @ stretch)
    mine = g.object_id > 0
    torch.testing.assert_close(moved.means[mine], g.means[mine] @ stretch, rtol=0, atol=1e-3)
    before, after = covariance(g.quats, g.scales), covariance(moved.quats, moved.scales)
    error = (after - stretch @ before @ stretch)[mine].abs().max() / before.abs().max()
    assert error < 5e-3


def test_objects_do_not_influence_each_other():
    g, binding, keypoints = prepared(scene_of("cloud"))
    shift = (keypoints.object_id == 1)[:, None] * torch.tensor([0.0, 0.0, 1.0])
    moved = deform(g, binding, keypoints, keypoints.rest + shift)
    expected = g.means + (g.object_id == 1)[:, None] * torch.tensor([0.0, 0.0, 1.0])
    torch.testing.assert_close(moved.means, expected, rtol=0, atol=1e-6)


def test_skinning_is_reused_for_many_frames():
    g, binding, keypoints = prepared(scene_of("cloud"))
    skinning = Skinning(g, binding, keypoints)
    skinning(keypoints.rest + 1)
    again = skinning(keypoints.rest)
    assert isinstance(again, Gaussians) and torch.equal(again.means, g.means)


def test_what_follows_the_same_keypoints_shares_their_motion(monkeypatch):
    g, binding, keypoints = prepared(scene_of("cloud"))
    frames = [keypoints.rest @ TURN.mT, keypoints.rest @ TURN, keypoints.rest @ TURN.mT]
    alone = [Skinning(g, binding, replace(keypoints))(x).means for x in frames]
    found, gradients = [], KeypointDeformation._gradients
    monkeypatch.setattr(KeypointDeformation, "_gradients", lambda self, u: found.append(u) or gradients(self, u))
    both = [Skinning(g, binding, keypoints) for _ in range(2)]
    for x, expected in zip(frames, alone, strict=True):
        assert all(torch.equal(skinning(x).means, expected) for skinning in both)
    assert len(found) == len(frames)


def test_farthest_points_cover_a_square():
    # 64 points on a unit square: a greedy cover is within twice the best radius, sqrt(2)/16 for a grid of 8 x 8
    points = torch.rand(5000, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1.0, 1, 0])
    chosen = farthest_points(points, 64)
    assert len(chosen.unique()) == 64
    assert float(torch.cdist(points, points[chosen]).amin(1).max()) < 2 * 2**0.5 / 16


@pytest.mark.parametrize("n, k", [(1, 8), (3, 8), (9, 8), (100, 8)])
def test_weights_sum_to_one_and_decrease(n, k):
    points = torch.rand(n, 3, generator=torch.Generator().manual_seed(0))
    index, weight = nearest_weights(points, points, k)
    assert index.shape == weight.shape == (n, k) and int(index.max()) < n
    torch.testing.assert_close(weight.sum(1), torch.ones(n))
    assert (weight >= 0).all() and (weight[:, 0] == weight.amax(1)).all()


def test_object_rotations():
    keypoints = choose_keypoints(scene_of("cloud"), 64)
    first = (keypoints.object_id == 1)[:, None]
    moved = torch.where(first, keypoints.rest @ TURN.mT + 3, keypoints.rest)
    R = matrix(object_rotations(keypoints, moved, [1, 2]))
    torch.testing.assert_close(R, torch.stack([TURN, torch.eye(3)]), rtol=0, atol=1e-5)


def test_a_single_point_has_the_identity_rotation():
    body = torch.zeros(1, dtype=torch.int64)
    torch.testing.assert_close(fit_rotations(torch.ones(1, 3), torch.zeros(1, 3), body), torch.eye(3)[None])


def test_a_body_without_points_has_the_identity_rotation():
    points = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])
    fitted = fit_rotations(points, points @ TURN.mT, torch.full((4,), 2))
    torch.testing.assert_close(fitted, torch.stack([torch.eye(3), torch.eye(3), TURN]), rtol=0, atol=1e-4)


def test_a_scene_without_objects_has_no_keypoints():
    keypoints = choose_keypoints(replace(scene_of("cloud"), objects=()), 8)
    assert keypoints.rest.shape == (0, 3) and keypoints.object_id.shape == (0,)


def test_a_gaussian_follows_a_single_keypoint():
    """It follows the first of the row; the others are padding."""
    g, u = random_gaussians(3), torch.tensor([[0.1, -0.2, 0.3]])
    keypoints = Keypoints(torch.zeros(1, 3), torch.ones(1, dtype=torch.int64))
    binding = Binding(torch.tensor([[0, -1], [-1, -1], [0, -1]]), torch.tensor([[1.0, 0], [0, 0], [1, 0]]))
    moved = deform(g, binding, keypoints, keypoints.rest + u)
    torch.testing.assert_close(moved.means, g.means + u * torch.tensor([[1.0], [0.0], [1.0]]))
