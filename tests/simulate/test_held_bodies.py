"""Objects of photos in the learned field with solved contacts are held until their equilibrium is disturbed."""

from dataclasses import replace

import pytest
import torch

from stages.core.scene.sequence import FilmedSequence
from stages.simulate.options import SimulateOptions
from tests.simulate.motion import Motion, roll_out
from tests.simulate.test_rigid import cube, scene_of, small_bodies  # noqa: F401 -- small_bodies is a fixture


def roll(*surfaces, photos=True, film=False, **options) -> Motion:
    scene = scene_of(surfaces, photos=photos)
    if film:
        scene = replace(scene, sequence=FilmedSequence(50.0, 60, {"a": 3.0}))
    material = tuple(f"{o.id}=wood" for o in scene.objects)
    chosen = {"engine": "ngff", "contact": "solved", "keypoints": 32, "quality": "draft", "material": material}
    return roll_out(scene, SimulateOptions(**{**chosen, **options}))


def moved(t: Motion, row: int) -> torch.Tensor:
    return t.com[-1, row] - t.com[0, row]


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize("film", [False, True])
@pytest.mark.parametrize("contact", ["solved", "learned"])
def test_with_no_rest_and_in_films_what_hangs_in_the_air_falls(contact, film):
    t = roll(cube(0.1, 0, 0.15), steps=7, rest=film, contact=contact, film=film)
    assert float(moved(t, 0)[2]) == pytest.approx(-9.81 * 0.12**2 / 2, rel=0.1)


@pytest.mark.usefixtures("device")
def test_what_hangs_in_the_air_in_photos_stays_there():
    surfaces = cube(0.1, 0, 0), cube(0.1, 0.0, 0.102)
    assert float(moved(roll(*surfaces, steps=20), 1).norm()) == 0.0
    free = moved(roll(*surfaces, steps=20, photos=False), 1)
    assert float(free[2]) == pytest.approx(-0.002, abs=5e-4)  # without photos, it falls onto the other cube


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize(("speed", "moves"), [(0.05, False), (1.0, True)])
def test_only_a_hard_enough_hit_moves_an_object_at_rest(speed, moves):
    t = roll(cube(0.1, 0, 0), cube(0.1, 0.11, 0), steps=30, friction=0.2, velocity=(f"object=1 {speed},0,0",))
    assert (float(moved(t, 1)[0]) > 0.02) == moves
    if moves:  # the step that wakes it is repeated, so that the impact is on a free body and momentum is conserved
        lost = 0.2 * 9.81 * 0.05  # momentum lost to friction of one of them until the middle of the frame
        assert 1 - 2 * lost - 0.01 < float((t.com[3, :, 0] - t.com[2, :, 0]).sum() / 0.02) < 1 - lost + 0.01


@pytest.mark.usefixtures("device")
def test_a_box_is_pulled_away_from_under_another_that_stays_behind():
    """Edges do not collide if they pass at a distance of 1/100 of the side."""
    t = roll(cube(0.1, 0, 0), cube(0.1, 0.0, 0.101), cube(0.1, -0.5, 0), steps=8, velocity=("object=1 3,0,0",))
    assert float(moved(t, 0)[0]) > 0.3 and abs(float(moved(t, 1)[0])) < 0.02
    assert float(moved(t, 1)[2]) < -0.05 and float(moved(t, 2).norm()) == 0.0  # the second is held until the impact
