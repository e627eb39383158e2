"""Heaps of random bodies that fall on each other do not penetrate, and impacts do not add energy."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from stages.core.geometry.rotations import matrix
from stages.core.scene.gaussians import concatenate
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.scene_ply import write_scene
from stages.core.scene.trajectory import read_trajectory
from stages.lab.assets.shapes import Surface, box, ellipsoid, to_gaussians, union
from stages.simulate.options import SimulateOptions
from stages.simulate.stage import run

SHAPES = "box", "ball", "egg", "ell", "tee", "stool", "cross"
MATERIAL = '"E": 1e8, "density": {:.0f}, "loss": {:.2f}, "friction": {:.2f}'


def bar(sides: tuple, at: tuple, spacing: float) -> tuple[Surface, Callable[[Tensor], Tensor]]:
    half, centre = torch.tensor(sides) / 2 - 1e-4, torch.tensor(at)
    return box(sides, spacing).moved(at), lambda p: ((p - centre).abs() < half).all(1)


def body(shape: str, s: float, rng: np.random.Generator) -> Surface:
    """A body of about this size [m]."""
    t, spacing = 0.18 * s, s / 20
    if shape == "box":
        return box((s, s * rng.uniform(0.4, 1), s * rng.uniform(0.3, 1)), spacing)
    if shape in ("ball", "egg"):
        others = (1.0, 1.0) if shape == "ball" else rng.uniform(0.4, 0.9, 2).tolist()
        return ellipsoid((s / 2, *(s / 2 * ratio for ratio in others)), 2500)
    bars = {
        "ell": [((s, s / 2, t), (0.0, 0.0, 0.0)), ((t, s / 2, s), (t / 2 - s / 2, 0.0, s / 2 - t / 2))],
        "tee": [((s, 0.4 * s, t), (0.0, 0.0, 0.0)), ((t, 0.4 * s, 0.8 * s), (0.0, 0.0, -0.4 * s))],
        "stool": [((s, s, t), (0.0, 0.0, 0.0)),
                  *(((t, t, 0.7 * s), (a * 0.4 * s, b * 0.4 * s, -0.35 * s)) for a in (-1, 1) for b in (-1, 1))],
        "cross": [(tuple(np.where(np.arange(3) == axis, s, t).tolist()), (0.0, 0.0, 0.0)) for axis in range(3)],
    }[shape]  # fmt: skip
    return union(*(bar(sides, at, spacing) for sides, at in bars))


def heap(seed: int) -> tuple[Scene, str]:
    """Four to six bodies of random shapes, sizes and orientations above each other, and their materials as JSON."""
    rng = np.random.default_rng(seed)
    parts, materials = [], []
    for i in range(4 + seed % 3):
        s = body(str(rng.choice(SHAPES)), rng.uniform(0.06, 0.16), rng)
        R = matrix(torch.from_numpy(rng.normal(size=4)).float())
        s = Surface(s.points @ R.mT, s.normals @ R.mT)
        middle, low = (s.points.amin(0) + s.points.amax(0)) / 2, s.points.amin(0)[2]
        at = *rng.uniform(-0.08, 0.08, 2), 0.03 + 0.2 * i
        s = s.moved((at[0] - float(middle[0]), at[1] - float(middle[1]), at[2] - float(low)))
        parts.append(to_gaussians(s, torch.full((len(s.points), 3), 0.5), i + 1, widest=float("inf")))
        values = MATERIAL.format(rng.uniform(200, 3000), rng.uniform(0.05, 0.5), rng.uniform(0.1, 0.8))
        materials.append(f'"body{i + 1}": {{{values}}}')
    objects = tuple(SceneObject(i + 1, f"body{i + 1}") for i in range(len(parts)))
    return Scene(concatenate(parts), objects, None, 0.0), "{" + ", ".join(materials) + "}"


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["rigid", "ngff"])
@pytest.mark.parametrize("seed", range(8))
def test_nothing_sinks_in_and_no_energy_is_gained(tmp_path, device, engine, seed):
    scene, materials = heap(seed)
    write_scene(tmp_path / "scene.ply", scene)
    (tmp_path / "m.json").write_text(materials)
    contact = {"contact": "solved"} if engine == "ngff" else {}
    options = SimulateOptions(engine=engine, steps=150, materials=tmp_path / "m.json", **contact)
    run(tmp_path / "scene.ply", tmp_path / "t.h5", options)
    measured = read_trajectory(tmp_path / "t.h5").plausibility
    assert max(o["penetration"] for o in measured["objects"].values()) < 0.05
    assert measured["energy_gain"] < 0.01
