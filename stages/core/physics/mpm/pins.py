"""Find the grid nodes at the faces of pinned parts of bodies, for the kernel of core/kernels/mpm/pins.py.

At each node that both pinned and free particles reach, their fractions of the scattered volume give a plane that
approximates the face. A node's distance from the face is the weighted mean of its distances from the nearby planes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree

from stages.core.kernels.interop import view
from stages.core.kernels.mpm import pins as kernels
from stages.core.kernels.mpm.transfers import FREE, KINEMATIC, PINNED
from stages.core.physics.mpm.particle_rows import ParticleRows

OUTSIDE = 1.5  # distance from the face above which nodes are masters [cells]: their B-splines vanish at the face
DIAGONAL = 3**0.5  # of a cell; a full grid has a node within this distance of any point [cells]
NEIGHBOURS, NEAR = 16, 4.0  # planes averaged for a distance, and their largest distance [cells]
DISTANCES = np.linspace(1.5, -1.5, 3001)  # at which `share_below` is tabulated [cells]
STENCIL = np.indices((3, 3, 3)).reshape(3, -1).T


class FaceNodes(NamedTuple):
    """Slave nodes at the face of a pinned part, each with its master node."""

    at_face: np.ndarray  # (p,) whether a particle is pinned and reaches both free particles and a node inside the face
    slaves: np.ndarray  # (s, 3) indices along x, y, z
    masters: np.ndarray  # (s, 3) indices along x, y, z; -1 for a slave without a master
    ratio: np.ndarray  # (s,) velocity of a slave over that of its master


class Pins:
    """Nodes at the faces between pinned parts at rest and the free rest of their body; each scene of `rows` is a body.

    Pinned particles at faces become PINNED, which excludes them from the scatter. In parts too thin to contain a node
    they stay KINEMATIC, and hold all nodes that they reach.
    """

    def __init__(self, rows: ParticleRows):
        held, v, scene, x, volume = (rows.get(name).cpu() for name in ("held", "v", "scene", "x", "volume"))
        held[held == PINNED] = KINEMATIC
        origin, shape = torch.tensor(list(rows.grid.origin), dtype=torch.float64), tuple(rows.grid.nodes)
        found = [np.zeros((3, 0))]
        for n in range(rows.scenes):
            own = ((scene == n) & ((held == FREE) | (held == KINEMATIC))).nonzero()[:, 0]
            pinned = held[own] == KINEMATIC
            if not bool(pinned.any()) or bool(pinned.all()) or bool(v[own[pinned]].any()):
                continue
            g = ((x[own] - origin) / rows.grid.dx).numpy()
            nodes = face_nodes(g, volume[own].double().numpy(), pinned.numpy())
            held[own[torch.from_numpy(nodes.at_face)]] = PINNED
            row = [n * rows.grid.count + np.ravel_multi_index(tuple(at.T), shape, "clip") for at in nodes[1:3]]
            found.append(np.stack([row[0], np.where(nodes.masters[:, 0] < 0, -1, row[1]), nodes.ratio]))
        rows.put("held", held)
        slaves, masters, ratio = np.concatenate(found, 1)
        order = np.lexsort((slaves, masters))
        masters = masters[order]
        # one thread per master, and one per slave without a master
        starts = ((np.diff(masters, prepend=-1) != 0) | (masters < 0)).nonzero()[0]
        self.count, self.nodes = len(starts), kernels.PinnedNodes()
        columns = masters[starts], np.append(starts, len(slaves)), slaves[order], ratio[order]
        kinds = np.int32, np.int32, np.int32, np.float32
        self._memory = [torch.from_numpy(c.astype(k)).to(rows.device) for c, k in zip(columns, kinds, strict=True)]
        for name, array in zip(("masters", "starts", "slaves", "ratio"), self._memory, strict=True):
            setattr(self.nodes, name, view(array))


def face_nodes(g: np.ndarray, volume: np.ndarray, pinned: np.ndarray) -> FaceNodes:
    """Find the nodes at the faces between the `pinned` (p,) and the other particles of a body.

    `g` (p, 3) are positions [cells], with node (i, j, k) at (i, j, k); `volume` (p,) is in any unit.
    """
    base = np.floor(g - 0.5).astype(np.int64)
    low, size = base.min(0) - 1, np.ptp(base, 0) + 5  # padded by one layer for the gradients
    f = g - base
    weight = np.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2])
    nodes = [np.ravel_multi_index(tuple((base - low + step).T), size) for step in STENCIL]
    free, held = np.zeros(size), np.zeros(size)  # scattered volumes of free and pinned particles
    for at, (i, j, k) in zip(nodes, STENCIL, strict=True):
        w = volume * weight[i, :, 0] * weight[j, :, 1] * weight[k, :, 2]
        for to, mine in ((free, ~pinned), (held, pinned)):
            to += np.bincount(at[mine], w[mine], free.size).reshape(size)
    beside, within, reached = np.zeros(len(g), bool), np.zeros(len(g), bool), np.zeros(free.size, bool)
    for at in nodes:
        beside |= free.ravel()[at] > 0
        within |= (held >= free).ravel()[at]
    at_face = pinned & beside & within
    for at in nodes:
        reached[at[at_face]] = True
    if not at_face.any():
        return FaceNodes(at_face, *np.zeros((2, 0, 3), np.int64), np.zeros(0))
    moving = free.ravel() > 0
    x = np.stack(np.nonzero((reached | moving).reshape(size)), 1)
    d, normal = _distances(free, held, x)
    reached, moving = (a.reshape(size)[tuple(x.T)] for a in (reached, moving))
    master, slave = moving & (d >= OUTSIDE), reached & ((d < OUTSIDE) | ~moving)
    above = x[slave] + (OUTSIDE - d[slave, None]) * normal[slave]  # along the normal, at the distance of the masters
    away, row = cKDTree(x[master]).query(above, distance_upper_bound=DIAGONAL)
    led = moving[slave] & np.isfinite(away)
    masters, ratio = np.full((len(led), 3), -1), np.zeros(len(led))
    masters[led], ratio[led] = x[master][row[led]] + low, d[slave][led] / d[master][row[led]]
    return FaceNodes(at_face, x[slave] + low, masters, ratio)


def _distances(free: np.ndarray, held: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Signed distances (n,) [cells] of nodes x (n, 3) to the face of the pinned part, and its outward normals (n, 3).

    `free` and `held` (nx, ny, nz) are the volumes at nodes; some nodes must have both. Beyond NEAR from these nodes the
    distance is infinite.
    """
    both = np.stack(np.nonzero((free > 0) & (held > 0)), 1)
    at = tuple(both.T)
    total = free[at] + held[at]
    share = held[at] / total
    slopes = [np.stack(np.gradient(a), -1)[at] for a in (free, held)]
    normals = share[:, None] * slopes[0] - (1 - share[:, None]) * slopes[1]
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    heights = np.interp(share, share_below(DISTANCES), DISTANCES)
    away, row = cKDTree(both).query(x, NEIGHBOURS, distance_upper_bound=NEAR)
    known = row < len(both)
    row = np.minimum(row, len(both) - 1)
    # planes are most accurate at full nodes to which pinned and free particles both contribute
    best = total * share * (1 - share)
    weight = np.where(known, best[row] * np.exp(-np.square(np.minimum(away, NEAR)) / 2), 0)
    weight /= np.maximum(weight.sum(1, keepdims=True), 1e-300)
    height = heights[row] + ((x[:, None] - both[row]) * normals[row]).sum(-1)
    normal = (weight[..., None] * normals[row]).sum(1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    return np.where(known.any(1), (weight * height).sum(1), np.inf), normal


def share_below(d: np.ndarray) -> np.ndarray:
    """Fraction of a node's B-spline inside a half-space, for nodes at signed distances d from its face [cells]."""
    a = np.abs(d)
    tail = np.where(a < 0.5, 0.5 - 0.75 * a + a**3 / 3, np.maximum(1.5 - a, 0) ** 3 / 6)  # of the quadratic B-spline
    return np.where(d < 0, 1 - tail, tail)
