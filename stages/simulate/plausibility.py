"""Measures of implausible motion, updated in every frame: penetration, creep, spread and energy gain.

penetration: depth of the deepest keypoint of an object in another object or below the floor, relative to the smaller
height of the two; with an engine whose table has edges, depth in the table from its top or its sides. Subtracted are:
the depth in the scene at rest; a depth that --lift causes, which has a warning of its own; the distance of a keypoint
from the mean surface of its own object (noise, floaters); and, in other objects, its depth below the floor at rest,
where bodies are cut off. In a deformed object depth is measured in material coordinates, since a dent under a load is
not a penetration.
creep: magnitude of the mean velocity in the last quarter of the time, if the object is slow throughout [its size / s].
spread: largest relative change of the root mean square distance of an object's keypoints from their mean.
energy_gain: largest increase of the mechanical energy of all objects above its value at the start, or after the last
force, relative to the converted energy. This is the larger of the energy loss and the kinetic energy, since almost no
energy is lost in free fall or free space. The inertia is that of the filled bodies, since keypoints are on surfaces.
"""

from __future__ import annotations

import logging
import math
from collections import deque
from functools import cache

import numpy as np
from scipy.spatial import cKDTree

from stages.core.geometry.rotations import matrix
from stages.core.physics.forces import ForcePrompts
from stages.core.physics.materials import MODELS, choose_materials
from stages.core.physics.solid_surface import SolidSurface, solid_surface
from stages.core.physics.state import FrameState
from stages.core.scene.scene import Scene
from stages.core.scene.trajectory import Keypoints
from stages.simulate.options import SimulateOptions
from stages.simulate.setup import table_of

log = logging.getLogger(__name__)
BOUNDS = {"penetration": 0.03, "creep": 0.01, "spread": 0.1, "energy_gain": 0.05}  # a warning is logged above these
MAX_CHECKED_KEYPOINTS = 256  # largest number of keypoints per object whose depth is measured
SLOW = 0.1  # largest speed of a creeping object, relative to its speed after a fall by half its size
MOVED = 1e-3  # displacements and deformations below this are ignored [size of the object]
NEIGHBOURS = 4  # number of nearest keypoints from which the displacement of a point is interpolated


class PlausibilityMonitor:
    """Measures the frames of a run one by one; rows of objects follow scene.objects. Lengths are in scene units."""

    def __init__(self, scene: Scene, keypoints: Keypoints, prompts: ForcePrompts, options: SimulateOptions):
        self._scene, self._prompts, self._options = scene, prompts, options
        self._g = options.gravity / scene.metres_per_unit
        self._rows = [(keypoints.object_id == o.id).nonzero()[:, 0] for o in scene.objects]
        self._rest = [keypoints.rest[rows].double().numpy() for rows in self._rows]
        self._few = [slice(None, None, -(-max(len(r), 1) // MAX_CHECKED_KEYPOINTS)) for r in self._rest]
        self._size = np.array([np.ptp(r, axis=0).max() if len(r) else np.inf for r in self._rest]).clip(1e-9)
        self._radius = [max(_radius(r), 1e-12) if len(r) else 1.0 for r in self._rest]
        self._floor = options.floor if options.floor is not None else scene.floor
        self._table = table_of(scene, options) if options.engine == "rigid" else None
        self._left = np.zeros(len(scene.objects), bool)  # mask of the objects that have fallen off the table
        self._surface, self._outside = cache(self._surface_of), cache(self._outside_of)
        self._height = cache(self._height_of)
        self._at_rest = cache(self._rest_depth)
        count = len(scene.objects)
        self.penetration, self._partner = np.zeros(count), [""] * count
        self._put_into: dict[tuple[int, int], float] = {}  # pair of rows -> depth in the first frame
        self._spread = np.zeros(count)
        self._frames, self._com = 0, deque[np.ndarray](maxlen=max(2, options.steps // 4))  # last quarter of the run
        self._energy: list[tuple[float, float]] = []  # kinetic and potential energy between frames
        self._start: tuple[float, float] | None = None  # kinetic and potential energy at the start
        self._second_moment = cache(self._second_moment_of)
        self._before: tuple[list[np.ndarray], np.ndarray, np.ndarray] | None = None

    def add(self, state: FrameState) -> None:
        """Measure the next frame."""
        x = state.positions.double().cpu().numpy()
        points = [x[rows.numpy()] for rows in self._rows]
        com, R = state.com.double().cpu().numpy(), matrix(state.rotation.double().cpu()).numpy()
        if not self._frames:
            lift = np.array([[0.0, 0.0, self._prompts.lift.get(o.id, 0.0)] for o in self._scene.objects])
            self._origin = com - lift
        self._com.append(com)
        self._frames += 1
        for i, (p, radius) in enumerate(zip(points, self._radius, strict=True)):
            if len(p):
                self._spread[i] = max(self._spread[i], abs(_radius(p) / radius - 1))
        self._measure_penetration(points, com, R)
        mass = np.ones(len(com)) if state.mass is None else state.mass.double().numpy()
        if self._before is None:
            self._start = self._start_energy(com, mass)
        else:
            self._energy.append(self._mechanical_energy((points, com, R), self._before, mass))
        self._before = points, com, R

    def _measure_penetration(self, points: list[np.ndarray], com: np.ndarray, R: np.ndarray) -> None:
        moved = np.linalg.norm(com - self._origin, axis=1) > MOVED * self._size
        low = np.array([p.min(0) if len(p) else np.full(3, np.inf) for p in points])
        high = np.array([p.max(0) if len(p) else np.full(3, -np.inf) for p in points])
        if self._table is not None:
            self._left |= (self._table.beyond(com) > 0) & (com[:, 2] < self._floor)
        for a in np.flatnonzero(moved & ~self._left):
            if self._floor is not None and len(points[a]):
                below, seen = (self._floor - p[:, 2] - self._outside(a) for p in (points[a], self._rest[a]))
                if self._table is not None:
                    below = np.minimum(below, np.maximum(-self._table.beyond(points[a]), 0.0))
                self._record(a, float(below.max() - max(seen.max(), 0.0)), self._height(a), "the floor")
        near = ((low[:, None] < high) & (low < high[:, None])).all(-1) & (moved[:, None] | moved)
        for a, b in zip(*np.nonzero(near), strict=True):
            if a != b:
                local = (points[a][self._few[a]] - com[b]) @ R[b] + self._origin[b]
                local = self._undeformed(b, local, (points[b] - com[b]) @ R[b] + self._origin[b])
                depth = float(self._depth(a, b, local).max())
                if self._frames == 1:  # initial penetration, which the prompts cause
                    self._put_into[a, b] = depth
                depth -= max(self._at_rest(a, b), self._put_into.get((a, b), 0.0))
                smaller = min(self._height(a), self._height(b))
                for i, other in ((a, b), (b, a)):
                    o = self._scene.objects[other]
                    self._record(i, depth, smaller, f"object {o.id} ({o.name})")

    def _undeformed(self, row: int, x: np.ndarray, keypoints: np.ndarray) -> np.ndarray:
        """Rest positions of points (k, 3) in a deformed object, by interpolation between its nearest `keypoints`."""
        shift = self._rest[row] - keypoints
        if np.abs(shift).max() < MOVED * self._size[row]:
            return x
        distance, near = cKDTree(keypoints).query(x, min(NEIGHBOURS, len(keypoints)))
        weight = 1 / np.maximum(distance.reshape(len(x), -1), 1e-9 * self._size[row]) ** 2
        weight /= weight.sum(1, keepdims=True)
        return x + (weight[..., None] * shift[near.reshape(len(x), -1)]).sum(1)

    def _record(self, row: int, depth: float, height: float, partner: str) -> None:
        if depth / height > self.penetration[row]:
            self.penetration[row], self._partner[row] = depth / height, partner

    def _rest_depth(self, a: int, b: int) -> float:
        return max(0.0, float(self._depth(a, b, self._rest[a][self._few[a]]).max()))

    def _depth(self, a: int, b: int, x: np.ndarray) -> np.ndarray:
        """Depths in object b of the checked keypoints of object a, at `x` (k, 3) in the rest frame of b."""
        few = self._few[a]
        outside = self._outside(a)[few] if self._floor is None else np.maximum(
            self._outside(a)[few], self._floor - self._rest[a][few, 2])  # fmt: skip
        return self._body_depth(b, x) - outside

    def _body_depth(self, row: int, x: np.ndarray) -> np.ndarray:
        """Depths of points (k, 3) in the body of an object at rest, cut off at the floor; negative outside."""
        depth = self._surface(row).depth(x)
        return depth if self._floor is None else np.minimum(depth, x[:, 2] - self._floor)

    def _surface_of(self, row: int) -> SolidSurface:
        return solid_surface(self._scene, self._scene.objects[row].id, self._options.seed)

    def _height_of(self, row: int) -> float:
        """Height of an object at rest; at least one voxel, since the height of a flat sheet may be 0."""
        return max(float(np.ptp(self._rest[row][:, 2])), self._surface(row).h)

    def _outside_of(self, row: int) -> np.ndarray:
        """Distances (k,) of the keypoints of an object from its own body; 0 for those inside."""
        return np.maximum(-self._surface(row).depth(self._rest[row]), 0)

    def _second_moment_of(self, row: int) -> np.ndarray:
        """Second moment of an object's filled body at rest: mean of x x^T (3, 3) about its centre."""
        body = self._surface(row)
        return np.cov(body.voxels.T, bias=True) + body.h**2 / 12 * np.eye(3)

    def _start_energy(self, com: np.ndarray, mass: np.ndarray) -> tuple[float, float]:
        """Like `_mechanical_energy`, from the velocities of the prompts: an impact may follow in the first frame."""
        moving = {id: v for id, v in self._prompts.velocity.items() if id not in self._prompts.pinned}
        kinetic = np.array([math.hypot(*moving.get(o.id, (0.0,))) ** 2 / 2 for o in self._scene.objects])
        return float(mass @ kinetic / mass.sum()), float(mass @ (self._g * com[:, 2]) / mass.sum())

    def _mechanical_energy(self, now: tuple, before: tuple, mass: np.ndarray) -> tuple[float, float]:
        """Kinetic and potential energy per unit mass between two frames [units^2 / s^2].

        Each frame is given by the keypoints, centres of mass and rotations of the objects. Kinetic energy is that of
        translation, rotation, and deformation: the motion of keypoints relative to the rigid motion.
        """
        points, com, R = ([a - b for a, b in zip(x, y, strict=True)] for x, y in zip(now, before, strict=True))
        kinetic, potential = np.zeros(len(com)), self._g * (now[1] + before[1])[:, 2] / 2
        for i, moved in enumerate(points):
            if len(moved):
                turning = np.trace(R[i] @ self._second_moment(i) @ R[i].T)
                rigid = com[i] + (self._rest[i] - self._origin[i]) @ R[i].T
                square = com[i] @ com[i] + turning + ((moved - rigid) ** 2).sum(1).mean()
                kinetic[i] = square / (2 * self._options.dt**2)
        return float(mass @ kinetic / mass.sum()), float(mass @ potential / mass.sum())

    def result(self) -> dict:
        """The measures of each object, by id, and of the whole scene."""
        dt = self._options.dt
        last = np.array(self._com)[-max(2, self._frames // 4) :]
        speed = np.linalg.norm(np.diff(last, axis=0), axis=2).max(0, initial=0) / dt
        creep = np.linalg.norm(last[-1] - last[0], axis=1) / (max(len(last) - 1, 1) * dt) / self._size
        creep[speed > SLOW * np.sqrt(abs(self._g) * self._size)] = 0
        if self._frames < 8:
            creep[:] = 0
        measures = {"penetration": self.penetration, "creep": creep, "spread": self._spread}
        objects = {str(o.id): {name: float(v[i]) for name, v in measures.items()}
                   for i, o in enumerate(self._scene.objects)}  # fmt: skip
        return {"objects": objects, "energy_gain": self._energy_gain()}

    def _energy_gain(self) -> float:
        ends = [f.end for f in self._prompts.forces] + [c.start for c in self._prompts.changes]
        first = 0 if not ends else min(max(ends) / self._options.dt, math.inf)
        known = self._energy if self._start is None or ends else [self._start, *self._energy]
        both = np.array(known[math.ceil(first) :] if math.isfinite(first) else [])
        if len(both) < 2:
            return 0.0
        energy, kinetic = both.sum(1), both[:, 0]
        converted = max(energy[0] - energy.min(), kinetic.max(), 1e-3 * abs(self._g) * float(self._size.min()), 1e-12)
        return float(max(energy.max() - energy[0], 0.0) / converted)

    def _warn_of_edges(self) -> None:
        """Warn of objects beyond the edge of the table, with engines whose floor has no edge."""
        if self._table is not None or not self._com:
            return
        far = np.linalg.norm(self._com[-1] - self._origin, axis=1) > self._size
        table = table_of(self._scene, self._options) if far.any() else None
        for row in [] if table is None else np.flatnonzero((table.beyond(self._com[-1]) > 0) & far):
            o = self._scene.objects[row]
            log.warning("object %d (%s) is beyond the edge of the table, where --engine %s extends the floor; "
                        "--engine rigid does not", o.id, o.name, self._options.engine)  # fmt: skip

    def warn(self, result: dict) -> None:
        """Warn of measures that exceed BOUNDS, with the objects and what to do."""
        materials = choose_materials(self._scene.objects, self._options.material, self._options.materials)
        other = "rigid or mpm" if self._options.engine not in ("rigid", "mpm") else (
            "mpm" if self._options.engine == "rigid" else "rigid, or a higher --quality")  # fmt: skip
        for a, b in sorted({(min(pair), max(pair)) for pair in self._put_into}):
            depth = max(self._put_into.get(p, 0.0) - self._at_rest(*p) for p in ((a, b), (b, a)))
            share = depth / min(self._height(a), self._height(b))
            if share > BOUNDS["penetration"]:
                one, into = self._scene.objects[a], self._scene.objects[b]
                log.warning("--lift makes object %d (%s) and object %d (%s) overlap by %.0f %% of the smaller "
                            "height", one.id, one.name, into.id, into.name, 100 * share)  # fmt: skip
        self._warn_of_edges()
        for row, o in enumerate(self._scene.objects):
            found = result["objects"][str(o.id)]
            what = f"object {o.id} ({o.name})"
            if found["penetration"] > BOUNDS["penetration"]:
                log.warning("%s sinks into %s by %.0f %% of the smaller height; compare with --engine %s",
                            what, self._partner[row], 100 * found["penetration"], other)  # fmt: skip
            if found["creep"] > BOUNDS["creep"]:
                log.warning("%s does not come to rest but creeps by %.1f %% of its size per second; compare with "
                            "--engine %s", what, 100 * found["creep"], other)  # fmt: skip
            elastic = not MODELS[materials[o.id].material.model].plastic
            if found["spread"] > BOUNDS["spread"] and elastic:
                log.warning("%s changes its size by %.0f %%; compare with --engine %s, or give a stiffer --material",
                            what, 100 * found["spread"], other)  # fmt: skip
        if result["energy_gain"] > BOUNDS["energy_gain"]:
            log.warning("the objects gain energy: %.0f %% of the energy that was converted; compare with --engine %s",
                        100 * result["energy_gain"], other)  # fmt: skip


def _radius(points: np.ndarray) -> float:
    return float(np.sqrt(((points - points.mean(0)) ** 2).sum(1).mean()))
