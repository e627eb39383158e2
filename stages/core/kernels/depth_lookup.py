"""Samples of bodies' surfaces looked up in the depths of others, as contacts of rigid bodies need them in each substep.

A body's depths below its surface are given at the nodes of a grid in its frame and interpolated linearly. Arrays are
NumPy's, in double precision, as those of the rigid-body solver; bodies are at positions `at` (o, 3), turned by `turn`
(o, 3, 3). `CompiledDepthLookup` does in Warp kernels on the CPU what `DepthLookup` does in NumPy, where these can be
compiled.

Where a body has an edge its depths increase in an oblique direction. The normal of a contact is that of a face: of
faces that are parallel the one of the flatter surface, else that of the sample if it is on one (`surface_faces.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import warp as wp
from scipy import ndimage

from stages.core.geometry import surface_faces
from stages.core.kernels.interop import compiles_for_cpu

_F, _I = wp.float64, wp.int64
FACES = wp.constant(surface_faces.FACES)
OPPOSED, CURVED = wp.constant(wp.float64(surface_faces.OPPOSED)), wp.constant(wp.float64(surface_faces.CURVED))
CORNERS = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(-1, 3)  # of a cell


class Samples(NamedTuple):
    """Samples of the surfaces of all bodies, in the frames of these."""

    points: np.ndarray  # (s, 3)
    normals: np.ndarray  # (s, 3), outwards
    flatness: np.ndarray  # (s,), 0 where a sample is not on a face
    faces: np.ndarray  # (s, 3, 3), normals of up to three faces that meet there, the others 0
    nearest: np.ndarray  # (n,), the sample nearest to each node of the grids, one after the other; -1 for none


class Inside(NamedTuple):
    """Samples of bodies a that are inside bodies b."""

    row: np.ndarray  # (k,), of those looked up
    x: np.ndarray  # (k, 3), positions
    normal: np.ndarray  # (k, 3), out of b
    depth: np.ndarray  # (k,)
    facing: np.ndarray  # (k,), cosine of the angle at which the surfaces face each other


def depth_lookup(depth: Sequence[np.ndarray], low: np.ndarray, h: np.ndarray, samples: Samples) -> DepthLookup:
    """The lookup in grids of depths (x, y, z), of which `low` (o, 3) are the first nodes and h (o,) the distances."""
    return (CompiledDepthLookup if compiles_for_cpu() else DepthLookup)(depth, low, h, samples)


class DepthLookup:
    """Grids and samples of all bodies, and points looked up in them by NumPy."""

    def __init__(self, depth: Sequence[np.ndarray], low: np.ndarray, h: np.ndarray, samples: Samples):
        self.samples = Samples(*map(np.ascontiguousarray, samples))
        self.depth = np.concatenate([d.ravel() for d in depth])
        self.smooth = np.concatenate([ndimage.gaussian_filter(d, 1.0).ravel() for d in depth])  # for directions
        self.first = np.cumsum([0, *(d.size for d in depth)])[:-1]
        self.shape, self.low, self.h = np.array([d.shape for d in depth]), low, h
        self.high = low + h[:, None] * (self.shape - 1)
        self._stride = np.stack([self.shape[:, 1] * self.shape[:, 2], self.shape[:, 2], np.ones(len(h), np.int64)], 1)
        self._to_corners = self._stride @ CORNERS.T

    def distances(
        self, points: np.ndarray, a: np.ndarray, b: np.ndarray, turn: np.ndarray, at: np.ndarray
    ) -> np.ndarray:
        """Lower bounds of the distances (k,) of points (k, 3), in the frames of bodies a (k,), from bodies b (k,).

        Negative inside.
        """
        x = self._relative(points, a, b, turn, at)
        inside = np.minimum(np.maximum(x, self.low[b]), self.high[b])
        node, f = self._cells(b, inside)
        distance = -interpolated(self.depth[node], f)
        beyond = ((x - inside) ** 2).sum(1)
        # the body is in the box of its grid, so the angle at the nearest point of the box is at least a right one
        return np.where(beyond > 0, np.sqrt(beyond + np.maximum(distance, 0) ** 2), distance)

    def inside(self, sample: np.ndarray, a: np.ndarray, b: np.ndarray, turn: np.ndarray, at: np.ndarray) -> Inside:
        """Those of samples (k,) of bodies a (k,) that are inside bodies b (k,)."""
        return self.near(sample, a, b, turn, at, 0.0)

    def near(
        self, sample: np.ndarray, a: np.ndarray, b: np.ndarray, turn: np.ndarray, at: np.ndarray, gap: float
    ) -> Inside:
        """As `inside`, with those that are less than `gap` outside."""
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
        """Normals (k, 3) out of bodies b, in their frames, of contacts of samples (k,) of bodies a near samples (k,) of
        b, and the cosines (k,) of the angles at which they face each other. Depths in b increase against `outwards`
        (k, 3); `turn` (k, 3, 3) is from a to b.
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
        """Points in the frames of bodies b."""
        return turned(turn[b].transpose(0, 2, 1), turned(turn[a], points) + at[a] - at[b])

    def _cells(self, b: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows (k, 8) of the nodes around points (k, 3) in the frames of bodies b (k,), and the places (k, 3) between
        them, beyond 0..1 for points outside of the grid.
        """
        u = (x - self.low[b]) / self.h[b, None]
        cell = np.minimum(np.maximum(u.astype(np.int64), 0), self.shape[b] - 2)
        return (self.first[b] + (cell * self._stride[b]).sum(1))[:, None] + self._to_corners[b], u - cell


class CompiledDepthLookup(DepthLookup):
    """The same by kernels, whose launches are recorded once for arrays that are reused: preparing one takes longer."""

    def __init__(self, depth: Sequence[np.ndarray], low: np.ndarray, h: np.ndarray, samples: Samples):
        super().__init__(depth, low, h, samples)
        grids = [self.depth, self.smooth, self.first, self.shape, self.low, self.h]
        self._grids = [_array(x, t) for x, t in zip(grids, (_F, _F, _I, wp.vec3l, wp.vec3d, _F), strict=True)]
        types = wp.vec3d, wp.vec3d, _F, wp.mat33d, _I
        self._samples = [_array(x, t) for x, t in zip(self.samples, types, strict=True)]
        self._turn, self._at = np.empty((len(h), 3, 3)), np.empty((len(h), 3))
        self._reserve(1024)

    def _reserve(self, count: int) -> None:
        """Make room for `count` points."""
        self._room = count
        self._points, self._x, self._normal = (np.empty((count, 3)) for _ in range(3))
        self._sample, self._a, self._b = (np.empty(count, np.int64) for _ in range(3))
        self._out, self._facing_out = np.empty(count), np.empty(count)
        rest = [_array(self._a, _I), _array(self._b, _I), _array(self._turn, wp.mat33d), _array(self._at, wp.vec3d),
                _array(self._out, _F)]  # fmt: skip
        found = [_array(self._x, wp.vec3d), _array(self._normal, wp.vec3d), _array(self._facing_out, _F)]
        points, sample = _array(self._points, wp.vec3d), _array(self._sample, _I)
        self._distance = wp.launch(_distance, count, [*self._grids, points, *rest], device="cpu", record_cmd=True)
        inputs = [*self._grids, *self._samples, sample, *rest, *found]
        self._inside = wp.launch(_inside, count, inputs, device="cpu", record_cmd=True)

    def _put(self, a, b, turn, at) -> int:
        count = len(a)
        if count > self._room:
            self._reserve(2 * count)
        self._a[:count], self._b[:count] = a, b
        self._turn[:], self._at[:] = turn, at
        return count

    def distances(
        self, points: np.ndarray, a: np.ndarray, b: np.ndarray, turn: np.ndarray, at: np.ndarray
    ) -> np.ndarray:
        """As those of DepthLookup."""
        count = self._put(a, b, turn, at)
        self._points[:count] = points
        _run(self._distance, count)
        return self._out[:count].copy()

    def inside(self, sample: np.ndarray, a: np.ndarray, b: np.ndarray, turn: np.ndarray, at: np.ndarray) -> Inside:
        """As that of DepthLookup."""
        count = self._put(a, b, turn, at)
        self._sample[:count] = sample
        _run(self._inside, count)
        k = np.flatnonzero(self._out[:count] > 0)
        return Inside(k, self._x[k], self._normal[k], self._out[k], self._facing_out[k])


def _array(values: np.ndarray, dtype) -> wp.array:
    """A view of contiguous values, as one of `dtype` for each row."""
    return wp.array(ptr=values.ctypes.data, dtype=dtype, shape=(len(values),), device="cpu")


def _run(recorded: wp.Launch, count: int) -> None:
    if count:
        recorded.set_dim(count)
        recorded.launch()


@wp.func
def _place(first: wp.int64, shape: wp.vec3l, low: wp.vec3d, h: wp.float64, x: wp.vec3d):
    """Row of the first node of the cell around a point, and the place of the point in it."""
    u = (x - low) / h
    zero, two = wp.int64(0), wp.int64(2)
    i = wp.clamp(wp.int64(u[0]), zero, shape[0] - two)
    j = wp.clamp(wp.int64(u[1]), zero, shape[1] - two)
    k = wp.clamp(wp.int64(u[2]), zero, shape[2] - two)
    f = u - wp.vec3d(wp.float64(i), wp.float64(j), wp.float64(k))
    return wp.int32(first + (i * shape[1] + j) * shape[2] + k), f


@wp.func
def _interpolated(value: wp.array[wp.float64], node: int, shape: wp.vec3l, f: wp.vec3d):
    """Value at a place in a cell."""
    y = node + wp.int32(shape[2])
    x = wp.int32(shape[1] * shape[2])
    v00, v01 = wp.lerp(value[node], value[node + x], f[0]), wp.lerp(value[node + 1], value[node + x + 1], f[0])
    v10, v11 = wp.lerp(value[y], value[y + x], f[0]), wp.lerp(value[y + 1], value[y + x + 1], f[0])
    return wp.lerp(wp.lerp(v00, v10, f[1]), wp.lerp(v01, v11, f[1]), f[2])


@wp.func
def _gradient(value: wp.array[wp.float64], node: int, shape: wp.vec3l, f: wp.vec3d):
    """Gradient of `_interpolated` [per edge of a cell]."""
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
    depth: wp.array[wp.float64], smooth: wp.array[wp.float64], first: wp.array[wp.int64], shape: wp.array[wp.vec3l],
    low: wp.array[wp.vec3d], h: wp.array[wp.float64], points: wp.array[wp.vec3d], a: wp.array[wp.int64],
    b: wp.array[wp.int64], turn: wp.array[wp.mat33d], at: wp.array[wp.vec3d], out: wp.array[wp.float64],
):  # fmt: skip
    i = wp.tid()
    own, other = wp.int32(a[i]), wp.int32(b[i])
    x = wp.transpose(turn[other]) * (turn[own] * points[i] + at[own] - at[other])
    n = shape[other]
    one = wp.int64(1)
    high = low[other] + h[other] * wp.vec3d(wp.float64(n[0] - one), wp.float64(n[1] - one), wp.float64(n[2] - one))
    inside = wp.min(wp.max(x, low[other]), high)
    node, f = _place(first[other], n, low[other], h[other], inside)
    distance = -_interpolated(depth, node, n, f)
    beyond = wp.length_sq(x - inside)
    if beyond > wp.float64(0.0):
        outside = wp.max(distance, wp.float64(0.0))
        distance = wp.sqrt(beyond + outside * outside)
    out[i] = distance


@wp.kernel(enable_backward=False)
def _inside(
    depth: wp.array[wp.float64], smooth: wp.array[wp.float64], first: wp.array[wp.int64], shape: wp.array[wp.vec3l],
    low: wp.array[wp.vec3d], h: wp.array[wp.float64], points: wp.array[wp.vec3d], normals: wp.array[wp.vec3d],
    flatness: wp.array[wp.float64], faces: wp.array[wp.mat33d], nearest: wp.array[wp.int64],
    sample: wp.array[wp.int64], a: wp.array[wp.int64], b: wp.array[wp.int64], turn: wp.array[wp.mat33d],
    at: wp.array[wp.vec3d], out: wp.array[wp.float64], out_x: wp.array[wp.vec3d], out_normal: wp.array[wp.vec3d],
    out_facing: wp.array[wp.float64],
):  # fmt: skip
    i = wp.tid()
    own, other, s = wp.int32(a[i]), wp.int32(b[i]), wp.int32(sample[i])
    zero, half, one = wp.float64(0.0), wp.float64(0.5), wp.float64(1.0)
    x = turn[own] * points[s] + at[own]
    n = shape[other]
    node, f = _place(first[other], n, low[other], h[other], wp.transpose(turn[other]) * (x - at[other]))
    out[i] = zero
    if wp.min(f) < zero or wp.max(f) > one:
        return
    inside = _interpolated(depth, node, n, f)
    if inside <= zero:
        return
    out[i] = inside
    out_x[i] = x
    right, up = wp.where(f[0] > half, n[1], wp.int64(0)), wp.where(f[1] > half, wp.int64(1), wp.int64(0))
    corner = wp.int64(node) + (right + up) * n[2] + wp.where(f[2] > half, wp.int64(1), wp.int64(0))
    r = wp.int32(nearest[corner])
    most, opposite = wp.float64(-2.0), wp.vec3d()
    if r >= 0:
        to_other = wp.transpose(turn[other]) * turn[own]
        for k in range(FACES):
            mine = faces[s][k]
            if wp.length_sq(mine) > zero:
                mine = to_other * mine
                for m in range(FACES):
                    face = faces[r][m]
                    cosine = -wp.dot(mine, face)
                    if cosine > most and wp.length_sq(face) > zero:
                        most = cosine
                        opposite = face
    normal = turn[own] * normals[s]
    direction = -_gradient(smooth, node, n, f)
    outwards = turn[other] * (direction / wp.max(wp.length(direction), wp.float64(1.0e-12)))
    out_facing[i] = most
    if most < -one:
        out_facing[i] = -wp.dot(normal, outwards)
    if most > OPPOSED and (flatness[s] == zero or flatness[r] > flatness[s] + CURVED):
        out_normal[i] = turn[other] * opposite
    elif flatness[s] > zero:
        out_normal[i] = -normal
    else:
        out_normal[i] = outwards


def turned(R: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Points (k, 3), each turned by its matrix (k, 3, 3)."""
    return np.einsum("kij,kj->ki", R, x)


def interpolated(value: np.ndarray, f: np.ndarray) -> np.ndarray:
    """Values (k,) at places (k, 3) in cells, between those at their corners (k, 8)."""
    x, y, z = f.T
    v = np.ascontiguousarray(value.T)
    v = v[:4] + (v[4:] - v[:4]) * x
    v = v[:2] + (v[2:] - v[:2]) * y
    return v[0] + (v[1] - v[0]) * z


def slope(value: np.ndarray, f: np.ndarray) -> np.ndarray:
    """Gradients (k, 3) of `interpolated` [per edge of a cell]."""
    x, y, z = f.T
    v = np.ascontiguousarray(value.T)
    dx = v[4:] - v[:4]
    v = v[:4] + dx * x
    dx = dx[:2] + (dx[2:] - dx[:2]) * y
    dy = v[2:] - v[:2]
    v = v[:2] + dy * y
    return np.stack([dx[0] + (dx[1] - dx[0]) * z, dy[0] + (dy[1] - dy[0]) * z, v[1] - v[0]], 1)
