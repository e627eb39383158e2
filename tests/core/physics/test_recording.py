"""Recordings that --forces repeats: trajectories and files saved by a page."""

import json

import pytest

from stages.core.errors import InputError
from stages.core.physics.forces import Change, Force, ForcePrompts
from stages.core.physics.recording import Recording, read_prompts_file, read_recording
from stages.core.scene.scene import SceneObject
from stages.simulate.options import SimulateOptions
from stages.simulate.stage import with_recorded

PROMPTS = ForcePrompts((Force(1, (0.0, 0.0, 8.0), start=0.2, end=0.22, at=(0.0, 0.1, 0.2)),), frozenset({2}),
                       changes=(Change("gravity", 1.6, 0.5), Change("pinned", False, 0.7, 2)))  # fmt: skip
SAVED = {"options": {"dt": 0.01, "engine": "ngff", "keypoints": 64, "material": ["1=foam"], "weights": "elsewhere"},
         "frames": 30, "prompts": PROMPTS.as_dicts()}  # fmt: skip


def test_prompts_and_options_come_back(tmp_path):
    file = tmp_path / "done.json"
    file.write_text(json.dumps(SAVED))
    options = {"dt": 0.01, "engine": "ngff", "keypoints": 64, "material": ("1=foam",)}  # options that do not name files
    assert read_recording(file) == Recording(PROMPTS, options, 30)
    repeated = with_recorded(SimulateOptions(forces=file, keypoints=128))
    assert (repeated.dt, repeated.steps, repeated.keypoints, repeated.material) == (0.01, 30, 128, ("1=foam",))
    with pytest.raises(InputError, match="done.json: acts on object 2"):
        read_prompts_file(file, "scene", (SceneObject(1, "duck"),))


@pytest.mark.parametrize("change, message", [
    ({"prompts": {}}, "not a list"), ({"prompts": [{"kind": "spell"}]}, "of none of the kinds"),
    ({"frames": 0}, "frames"), ({"options": []}, "no table"), ({"options": {"dt": "fast"}}, "dt"),
])  # fmt: skip
def test_damaged_recordings(tmp_path, change, message):
    file = tmp_path / "done.json"
    file.write_text(json.dumps({**SAVED, **change}))
    with pytest.raises(InputError, match=message) as error:
        read_recording(file)
    assert str(file) in str(error.value)


def test_the_format_of_ngff_is_no_recording(tmp_path):
    (tmp_path / "forces.json").write_text(json.dumps({"prompts": [{"obj_id": 0, "start": 0, "end": 1}]}))
    assert read_recording(tmp_path / "forces.json") is None


@pytest.mark.parametrize(("prompts", "missing"), [
    (ForcePrompts((Force(3),)), 3), (ForcePrompts(pinned=frozenset({1, 3})), 3), (ForcePrompts(lift={4: 0.1}), 4),
    (ForcePrompts(velocity={3: (0.0, 0.0, 1.0)}), 3), (ForcePrompts(changes=(Change("pinned", True, 0.1, 5),)), 5),
    (ForcePrompts((Force(1),), frozenset({2}), changes=(Change("gravity", 1.6, 0.5),)), None),
])  # fmt: skip
def test_prompts_act_on_objects_of_the_scene(tmp_path, prompts, missing):
    file, objects = tmp_path / "done.json", (SceneObject(1, "duck"), SceneObject(2, "cup"))
    file.write_text(json.dumps({**SAVED, "prompts": prompts.as_dicts()}))
    if missing is None:
        assert read_prompts_file(file, "scene", objects) == prompts
    else:
        with pytest.raises(InputError, match=f"done.json: acts on object {missing}, which"):
            read_prompts_file(file, "scene", objects)
