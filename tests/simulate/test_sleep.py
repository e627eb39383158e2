"""Objects at rest sleep until they are hit or pushed, or lose their support."""

from dataclasses import replace

import pytest
import torch

from stages.core.models.checkpoints import SHIPPED, find
from stages.core.models.initial_conditions import FLOOR, InitialConditions
from stages.simulate.options import SimulateOptions
from stages.simulate.sleep import INITIAL_CONTACT_DISTANCE, SleepState
from tests.conftest import two_balls_scene
from tests.simulate.motion import roll_out

SIDE = 0.3


def stacked(*heights: float, aside: float = 0.0) -> InitialConditions:
    """Cubes of points whose lower faces are at these heights above the floor, in model units."""
    line = torch.linspace(0, SIDE, 8)
    cube = torch.cartesian_prod(line, line, line)
    points = torch.stack([cube + torch.tensor([i * aside, 0, FLOOR + h]) for i, h in enumerate(heights)])
    return InitialConditions.of(points[None])


def sleep_state(world: InitialConditions, awake: torch.Tensor, device: str = "cpu") -> SleepState:
    """The sleep state, in which objects at the height of the floor stand on it."""
    return SleepState(world.to(device), awake, world.points[0, ..., 2].amin(1) < FLOOR + 1e-3)


def none(count: int) -> torch.Tensor:
    return torch.zeros(count, dtype=torch.bool)


def test_a_stack_sleeps_and_a_floating_object_does_not(device):
    assert sleep_state(stacked(0.0, SIDE, 2 * SIDE), none(3), device).asleep.all()
    high = 2 * SIDE + 3 * INITIAL_CONTACT_DISTANCE  # above the second cube
    assert sleep_state(stacked(0.0, SIDE, SIDE + high), none(3), device).asleep.tolist() == [True, True, False]


@pytest.mark.parametrize(("gap", "touches"), [(0.1, True), (0.13, False)])
def test_objects_touch_at_the_start_up_to_a_tenth_of_a_metre_and_half_their_spacing(gap, touches):
    """The assumed spacing of 512 keypoints on cubes of side 0.3 is 0.032, as if all were on the faces."""
    assert sleep_state(stacked(0.0, SIDE + gap), none(2)).asleep.tolist() == [True, touches]


def test_objects_that_lose_their_support_wake():
    stack = stacked(0.0, SIDE, 2 * SIDE)
    assert sleep_state(stack, torch.tensor([True, False, False])).asleep.tolist() == [False, False, False]
    assert sleep_state(stack, torch.tensor([False, False, True])).asleep.tolist() == [True, True, False]
    beside = stacked(0.0, 0.0, aside=SIDE)
    assert sleep_state(beside, torch.tensor([True, False])).asleep.tolist() == [False, True]


@pytest.mark.parametrize(("speed", "height", "mass", "wakes"), [
    (1.0, SIDE, 1.0, True), (0.1, SIDE, 1.0, False), (1.0, 3 * SIDE, 1.0, False), (1.0, SIDE, 0.1, False),
])  # fmt: skip
def test_only_fast_and_heavy_impacts_wake(speed, height, mass, wakes, device):
    world = replace(stacked(0.0, 3 * SIDE), mass=torch.tensor([[1.0, mass]]))
    state = sleep_state(world, torch.tensor([False, True]), device)
    points = world.points.clone().to(device)
    points[0, 1, :, 2] += height - 3 * SIDE
    velocity = torch.tensor([[0.0, -speed]], device=device)[..., None, None].expand_as(points)
    state.wake_on_impact(points, velocity)
    assert state.asleep.tolist() == [not wakes, False]


@pytest.fixture(scope="module")
def two_balls():
    return two_balls_scene()


def of_learned_engine(**chosen) -> SimulateOptions:
    """Options for the learned engine with the shipped weights."""
    return SimulateOptions(engine="ngff", weights=find("ngff", SHIPPED), keypoints=64, quality="draft", **chosen)


def test_an_object_slightly_above_the_floor_falls(two_balls):
    """In both engines, standing objects are within two particle spacings of the floor."""
    red = two_balls.gaussians.object_id == 1
    means = two_balls.gaussians.means + 0.06 * red[:, None] * torch.tensor([0.0, 0.0, 1.0])
    scene = replace(two_balls, gaussians=replace(two_balls.gaussians, means=means))
    for engine in ("ngff", "mpm"):
        t = roll_out(scene, SimulateOptions(steps=5, engine=engine, keypoints=64, quality="draft"))
        assert float(t.com[0, 0, 2] - t.com[-1, 0, 2]) > 0.02


def test_an_object_at_rest_moves_only_after_an_impact(two_balls):
    """The red ball is at rest; the green one is dropped beside it, and then from above it."""
    beside = roll_out(two_balls, of_learned_engine(steps=16))
    moved = (beside.positions - beside.positions[0]).norm(dim=-1)
    assert moved[:, beside.keypoints.object_id == 1].max() == 0 < moved[:, beside.keypoints.object_id == 2].max()
    green = two_balls.gaussians.object_id == 2
    means = two_balls.gaussians.means.clone()
    red = means[two_balls.gaussians.object_id == 1].mean(0)
    means[green] += red + torch.tensor([0.0, 0, 0.45]) - means[green].mean(0)
    above = replace(two_balls, gaussians=replace(two_balls.gaussians, means=means))
    hit = roll_out(above, of_learned_engine(steps=16))
    moved = (hit.positions - hit.positions[0])[:, hit.keypoints.object_id == 1].norm(dim=-1).amax(1)
    assert moved[3] == 0 < moved[-1]


def test_a_later_push_gives_the_same_motion_later(two_balls):
    red = two_balls.gaussians.object_id == 1
    alone = replace(two_balls, gaussians=two_balls.gaussians[red], objects=two_balls.objects[:1])
    at_once, later = (
        roll_out(alone, of_learned_engine(steps=16, force=(f"object=1 force=2,0,0 from={t} to={t + 0.1}",))).positions
        for t in (0.0, 0.2)
    )
    assert torch.equal(later[:11], later[:1].expand(11, -1, -1))
    torch.testing.assert_close(later[10:], at_once[:6], rtol=0, atol=1e-6)
    assert (at_once[5] - at_once[0]).norm(dim=1).max() > 1e-3
