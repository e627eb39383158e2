"""Conversion of meshes: textured boxes, colours, glTF, parts, inverted faces, units and invalid files."""

import json
import logging
import sys

import numpy as np
import pytest
import torch

from stages.core.errors import InputError, MissingPackage
from stages.core.geometry.harmonics import C0
from stages.core.geometry.neighbours import knn
from stages.core.geometry.rotations import matrix
from stages.core.scene.images import write_png
from stages.lab.assets.mesh_files import find_objects, object_name
from stages.lab.assets.meshes import read_mesh
from stages.lab.assets.winding import winding_signs

CORNERS = [(x, y, z) for z in (0, 1) for y in (0, 2) for x in (0, 2)]  # corners of a box of 2 x 2 x 1
# vertices of the sides: -z +z -y +y -x +x
SIDES = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
PAINT = np.array([[200, 30, 30], [30, 200, 30], [30, 30, 200], [200, 200, 30], [30, 200, 200], [200, 30, 200]])
NORMALS = torch.tensor([[0.0, 0, -1], [0, 0, 1], [0, -1, 0], [0, 1, 0], [-1, 0, 0], [1, 0, 0]])


@pytest.fixture(autouse=True)
def trimesh():
    return pytest.importorskip("trimesh")


def textured_box(folder):
    """An OBJ box whose six sides have the colours of stripes of a texture."""
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
    """Index of the side on which each centre lies; -1 near an edge."""
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
        short_axis = matrix(g.quats[own])[:, :, 2]  # the direction along the normal
        torch.testing.assert_close((short_axis @ NORMALS[s]).abs(), torch.ones(int(own.sum())), rtol=0, atol=1e-3)


def test_gaussians_are_uniform_over_the_area(tmp_path):
    """Top and bottom have half of the total area: 8 of 16."""
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
    """In files with y up, y is converted to z and z to -y."""
    path = textured_box(tmp_path)
    z, y = read_mesh(path, 3000), read_mesh(path, 3000, up="y")
    torch.testing.assert_close(y.means[:, 2], z.means[:, 1], rtol=0, atol=1e-6)
    torch.testing.assert_close(y.means[:, 1], -z.means[:, 2], rtol=0, atol=1e-6)


@pytest.mark.parametrize("kind", ["vertex_colors", "face_colors"])
def test_colours_of_vertices_and_faces(tmp_path, trimesh, kind):
    """Vertex colours from red (left) to blue (right) are interpolated; faces have one colour each."""
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
    """Two unit boxes, one translated by 3 along y, have a total height of 4, along z after the conversion."""
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


@pytest.mark.parametrize(("change", "words"), [
    ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "is compressed .KHR_draco_mesh_compression.; export it w"),
    ({"accessors": [{"count": 10**10, "componentType": 5126, "type": "VEC3"}]}, "10000000000 vertices without"),
    ({"accessors": 3}, "cannot be read as a mesh"),
])  # fmt: skip
@pytest.mark.parametrize("suffix", ["glb", "gltf"])
def test_gltf_that_would_be_read_as_empty_is_rejected(tmp_path, trimesh, suffix, change, words):
    path = tmp_path / f"box.{suffix}"
    files = trimesh.Scene(trimesh.creation.box()).export(file_type=suffix)
    if suffix == "glb":
        length = int.from_bytes(files[12:16], "little")
        text, rest = json.dumps(json.loads(files[20 : 20 + length]) | change).encode(), files[20 + length :]
        path.write_bytes(files[:12] + len(text).to_bytes(4, "little") + b"JSON" + text + rest)
    else:
        path.write_text(json.dumps(json.loads(files["model.gltf"]) | change))
    with pytest.raises(InputError, match=f"box.{suffix}: .*{words}"):
        read_mesh(path, 1000)


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
        (tmp_path / "points.ply", 1000, "z", "contains no triangles"),
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
    with pytest.raises(MissingPackage, match=r"pip install 'ngff\[mesh\]'"):
        read_mesh(path, 1000)


@pytest.mark.parametrize("name", ["ball", "banana", "bowl", "can", "duck", "frypan", "phone", "teddy_bear", "toy_cow"])
def test_real_meshes(shared, name):
    (path,) = (shared / "data/objects" / name).glob("*.obj")
    g = read_mesh(path, 5000)
    assert abs(len(g) - 5000) < 1000
    assert rgb(g).std(0).max() > 0.02  # it has more than one colour


def obj_box(low=(0, 0, 0), sides=(1, 1, 1), start: int = 0, inverted: tuple[int, ...] = ()) -> list[str]:
    """Lines of an OBJ box with its corner at `low`, after `start` other vertices; some of its 6 faces are inverted."""
    v = [f"v {low[0] + sides[0] * x} {low[1] + sides[1] * y} {low[2] + sides[2] * z}"
         for z in (0, 1) for y in (0, 1) for x in (0, 1)]  # fmt: skip
    quads = [tuple(reversed(quad)) if i in inverted else quad for i, quad in enumerate(SIDES)]
    return v + ["f " + " ".join(str(start + corner + 1) for corner in quad) for quad in quads]


def sides_of(g) -> list[float]:
    return (g.means.amax(0) - g.means.amin(0)).tolist()


TWO = ((0, 0, 0), (1, 1, 1)), ((3, 0, 0), (1, 1, 1))  # two unit boxes with a gap of 2, total length 4


def two_boxes(folder, trimesh, kind: str):
    """One object of two boxes, in the different forms in which files store its parts."""
    folder.mkdir()
    lines = [obj_box(*box, start=8 * i) for i, box in enumerate(TWO)]
    if kind in ("o", "g"):
        text = "\n".join(line for i, part in enumerate(lines) for line in (f"{kind} part{i}", *part))
        (folder / "a.obj").write_text(text)
    elif kind == "materials":
        (folder / "a.mtl").write_text("newmtl red\nKd 1 0 0\nnewmtl blue\nKd 0 0 1\n")
        text = [line for name, part in zip(("red", "blue"), lines, strict=True) for line in (f"usemtl {name}", *part)]
        (folder / "a.obj").write_text("\n".join(["mtllib a.mtl", *text]))
    elif kind == "files":
        for i, box in enumerate(TWO):
            (folder / f"leg_{i}.obj").write_text("\n".join(obj_box(*box)))
    else:
        scene = trimesh.Scene()
        for (x, _, _), _ in TWO:
            to = trimesh.transformations.translation_matrix((x, 0, 0))
            scene.add_geometry(trimesh.creation.box((1, 1, 1)), transform=to)
        scene.export(folder / "a.glb")
    return folder


@pytest.mark.parametrize("kind", ["o", "g", "materials", "files", "nodes"])
def test_parts_are_one_object(tmp_path, trimesh, kind):
    (files,) = find_objects([two_boxes(tmp_path / "chair", trimesh, kind)])
    g = read_mesh(files, 2000, light=False)
    assert sides_of(g) == pytest.approx([1, 0.25, 0.25], abs=0.01)
    left, right = g.means[:, 0] < -0.24, g.means[:, 0] > 0.24
    assert (left | right).all() and abs(float(left.float().mean()) - 0.5) < 0.03
    if kind == "materials":
        torch.testing.assert_close(rgb(g)[left].mean(0), torch.tensor([0.98, 0.02, 0.02]), rtol=0, atol=1e-3)
        torch.testing.assert_close(rgb(g)[right].mean(0), torch.tensor([0.02, 0.02, 0.98]), rtol=0, atol=1e-3)


def test_folders_are_searched_for_objects(tmp_path):
    """Numbered parts are grouped, other formats of a mesh are skipped, and different names are different objects."""
    names = ["mug/mug.obj", "mug/mug.stl", "chair/seat.obj", "chair/leg_1.obj", "chair/leg_2.obj", "bed/Part1.ply",
             "bed/Part2.ply", "bed/frame.001.ply", "bed/frame.ply", "flat/towel2.obj", "flat/towel3.obj", "n/1.obj",
             "n/2.obj", "n/.hidden.obj", "n/paint.png"]  # fmt: skip
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    found = [[p.relative_to(tmp_path).as_posix() for p in files] for files in find_objects([tmp_path])]
    assert found == [["bed/Part1.ply", "bed/Part2.ply"], ["bed/frame.ply", "bed/frame.001.ply"],
                     ["chair/leg_1.obj", "chair/leg_2.obj"], ["chair/seat.obj"], ["flat/towel2.obj"],
                     ["flat/towel3.obj"], ["mug/mug.obj"], ["n/1.obj"], ["n/2.obj"]]  # fmt: skip
    assert find_objects([tmp_path / "a.obj"]) == [(tmp_path / "a.obj",)]
    assert object_name([tmp_path / "bed/Part1.ply", tmp_path / "bed/Part2.ply"]) == "bed"
    assert object_name([tmp_path / "chair/leg_1.obj", tmp_path / "chair/leg_2.obj"]) == "leg"
    assert object_name([tmp_path / "chair/model.obj"]) == "chair" and object_name([tmp_path / "mug_2.obj"]) == "mug_2"
    with pytest.raises(InputError, match="contains no meshes; give a folder"):
        (tmp_path / "empty").mkdir()
        find_objects([tmp_path / "empty"])


@pytest.mark.parametrize("inverted", [(1,), (0, 2, 4), (0, 1, 2, 3, 4, 5)])
@pytest.mark.parametrize("split", [False, True], ids=["shared", "split"])
def test_inverted_faces_are_lit_as_right_ones(tmp_path, inverted, split):
    """In the second case each face has its own vertices."""

    def box(name, faces):
        lines = obj_box(inverted=faces)
        if split:
            vertices = [line for line in lines if line[0] == "v"]
            quads = [[vertices[int(i) - 1] for i in line.split()[1:]] for line in lines if line[0] == "f"]
            lines = [
                line for i, q in enumerate(quads) for line in (*q, f"f {4 * i + 1} {4 * i + 2} {4 * i + 3} {4 * i + 4}")
            ]
        (tmp_path / name).write_text("\n".join(lines))
        return read_mesh(tmp_path / name, 3000)

    right, wrong = box("right.obj", ()), box("wrong.obj", inverted)
    for axis in range(3):
        for side in (-0.5, 0.5):
            own, other = ((g.means[:, axis] - side).abs() < 1e-3 for g in (right, wrong))
            assert float(rgb(right)[own].median()) == pytest.approx(float(rgb(wrong)[other].median()), abs=1e-4)


def test_winding_of_open_and_twisted_surfaces():
    """An open strip keeps the winding of most of its area, a Moebius strip its own; distant parts are independent."""

    def strip(n, twist, close):
        u = torch.linspace(0, 2 * torch.pi * (1 if close else 0.8), n + 1).double()
        half = twist * u / 2
        edge = [torch.stack([(1 + s * half.cos()) * u.cos(), (1 + s * half.cos()) * u.sin(), s * half.sin()], 1)
                for s in (-0.3, 0.3)]  # fmt: skip
        a, b = edge
        return torch.cat([torch.stack([a[:-1], a[1:], b[1:]], 1), torch.stack([a[:-1], b[1:], b[:-1]], 1)]).numpy()

    flat = strip(12, 0, close=False)
    mixed = flat.copy()
    mixed[[2, 3, 17]] = mixed[[2, 3, 17], ::-1]
    assert winding_signs(flat).tolist() == [1] * 24
    assert (winding_signs(mixed) < 0).nonzero()[0].tolist() == [2, 3, 17]
    both = winding_signs(np.concatenate([mixed, flat[:, ::-1] + 5]))
    assert (both < 0).nonzero()[0].tolist() == [2, 3, 17]
    assert set(winding_signs(strip(12, 1, close=True)).tolist()) == {1.0}


def test_open_meshes_and_sheets_are_read(tmp_path):
    """A box without its top, and a square without thickness."""
    lines = obj_box()
    (tmp_path / "open.obj").write_text("\n".join(lines[:9] + lines[10:]))
    g = read_mesh(tmp_path / "open.obj", 2000)
    assert sides_of(g) == pytest.approx([1, 1, 1], abs=0.01)
    assert not ((g.means[:, 2] > 0.499) & (g.means[:, :2].abs() < 0.49).all(1)).any()
    (tmp_path / "sheet.obj").write_text("v 0 0 0\nv 2 0 0\nv 2 1 0\nv 0 1 0\nf 1 2 3 4\n")
    g = read_mesh(tmp_path / "sheet.obj", 2000)
    assert sides_of(g) == pytest.approx([1, 0.5, 0], abs=0.01) and abs(len(g) - 2000) < 300


@pytest.mark.parametrize("size", [1e-12, 1e-9, 1e9, 1e30])
@pytest.mark.parametrize("at", [0.0, 1e4])
def test_units_do_not_matter(tmp_path, size, at):
    """The position does not matter either: one object is 10,000 times its size away from the origin."""
    (tmp_path / "box.obj").write_text("\n".join(obj_box((at * size,) * 3, (2 * size, size, size))))
    g = read_mesh(tmp_path / "box.obj", 1000)
    assert sides_of(g) == pytest.approx([1, 0.5, 0.5], abs=0.01) and g.scales.isfinite().all()


def test_missing_textures_leave_the_colour_of_the_material(tmp_path, caplog):
    caplog.set_level(logging.INFO, "stages")
    (tmp_path / "box.mtl").write_text("newmtl skin\nKd 0.2 0.4 0.8\nmap_Kd absent.png\n")
    for first, colour in (("mtllib box.mtl\nusemtl skin\n", [0.2, 0.4, 0.8]), ("", [0.6] * 3)):
        (tmp_path / "box.obj").write_text(first + "\n".join(obj_box()))
        g = read_mesh(tmp_path / "box.obj", 1000, light=False)
        torch.testing.assert_close(rgb(g).mean(0), torch.tensor(colour), rtol=0, atol=0.01)
    assert "no texture" not in caplog.text  # without texture coordinates there is nothing to miss
    text = "mtllib box.mtl\nusemtl skin\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\n"
    (tmp_path / "one.obj").write_text(text)
    assert rgb(read_mesh(tmp_path / "one.obj", 200, light=False)).mean(0).tolist() == pytest.approx([0.2, 0.4, 0.8])
    assert "one.obj: has no texture that can be read for some faces" in caplog.text


@pytest.mark.parametrize("corners", ["vt 0.25\nvt 0.25\nvt 0.25", "vt nan 0\nvt inf 0\nvt 3e38 0"])
def test_odd_texture_coordinates_are_read(tmp_path, corners):
    """OBJ allows a single coordinate; coordinates outside any texture count as 0."""
    write_png(tmp_path / "paint.png", torch.tensor([0.8, 0.4, 0.2]).expand(4, 4, 3).contiguous())
    (tmp_path / "skin.mtl").write_text("newmtl skin\nmap_Kd paint.png\n")
    text = f"mtllib skin.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\n{corners}\nusemtl skin\nf 1/1 2/2 3/3\n"
    (tmp_path / "one.obj").write_text(text)
    g = read_mesh(tmp_path / "one.obj", 200, light=False)
    torch.testing.assert_close(rgb(g).mean(0), torch.tensor([0.8, 0.4, 0.2]), rtol=0, atol=0.01)


@pytest.mark.parametrize(("text", "words"), [
    ("v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n", "three coordinates"),
    ("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "no area"),
    ("v 5 5 5\nv 5 5 5\nv 5 5 5\nf 1 2 3\n", "no area"),
    ("v 0 0 0\nv 1 0 0\nv 0 1 nan\nf 1 2 3\n", "not finite"),
    ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "cannot be read as a mesh"),
    ("v 0 0 0\nv 1 0 0\nv 0 1 0\n", "contains no triangles|cannot be read as a mesh"),
], ids=["flat", "line", "point", "nan", "index", "faces"])  # fmt: skip
def test_meshes_without_a_surface_are_rejected(tmp_path, text, words):
    (tmp_path / "bad.obj").write_text(text)
    with pytest.raises(InputError, match=rf"bad\.obj: .*({words})"):
        read_mesh(tmp_path / "bad.obj", 1000)
