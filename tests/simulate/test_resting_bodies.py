"""Bodies at rest in photos: conditions for sliding, lifting and tipping, and for falling after losing support."""

import math
from dataclasses import replace

import numpy as np
import pytest

from stages.simulate.resting_bodies import RELEASE_SPEED, RestingBodies, Stance, leans

mujoco = pytest.importorskip("mujoco")
MASS, G, STEP = 2.0, 9.81, 0.01
WEIGHT = MASS * G
HEIGHT, HALF_WIDTH = 0.5, 0.3


def stance(friction: float, height: float, half_width: float, box: tuple) -> Stance:
    """Stance of a box of half sides (half, half, half) at (x, y, z)."""
    *centre, half = box
    return Stance(friction, height, half_width, math.isclose(centre[2], half), np.array(centre) - half,
                  np.array(centre) + half)  # fmt: skip


def world(boxes: list[tuple], stances: list[Stance] | None = None):
    """Boxes of half sides (half, half, half) at (x, y, z) above a plane at z = 0, all at rest."""
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.gravity = STEP, [0, 0, -G]
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1])
    for x, y, z, half in boxes:
        body = spec.worldbody.add_body(pos=[x, y, z])
        body.add_freejoint()
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[half] * 3, mass=MASS, margin=0.01)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    stances = stances or [stance(0.5, b[3], b[3], b) for b in boxes]
    pairs, normals = model.geom_bodyid[data.contact.geom], data.contact.frame[:, :3]
    return model, data, RestingBodies(model, stances, pairs, normals, range(1, len(boxes) + 1))


def steps_until_released(wrench: tuple, friction: float, most: int = 300) -> int | None:
    """Substeps with contact forces and moments about the centre of mass until a body is released, or None."""
    _, data, resting = world([(0, 0, 0.5, 0.5)], [stance(friction, HEIGHT, HALF_WIDTH, (0, 0, 0.5, 0.5))])
    for n in range(1, most + 1):
        data.qfrc_constraint[:6] = wrench
        if resting.release_disturbed(data):
            return n
    return None


def steps_of(excess: float) -> int:
    """Substeps in which this force accelerates the body to the speed at which it is released."""
    return math.floor(MASS * RELEASE_SPEED / (excess * STEP)) + 1


@pytest.mark.parametrize("turn", [0.0, 1.0, 2.5])
def test_a_push_slides_a_body_when_it_exceeds_friction(turn):
    """The direction does not matter, and lifting forces are subtracted from the weight."""

    def push(force, lift=0.0):
        # at the base, so that the body does not tip
        x, y = force * math.cos(turn), force * math.sin(turn)
        return x, y, lift, HEIGHT * y, -HEIGHT * x, 0.0

    assert steps_until_released(push(0.99 * 0.4 * WEIGHT), 0.4) is None
    assert steps_until_released(push(1.5 * 0.4 * WEIGHT), 0.4) == steps_of(0.5 * 0.4 * WEIGHT)
    assert steps_until_released(push(0.4 * WEIGHT, lift=0.5 * WEIGHT), 0.4) == steps_of(0.2 * WEIGHT)


def test_a_body_is_lifted_by_more_than_its_weight():
    assert steps_until_released((0, 0, 0.99 * WEIGHT, 0, 0, 0), 0.4) is None
    assert steps_until_released((0, 0, 1.2 * WEIGHT, 0, 0, 0), 0.4) == steps_of(0.2 * WEIGHT)


@pytest.mark.parametrize("turn", [0.0, 1.0, 2.5])
@pytest.mark.parametrize("above", [0.0, 0.5])
def test_a_push_tips_a_body_by_its_moment_about_the_base(turn, above):
    """The push is at a height `above` the centre of mass; friction prevents sliding."""
    tips = WEIGHT * HALF_WIDTH / (HEIGHT + above)
    for share, expected in ((0.98, None), (1.5, steps_of(0.5 * WEIGHT * HALF_WIDTH / HEIGHT))):
        x, y = share * tips * math.cos(turn), share * tips * math.sin(turn)
        assert steps_until_released((x, y, 0, -above * y, above * x, 0), 10.0) == expected


def test_a_short_disturbance_is_forgotten():
    _, data, resting = world([(0, 0, 0.5, 0.5)])
    lasting = steps_of(0.2 * WEIGHT)
    for _ in range(3):
        for lift in [1.2 * WEIGHT] * (lasting - 1) + [0.0]:
            data.qfrc_constraint[:6] = 0, 0, lift, 0, 0, 0
            assert resting.release_disturbed(data) == []
    assert resting.held.all()


def test_what_rests_on_a_released_body_is_released_with_it():
    """Independent of the order of the bodies: a tower of three, a box touching it from the side, and one in the air."""
    tower = [(0, 0, 0.5, 0.1), (0, 0, 0.3, 0.1), (0, 0, 0.1, 0.1)]
    beside, floating = (0.2, 0, 0.105, 0.1), (2.0, 0, 0.5, 0.1)
    _, _, resting = world([*tower, beside, floating])
    assert resting.held.all()  # those without contact are held too, because their support is not visible
    assert resting.resting_on == {3: {2}, 2: {1}}
    assert sorted(resting.release([2])) == [1, 2] and resting.held.tolist() == [False, False, True, True, True]
    assert resting.release([2]) == [] and sorted(resting.release([3])) == [3]
    _, _, resting = world([*tower[::-1], beside])
    assert resting.resting_on == {1: {2}, 2: {3}} and sorted(resting.release([1])) == [1, 2, 3]


def test_what_leans_on_a_released_body_is_released_with_it():
    """Three boxes beside each other on the floor; the middle one leans, or the last two lean on each other."""
    boxes = [(0.0, 0, 0.1, 0.1), (0.205, 0, 0.1, 0.1), (0.41, 0, 0.1, 0.1)]
    stances = [stance(0.5, 0.1, 0.1, b) for b in boxes]
    _, _, resting = world(boxes, [stances[0], replace(stances[1], leaning=True), stances[2]])
    assert resting.resting_on == {1: {2}, 3: {2}} and sorted(resting.release([3])) == [2, 3]
    _, _, resting = world(boxes, [stances[0], *(replace(s, leaning=True) for s in stances[1:])])
    assert sorted(resting.release([3])) == [2, 3] and sorted(resting.release([1])) == [1]


@pytest.mark.parametrize(("degrees", "leaning"), [(0, False), (20, True), (50, True), (80, True), (90, False)])
def test_a_board_leans_unless_it_stands_or_lies(degrees, leaning):
    """A board of 0.5 x 0.15 x 0.06 is rotated by an angle from lying; at 90 degrees it stands on its end."""
    x, y, z = np.meshgrid(*(np.array([-0.5, 0.5]) * side for side in (0.5, 0.15, 0.06)))
    corners, a = np.stack([x, y, z], -1).reshape(-1, 3), math.radians(degrees)
    turn = np.array([[math.cos(a), 0, -math.sin(a)], [0, 1, 0], [math.sin(a), 0, math.cos(a)]])
    assert leans(corners @ turn.T + 3.0, np.full(3, 3.0)) == leaning


def test_what_touches_nothing_rests_on_the_highest_body_below_it():
    boxes = [(0, 0, 0.1, 0.1), (0.08, 0, 0.35, 0.1), (0, 0.08, 0.6, 0.05), (2.0, 0, 0.6, 0.1)]
    _, _, resting = world(boxes)
    assert resting.resting_on == {1: {2}, 2: {3}} and sorted(resting.release([1])) == [1, 2, 3]
    _, _, resting = world(boxes[::-1])
    assert resting.resting_on == {4: {3}, 3: {2}} and sorted(resting.release([4])) == [2, 3, 4]


def test_held_bodies_are_put_back_and_collide_only_with_what_moves():
    model, data, resting = world([(0, 0, 0.1, 0.1), (0.19, 0, 0.1, 0.1), (2.0, 0, 0.5, 0.1)])
    assert resting.release([3]) == [3]
    start = data.qpos.reshape(-1, 7).copy()
    data.qpos.reshape(-1, 7)[:, 0] += 0.001
    data.qvel[:] = 1.0
    resting.restore(data, start)
    assert (data.qpos.reshape(-1, 7)[:2] == start[:2]).all() and data.qpos.reshape(-1, 7)[2, 0] == pytest.approx(2.001)
    assert data.qvel.reshape(-1, 6).any(1).tolist() == [False, False, True]

    def collide(a: int, b: int) -> bool:
        mujoco.mj_forward(model, data)
        return {a, b} in [set(model.geom_bodyid[pair]) for pair in data.contact.geom]

    assert not collide(1, 2) and not collide(0, 1)
    inertia = model.dof_M0[:6].copy()
    resting.release([1])
    assert collide(1, 2) and collide(0, 1)
    assert (inertia > 1e5 * model.dof_M0[:6]).all()  # contacts did not move it
    assert model.dof_M0[:3].tolist() == pytest.approx([MASS] * 3, rel=1e-3)
