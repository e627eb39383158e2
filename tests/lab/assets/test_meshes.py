"""Conversion of meshes: a textured box, colours of vertices and faces, glTF, and invalid files."""

import sys

import numpy as np
import pytest
import torch

from stages.core.errors import InputError
from stages.core.geometry.harmonics import C0
from stages.core.geometry.neighbours import knn
from stages.core.geometry.rotations import matrix
from stages.core.scene.images import write_png
from stages.lab.assets.meshes import read_mesh

CORNERS = [(x, y, z) for z in (0, 1) for y in (0, 2) for x in (0, 2)]  # 2 x 2 x 1
SIDES = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]  # -z +z -y +y -x +x
PAINT = np.array([[200, 30, 30], [30, 200, 30], [30, 30, 200], [200, 200, 30], [30, 200, 200], [200, 30, 200]])
NORMALS = torch.tensor([[0.0, 0, -1], [0, 0, 1], [0, -1, 0], [0, 1, 0], [-1, 0, 0], [1, 0, 0]])


@pytest.fixture(autouse=True)
def trimesh():
    return pytest.importorskip("trimesh")


def textured_box(folder):
    """An OBJ box whose six sides have one colour each, from stripes of a texture."""
    write_png(folder / "paint.png", torch.from_numpy(np.repeat(np.repeat(PAINT[None], 8, 1), 8, 0)).float() / 255)
    (folder / "box.mtl").write_text("newmtl skin\nKd 1 1 1\nmap_Kd paint.png\n")
    lines = ["mtllib box.mtl", "usemtl skin"]
    lines += [f"v {x} {y} {z}" for x, y, z in CORNERS]
    for s in range(6):
        lines += [f"vt {(s + u) / 6} {v}" for u, v in ((0.3, 0.3), (0.7, 0.3), (0.7, 0.7), (0.3, 0.7))]
    for s, (a, b, c, d) in enumerate(SIDES):
        a, b, c, d = (f"{corner + 1}/{4 * s + k + 1}" for k, corner in enumerate((a, b, c, d)))
        lines += [f"f {a} {b} {c}", f"f {a} {c} {d}"]
    (folder / "box.obj").write_text("\n".join(lines))
    return folder / "box.obj"


def side_of(g) -> torch.Tensor:
    """Index of the side each centre lies on; -1 near an edge."""
    away = torch.stack([(g.means - n / 2 * torch.tensor([1.0, 1.0, 0.5])) @ n for n in NORMALS], 1).abs()
    nearest = away.sort(1)
    return torch.where(nearest.values[:, 1] > 0.02, nearest.indices[:, 0], -1)


def rgb(g) -> torch.Tensor:
    return g.sh[:, 0] * C0 + 0.5


def test_textured_box_keeps_size_and_colours(tmp_path):
    g = read_mesh(textured_box(tmp_path), 3000, light=False)
    torch.testing.assert_close(g.means.amax(0), torch.tensor([0.5, 0.5, 0.25]), rtol=0, atol=0.01)
    torch.testing.assert_close(g.means.amin(0), -g.means.amax(0), rtol=0, atol=0.01)
    assert abs(len(g) - 3000) < 450 and (g.object_id == 1).all()
    side = side_of(g)
    for s, paint in enumerate(PAINT):
        own = side == s
        torch.testing.assert_close(rgb(g)[own], torch.tensor(paint / 255.0).float().expand(int(own.sum()), 3),
                                   rtol=0, atol=0.004)  # fmt: skip
        short_axis = matrix(g.quats[own])[:, :, 2]  # along the normal
        torch.testing.assert_close((short_axis @ NORMALS[s]).abs(), torch.ones(int(own.sum())), rtol=0, atol=1e-3)


def test_gaussians_are_uniform_over_the_area(tmp_path):
    """Top and bottom have half of the area of the six sides: 8 of 16."""
    g = read_mesh(textured_box(tmp_path), 4000)
    flat = (g.means[:, 2].abs() > 0.249).float().mean()
    assert abs(float(flat) - 0.5) < 0.03
    nearest = knn(g.means, g.means, 2)[0][:, 1]
    assert nearest[side_of(g) >= 0].min() > 0.5 * float(nearest.mean())


def test_baked_light_comes_from_above(tmp_path):
    """The same colour is brighter on top than below."""
    path = textured_box(tmp_path)
    lit, plain = read_mesh(path, 3000), read_mesh(path, 3000, light=False)
    torch.testing.assert_close(lit.means, plain.means)
    gain = (rgb(lit) / rgb(plain)).mean(1)
    side = side_of(lit)
    assert gain[side == 1].mean() > gain[side == 2].mean() > gain[side == 0].mean()


def test_up_axis(tmp_path):
    """With y up, y becomes z and z becomes -y."""
    path = textured_box(tmp_path)
    z, y = read_mesh(path, 3000), read_mesh(path, 3000, up="y")
    torch.testing.assert_close(y.means[:, 2], z.means[:, 1], rtol=0, atol=1e-6)
    torch.testing.assert_close(y.means[:, 1], -z.means[:, 2], rtol=0, atol=1e-6)


@pytest.mark.parametrize("kind", ["vertex_colors", "face_colors"])
def test_colours_of_vertices_and_faces(tmp_path, trimesh, kind):
    """Vertices: red at the left, blue at the right, interpolated between. Faces: one colour each."""
    triangles = [t for a, b, c, d in SIDES for t in ((a, b, c), (a, c, d))]
    if kind == "vertex_colors":
        colours = [(255, 0, 0, 255) if x == 0 else (0, 0, 255, 255) for x, _, _ in CORNERS]
    else:
        colours = [(*map(int, PAINT[i // 2]), 255) for i in range(12)]
    mesh = trimesh.Trimesh(CORNERS, triangles, process=False, **{kind: colours})
    mesh.export(tmp_path / "box.ply")
    g = read_mesh(tmp_path / "box.ply", 3000, light=False)
    if kind == "vertex_colors":
        across = g.means[:, 0] + 0.5
        expected = torch.stack([1 - across, 0 * across, across], 1).clamp(0.02, 0.98)
    else:
        expected = torch.tensor(PAINT / 255.0).float()[side_of(g)]
    inner = side_of(g) >= 0
    torch.testing.assert_close(rgb(g)[inner], expected[inner], rtol=0, atol=0.01)


def test_gltf_is_y_up_and_its_scene_graph_is_applied(tmp_path, trimesh):
    """Two unit boxes, one translated by 3 along y: total height 4, along z after the conversion."""
    box = trimesh.creation.box((1, 1, 1))
    box.visual = trimesh.visual.TextureVisuals(material=trimesh.visual.material.PBRMaterial(
        baseColorFactor=[51, 102, 204, 255]))  # fmt: skip
    scene = trimesh.Scene()
    scene.add_geometry(box)
    scene.add_geometry(box, transform=trimesh.transformations.translation_matrix((0, 3, 0)))
    scene.export(tmp_path / "boxes.glb")
    g = read_mesh(tmp_path / "boxes.glb", 2000, light=False)
    torch.testing.assert_close(g.means.amax(0) - g.means.amin(0), torch.tensor([0.25, 0.25, 1.0]), rtol=0, atol=0.01)
    assert not (g.means[:, 2].abs() < 0.24).any()
    torch.testing.assert_close(rgb(g).mean(0), torch.tensor([0.2, 0.4, 0.8]), rtol=0, atol=0.01)


def test_conversion_is_deterministic(tmp_path):
    path = textured_box(tmp_path)
    a, b = read_mesh(path, 2000), read_mesh(path, 2000)
    assert torch.equal(a.means, b.means) and torch.equal(a.sh, b.sh)


def test_wrong_files_and_options_are_rejected(tmp_path, trimesh):
    (tmp_path / "points.ply").write_bytes(trimesh.PointCloud(np.eye(3)).export(file_type="ply"))
    (tmp_path / "broken.glb").write_bytes(b"glTF nothing of the kind")
    (tmp_path / "shape.fbx").write_bytes(b"x")
    box = textured_box(tmp_path)
    for path, count, up, words in [
        (tmp_path / "points.ply", 1000, "z", "holds no triangles"),
        (tmp_path / "broken.glb", 1000, "z", "cannot be read as a mesh"),
        (tmp_path / "shape.fbx", 1000, "z", "not a readable mesh file"),
        (tmp_path / "absent.obj", 1000, "z", "no such file"),
        (box, 10, "z", "--count 10"),
        (box, 1000, "w", "--up w"),
    ]:
        with pytest.raises(InputError, match=words):
            read_mesh(path, count, up)


def test_missing_trimesh_is_reported_with_its_install_command(tmp_path, monkeypatch):
    path = textured_box(tmp_path)
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(InputError, match=r"pip install 'ngff\[mesh\]'"):
        read_mesh(path, 1000)


@pytest.mark.parametrize("name", ["ball", "banana", "bowl", "can", "duck", "frypan", "phone", "teddy_bear", "toy_cow"])
def test_real_meshes(shared, name):
    (path,) = (shared / "data/objects" / name).glob("*.obj")
    g = read_mesh(path, 5000)
    assert abs(len(g) - 5000) < 1000
    assert rgb(g).std(0).max() > 0.02  # more than one colour
