"""The ablation benchmark and the ablated networks."""

import json

import pytest
import torch
from torch.testing import assert_close

from ngff_cli.lab import app
from stages.core.errors import InputError
from stages.core.models.external_forces import ExternalForces
from stages.core.models.field.contact_points import ARM_UNIT, pair_contacts
from stages.core.models.field.rest_shape import rest_shape_of
from stages.core.models.initial_conditions import InitialConditions
from stages.lab.bench import ablation as bench_ablation
from stages.lab.bench.ablation import run
from stages.lab.bench.motion_options import AblationBenchOptions
from stages.lab.dataset.keypoint_motions import write_motions
from stages.lab.training.ablation import ABLATIONS, IMPULSE_VECTORS
from stages.lab.training.options import TrainOptions
from tests.conftest import CliRunner
from tests.lab.training.motions import falling

DT = 0.02
TINY = AblationBenchOptions(steps=2, batch=2, keypoints=8, horizons="1,2", groups="3_0", test="3_1")


@pytest.fixture
def data(tmp_path):
    for seed, name in enumerate(("3_0", "3_1")):
        write_motions(tmp_path / f"{name}.h5", falling(frames=6, seed=seed), {})
    return tmp_path


def colliding() -> InitialConditions:
    """Two balls of points that collide, far from floor and walls."""
    rng = torch.Generator().manual_seed(0)
    ball = 0.1 * torch.nn.functional.normalize(torch.randn(2, 48, 3, generator=rng), dim=-1)
    points = ball + torch.tensor([[-0.12, 0.0, 0.3], [0.12, 0.0, 0.3]])[:, None]
    velocity = torch.tensor([[[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]])
    return InitialConditions.of(points[None], velocity=velocity, mass=torch.tensor([1.0, 2.0]), gravity=torch.zeros(3),
                    E=torch.tensor([1e5, 1e4]))  # fmt: skip


def stepped(name: str, world: InitialConditions) -> tuple[torch.Tensor, torch.Tensor]:
    """Velocities of the bodies after a step, and the gradient of their sum of squares by Young's modulus."""
    torch.manual_seed(0)
    model = ABLATIONS[name].network().eval()
    E = world.E.clone().requires_grad_()
    object.__setattr__(world, "E", E)
    scene = model.encode(model.precompute(world))
    state = model.step(scene, model.initial_state(scene), 0.0, DT, ExternalForces.none(world))
    gradient = torch.autograd.grad(state.velocity.square().sum(), E, allow_unused=True)[0]
    return state.velocity.detach(), torch.zeros_like(E) if gradient is None else gradient


def momentum(world: InitialConditions, velocity: torch.Tensor) -> torch.Tensor:
    return (world.mass[..., None] * velocity).sum(1)


def test_momentum_is_conserved_except_without_reaction():
    world = colliding()
    before = momentum(world, world.velocity)
    for name in ("full", "deformation", "impulses", "context", "materials"):
        velocity, _ = stepped(name, world)
        assert (velocity - world.velocity).abs().max() > 1e-5, f"{name}: they do not touch"
        assert_close(momentum(world, velocity), before, rtol=0, atol=1e-6)
    velocity, _ = stepped("reaction", world)
    assert (momentum(world, velocity) - before).abs().max() > 1e-5


def test_stiffness_matters_except_without_material_inputs():
    assert stepped("full", colliding())[1].abs().max() > 0
    assert stepped("materials", colliding())[1].abs().max() == 0


def test_rigid_bodies_keep_their_shape():
    world = colliding()
    for name, moved in (("full", True), ("deformation", False)):
        model = ABLATIONS[name].network().eval()
        scene = model.encode(model.precompute(world))
        state = model.step(scene, model.initial_state(scene), 0.0, DT, ExternalForces.none(world))
        assert bool(state.u.abs().max() > 0) is moved


def test_impulses_are_the_last_contact_features():
    """The removed features are the impulses that stop a pair in contact, or separate it at 1 m/s."""
    world = colliding()
    shape = rest_shape_of(world)
    model = ABLATIONS["full"].network()
    moving = model._kinematics(model.encode(shape), model.initial_state(model.encode(shape)))
    places = pair_contacts(shape, moving)
    near, vectors = places.gate[0, 0, 0] > 0, places.vectors[0, 0, 0]
    vectors = vectors[near]
    assert len(vectors) > 3 and vectors.shape[-2] == 10
    m = world.mass[0]
    reduced = m[0] * m[1] / (m[0] + m[1])
    for impulse, wanted in ((vectors[:, -IMPULSE_VECTORS], vectors[:, 3]), (vectors[:, -1], vectors[:, 2])):
        change = torch.zeros_like(wanted)
        for body, arm in enumerate((ARM_UNIT * vectors[:, 4], ARM_UNIT * vectors[:, 5])):
            spin = torch.linalg.cross(arm, impulse) @ moving.inverse[0, body].T
            change += reduced / m[body] * (impulse + torch.linalg.cross(spin, arm))
        assert_close(change, wanted, rtol=1e-4, atol=1e-5)


def test_contacts_without_context_are_independent():
    model = ABLATIONS["context"].network()
    x = torch.randn(2, 3, 4 * model.config["hidden"])
    assert model.between(x).abs().max() == 0 and model.between(x).shape == (2, 3, model.config["hidden"])


def test_each_ablation_changes_one_option():
    base = TrainOptions(keypoints=64, horizons="8,20", loss="axes")
    changed = {name: {k for k, v in vars(choice.options(base)).items() if v != getattr(base, k)}
               for name, choice in ABLATIONS.items()}  # fmt: skip
    others = {"keypoints": {"keypoints"}, "discount": {"gradient_discount"}, "axes": {"loss"}, "horizons": {"horizons"}}
    assert changed == {name: others.get(name, set()) for name in ABLATIONS}


def test_ablations_are_trained_scored_and_kept(data, tmp_path, monkeypatch):
    monkeypatch.setattr(bench_ablation, "VALIDATION_CHECKS", 1)
    for name in set(ABLATIONS) - {"full", "reaction", "keypoints"}:
        monkeypatch.delitem(ABLATIONS, name)
    out = tmp_path / "ablation.json"
    assert len(list(run(data, out, TINY, "reaction,full"))) == 2
    before = json.loads(out.read_text())["rows"]
    assert list(before) == ["full", "reaction"]
    lines = list(run(data, out, TINY))
    rows = json.loads(out.read_text())["rows"]
    assert list(rows) == list(ABLATIONS) and len(lines) == len(ABLATIONS)
    assert {k: rows[k] for k in before} == before
    assert all(row["RMSE"] > 0 and row["scenes"] == 6 and row["frames"] == 6 for row in rows.values())
    table = out.with_suffix(".md").read_text()
    assert table.count("\n| ") == len(ABLATIONS) + 2 and "| 1.00 |" in table


def test_other_result_files_are_not_overwritten(data, tmp_path):
    out = tmp_path / "ablation.json"
    for text in ("{}", "[1]", '{"options": {"steps": 1}, "rows": {}}'):
        out.write_text(text)
        with pytest.raises(InputError, match="ablation.json"):
            list(run(data, out, TINY))
        assert out.read_text() == text


def test_the_command(data, tmp_path, monkeypatch):
    monkeypatch.setattr(bench_ablation, "VALIDATION_CHECKS", 1)
    words = "--steps 1 --batch 2 --keypoints 8 --horizons 1 --groups 3_0 --test 3_1 --only materials"
    call = ["bench", "ablation", "--data", str(data), "-o", str(tmp_path / "a.json"), *words.split()]
    result = CliRunner().invoke(app, call)
    assert result.exit_code == 0 and result.stdout.startswith("materials"), result.output
    assert CliRunner().invoke(app, [*call[:-1], "nothing"]).exit_code == 2
