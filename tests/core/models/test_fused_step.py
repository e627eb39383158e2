"""The fused step of fifteen kernels, compared with the unfused step in double precision."""

from dataclasses import replace

import pytest
import torch

pytest.importorskip("triton")
if not torch.cuda.is_available():
    pytest.skip("Triton's kernels need an NVIDIA GPU", allow_module_level=True)

from stages.core.models.external_forces import ExternalForces
from stages.core.models.field import fused_step
from stages.core.models.field.force_field import ForceField
from stages.core.models.rollout import TimeStepper, record_frames
from tests.core.models.dynamics_fixtures import add_padding, external_force, overlapping_objects

pytestmark = pytest.mark.gpu
NARROW = torch.tensor([[-0.08, -0.05, -0.94], [0.3, 0.35, -0.55]], dtype=torch.float64)  # walls among the objects
STEPPED = (
    NARROW + torch.tensor([0.0, 0.05, 0.1], dtype=torch.float64)[None, :, None, None]
)  # a different box for each object


def model_with_amplified_forces(hidden: int) -> ForceField:
    """Untrained model with output weights scaled up, so that its forces are of realistic strength."""
    torch.manual_seed(0)
    model = ForceField(hidden=hidden).double().cuda().eval()
    with torch.no_grad():
        for net in (model.pairs, model.planes, model.deformation):
            net.decoder[-1].weight *= 10
    return model


def step_all_ways(model: ForceField, initial, steps: int, prompt=None, pinned: bool = False):
    """States after `steps` steps: unfused in double precision, unfused in single precision, fused; then the points."""
    external = ExternalForces.none(initial) if prompt is None else external_force(initial, 0, **prompt)
    pinned_mask = external.pinned.clone()
    pinned_mask[:, 0] = pinned
    external = replace(external, pinned=pinned_mask).to("cuda")
    scene = model.prepare(initial.to("cuda"))
    half = scene.shape.blur.half()
    exact = replace(scene, shape=replace(scene.shape, blur=half.double()))
    state = model.initial_state(scene)
    is_valid = initial.valid[..., None].cuda()
    rng = torch.Generator("cuda").manual_seed(0)
    deformation = [
        torch.randn(state.u.shape, generator=rng, device="cuda", dtype=torch.float64) * is_valid for _ in range(2)
    ]
    state = state._replace(u=0.01 * deformation[0], du=0.3 * deformation[1])
    expected, start = state, type(state)(*(x.float() for x in state))
    for i in range(steps):
        expected = model.step(exact, expected, 0.02 * i, 0.02, external)
    single = ForceField(**model.config).cuda()
    single.load_state_dict(model.state_dict())
    shape = replace(scene.shape, initial=scene.shape.initial.to(torch.float32), blur=half)
    shape = replace(
        shape,
        **{
            k: getattr(shape, k).float()
            for k in ("arm", "normal", "spacing", "size", "inverse", "keypoint_inverse", "principal")
        },
    )
    encoded = {k: getattr(scene, k).float() for k in ("embedding", "stiffness", "damping", "compliance_scale")}
    scene = replace(scene, shape=shape, **encoded)
    external = replace(external, **{k: getattr(external, k).float() for k in ("force", "torque", "start", "end")})
    assert fused_step.fits(single, scene)
    unfused, fused = start, start
    # the kernels do not support this precision
    unsupported = replace(scene, shape=replace(shape, blur=half.float()))
    for i in range(steps):
        unfused = single.step(unsupported, unfused, 0.02 * i, 0.02, external)
        fused = fused_step.step(single, scene, fused, 0.02 * i, 0.02, external)
    states = [{name: x.double() for name, x in s._asdict().items()} for s in (expected, unfused, fused)]
    return *states, model.points(exact, expected), fused_step.points(scene, fused).double()


@pytest.mark.parametrize("hidden, initial, options", [
    (64, overlapping_objects(2, 3, 200, seed=1), {}),  # seed 0 has a tie of nearest points to within rounding
    (16, add_padding(overlapping_objects(2, 3, 70), 1, 3),
     {"prompt": {"force": (0.0, 3.0, 30.0), "torque": (0.1, 0.2, 0.0), "point": 2}}),
    (64, overlapping_objects(1, 5, 200, seed=3), {"pinned": True}),
    (64, replace(overlapping_objects(1, 3, 200), box=STEPPED), {}),
    (64, overlapping_objects(3, 1, 33), {}),
    (128, overlapping_objects(1, 2, 40), {}),
], ids=["overlapping", "padded with external force", "pinned", "walls", "single object", "wide layers"])  # fmt: skip
@torch.no_grad()
def test_fused_step_equals_unfused_step(hidden, initial, options):
    expected, unfused, fused, expected_points, fused_points = step_all_ways(
        model_with_amplified_forces(hidden), initial, 3, **options
    )
    # the tolerance is ten times the error of the unfused step in single precision
    for name, reference in expected.items():
        atol = 10 * float((unfused[name] - reference).abs().max()) + 4e-5 * float(reference.abs().max()) + 1e-6
        torch.testing.assert_close(fused[name], reference, rtol=0, atol=atol, msg=lambda m, name=name: f"{name}: {m}")
    torch.testing.assert_close(fused_points, expected_points, rtol=0, atol=1e-4)


@torch.no_grad()
def test_repeated_recordings_are_bitwise_equal():
    model, initial = ForceField().cuda().eval(), overlapping_objects(2, 3, 200).to(torch.float32).to("cuda")
    stepper = TimeStepper(model, initial)
    first = record_frames(stepper, 10)
    stepper.restart(initial)
    assert torch.equal(record_frames(stepper, 10), first)
    assert (first[:, -1] - first[:, 0]).norm(dim=-1).max() > 0.05


@torch.no_grad()
def test_rollout_equals_single_steps_with_the_present_weights():
    model, initial = (
        model_with_amplified_forces(64).float(),
        overlapping_objects(2, 3, 200).to(torch.float32).to("cuda"),
    )
    external, rollouts = ExternalForces.none(initial), []
    for _ in range(2):
        rollouts.append(model.rollout(initial, 5))
        scene = model.prepare(initial)
        state = model.initial_state(scene)
        for i in range(4):
            state = model.step(scene, state, 0.02 * i, 0.02, external)
        assert torch.equal(rollouts[-1][:, -1], model.points(scene, state))
        model.load_state_dict({name: 0.9 * x for name, x in model.state_dict().items()})
    assert (rollouts[1] - rollouts[0]).abs().max() > 1e-4


@torch.no_grad()
def test_step_follows_weights_changed_in_place():
    model, initial = (
        model_with_amplified_forces(64).float(),
        overlapping_objects(1, 3, 200).to(torch.float32).to("cuda"),
    )
    scene, external = model.prepare(initial), ExternalForces.none(initial)
    state, step = model.initial_state(scene), model.stepping(scene, 0.02, external)
    assert isinstance(step, fused_step.FusedStep)
    before = step(state, 0.0)
    model.load_state_dict({name: 0.9 * x for name, x in model.state_dict().items()})
    after, expected = step(state, 0.0), model.step(scene, state, 0.0, 0.02, external)
    assert all(torch.equal(x, y) for x, y in zip(after, expected, strict=True))
    assert not torch.equal(after.velocity, before.velocity)


@torch.no_grad()
def test_collision_conserves_linear_and_angular_momentum():
    model = model_with_amplified_forces(64).float()
    large_box = torch.tensor([[-9.0] * 3, [9.0] * 3]).expand(1, 3, 2, 3)
    initial = replace(overlapping_objects(1, 3, 200), gravity=torch.zeros(1, 3).double(), box=large_box)
    initial = initial.to(torch.float32).to("cuda")
    scene, external = model.prepare(initial), ExternalForces.none(initial)
    states = [model.initial_state(scene)]
    for i in range(10):
        states.append(fused_step.step(model, scene, states[-1], 0.02 * i, 0.02, external))
    mass = initial.mass[..., None]
    before, after = ((mass * s.velocity).sum(1) for s in (states[0], states[-1]))
    angular = [(torch.linalg.cross(s.com, mass * s.velocity) + mass * s.momentum).sum(1) for s in states]
    assert (states[-1].velocity - states[0].velocity).norm(dim=-1).max() > 0.05
    torch.testing.assert_close(after, before, rtol=0, atol=1e-4)
    torch.testing.assert_close(angular[-1], angular[0], rtol=0, atol=1e-4)
