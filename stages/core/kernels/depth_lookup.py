"""Penetration depths and contact normals of surface samples of one body in another, for rigid-body contact.

Each body has a grid in its own frame that stores depths below its surface (negative outside) at the nodes; depths are
interpolated trilinearly. Arrays are NumPy's in double precision, as in the rigid-body solver. Bodies have positions
`at` (o, 3) and rotations `turn` (o, 3, 3). `DepthLookup` is written in NumPy; `CompiledDepthLookup` does the same in
Warp kernels on the CPU, where Warp can compile them.

Near an edge of a body the gradient of the depth is oblique, so the contact normal is taken from a face: if two faces
of the bodies are parallel, the face of the flatter surface; otherwise the face of the sample, if the sample is on one
(`surface_faces.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import warp as wp
from scipy import ndimage

from stages.core.geometry import surface_faces
from stages.core.kernels.interop import compiles_for_cpu

FACES = wp.constant(surface_faces.FACES)
OPPOSED, CURVED = wp.constant(wp.float64(surface_faces.OPPOSED)), wp.constant(wp.float64(surface_faces.CURVED))
CORNERS = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(-1, 3)  # corners of a grid cell


class Samples(NamedTuple):
    """Surface samples of all bodies, each in the frame of its body."""

    points: np.ndarray  # (s, 3)
    normals: np.ndarray  # (s, 3), outward
    flatness: np.ndarray  # (s,), 1 in a plane, 0 where a sample is not on a face
    faces: np.ndarray  # (s, 3, 3), normals of up to three faces that meet at the sample; unused rows are 0
    nearest: np.ndarray  # (n,), sample nearest to each grid node, for the grids of all bodies in turn; -1: none


class Inside(NamedTuple):
    """Samples of bodies a that are inside bodies b."""

    row: np.ndarray  # (k,), index among the samples looked up
    x: np.ndarray  # (k, 3), world position
    normal: np.ndarray  # (k, 3), contact normal in world axes, out of b
    depth: np.ndarray  # (k,), penetration depth
    facing: np.ndarray  # (k,), cosine of the angle at which the surfaces face each other: 1 if their normals oppose


@wp.struct
class DepthGrid:
    """Depth grid of one body: its geometry in the body frame, and where its nodes are stored."""

    first: wp.int64  # index of its first node in the arrays of all grids
    shape: wp.vec3l  # nodes along x, y, z
    low: wp.vec3d  # position of the first node
    h: wp.float64  # distance between nodes


@wp.struct
class DepthNodes:
    """Values at the nodes of all grids, concatenated."""

    depth: wp.array[wp.float64]
    smooth: wp.array[wp.float64]  # blurred depth, whose gradient gives directions
    nearest: wp.array[wp.int64]  # nearest sample; -1: none


@wp.struct
class SurfaceSample:
    """One row of Samples, which describes the fields."""

    point: wp.vec3d
    normal: wp.vec3d
    flatness: wp.float64
    faces: wp.mat33d


@wp.struct
class RigidPose:
    """Pose of a body."""

    turn: wp.mat33d  # rotation from the body frame to the world
    at: wp.vec3d


@wp.struct
class DepthQuery:
    """One query: a sample of body a looked up in the depth grid of body b."""

    a: wp.int64
    b: wp.int64
    sample: wp.int64


@wp.struct
class InsideSample:
    """Result of a query, with the fields of Inside; where the depth is 0 the other fields are undefined."""

    depth: wp.float64
    x: wp.vec3d
    normal: wp.vec3d
    facing: wp.float64


def depth_lookup(depth: Sequence[np.ndarray], low: np.ndarray, h: np.ndarray, samples: Samples) -> DepthLookup:
    """Return the lookup for bodies with depth grids (x, y, z); compiled where Warp can compile for the CPU.

    `low` (o, 3) are the positions of the first nodes and `h` (o,) the distances between nodes.
    """
    return (CompiledDepthLookup if compiles_for_cpu() else DepthLookup)(depth, low, h, samples)


class DepthLookup:
    """Depth grids and surface samples of all bodies, with lookups in NumPy."""

    def __init__(self, depth: Sequence[np.ndarray], low: np.ndarray, h: np.ndarray, samples: Samples):
        self.samples = Samples(*map(np.ascontiguousarray, samples))
        self.depth = np.concatenate([d.ravel() for d in depth])
        self.smooth = np.concatenate([ndimage.gaussian_filter(d, 1.0).ravel() for d in depth])  # for gradients
        self.first = np.cumsum([0, *(d.size for d in depth)])[:-1]
        self.shape, self.low, self.h = np.array([d.shape for d in depth]), low, h
        self.high = low + h[:, None] * (self.shape - 1)
        self._stride = np.stack([self.shape[:, 1] * self.shape[:, 2], self.shape[:, 2], np.ones(len(h), np.int64)], 1)
        self._to_corners = self._stride @ CORNERS.T

    def distances(
        self, points: np.ndarray, a: np.ndarray, b: np.ndarray, turn: np.ndarray, at: np.ndarray
    ) -> np.ndarray:
        """Return lower bounds (k,) of the signed distances of points from bodies b (k,), negative inside.

        `points` (k, 3) are in the frames of bodies a (k,).
        """
        x = self._relative(points, a, b, turn, at)
        inside = np.minimum(np.maximum(x, self.low[b]), self.high[b])
        node, f = self._cells(b, inside)
        distance = -interpolated(self.depth[node], f)
        beyond = ((x - inside) ** 2).sum(1)
        # Outside the grid: `inside` is the nearest point of the grid's box. The body lies within the box, so the angle
        # at that point is at least a right angle, and Pythagoras gives a lower bound.
        return np.where(beyond > 0, np.sqrt(beyond + np.maximum(distance, 0) ** 2), distance)

    def inside(self, sample: np.ndarray, a: np.ndarray, b: np.ndarray, turn: np.ndarray, at: np.ndarray) -> Inside:
        """Return those samples (k,) of bodies a (k,) that are inside bodies b (k,)."""
        return self.near(sample, a, b, turn, at, 0.0)

    def near(
        self, sample: np.ndarray, a: np.ndarray, b: np.ndarray, turn: np.ndarray, at: np.ndarray, gap: float
    ) -> Inside:
        """As `inside`, but including samples that are outside by less than `gap`."""
        points = self.samples.points[sample]
        node, f = self._cells(b, self._relative(points, a, b, turn, at))
        within = (np.abs(f - 0.5) <= 0.5).all(1)
        depth = np.where(within, interpolated(self.depth[node], f), -np.inf)
        k = np.flatnonzero(depth > -gap)
        a, b, node, f = a[k], b[k], node[k], f[k]
        out = -slope(self.smooth[node], f)
        out /= np.linalg.norm(out, axis=1, keepdims=True).clip(1e-12)
        other = self.samples.nearest[node[np.arange(len(k)), (f > 0.5) @ [4, 2, 1]]]
        normal, facing = self._facing(sample[k], other, out, turn[b].transpose(0, 2, 1) @ turn[a])
        return Inside(k, turned(turn[a], points[k]) + at[a], turned(turn[b], normal), depth[k], facing)

    def _facing(self, sample: np.ndarray, other: np.ndarray, outwards: np.ndarray, turn: np.ndarray):
        """Return contact normals (k, 3) out of bodies b, in their frames, and the cosines (k,) of facing angles.

        `sample` (k,) are the samples of bodies a, `other` (k,) the nearest samples of bodies b (-1: none). `outwards`
        (k, 3) is the direction in which the depth in b decreases; `turn` (k, 3, 3) rotates from a to b.
        """
        own, faces = turned(turn, self.samples.normals[sample]), self.samples.faces[sample]
        others = np.where(other[:, None, None] < 0, 0.0, self.samples.faces[other])
        cosine = -np.einsum("kij,kaj,kbi->kab", turn, faces, others)
        cosine[~faces.any(2)] = -np.inf
        cosine.swapaxes(1, 2)[~others.any(2)] = -np.inf
        row, cosine = np.arange(len(sample)), cosine.reshape(len(sample), surface_faces.FACES**2)
        best = cosine.argmax(1)
        most, flatness = cosine[row, best], self.samples.flatness[sample]
        on_face, flatter = flatness > 0, self.samples.flatness[other] > flatness + surface_faces.CURVED
        normal = np.where(on_face[:, None], -own, outwards)
        parallel = (most > surface_faces.OPPOSED) & (~on_face | flatter)
        normal[parallel] = others[row, best % surface_faces.FACES][parallel]
        return normal, np.where(np.isfinite(most), most, -(own * outwards).sum(1))

    def _relative(self, points, a, b, turn, at) -> np.ndarray:
        """Transform points from the frames of bodies a to those of bodies b."""
        return turned(turn[b].transpose(0, 2, 1), turned(turn[a], points) + at[a] - at[b])

    def _cells(self, b: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows (k, 8) of the corner nodes of the cells that contain points x (k, 3), and the local
        coordinates (k, 3) in the cells: 0..1, or beyond for points outside the grid.

        The points are in the frames of bodies b (k,).
        """
        u = (x - self.low[b]) / self.h[b, None]
        cell = np.minimum(np.maximum(u.astype(np.int64), 0), self.shape[b] - 2)
        return (self.first[b] + (cell * self._stride[b]).sum(1))[:, None] + self._to_corners[b], u - cell


class CompiledDepthLookup(DepthLookup):
    """DepthLookup by Warp kernels.

    Launches are recorded once, for arrays that are reused, since preparing a launch takes longer than running it. Data
    is stored as arrays of structs: on the CPU, Warp indexes arrays within a struct more slowly.
    """

    def __init__(self, depth: Sequence[np.ndarray], low: np.ndarray, h: np.ndarray, samples: Samples):
        super().__init__(depth, low, h, samples)
        self._grids = _records(DepthGrid, len(h), first=self.first, shape=self.shape, low=low, h=h)
        s = self.samples
        self._samples = _records(SurfaceSample, len(s.points), point=s.points, normal=s.normals, flatness=s.flatness,
                                 faces=s.faces)  # fmt: skip
        self._nodes = DepthNodes()
        self._nodes.depth, self._nodes.smooth = _array(self.depth, wp.float64), _array(self.smooth, wp.float64)
        self._nodes.nearest = _array(s.nearest, wp.int64)
        self._poses = _records(RigidPose, len(h))
        self._reserve(1024)

    def _reserve(self, count: int) -> None:
        """Allocate arrays and record launches for up to `count` points."""
        self._room = count
        self._points, self._out = np.empty((count, 3)), np.empty(count)
        self._queries, self._found = _records(DepthQuery, count), _records(InsideSample, count)
        grids, samples = _array(self._grids, DepthGrid), _array(self._samples, SurfaceSample)
        bodies = _array(self._poses, RigidPose), _array(self._queries, DepthQuery)
        inputs = [self._nodes.depth, grids, *bodies, _array(self._points, wp.vec3d), _array(self._out, wp.float64)]
        self._distance = wp.launch(_distance, count, inputs, device="cpu", record_cmd=True)
        inputs = [self._nodes, grids, samples, *bodies, _array(self._found, InsideSample)]
        self._inside = wp.launch(_inside, count, inputs, device="cpu", record_cmd=True)

    def _put(self, a, b, turn, at) -> int:
        count = len(a)
        if count > self._room:
            self._reserve(2 * count)
        self._queries["a"][:count], self._queries["b"][:count] = a, b
        self._poses["turn"], self._poses["at"] = turn, at
        return count

    def distances(
        self, points: np.ndarray, a: np.ndarray, b: np.ndarray, turn: np.ndarray, at: np.ndarray
    ) -> np.ndarray:
        """See DepthLookup.distances."""
        count = self._put(a, b, turn, at)
        self._points[:count] = points
        _run(self._distance, count)
        return self._out[:count].copy()

    def inside(self, sample: np.ndarray, a: np.ndarray, b: np.ndarray, turn: np.ndarray, at: np.ndarray) -> Inside:
        """See DepthLookup.inside."""
        count = self._put(a, b, turn, at)
        self._queries["sample"][:count] = sample
        _run(self._inside, count)
        k = np.flatnonzero(self._found["depth"][:count] > 0)
        found = self._found[k]
        return Inside(k, *(np.ascontiguousarray(found[name]) for name in Inside._fields[1:]))


def _array(values: np.ndarray, dtype) -> wp.array:
    """View contiguous values as a Warp array with one `dtype` per row, without a copy."""
    return wp.array(ptr=values.ctypes.data, dtype=dtype, shape=(len(values),), device="cpu")


def _records(struct, count: int, **fields: np.ndarray) -> np.ndarray:
    """Return `count` instances of a Warp struct with these field values; the other fields are uninitialised."""
    out = np.empty(count, struct.numpy_dtype())
    for name, values in fields.items():
        out[name] = values
    return out


def _run(recorded: wp.Launch, count: int) -> None:
    if count:
        recorded.set_dim(count)
        recorded.launch()


@wp.func
def _place(g: DepthGrid, x: wp.vec3d):
    """Return the row of the first node of the cell that contains a point, and the point's local coordinates in it."""
    u = (x - g.low) / g.h
    zero, two = wp.int64(0), wp.int64(2)
    i = wp.clamp(wp.int64(u[0]), zero, g.shape[0] - two)
    j = wp.clamp(wp.int64(u[1]), zero, g.shape[1] - two)
    k = wp.clamp(wp.int64(u[2]), zero, g.shape[2] - two)
    f = u - wp.vec3d(wp.float64(i), wp.float64(j), wp.float64(k))
    return wp.int32(g.first + (i * g.shape[1] + j) * g.shape[2] + k), f


@wp.func
def _interpolated(value: wp.array[wp.float64], node: int, shape: wp.vec3l, f: wp.vec3d):
    """Interpolate node values trilinearly at local coordinates f of a cell."""
    y = node + wp.int32(shape[2])
    x = wp.int32(shape[1] * shape[2])
    v00, v01 = wp.lerp(value[node], value[node + x], f[0]), wp.lerp(value[node + 1], value[node + x + 1], f[0])
    v10, v11 = wp.lerp(value[y], value[y + x], f[0]), wp.lerp(value[y + 1], value[y + x + 1], f[0])
    return wp.lerp(wp.lerp(v00, v10, f[1]), wp.lerp(v01, v11, f[1]), f[2])


@wp.func
def _gradient(value: wp.array[wp.float64], node: int, shape: wp.vec3l, f: wp.vec3d):
    """Gradient of `_interpolated` [1 / grid spacing]."""
    y = node + wp.int32(shape[2])
    x = wp.int32(shape[1] * shape[2])
    a00, a01, a10, a11 = value[node], value[node + 1], value[y], value[y + 1]
    b00, b01, b10, b11 = value[node + x], value[node + x + 1], value[y + x], value[y + x + 1]
    dx = wp.lerp(wp.lerp(b00 - a00, b10 - a10, f[1]), wp.lerp(b01 - a01, b11 - a11, f[1]), f[2])
    v00, v01 = wp.lerp(a00, b00, f[0]), wp.lerp(a01, b01, f[0])
    v10, v11 = wp.lerp(a10, b10, f[0]), wp.lerp(a11, b11, f[0])
    dy = wp.lerp(v10 - v00, v11 - v01, f[2])
    return wp.vec3d(dx, dy, wp.lerp(v01 - v00, v11 - v10, f[1]))


@wp.kernel(enable_backward=False)
def _distance(
    depth: wp.array[wp.float64], grids: wp.array[DepthGrid], poses: wp.array[RigidPose], queries: wp.array[DepthQuery],
    points: wp.array[wp.vec3d], out: wp.array[wp.float64],
):  # fmt: skip
    i = wp.tid()
    own, other = poses[queries[i].a], poses[queries[i].b]
    x = wp.transpose(other.turn) * (own.turn * points[i] + own.at - other.at)
    grid = grids[queries[i].b]
    n, one = grid.shape, wp.int64(1)
    high = grid.low + grid.h * wp.vec3d(wp.float64(n[0] - one), wp.float64(n[1] - one), wp.float64(n[2] - one))
    inside = wp.min(wp.max(x, grid.low), high)
    node, f = _place(grid, inside)
    distance = -_interpolated(depth, node, n, f)
    beyond = wp.length_sq(x - inside)
    if beyond > wp.float64(0.0):
        outside = wp.max(distance, wp.float64(0.0))
        distance = wp.sqrt(beyond + outside * outside)
    out[i] = distance


@wp.kernel(enable_backward=False)
def _inside(
    nodes: DepthNodes, grids: wp.array[DepthGrid], samples: wp.array[SurfaceSample], poses: wp.array[RigidPose],
    queries: wp.array[DepthQuery], found: wp.array[InsideSample],
):  # fmt: skip
    i = wp.tid()
    own, other, s = poses[queries[i].a], poses[queries[i].b], samples[queries[i].sample]
    zero, half, one = wp.float64(0.0), wp.float64(0.5), wp.float64(1.0)
    x = own.turn * s.point + own.at
    grid = grids[queries[i].b]
    n = grid.shape
    node, f = _place(grid, wp.transpose(other.turn) * (x - other.at))
    found[i].depth = zero
    if wp.min(f) < zero or wp.max(f) > one:
        return
    inside = _interpolated(nodes.depth, node, n, f)
    if inside <= zero:
        return
    found[i].depth = inside
    found[i].x = x
    right, up = wp.where(f[0] > half, n[1], wp.int64(0)), wp.where(f[1] > half, wp.int64(1), wp.int64(0))
    corner = wp.int64(node) + (right + up) * n[2] + wp.where(f[2] > half, wp.int64(1), wp.int64(0))
    r = nodes.nearest[corner]
    most, opposite = wp.float64(-2.0), wp.vec3d()
    if r >= wp.int64(0):
        to_other = wp.transpose(other.turn) * own.turn
        for k in range(FACES):
            mine = s.faces[k]
            if wp.length_sq(mine) > zero:
                mine = to_other * mine
                for m in range(FACES):
                    face = samples[r].faces[m]
                    cosine = -wp.dot(mine, face)
                    if cosine > most and wp.length_sq(face) > zero:
                        most = cosine
                        opposite = face
    normal = own.turn * s.normal
    direction = -_gradient(nodes.smooth, node, n, f)
    outwards = other.turn * (direction / wp.max(wp.length(direction), wp.float64(1.0e-12)))
    found[i].facing = most
    if most < -one:
        found[i].facing = -wp.dot(normal, outwards)
    if most > OPPOSED and (s.flatness == zero or samples[r].flatness > s.flatness + CURVED):
        found[i].normal = other.turn * opposite
    elif s.flatness > zero:
        found[i].normal = -normal
    else:
        found[i].normal = outwards


def turned(R: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Rotate each point (k, 3) by its own matrix (k, 3, 3)."""
    return np.einsum("kij,kj->ki", R, x)


def interpolated(value: np.ndarray, f: np.ndarray) -> np.ndarray:
    """Interpolate corner values (k, 8) of cells trilinearly at local coordinates f (k, 3)."""
    x, y, z = f.T
    v = np.ascontiguousarray(value.T)
    v = v[:4] + (v[4:] - v[:4]) * x
    v = v[:2] + (v[2:] - v[:2]) * y
    return v[0] + (v[1] - v[0]) * z


def slope(value: np.ndarray, f: np.ndarray) -> np.ndarray:
    """Gradients (k, 3) of `interpolated` [1 / grid spacing]."""
    x, y, z = f.T
    v = np.ascontiguousarray(value.T)
    dx = v[4:] - v[:4]
    v = v[:4] + dx * x
    dx = dx[:2] + (dx[2:] - dx[:2]) * y
    dy = v[2:] - v[:2]
    v = v[:2] + dy * y
    return np.stack([dx[0] + (dx[1] - dx[0]) * z, dy[0] + (dy[1] - dy[0]) * z, v[1] - v[0]], 1)
