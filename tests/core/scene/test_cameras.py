import dataclasses
import json
from contextlib import nullcontext

import numpy as np
import pytest
import torch

from stages.core.errors import InputError
from stages.core.geometry.cameras import centres, resize
from stages.core.geometry.similarity import Similarity
from stages.core.scene.cameras import (
    MAX_SIDE,
    Cameras,
    PhotoIntrinsics,
    check_cameras,
    from_json,
    read_cameras,
    to_json,
)
from tests.conftest import ring

POSE = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]  # at a distance of 3 from the origin, facing it
LENS = {"k1": -0.25, "k2": 0.04, "p1": 0.001, "p2": -0.002, "k3": 0.01}


def with_photos(cameras: Cameras) -> Cameras:
    """Cameras that store photos of twice the size, each with different lens distortion."""
    c = len(cameras)
    lens = torch.tensor([-0.25, 0.04, 0.001, -0.002, 0.01]) * torch.arange(1, c + 1)[:, None]
    return dataclasses.replace(cameras, photos=PhotoIntrinsics(resize(cameras.Ks, 2.1, 2.1), 2 * cameras.sizes, lens))


def write_transforms(folder, **more):
    data = {"fl_x": 50, "fl_y": 51, "cx": 32, "cy": 24, "w": 64, "h": 48, **LENS, **more,
            "frames": [{"file_path": f"images/{name}.jpg", "transform_matrix": POSE} for name in "ba"]}  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps(data))
    return folder / "transforms.json"


def write_colmap(folder, model: str, params: list[float], text: bool = False):
    """Let pycolmap write a model of two photos with a camera of this model and parameters."""
    pycolmap = pytest.importorskip("pycolmap")

    reconstruction = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model=model, width=64, height=48, params=params, camera_id=1)
    reconstruction.add_camera_with_trivial_rig(camera)
    for i, name in enumerate("ba", start=1):
        image = pycolmap.Image(name=f"{name}.jpg", camera_id=1, image_id=i)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(np.array([1.0, 2.0]))] * (i - 1))
        turned = pycolmap.Rotation3d(np.array([0.5, 0.1, -0.3, 0.8]) / np.linalg.norm([0.5, 0.1, -0.3, 0.8]))
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(turned, np.array([i, 2.0, 3.0])))
    (folder / "model").mkdir()
    (reconstruction.write_text if text else reconstruction.write)(str(folder / "model"))
    return folder / "model"


def test_json_round_trip():
    cameras = ring()
    back = from_json(json.loads(json.dumps(to_json(cameras))))
    torch.testing.assert_close(back.viewmats, cameras.viewmats)
    assert torch.equal(back.sizes, cameras.sizes) and back.names == cameras.names


def test_json_round_trip_with_photos():
    cameras = with_photos(ring())
    back = from_json(json.loads(json.dumps(to_json(cameras))))
    for field in dataclasses.fields(PhotoIntrinsics):
        assert torch.equal(getattr(back.photos, field.name), getattr(cameras.photos, field.name))


def test_cameras_without_photo_have_that_of_their_view():
    rows = to_json(with_photos(ring(count=2)))
    del rows[1]["photo"]
    photos, view = from_json(rows).photos, ring(count=2)
    assert photos.sizes.tolist() == [(2 * view.sizes[0]).tolist(), view.sizes[1].tolist()]
    assert torch.equal(photos.Ks[1], view.Ks[1]) and not photos.distortion[1].any()
    assert from_json([{k: v for k, v in row.items() if k != "photo"} for row in rows]).photos is None


def test_selected_and_moved_cameras_keep_their_photos():
    cameras = with_photos(ring())
    moved = cameras.transformed(Similarity(2.0, torch.eye(3), torch.zeros(3)))[[2, 0]]
    assert torch.equal(moved.photos.distortion, cameras.photos.distortion[[2, 0]])
    assert torch.equal(moved.photos.Ks, cameras.photos.Ks[[2, 0]])
    assert cameras[1:3].photos.sizes.shape == (2, 2)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [("distortion", [0.1, 0.2], r"00.png: photo: distortion has shape \(2,\), not \(5,\)"),
     ("distortion", [0.1, float("nan"), 0, 0, 0], "distortion has a value that is not finite"),
     ("K", [[1, 0, 0], [0, 1, 0]], r"K has shape \(2, 3\), not \(3, 3\)"),
     ("K", [[0, 0, 1], [0, 1, 1], [0, 0, 1]], "00.png: photo has a focal length in K that is not above 0"),
     ("K", [[1, 9, 1], [0, 1, 1], [0, 0, 1]], r"00.png: photo has a K that is not \[\[fx, 0, cx\]"),
     ("size", [64.5, 48], r"size \[64.5, 48\] is not two whole numbers above 0"), ("size", [64], "not two whole"),
     ("size", [64, 0], "not two whole"), ("model", "fisheye", "lens model 'fisheye' is not known; only 'opencv' is")],
)  # fmt: skip
def test_wrong_photo_fields_are_refused(field, value, message):
    rows = to_json(with_photos(ring(count=1)))
    rows[0]["photo"][field] = value
    with pytest.raises(ValueError, match=message):
        from_json(rows)


@pytest.mark.parametrize(("side", "right"), [(0, False), (1, True), (MAX_SIDE, True), (MAX_SIDE + 1, False)])
def test_sizes_of_cameras_are_bounded(side, right):
    cameras = dataclasses.replace(ring(count=2), sizes=torch.tensor([[9, 9], [9, side]]))
    with nullcontext() if right else pytest.raises(ValueError, match=f"{cameras.names[1]}.*has a size that is not 1"):
        check_cameras(cameras)


@pytest.mark.parametrize(("value", "message"), [(float("nan"), "viewmat that is not finite"), (0.5, "not a rotation")])
def test_viewmats_are_finite_and_rigid(value, message):
    cameras = ring(count=3)
    cameras.viewmats[1, 0, 0] = value
    with pytest.raises(ValueError, match=f"{cameras.names[1]}.*{message}"):
        check_cameras(cameras)


@pytest.mark.parametrize(("field", "value"), [("viewmat", [[1.0]]), ("K", [[float("inf")] * 3] * 3), ("size", [0, 1])])
def test_wrong_camera_fields_are_refused(field, value):
    rows = to_json(ring(count=1))
    rows[0][field] = value
    with pytest.raises(ValueError, match=f"00.png: {field}"):
        from_json(rows)


def test_transforms_json_has_opengl_axes(tmp_path):
    # An OpenGL camera at (0, 0, 3) without rotation faces -z: the origin is 3 in front of it, and y is up.
    cameras, lenses = read_cameras(write_transforms(tmp_path))
    assert cameras.names == ("a.jpg", "b.jpg")
    assert (cameras.viewmats[0] @ torch.tensor([0.0, 1, 0, 1])).tolist() == [0, -1, 3, 1]
    torch.testing.assert_close(centres(cameras.viewmats), torch.tensor([[0.0, 0, 3]]).expand(2, 3))
    assert lenses.coefficients[0].tolist() == pytest.approx(list(LENS.values()))


@pytest.mark.parametrize(
    ("model", "params", "expected"),
    [("SIMPLE_PINHOLE", [], []), ("PINHOLE", [], []), ("SIMPLE_RADIAL", [-0.25], [-0.25]),
     ("RADIAL", [-0.25, 0.04], [-0.25, 0.04]), ("OPENCV", [-0.25, 0.04, 0.001, -0.002], [-0.25, 0.04, 0.001, -0.002]),
     ("FULL_OPENCV", [*LENS.values(), 0, 0, 0], [*LENS.values()])],
)  # fmt: skip
def test_colmap_models_keep_their_lens(tmp_path, model, params, expected):
    focals = [50.0, 51.0] if model in ("PINHOLE", "OPENCV", "FULL_OPENCV") else [50.0]
    cameras, lenses = read_cameras(write_colmap(tmp_path, model, [*focals, 32, 24, *params]))
    assert cameras.names == ("a.jpg", "b.jpg")
    assert cameras.Ks[0].tolist() == [[50, 0, 32], [0, focals[-1], 24], [0, 0, 1]]
    assert lenses.coefficients[1].tolist() == pytest.approx(expected + [0.0] * (5 - len(expected)))


@pytest.mark.parametrize("text", [False, True])
def test_colmap_poses_are_those_that_colmap_reads(tmp_path, text):
    pycolmap = pytest.importorskip("pycolmap")
    path = write_colmap(tmp_path, "PINHOLE", [50, 51, 32, 24], text)
    images = sorted(pycolmap.Reconstruction(str(path)).images.values(), key=lambda image: image.name)
    (path / f"points3D.{'txt' if text else 'bin'}").write_bytes(b"\xff" * 20)  # a damaged file of points has no effect
    poses = np.array([image.cam_from_world().matrix() for image in images])
    torch.testing.assert_close(read_cameras(path)[0].viewmats[:, :3], torch.from_numpy(poses).float())


@pytest.mark.parametrize("quaternion", [[0, 0, 0, 0], [float("nan"), 0, 0, 1], [1e300, 0, 0, 1]])
def test_colmap_poses_without_a_rotation_are_refused(tmp_path, quaternion):
    path = write_colmap(tmp_path, "PINHOLE", [50, 51, 32, 24], text=True)
    pose = " ".join(map(str, quaternion))
    (path / "images.txt").write_text(f"1 {pose} 0 0 1 1 a.png\n\n")
    with pytest.raises(InputError, match="quaternion"):
        read_cameras(path)


@pytest.mark.parametrize(
    ("model", "params"), [("FULL_OPENCV", [50, 51, 32, 24, 0.1, 0, 0, 0, 0, 0, 0, 0.3]),
                          ("OPENCV_FISHEYE", [50, 51, 32, 24, 0.1, 0, 0, 0])],
)  # fmt: skip
def test_other_lenses_of_colmap_are_refused(tmp_path, model, params):
    with pytest.raises(InputError, match=f"camera model {model}.* is not supported; undistort it"):
        read_cameras(write_colmap(tmp_path, model, params))


@pytest.mark.parametrize(
    "more", [{"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True}, {"k4": 0.1}, {"k1": float("nan")}]
)
def test_other_lenses_of_transforms_are_refused(tmp_path, more):
    with pytest.raises(InputError, match="only k1 k2 p1 p2 k3|not finite"):
        read_cameras(write_transforms(tmp_path, **more))


@pytest.mark.parametrize(
    ("absent", "angle", "K"),
    [(["fl_y"], {}, [[50, 0, 32], [0, 50, 24], [0, 0, 1]]),
     (["fl_x", "fl_y", "cx", "cy"], {"camera_angle_x": np.pi / 2}, [[32, 0, 32], [0, 32, 24], [0, 0, 1]]),
     (["fl_y"], {"camera_angle_y": np.pi / 2}, [[50, 0, 32], [0, 24, 24], [0, 0, 1]])],
)  # fmt: skip
def test_absent_intrinsics_of_transforms_follow_from_the_others(tmp_path, absent, angle, K):
    path = write_transforms(tmp_path, **angle)
    path.write_text(json.dumps({k: v for k, v in json.loads(path.read_text()).items() if k not in absent}))
    torch.testing.assert_close(read_cameras(path)[0].Ks[0], torch.tensor(K, dtype=torch.float32))


@pytest.mark.parametrize("absent", ["w", "fl_x"])
def test_transforms_without_size_or_focal_length_are_refused(tmp_path, absent):
    path = write_transforms(tmp_path)
    absent = ["fl_x", "fl_y"] if absent == "fl_x" else [absent]
    path.write_text(json.dumps({k: v for k, v in json.loads(path.read_text()).items() if k not in absent}))
    with pytest.raises(InputError, match=f"'{absent[0]}' is absent"):
        read_cameras(path)


def test_poses_of_three_rows_are_read(tmp_path):
    path = write_transforms(tmp_path)
    whole, _ = read_cameras(path)
    path.write_text(path.read_text().replace(json.dumps(POSE), json.dumps(POSE[:3])))
    assert torch.equal(read_cameras(path)[0].viewmats, whole.viewmats)


def test_two_photos_of_one_name_are_refused(tmp_path):
    path = write_transforms(tmp_path)
    path.write_text(path.read_text().replace("images/b.jpg", "other/a.jpg"))
    with pytest.raises(InputError, match="two photos are named a.jpg, without their folders; rename"):
        read_cameras(path)


@pytest.mark.parametrize(("offset", "right"), [(1000.0, True), (4e6, False)])
def test_cameras_far_from_the_origin_are_refused(tmp_path, offset, right):
    path = write_transforms(tmp_path)
    data = json.loads(path.read_text())
    for i, frame in enumerate(data["frames"]):
        frame["transform_matrix"] = [[1, 0, 0, offset + i], *POSE[1:]]
    path.write_text(json.dumps(data))
    with nullcontext() if right else pytest.raises(InputError, match="4e.06 from the origin, but only 1 from each"):
        read_cameras(path)


def test_real_reference_cameras_are_read(shared):
    cameras, _ = read_cameras(shared / "data/photos/tum_fr2_desk/cameras.json")
    assert len(cameras) == 20 and cameras.sizes[0].tolist() == [640, 480]


@pytest.mark.parametrize(("text", "reason"), [("{}", "frames"), ('{"frames": []}', "no frames"), ("[1]", ""),
                                              ("nonsense", "Expecting value")])  # fmt: skip
def test_other_json_is_refused(tmp_path, text, reason):
    (tmp_path / "c.json").write_text(text)
    with pytest.raises(InputError, match=f"not a nerfstudio transforms file .*{reason}"):
        read_cameras(tmp_path / "c.json")


def test_a_folder_without_a_colmap_model_and_an_absent_file_are_refused(tmp_path):
    with pytest.raises(InputError, match="none.json: no such file; give a transforms.json or a COLMAP model folder"):
        read_cameras(tmp_path / "none.json")
    with pytest.raises(InputError, match="no COLMAP model.*txt[)]$"):
        read_cameras(tmp_path)


def test_a_colmap_project_names_the_folder_of_its_model(tmp_path):
    (tmp_path / "sparse/0").mkdir(parents=True)
    (tmp_path / "sparse/0/cameras.bin").touch()
    for folder in (tmp_path, tmp_path / "sparse"):
        with pytest.raises(InputError, match="no COLMAP model.*; give .*/sparse/0$"):
            read_cameras(folder)
