"""Training of the splat head: it improves, and the other weights of the network do not change."""

import dataclasses
import json
import shutil
from types import SimpleNamespace

import pytest
import torch
from safetensors.torch import load_file, save_file

from stages.core.errors import InputError
from stages.core.geometry.cameras import depths
from stages.core.models.pi3.network import Pi3
from stages.core.models.pi3.weights import load
from stages.core.scene.scene_ply import write_scene
from stages.lab.training.options import SplatterOptions
from stages.lab.training.splatter_data import PosedViews, read_training_scenes, render_views
from stages.lab.training.train_splatter import held_out_psnr, load_network, run, step_loss, view_geometry
from tests.conftest import ring, two_balls_scene
from tests.core.models.pi3.test_network import TINY, random_weights
from tests.reconstruct.oracle import truth
from tests.reconstruct.raycast import arc, photograph, write_set


@pytest.fixture
def folder(tmp_path):
    """A folder with one scene of two balls and eight cameras."""
    (tmp_path / "data").mkdir()
    write_scene(tmp_path / "data/balls.ply", dataclasses.replace(two_balls_scene(), cameras=ring(8, 64, 0.1)))
    return tmp_path / "data"


QUICK = SplatterOptions(steps=20, views=2, side=28, depth="given", width=16, lr=1e-2)
pytestmark = pytest.mark.usefixtures("device", "one_thread")


def test_held_out_views_improve_and_only_the_head_changes(folder, tmp_path):
    lines = list(run(folder, tmp_path / "w.safetensors", QUICK))
    facts = json.loads((tmp_path / "w.json").read_text())
    history = facts["history"]
    assert len(lines) == len(history) == 11 and (tmp_path / "w.png").stat().st_size > 1000
    assert max(row["psnr"] for row in history) > history[0]["psnr"] + 2
    assert history[-1]["loss"] < 0.8 * history[1]["loss"]
    torch.manual_seed(QUICK.seed)
    before = load_network(None, QUICK)[0].state_dict()
    after = load_file(tmp_path / "w.safetensors")
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert changed and all(name.startswith("encoder.feature_") for name in changed)


def test_weights_serve_reconstruct_and_further_training(folder, tmp_path, device):
    list(run(folder, tmp_path / "w.safetensors", dataclasses.replace(QUICK, steps=4)))
    model = load(tmp_path / "w.safetensors", "pi3-splat").to(device)
    scene = read_training_scenes(folder, QUICK.side)[0]
    again, fresh = load_network(tmp_path / "w.safetensors", dataclasses.replace(QUICK, width=0))
    ours, theirs = (held_out_psnr(network, scene, QUICK, device) for network in (again.to(device), model))
    assert not fresh and ours == theirs


def test_pi3_weights_get_an_untrained_head(tmp_path):
    base = random_weights(Pi3(TINY))
    save_file(base.state_dict(), tmp_path / "pi3.safetensors")
    model, fresh = load_network(tmp_path / "pi3.safetensors", dataclasses.replace(QUICK, width=0))
    assert fresh and torch.equal(model.encoder.camera_head.fc_t.weight, base.camera_head.fc_t.weight)
    frozen = {name.split(".")[1] for name, p in model.named_parameters() if not p.requires_grad}
    assert frozen.isdisjoint({"feature_decoder", "feature_head"}) and {"encoder", "decoder", "point_head"} <= frozen


def test_true_depth_gives_points_on_the_surface(device):
    scene = render_views("balls", dataclasses.replace(two_balls_scene(), cameras=ring(8, 64, 0.1)), 56, device)
    geometry = view_geometry(None, scene.to(device), QUICK)
    world = (geometry.points @ geometry.poses[:, None, :3, :3].mT + geometry.poses[:, None, None, :3, 3]).cpu()
    known = scene.depths > 0
    assert known.float().mean() > 0.5
    on_floor = world[known][:, 2].abs() < 0.025  # drawn depth is that of the centres of discs of 4 cm
    assert on_floor.float().mean() > 0.5  # most of the image is the floor at z = 0
    back = depths(world[0][known[0]], scene.viewmats[0])
    torch.testing.assert_close(back, scene.depths[0][known[0]], rtol=1e-4, atol=1e-4)


def test_posed_photos_are_read_with_their_cameras(tmp_path):
    write_set(tmp_path / "data/table", arc(5, (64, 48)))
    (scene,) = read_training_scenes(tmp_path / "data", 56)
    assert scene.images.shape == (5, 3, 42, 56) and scene.depths is None and scene.name == "table"
    ratio = torch.tensor([[56 / 64], [42 / 48], [1.0]])
    torch.testing.assert_close(scene.Ks, arc(5, (64, 48)).Ks * ratio)
    torch.testing.assert_close(scene.viewmats, arc(5, (64, 48)).viewmats, rtol=1e-4, atol=1e-4)
    assert (scene.images[0].mean((1, 2)) - photograph(arc(5, (64, 48)), 0)[0].mean((0, 1))).abs().max() < 0.02


def test_inconsistent_options_are_reported(folder, tmp_path):
    with pytest.raises(InputError, match="contains neither scenes"):
        list(run(tmp_path / "data" / "..", tmp_path / "w.safetensors", QUICK))
    write_set(folder / "table", arc(5, (64, 48)))
    with pytest.raises(InputError, match="--depth given: table is a set of photos"):
        list(run(folder, tmp_path / "w.safetensors", QUICK))
    shutil.rmtree(folder / "table")
    for wrong in ({"depth": "guess"}, {"width": 20}, {"steps": 0}):
        with pytest.raises(InputError):
            dataclasses.replace(QUICK, **wrong)


def test_predicted_depth_is_scaled_to_the_given_cameras():
    cameras = arc(4, (56, 42))
    predicted = truth(cameras, scale=3.7)  # in a different frame and unit
    encoder = SimpleNamespace(tokens=lambda *_: (None, None), geometry=lambda *_: predicted)
    images = torch.stack([photograph(cameras, i)[0] for i in range(4)]).permute(0, 3, 1, 2)
    views = PosedViews("table", images, cameras.viewmats, cameras.Ks, None)
    options = dataclasses.replace(QUICK, depth="network")
    geometry = view_geometry(SimpleNamespace(encoder=encoder), views, options)
    torch.testing.assert_close(geometry.points, predicted.points / 3.7, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(geometry.poses, torch.linalg.inv(cameras.viewmats))


def test_photos_train_the_head_at_predicted_depth(device):
    cameras = arc(4, (56, 42))
    images = torch.stack([photograph(cameras, i)[0] for i in range(4)]).permute(0, 3, 1, 2)
    options = dataclasses.replace(QUICK, depth="network")
    torch.manual_seed(0)
    model, _ = load_network(None, options)
    views = PosedViews("table", images, cameras.viewmats, cameras.Ks, None)
    step_loss(model.to(device), views.to(device), options).backward()
    assert model.encoder.feature_head.down_proj.weight.grad.isfinite().all()
    assert all(p.grad is None for name, p in model.encoder.named_parameters() if not name.startswith("feature_"))
