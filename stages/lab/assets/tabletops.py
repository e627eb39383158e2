"""Ground-truth scenes: the ten objects resting on the eight tables, apart or touching each other."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from stages.core.geometry.cameras import intrinsics, orbit
from stages.core.geometry.harmonics import rotate_sh
from stages.core.geometry.rotations import multiply, quaternion
from stages.core.scene.cameras import Cameras
from stages.core.scene.gaussians import Gaussians, concatenate
from stages.core.scene.scene import Scene, SceneObject
from stages.lab.assets.backgrounds import BACKGROUNDS, TABLE_HEIGHT, make_background
from stages.lab.assets.objects import OBJECTS, make_object

ARRANGEMENTS = ("apart", "touching")
OBJECTS_PER_SCENE = 5  # two scenes together show all ten objects
MAX_RADIUS = 1.5  # largest distance of an object's points from the centre of the table [m]
MIN_GAP = 0.12  # smallest distance between separate objects [m]
CONTACT_GAP = 0.015  # distance between the nearest Gaussians of touching objects [m], about their spacing
DISTANCE_SAMPLES = 4000  # number of Gaussians per object used to compute distances
WIDTH, HEIGHT, FOCAL = 640, 480, 640.0  # size and focal length of the cameras [px]
CAMERA_DISTANCE = 3.8  # distance of the cameras from the scene, as in the data set [m]


def tabletop(kind: str, index: int, photos: int = 24) -> Scene:
    """Scene `index` of an arrangement: five objects resting on a table, with true object ids, and `photos` cameras.

    Two consecutive scenes show all ten objects. In "touching" scenes the first three objects touch each other, and so
    do the last two.
    """
    rng = np.random.default_rng([ARRANGEMENTS.index(kind), index // 2])
    names = list(rng.permutation(list(OBJECTS)))[OBJECTS_PER_SCENE * (index % 2) :][:OBJECTS_PER_SCENE]
    rng = np.random.default_rng([ARRANGEMENTS.index(kind), index, 1])
    clusters = [[name] for name in names] if kind == "apart" else [names[:3], names[3:]]
    placed: list[Gaussians] = []
    for cluster in clusters:
        together = _push_together(rng, [_turned(_resting(name), rng.uniform(0, 2 * math.pi)) for name in cluster])
        placed += _place_apart(rng, together, placed)
    numbered = [replace(g, object_id=torch.full((len(g),), i)) for i, g in enumerate(placed, start=1)]
    table = make_background(list(BACKGROUNDS)[(2 * index + ARRANGEMENTS.index(kind)) % len(BACKGROUNDS)])
    objects = tuple(SceneObject(i, str(name)) for i, name in enumerate(names, start=1))
    return Scene(concatenate([table, *numbered]), objects, _cameras(photos), TABLE_HEIGHT)


@cache
def _resting(name: str) -> Gaussians:
    """An object at its scale prior, resting on the table around the origin; the phone lies on its back."""
    g = make_object(name)
    s = OBJECTS[name].scale
    g = replace(g, means=s * g.means, scales=s * g.scales)
    if name == "phone":
        g = _rotated(g, torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]))
    low = float(g.means[:, 2].quantile(0.0005))  # ignores outliers
    return _moved(g, torch.tensor([0.0, 0.0, TABLE_HEIGHT - low + 0.002]))


def _rotated(g: Gaussians, R: Float[Tensor, "3 3"]) -> Gaussians:
    quats = multiply(quaternion(R[None]).expand(len(g), 4), g.quats)
    return replace(g, means=g.means @ R.mT, quats=quats, sh=rotate_sh(g.sh, R.expand(len(g), 3, 3)))


def _turned(g: Gaussians, angle: float) -> Gaussians:
    c, s = math.cos(angle), math.sin(angle)
    return _rotated(g, torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]))


def _moved(g: Gaussians, offset: Float[Tensor, "3"]) -> Gaussians:
    return replace(g, means=g.means + offset)


def _points(g: Gaussians) -> np.ndarray:
    return g.means[:: max(1, len(g) // DISTANCE_SAMPLES)].double().numpy()


def _push_together(rng: np.random.Generator, objects: list[Gaussians]) -> list[Gaussians]:
    """Move each object along the table from a random direction until it touches the previous ones."""
    out = objects[:1]
    for moving in objects[1:]:
        tree, points = cKDTree(np.concatenate([_points(g) for g in out])), _points(moving)
        angle = rng.uniform(0, 2 * math.pi)
        direction = np.array([math.cos(angle), math.sin(angle), 0.0])
        far = 3.0
        while (gap := tree.query(points + far * direction)[0].min()) > CONTACT_GAP:
            far -= max(gap - CONTACT_GAP, 0.002)  # never overlaps: the gap shrinks no faster than the object moves
            if far < -3.0:
                raise ValueError("two objects miss each other")
        out = [*out, _moved(moving, torch.tensor(far * direction).float())]
    return out


def _place_apart(rng: np.random.Generator, objects: list[Gaussians], others: list[Gaussians]) -> list[Gaussians]:
    """Translate the objects together to a free position on the table, at least MIN_GAP from the others."""
    points = np.concatenate([_points(g)[:, :2] for g in objects])
    centre = points.mean(0)
    tree = cKDTree(np.concatenate([_points(g)[:, :2] for g in others])) if others else None
    for attempt in range(4000):
        shift = rng.uniform(-MAX_RADIUS, MAX_RADIUS, 2) - centre
        radius = MAX_RADIUS * (1 + attempt / 8000)
        if np.linalg.norm(points + shift, axis=1).max() > radius:
            continue
        if tree is None or tree.query(points + shift)[0].min() > MIN_GAP:
            return [_moved(g, torch.tensor([*shift, 0.0]).float()) for g in objects]
    raise ValueError("the table is too small")


def _cameras(count: int) -> Cameras:
    """A low and a high ring of cameras."""
    low = count * 3 // 5
    centre = torch.tensor([0.0, 0.0, TABLE_HEIGHT + 0.2])
    rings = [
        orbit(low, centre, CAMERA_DISTANCE, 22.0),
        orbit(count - low, centre, CAMERA_DISTANCE, 48.0, azimuth=127.0),
    ]
    K = intrinsics(WIDTH, HEIGHT, FOCAL).expand(count, 3, 3).clone()
    names = tuple(f"{i:02d}.jpg" for i in range(count))
    return Cameras(torch.cat(rings), K, torch.tensor([[WIDTH, HEIGHT]] * count), names)
