"""Points looked up in the depths of bodies below their surfaces, as contacts of rigid bodies need them in each substep.

A body's depths are given at the nodes of a grid in its frame and interpolated linearly. Arrays are NumPy's, in double
precision, as those of the rigid-body solver; bodies are at positions `at` (o, 3), turned by `turn` (o, 3, 3).
`CompiledDepthLookup` does in Warp kernels on the CPU what `DepthLookup` does in NumPy, where these can be compiled.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp
from scipy import ndimage

from stages.core.kernels.interop import compiles_for_cpu

_F, _I = wp.float64, wp.int64
CORNERS = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(-1, 3)  # of a cell


def depth_lookup(depth: Sequence[np.ndarray], low: np.ndarray, h: np.ndarray) -> DepthLookup:
    """The lookup in grids of depths (x, y, z), of which `low` (o, 3) are the first nodes and h (o,) the distances."""
    return (CompiledDepthLookup if compiles_for_cpu() else DepthLookup)(depth, low, h)


class DepthLookup:
    """Grids of all bodies, and points looked up in them by NumPy."""

    def __init__(self, depth: Sequence[np.ndarray], low: np.ndarray, h: np.ndarray):
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

    def inside(
        self, points: np.ndarray, a: np.ndarray, b: np.ndarray, turn: np.ndarray, at: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Points (k, 3) in the frames of bodies a (k,) that are inside bodies b (k,).

        Returns their rows (m,), positions (m, 3), directions (m, 3) out of b in its frame, depths (m,) in it, and rows
        (m,) of the nearest nodes.
        """
        return self.near(points, a, b, turn, at, 0.0)

    def near(
        self, points: np.ndarray, a: np.ndarray, b: np.ndarray, turn: np.ndarray, at: np.ndarray, gap: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """As `inside`, with the points that are less than `gap` outside."""
        local = self._relative(points, a, b, turn, at)
        node, f = self._cells(b, local)
        within = (np.abs(f - 0.5) <= 0.5).all(1)
        depth = np.where(within, interpolated(self.depth[node], f), -np.inf)
        k = np.flatnonzero(depth > -gap)
        out = -slope(self.smooth[node[k]], f[k])
        out /= np.linalg.norm(out, axis=1, keepdims=True).clip(1e-12)
        x = turned(turn[a[k]], points[k]) + at[a[k]]
        corner = (f[k] > 0.5) @ [4, 2, 1]
        return k, x, out, depth[k], node[k, corner]

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

    def __init__(self, depth: Sequence[np.ndarray], low: np.ndarray, h: np.ndarray):
        super().__init__(depth, low, h)
        grids = [self.depth, self.smooth, self.first, self.shape, self.low, self.h]
        self._grids = [_array(x, t) for x, t in zip(grids, (_F, _F, _I, wp.vec3l, wp.vec3d, _F), strict=True)]
        self._turn, self._at = np.empty((len(h), 3, 3)), np.empty((len(h), 3))
        self._reserve(1024)

    def _reserve(self, count: int) -> None:
        """Make room for `count` points."""
        self._room = count
        self._points, self._x, self._outwards = (np.empty((count, 3)) for _ in range(3))
        self._a, self._b, self._node = (np.empty(count, np.int64) for _ in range(3))
        self._out = np.empty(count)
        out = _array(self._out, _F)
        inputs = [*self._grids, _array(self._points, wp.vec3d), _array(self._a, _I), _array(self._b, _I),
                  _array(self._turn, wp.mat33d), _array(self._at, wp.vec3d), out]  # fmt: skip
        found = [_array(self._x, wp.vec3d), _array(self._outwards, wp.vec3d), _array(self._node, _I)]
        self._distance = wp.launch(_distance, count, inputs, device="cpu", record_cmd=True)
        self._inside = wp.launch(_inside, count, [*inputs, *found], device="cpu", record_cmd=True)

    def _put(self, points, a, b, turn, at) -> int:
        count = len(points)
        if count > self._room:
            self._reserve(2 * count)
        self._points[:count], self._a[:count], self._b[:count] = points, a, b
        self._turn[:], self._at[:] = turn, at
        return count

    def distances(
        self, points: np.ndarray, a: np.ndarray, b: np.ndarray, turn: np.ndarray, at: np.ndarray
    ) -> np.ndarray:
        """As those of DepthLookup."""
        count = self._put(points, a, b, turn, at)
        _run(self._distance, count)
        return self._out[:count].copy()

    def inside(
        self, points: np.ndarray, a: np.ndarray, b: np.ndarray, turn: np.ndarray, at: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """As that of DepthLookup."""
        count = self._put(points, a, b, turn, at)
        _run(self._inside, count)
        k = np.flatnonzero(self._out[:count] > 0)
        return k, self._x[k], self._outwards[k], self._out[k], self._node[k]


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
    low: wp.array[wp.vec3d], h: wp.array[wp.float64], points: wp.array[wp.vec3d], a: wp.array[wp.int64],
    b: wp.array[wp.int64], turn: wp.array[wp.mat33d], at: wp.array[wp.vec3d], out: wp.array[wp.float64],
    out_x: wp.array[wp.vec3d], outwards: wp.array[wp.vec3d], out_node: wp.array[wp.int64],
):  # fmt: skip
    i = wp.tid()
    own, other = wp.int32(a[i]), wp.int32(b[i])
    zero, half, one = wp.float64(0.0), wp.float64(0.5), wp.float64(1.0)
    x = turn[own] * points[i] + at[own]
    n = shape[other]
    node, f = _place(first[other], n, low[other], h[other], wp.transpose(turn[other]) * (x - at[other]))
    out[i] = zero
    if wp.min(f) < zero or wp.max(f) > one:
        return
    inside = _interpolated(depth, node, n, f)
    if inside <= zero:
        return
    direction = -_gradient(smooth, node, n, f)
    out_x[i] = x
    outwards[i] = direction / wp.max(wp.length(direction), wp.float64(1.0e-12))
    out[i] = inside
    right, up = wp.where(f[0] > half, n[1], wp.int64(0)), wp.where(f[1] > half, wp.int64(1), wp.int64(0))
    out_node[i] = wp.int64(node) + (right + up) * n[2] + wp.where(f[2] > half, wp.int64(1), wp.int64(0))


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
