"""The step of fifteen kernels goes where the plain one goes, in double precision and through autograd's operations."""

from dataclasses import replace

import pytest
import torch

pytest.importorskip("triton")
if not torch.cuda.is_available():
    pytest.skip("Triton's kernels need an NVIDIA GPU", allow_module_level=True)

from stages.core.models.external_forces import ExternalForces  # noqa: E402
from stages.core.models.field import fused_step  # noqa: E402
from stages.core.models.field.force_field import ForceField  # noqa: E402
from stages.core.models.rollout import TimeStepper, record_frames  # noqa: E402
from tests.core.models.worlds import crowd, padded, push  # noqa: E402

pytestmark = pytest.mark.gpu
NARROW = torch.tensor([[-0.08, -0.05, -0.94], [0.3, 0.35, -0.55]], dtype=torch.float64)  # walls among the objects
STEPPED = NARROW + torch.tensor([0.0, 0.05, 0.1], dtype=torch.float64)[None, :, None, None]  # each in its own room


def loud(hidden: int) -> ForceField:
    """A model whose random forces are as strong as real ones."""
    torch.manual_seed(0)
    model = ForceField(hidden=hidden).double().cuda().eval()
    with torch.no_grad():
        for net in (model.pairs, model.planes, model.stress):
            net.say[-1].weight *= 10
    return model


def all_ways(model: ForceField, initial, steps: int, prompt=None, pinned: bool = False):
    """States after as many steps from one start: plain in double precision, plain in single, and fused."""
    external = ExternalForces.none(initial) if prompt is None else push(initial, 0, **prompt)
    held = external.pinned.clone()
    held[:, 0] = pinned
    external = replace(external, pinned=held).to("cuda")
    scene = model.prepare(initial.to("cuda"))
    half = scene.shape.blur.half()
    exact = replace(scene, shape=replace(scene.shape, blur=half.double()))
    state = model.initial_state(scene)
    there = initial.valid[..., None].cuda()
    rng = torch.Generator("cuda").manual_seed(0)
    bent = [torch.randn(state.u.shape, generator=rng, device="cuda", dtype=torch.float64) * there for _ in range(2)]
    state = state._replace(u=0.01 * bent[0], du=0.3 * bent[1])
    wanted, start = state, type(state)(*(x.float() for x in state))
    for i in range(steps):
        wanted = model.step(exact, wanted, 0.02 * i, 0.02, external)
    single = ForceField(**model.config).cuda()
    single.load_state_dict(model.state_dict())
    shape = replace(scene.shape, initial=scene.shape.initial.to(torch.float32), blur=half)
    shape = replace(shape, **{k: getattr(shape, k).float() for k in ("arm", "normal", "spacing", "size", "inverse")})
    known = {k: getattr(scene, k).float() for k in ("embedding", "stiffness", "damping", "compliance_scale")}
    scene = replace(scene, shape=shape, **known)
    external = replace(external, **{k: getattr(external, k).float() for k in ("force", "torque", "start", "end")})
    assert fused_step.fits(single, scene)
    plain, found = start, start
    rough = replace(scene, shape=replace(shape, blur=half.float()))  # which the kernels do not take
    for i in range(steps):
        plain = single.step(rough, plain, 0.02 * i, 0.02, external)
        found = fused_step.step(single, scene, found, 0.02 * i, 0.02, external)
    states = [{name: x.double() for name, x in s._asdict().items()} for s in (wanted, plain, found)]
    return *states, model.points(exact, wanted), fused_step.points(scene, found).double()


@pytest.mark.parametrize("hidden, world, given", [
    (64, crowd(2, 3, 200, seed=1), {}),  # with seed 0 two points are nearest to within rounding: either may be taken
    (16, padded(crowd(2, 3, 70), 1, 3), {"prompt": {"force": (0.0, 3.0, 30.0), "torque": (0.1, 0.2, 0.0), "point": 2}}),
    (64, crowd(1, 5, 200, seed=3), {"pinned": True}),
    (64, replace(crowd(1, 3, 200), box=STEPPED), {}),
    (64, crowd(3, 1, 33), {}),
    (128, crowd(1, 2, 40), {}),
], ids=["crowd", "padded and pushed", "pinned", "walls", "alone", "wide"])  # fmt: skip
@torch.no_grad()
def test_it_goes_where_the_plain_step_goes(hidden, initial, given):
    wanted, plain, found, where, there = all_ways(loud(hidden), initial, 3, **given)
    for name, truth in wanted.items():  # as near as the plain step in single precision comes
        near = 10 * float((plain[name] - truth).abs().max()) + 4e-5 * float(truth.abs().max()) + 1e-6
        torch.testing.assert_close(found[name], truth, rtol=0, atol=near, msg=lambda m, name=name: f"{name}: {m}")
    torch.testing.assert_close(there, where, rtol=0, atol=1e-4)


@torch.no_grad()
def test_recorded_twice_it_is_the_same_to_the_last_bit():
    model, initial = ForceField().cuda().eval(), crowd(2, 3, 200).to(torch.float32).to("cuda")
    stepper = TimeStepper(model, initial)
    once = record_frames(stepper, 10)
    stepper.restart(initial)
    assert torch.equal(record_frames(stepper, 10), once)
    assert (once[:, -1] - once[:, 0]).norm(dim=-1).max() > 0.05


@torch.no_grad()
def test_a_collision_keeps_momentum():
    model = loud(64).float()
    roomy = torch.tensor([[-9.0] * 3, [9.0] * 3]).expand(1, 3, 2, 3)
    initial = replace(crowd(1, 3, 200), gravity=torch.zeros(1, 3).double(), box=roomy)
    initial = initial.to(torch.float32).to("cuda")
    scene, external = model.prepare(initial), ExternalForces.none(initial)
    states = [model.initial_state(scene)]
    for i in range(10):
        states.append(fused_step.step(model, scene, states[-1], 0.02 * i, 0.02, external))
    mass = initial.mass[..., None]
    before, after = ((mass * s.velocity).sum(1) for s in (states[0], states[-1]))
    turning = [(torch.linalg.cross(s.com, mass * s.velocity) + mass * s.momentum).sum(1) for s in states]
    assert (states[-1].velocity - states[0].velocity).norm(dim=-1).max() > 0.05
    torch.testing.assert_close(after, before, rtol=0, atol=1e-4)
    torch.testing.assert_close(turning[-1], turning[0], rtol=0, atol=1e-4)
