"""The published model: equality with recorded outputs of its code, and the shapes of its checkpoints."""

import json

import numpy as np
import pytest
import torch

from stages.core.models.baselines.ngff_paper import (
    BLOCK_POINTS,
    CONTACT_RADIUS,
    ObjectEncoder,
    PaperForceField,
    PaperState,
    StressNet,
    euler_matrix,
    world_points,
)
from stages.core.models.checkpoints import build, load
from stages.core.models.external_forces import ExternalForces
from stages.core.models.field.narrow_phase import near_walls, nearest
from stages.core.models.initial_conditions import InitialConditions, centre_of_mass
from stages.core.models.integrate import Integration
from tests.core.models.dynamics_fixtures import external_force

CLOSE = {"rtol": 1e-5, "atol": 1e-6}  # single precision with a different order of summation


@pytest.fixture
def recorded(shared):
    def read(name: str) -> dict[str, torch.Tensor]:
        data = np.load(shared / "facts/ngff_parity" / f"{name}.npz")
        return {key: torch.from_numpy(np.array(data[key])) for key in data}

    return read


@pytest.fixture
def published(recorded) -> PaperForceField:
    model = build("ngff-paper", hidden=16, layers=2, padding_encoded=True)
    model.load_state_dict({k.removeprefix("w/"): v for k, v in recorded("weights").items()})
    return model


def initial_conditions_of(data: dict) -> InitialConditions:
    return InitialConditions.of(
        data["in/points"], data["in/padding"] > 0, velocity=data["in/com_vel"], spin=data["in/angle_vel"]
    )


@torch.no_grad()
def test_predictor_equals_recorded_values(recorded, published):
    d = recorded("predictor_call")
    names = ("points_local", "points_vel", "com", "com_vel", "angle", "angle_vel")
    state = PaperState(*(d[f"in/{name}"] for name in names))
    initial = InitialConditions.of(d["in/ori_pos"], d["in/padding"] > 0)
    points = world_points(state)
    torch.testing.assert_close(euler_matrix(state.angle), d["mid/R_angle"], **CLOSE)
    torch.testing.assert_close(euler_matrix(-state.angle), d["mid/R_neg_angle"], **CLOSE)
    torch.testing.assert_close(points, d["mid/global_points"], **CLOSE)
    assert torch.equal(nearest(points, initial.valid, CONTACT_RADIUS)[0] < CONTACT_RADIUS, d["mid/overlap_mask"])
    assert torch.equal(
        near_walls(points, initial.valid, initial.box, CONTACT_RADIUS), d["mid/boundary_mask"][..., 0] > 0
    )
    shape = published.predictor.pointnet(state.local, torch.ones_like(initial.valid))
    torch.testing.assert_close(shape, d["mid/geom_features"], **CLOSE)
    forces, torques, stresses = published.predictor(initial, state, d["in/ori_pos"])
    torch.testing.assert_close(forces, d["out/forces"], **CLOSE)
    torch.testing.assert_close(torques, d["out/torques"], **CLOSE)
    torch.testing.assert_close(stresses, d["out/stresses"], **CLOSE)


@pytest.mark.parametrize("name", ["rollout_free", "rollout_force"])
@torch.no_grad()
def test_rollout_equals_recorded_values(recorded, published, name):
    d = recorded(name)
    initial = initial_conditions_of(d)
    torch.testing.assert_close(centre_of_mass(initial, initial.points), d["in/com"], **CLOSE)
    external = ExternalForces.none(initial)
    if name == "rollout_force":
        p = {k: d[f"in/external_0/{k}"].tolist() for k in ("obj_id", "force", "torque", "start", "end")}
        external = external_force(initial, p["obj_id"], p["force"], p["torque"], p["start"], p["end"])
    actual = published.rollout(initial, len(d["out/com"][0]), external=external, integration=Integration("euler"))
    expected = d["out/points_world"].masked_fill(~initial.valid[:, None, ..., None], 0)
    torch.testing.assert_close(actual, expected, **CLOSE)


def test_loss_and_adjoint_gradients_equal_recorded_values(recorded, published):
    # gradients of the adjoint equation; with Euler's method they differ much from backpropagated ones
    d = recorded("loss_and_adjoint_grads")
    initial = initial_conditions_of(recorded("rollout_free"))
    loss = (
        (published.rollout(initial, 5, integration=Integration("euler", adjoint=True)) - d["in/target"]).square().mean()
    )
    loss.backward()
    torch.testing.assert_close(loss.detach(), d["out/loss"], **CLOSE)
    expected = {k.removeprefix("out/grad/"): v for k, v in d.items() if k.startswith("out/grad/")}
    assert expected.keys() == dict(published.named_parameters()).keys()
    for key, p in published.named_parameters():
        torch.testing.assert_close(
            p.grad / expected[key].norm(), expected[key] / expected[key].norm(), rtol=0, atol=1e-5
        )


@pytest.mark.parametrize("hidden, count", [(128, 1_055_126), (200, 2_555_822), (256, 4_174_614)])
def test_published_parameter_counts(hidden, count):
    assert sum(x.numel() for x in build("ngff-paper", hidden=hidden).state_dict().values()) == count


def test_names_and_shapes_equal_a_public_checkpoint(shared):
    shapes = json.loads((shared / "facts/ngff_state_dict.json").read_text())
    assert {k: list(v.shape) for k, v in build("ngff-paper").state_dict().items()} == shapes


@pytest.mark.parametrize("wrapped", [False, True], ids=["plain", "from parallel training"])
def test_a_public_checkpoint_loads(tmp_path, wrapped):
    model = build("ngff-paper", hidden=24, layers=3)
    state = model.state_dict()
    torch.save({"model_state_dict": {f"module.{k}": v for k, v in state.items()}} if wrapped else state,
               tmp_path / "public.pth")  # fmt: skip
    loaded, card = load(tmp_path / "public.pth")
    assert loaded.config == {"hidden": 24, "layers": 3, "deform": True, "padding_encoded": False}
    assert card["model"] == "ngff-paper"
    assert all(torch.equal(v, loaded.state_dict()[k]) for k, v in state.items())


@pytest.mark.parametrize("network, width", [(ObjectEncoder(16, 2), 3), (StressNet(16), 12)])
def test_blocks_of_points_on_any_number_of_threads_equal_all_points(network, width, with_threads):
    rng = torch.Generator().manual_seed(0)
    x = torch.randn(2, 3, 300, width, generator=rng)
    counts = torch.rand(2, 3, 300, generator=rng) < 0.5
    counts[1, 2] = False
    assert x[..., 0].numel() > 2 * BLOCK_POINTS
    whole = network(x, counts).detach()
    with torch.no_grad():
        one, two = (with_threads(threads, network, x, counts) for threads in (1, 2))
    assert torch.equal(one, two)
    torch.testing.assert_close(one, whole, **CLOSE)


def test_rigid_variant_preserves_shapes():
    model = build("ngff-paper-rigid", hidden=16, layers=2)
    assert not any("stress" in name for name in model.state_dict())
    points = torch.rand(1, 2, 10, 3, generator=torch.Generator().manual_seed(0)) * 0.3
    final = model.rollout(InitialConditions.of(points), 10)[0, -1]
    torch.testing.assert_close(torch.cdist(final, final), torch.cdist(points[0], points[0]), rtol=0, atol=1e-5)
