import json

import pytest
import torch

from stages.core.errors import InputError
from stages.core.geometry.cameras import centres
from stages.core.scene.cameras import from_json, read_cameras, to_json
from tests.conftest import ring


def test_json_round_trip():
    cameras = ring()
    back = from_json(json.loads(json.dumps(to_json(cameras))))
    torch.testing.assert_close(back.viewmats, cameras.viewmats)
    assert torch.equal(back.sizes, cameras.sizes) and back.names == cameras.names


def test_transforms_json_has_opengl_axes(tmp_path):
    # An OpenGL camera at (0, 0, 3) without rotation looks along -z: the origin is 3 ahead, and y is up.
    pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]
    data = {"fl_x": 50, "fl_y": 50, "cx": 32, "cy": 24, "w": 64, "h": 48, "k1": 0.1,
            "frames": [{"file_path": "images/a.jpg", "transform_matrix": pose}]}  # fmt: skip
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    cameras, lenses = read_cameras(tmp_path / "transforms.json")
    assert cameras.names == ("a.jpg",)
    assert (cameras.viewmats[0] @ torch.tensor([0.0, 1, 0, 1])).tolist() == [0, -1, 3, 1]
    torch.testing.assert_close(centres(cameras.viewmats), torch.tensor([[0.0, 0, 3]]))
    assert lenses.coefficients[0].tolist() == pytest.approx([0.1, 0, 0, 0, 0])


def test_real_reference_cameras_are_read(shared):
    cameras, _ = read_cameras(shared / "data/photos/tum_fr2_desk/cameras.json")
    assert len(cameras) == 20 and cameras.sizes[0].tolist() == [640, 480]


@pytest.mark.parametrize("text", ["{}", '{"frames": []}', "[1]", "nonsense"])
def test_other_json_is_refused(tmp_path, text):
    (tmp_path / "c.json").write_text(text)
    with pytest.raises(InputError, match="not a nerfstudio transforms file"):
        read_cameras(tmp_path / "c.json")


def test_folder_without_a_colmap_model_is_refused(tmp_path):
    with pytest.raises(InputError, match="no COLMAP model"):
        read_cameras(tmp_path)
