"""Contact manifolds of faces of convex bodies, which replace contacts that MuJoCo finds.

MuJoCo generates several contacts for a pair of faces only if the faces are almost parallel. With a slight angle, such
as that from different penetration depths, a body rests on a single contact, which jumps from side to side, and creeps.
For these pairs the incident face is clipped against the reference face, the one more nearly perpendicular to MuJoCo's
normal. Edge-edge contacts and contacts with planes remain those of MuJoCo.

Source: Gregorius 2015, "Robust contact creation for physics simulations" (Game Developers Conference).
"""

from __future__ import annotations

import numpy as np

from stages.simulate.surface_contacts import AddedContacts, add_contacts, extremes

PARALLEL = 6e-4  # 1 - cosine of the largest angle (2 degrees) between coplanar faces; the largest counts
ENOUGH = 3  # number of MuJoCo's contacts of a pair that already span an area
ACROSS = 0.1  # smallest cosine between the contact normal and the normal of a face that takes part
ON_SIDE = 1e-5  # distance beyond a side of a face up to which points count as inside [simulation units]
CUBE = np.array([[[1, -1, -1], [1, 1, -1], [1, 1, 1], [1, -1, 1]]], float)
CUBE = np.concatenate([sign * np.roll(CUBE, axis, 2)[:, ::sign] for axis in range(3) for sign in (1, -1)])


class FaceContacts:
    """Finds the contact manifolds of the boxes and convex meshes among the geometries of a MuJoCo model."""

    def __init__(self, mujoco, model):
        self._mujoco, self._model = mujoco, model
        kinds = mujoco.mjtGeom
        faces = [_mesh_faces(model, model.geom_dataid[g]) if kind == kinds.mjGEOM_MESH
                 else list(CUBE * model.geom_size[g]) if kind == kinds.mjGEOM_BOX else []
                 for g, kind in enumerate(model.geom_type)]  # fmt: skip
        self._first = np.cumsum([0, *map(len, faces)])
        polygons = [polygon for own in faces for polygon in own]
        self._size = np.array([len(p) for p in polygons], np.int64)
        most = self._size.max(initial=3)  # number of corners; faces with fewer repeat the last one
        self._corners = c = np.array([p[np.minimum(np.arange(most), len(p) - 1)] for p in polygons]).reshape(
            -1, most, 3
        )
        normals = np.cross(c[:, 1:-1] - c[:, :1], c[:, 2:] - c[:, :1]).sum(1) / 2
        areas = np.linalg.norm(normals, axis=1)
        geom = np.repeat(np.arange(model.ngeom), np.diff(self._first))
        row = np.arange(len(c)) - self._first[geom]
        self._normals = np.zeros((model.ngeom, row.max(initial=-1) + 1, 3))  # 0 in unused rows
        self._areas = np.zeros(self._normals.shape[:2])
        self._normals[geom, row], self._areas[geom, row] = normals / np.maximum(areas, 1e-30)[:, None], areas
        self._many = self._first[1:] > self._first[:-1]

    def replace(self, data) -> None:
        """Replace MuJoCo's contacts of pairs of faces that have too few to span an area."""
        model, geom = self._model, data.contact.geom
        if not len(geom):
            return
        rows = np.flatnonzero(self._many[geom].all(1) & (data.contact.exclude == 0))
        number = geom[rows, 0] * model.ngeom + geom[rows, 1]
        order = rows[np.lexsort((data.contact.dist[rows], number))]
        _, first, count = np.unique(np.sort(number), return_index=True, return_counts=True)
        deepest = order[first[count < ENOUGH]]  # deepest contact of each pair
        if not len(deepest):
            return
        pairs = geom[deepest].copy()
        pair, x, normal, depth = self._clipped(data, pairs, data.contact.frame[deepest, :3])
        k = np.flatnonzero(depth > -model.geom_margin[pairs[pair]].max(1))
        k = k[extremes(x[k].round(6), normal[k], depth[k], pair[k])]
        pair, x, normal, depth = pair[k], x[k], normal[k], depth[k]
        replaced = rows[np.isin(number, (pairs[:, 0] * model.ngeom + pairs[:, 1])[pair])]
        data.contact.exclude[replaced] = 1
        data.contact.efc_address[replaced] = -1  # MuJoCo leaves it undefined if all contacts are excluded
        add_contacts(self._mujoco, model, data, AddedContacts(x, normal, depth, pairs[pair]))

    def _clipped(
        self, data, pairs: np.ndarray, normal: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Contacts of pairs (k, 2) of geometries, whose normals (k, 3) point from the first to the second.

        Returns the row of the pair of each contact (n,), positions (n, 3), normals (n, 3) and penetration depths (n,),
        which are negative for gaps.
        """
        turn, at = data.geom_xmat[pairs].reshape(-1, 2, 3, 3), data.geom_xpos[pairs]
        out = np.stack([normal, -normal], 1)  # outward direction for each body
        cosine = (self._normals[pairs] @ np.einsum("kbij,kbi->kbj", turn, out)[..., None])[..., 0]
        area = np.where(cosine >= cosine.max(2, keepdims=True) - PARALLEL, self._areas[pairs], -1.0)
        face = area.argmax(2)
        cosine = np.take_along_axis(cosine, face[..., None], 2)[..., 0]
        size = np.where(cosine > 1 - PARALLEL, np.take_along_axis(area, face[..., None], 2)[..., 0], 0.0)
        kept = np.flatnonzero((size > 0).any(1) & (cosine > ACROSS).all(1))
        flat = size[kept].argmax(1)  # the body that has the reference face
        swap = np.stack([flat, 1 - flat], 1)
        pairs, turn, at, face = (np.take_along_axis(v[kept], swap.reshape(swap.shape + (1,) * (v.ndim - 2)), 1)
                                 for v in (pairs, turn, at, face))  # fmt: skip
        n, m = np.einsum("kbij,kbj->bki", turn, self._normals[pairs, face])
        number = self._first[pairs] + face
        corners = self._corners[number, : self._size[number].max(initial=1)]
        p, q = (corners @ turn.swapaxes(2, 3) + at[:, :, None]).swapaxes(0, 1)
        row, x, depth = clipped_faces(p, n, q, m)
        towards = np.where(flat == 0, 1.0, -1.0)[row, None] * n[row]
        return kept[row], x, towards, depth


def clipped_faces(
    p: np.ndarray, n: np.ndarray, q: np.ndarray, m: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Clip incident faces q (k, v, 3) against the prisms above and below reference faces p (k, v, 3).

    n and m (k, 3) are the outward normals of p and q; corners are ordered counter-clockwise about them. Returns, for
    the corners of the clipped faces, the row of the face (c,), the position halfway between both faces (c, 3), and the
    depth below p (c,).
    """
    following = np.roll(p, -1, 1)
    inward = np.cross(n[:, None], following - p)  # normals of the sides of p, in its plane
    inward /= np.maximum(np.linalg.norm(inward, axis=2, keepdims=True), 1e-12)
    offset = (inward * p).sum(2)
    beyond = offset[:, None] - q @ inward.swapaxes(1, 2)  # of corners of q outside sides of p (k, v of q, v of p)
    inside_p = (beyond < ON_SIDE).all(2)
    slope = (m * n).sum(1)
    height = ((q[:, :1] - p) * m[:, None]).sum(2) / slope[:, None]  # of the plane of q above the corners of p
    above = p + height[..., None] * n[:, None]
    side = np.cross(m[:, None], np.roll(q, -1, 1) - q)
    side /= np.maximum(np.linalg.norm(side, axis=2, keepdims=True), 1e-12)
    inside_q = ((side * q).sum(2)[:, None] - above @ side.swapaxes(1, 2) < ON_SIDE).all(2)
    # intersections of the sides of q with the planes through the sides of p, within these sides
    ends = np.roll(beyond, -1, 1)
    k, i, j = np.nonzero(beyond * ends < 0)
    share = beyond[k, i, j] / (beyond[k, i, j] - ends[k, i, j])
    crossing = q[k, i] + share[:, None] * (np.roll(q, -1, 1)[k, i] - q[k, i])
    along = following[k, j] - p[k, j]
    place = ((crossing - p[k, j]) * along).sum(1)
    between = (place > 0) & (place < (along**2).sum(1))
    parts = [(np.nonzero(inside_p)[0], q[inside_p]), (np.nonzero(inside_q)[0], above[inside_q]),
             (k[between], crossing[between])]  # fmt: skip
    row, x = (np.concatenate(each) for each in zip(*parts, strict=True))
    depth = ((p[row, 0] - x) * n[row]).sum(1)
    return row, x + depth[:, None] / 2 * n[row], depth


def _mesh_faces(model, mesh: int) -> list[np.ndarray]:
    """Corners (v, 3) of the faces of a mesh, in order around their normals."""
    begin = model.mesh_vertadr[mesh]
    corners = model.mesh_vert[begin : begin + model.mesh_vertnum[mesh]].astype(float)
    polygons = slice(model.mesh_polyadr[mesh], model.mesh_polyadr[mesh] + model.mesh_polynum[mesh])
    first, count = model.mesh_polyvertadr[polygons], model.mesh_polyvertnum[polygons]
    return [corners[model.mesh_polyvert[f : f + c]] for f, c in zip(first, count, strict=True)]
