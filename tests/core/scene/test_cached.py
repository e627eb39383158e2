"""Results that are computed once per scene."""

import pickle
from dataclasses import replace

from stages.core.scene.cached import cached_in_scene
from tests.conftest import two_balls_scene


def test_a_result_is_computed_once_for_each_scene_and_each_argument():
    calls = []

    @cached_in_scene
    def floor_above(scene, height):
        calls.append(height)
        return scene.floor + height

    scene = two_balls_scene()
    assert [floor_above(scene, h) for h in (1.0, 2.0, 1.0)] == [1.0, 2.0, 1.0] and calls == [1.0, 2.0]
    lowered = replace(scene, floor=-1.0)
    assert floor_above(lowered, 1.0) == 0.0 and calls == [1.0, 2.0, 1.0]


def test_a_scene_goes_to_another_process_without_its_results():
    @cached_in_scene
    def objects(scene):
        return len(scene.objects)

    scene = two_balls_scene()
    assert objects(scene) == 2  # cached under a function that cannot be pickled
    assert "_cached" in scene.__dict__ and not pickle.loads(pickle.dumps(scene)).__dict__["_cached"]
