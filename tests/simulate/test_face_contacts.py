"""Contacts between the faces of convex bodies."""

import math

import mujoco
import numpy as np
import pytest

from stages.lab.bench.experiments.bodies import polyhedron
from stages.lab.bench.experiments.catalogue import experiments
from stages.lab.bench.motion_options import PhysicsBenchOptions
from stages.lab.bench.physics import measure
from stages.simulate.face_contacts import CUBE, FaceContacts, clipped_faces
from tests.simulate.test_rigid import roll

UP, DOWN = np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 0.0, -1.0]])
SQUARE = np.array([[1.0, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]])


def turned(points: np.ndarray, axis: str, degrees: float) -> np.ndarray:
    a = math.radians(degrees)
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    R = np.eye(3)
    R[[i, i, j, j], [i, j, i, j]] = math.cos(a), -math.sin(a), math.sin(a), math.cos(a)
    return points @ R.T


def clipped(q: np.ndarray, m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Different positions and depths of the contacts of a face with the square, from above."""
    row, x, depth = clipped_faces(SQUARE[None], UP, q[None], m)
    assert not row.any()
    found = np.unique(np.column_stack([x, depth]).round(6), axis=0)
    return found[:, :3], found[:, 3]


def test_equal_faces_touch_at_their_corners():
    x, depth = clipped(SQUARE[::-1] - [0, 0, 0.01], DOWN)
    np.testing.assert_allclose(np.sort(x, 0), np.sort(SQUARE - [0, 0, 0.005], 0), atol=1e-6)
    assert depth == pytest.approx([0.01] * 4)


def test_crossed_faces_touch_where_their_sides_cross():
    """A bar of half widths .5 and 3 on the square, turned by 20 degrees: its long sides leave at y = -1 and 1."""
    bar = turned(SQUARE[::-1] * [0.5, 3, 1], "z", 20)
    x, depth = clipped(bar + [0, 0, 0.02], DOWN)
    across, slant = 0.5 / math.cos(math.radians(20)), math.tan(math.radians(20))
    expected = [(-1, -across + slant), (-1, across + slant), (1, -across - slant), (1, across - slant)]
    np.testing.assert_allclose(sorted(map(tuple, x[:, [1, 0]])), expected, atol=1e-5)
    assert depth == pytest.approx([-0.02] * 4)  # a gap


def test_faces_that_lie_in_each_other_touch_at_the_corners_of_the_smaller_one():
    for inner, outer in ((0.5, 1.0), (1.0, 3.0)):
        x, depth = clipped(outer * SQUARE[::-1] if outer > 1 else inner * SQUARE[::-1], DOWN)
        np.testing.assert_allclose(np.abs(x[:, :2]), min(inner, 1.0), atol=1e-5)
        assert len(x) == 4 and depth == pytest.approx([0.0] * 4)


def test_an_inclined_face_is_deepest_at_its_lower_side():
    tilt = 3.0
    q = turned(0.5 * SQUARE[::-1], "y", tilt)
    x, depth = clipped(q, turned(DOWN, "y", tilt))
    sine = 0.5 * math.sin(math.radians(tilt))
    assert sorted(depth) == pytest.approx([-sine] * 2 + [sine] * 2, abs=1e-5)
    assert (np.sign(x[:, 0]) == np.sign(depth)).all()


def test_the_faces_of_a_box_have_outward_normals():
    area = np.cross(CUBE[:, 1] - CUBE[:, 0], CUBE[:, 2] - CUBE[:, 1])
    np.testing.assert_allclose(area, 4 * CUBE.mean(1))


@pytest.mark.parametrize("kinds", [("box", "mesh"), ("mesh", "box"), ("mesh", "mesh")])
@pytest.mark.parametrize("tilt", [0.0, 0.01, 0.1])
def test_a_tilted_box_on_another_touches_along_its_lower_edge(kinds, tilt):
    """Half as wide, turned about the vertical; all in one direction, and none of MuJoCo's contacts is left."""
    spec = mujoco.MjSpec()
    for (kind, half), name in zip(zip(kinds, (1.0, 0.5), strict=True), "ab", strict=True):
        body = spec.worldbody.add_body(name=name)
        body.add_freejoint()
        if kind == "box":
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[half] * 3)
        else:
            corners = half * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
            spec.add_mesh(name=name, uservert=corners.flatten().tolist())
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name)
    model = spec.compile()
    data = mujoco.MjData(model)
    about_y = np.array([math.cos(tilt / 2), 0, math.sin(tilt / 2), 0])
    about_z = np.array([math.cos(0.2), 0, 0, math.sin(0.2)])
    mujoco.mju_mulQuat(data.qpos[10:14], about_z, about_y)
    low = 0.5 * (math.cos(tilt) + math.sin(tilt))
    data.qpos[7:10] = 0.1, 0.2, 1 + low - 1e-3
    mujoco.mj_fwdPosition(model, data)
    FaceContacts(mujoco, model).replace(data)
    own = data.contact.exclude == 0
    normal, depth = data.contact.frame[own, :3], -data.contact.dist[own]
    sign = 1 if data.contact.geom[own][0, 0] == 0 else -1
    np.testing.assert_allclose(sign * normal, np.tile(UP, (len(normal), 1)), atol=1e-6)
    assert len(normal) == (4 if tilt == 0 else 2)
    assert depth == pytest.approx([1e-3] * len(depth), rel=1e-3)


def test_a_prism_on_a_slope_below_the_angle_of_friction_stays(tmp_path):
    """Of six sides, on a wedge of 15 degrees, whose tangent is .268; it crept by 3 % of its size a second."""
    degrees, ramp = 15.0, 0.5 * math.tan(math.radians(15.0))
    wedge = np.array([[x, y, z] for x, z in ((-0.5, 0), (0.5, 0), (-0.5, 2 * ramp)) for y in (-0.2, 0.2)])
    turn = np.pi / 3 * np.arange(6)
    prism = np.array([[0.1 * np.cos(a), 0.1 * np.sin(a), z] for a in turn for z in (0.0, 0.15)])
    prism = turned(prism, "y", degrees) + [0, 0, ramp]
    bodies = [polyhedron(corners, 2500, seed) for seed, corners in enumerate((wedge, prism))]
    t = roll(tmp_path, *bodies, pin=("1",), friction=0.4, steps=51)
    assert float((t.com[-1, 1] - t.com[0, 1]).norm()) < 1e-4


def test_an_arch_of_wedges_stands():
    experiment = experiments()["stack/arch of wedges"]
    assert measure(experiment, "rigid", PhysicsBenchOptions())["value"] < 0.01
