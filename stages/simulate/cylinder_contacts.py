"""Contacts between the curved sides of cylinders, which replace those of MuJoCo.

For two cylinders side by side MuJoCo finds only one contact, at one end or the other, and its normal and depth are far
off where the cylinders just touch. Here there are contacts where the axes cross, and at both ends of the length along
which the cylinders lie side by side. Contacts with the flat ends of cylinders are MuJoCo's.
"""

from __future__ import annotations

import numpy as np

from stages.simulate.surface_contacts import AddedContacts, add_contacts

LEANING = 0.1  # sine of the angle between an axis and the tangent plane above which edges touch instead of sides


class CylinderContacts:
    """Finds the contacts of the sides of a MuJoCo model's cylinders."""

    def __init__(self, mujoco, model):
        self._mujoco, self._model = mujoco, model
        geoms = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_CYLINDER)
        pairs = np.stack(np.triu_indices(len(geoms), 1), 1)
        moves = model.body_dofnum[model.geom_bodyid[geoms]] > 0
        self._pairs = geoms[pairs[moves[pairs].any(1)]]

    def replace(self, data) -> None:
        """Replace MuJoCo's contacts of the pairs whose sides touch."""
        if not len(self._pairs):
            return
        model, (a, b) = self._model, self._pairs.T
        kind, other = model.geom_contype, model.geom_conaffinity
        collide = (kind[a] & other[b]) | (kind[b] & other[a])
        distance, reach = np.linalg.norm(data.geom_xpos[a] - data.geom_xpos[b], axis=1), model.geom_rbound
        pairs = self._pairs[(collide != 0) & (distance < reach[a] + reach[b])]
        if not len(pairs):
            return
        size = model.geom_size[pairs]
        row, x, normal, depth, beside = side_contacts(
            data.geom_xpos[pairs], data.geom_xmat[pairs][:, :, 2::3], size[:, :, 0], size[:, :, 1]
        )
        count = model.ngeom
        numbers = pairs[beside].min(1) * count + pairs[beside].max(1)
        found = data.contact.geom
        replaced = np.isin(found.min(1) * count + found.max(1), numbers)
        data.contact.exclude[replaced] = 1
        data.contact.efc_address[replaced] = -1  # MuJoCo leaves it undefined if all contacts are excluded
        k = np.flatnonzero(depth > -model.geom_margin[pairs[row]].max(1))
        add_contacts(self._mujoco, model, data, AddedContacts(x[k], normal[k], depth[k], pairs[row[k]]))


def side_contacts(
    centre: np.ndarray, axis: np.ndarray, radius: np.ndarray, half: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Contacts between the sides of k pairs of cylinders.

    `centre` and `axis` (unit vectors) are (k, 2, 3), `radius` and `half` (half the length) are (k, 2). Returns the rows
    (n,) of the pairs, contact points (n, 3), normals (n, 3) from the first to the second cylinder, and depths (n,),
    negative for gaps; and a mask (k,) of the pairs that lie side by side, so that only their sides can touch.
    """
    (a, b), (u, v), between = centre.swapaxes(0, 1), axis.swapaxes(0, 1), centre[:, 1] - centre[:, 0]
    cosine, along_u, along_v = ((one * two).sum(1) for one, two in ((u, v), (between, u), (between, v)))
    # s from `low` to `high` on the first axis: the nearest point of the second axis, at s cosine - along_v, is on it
    slope = np.where(np.abs(cosine) < 1e-9, 1e-9, cosine)
    ends = (along_v + np.array([[-1.0], [1.0]]) * half[:, 1]) / slope
    low, high = np.maximum(ends.min(0), -half[:, 0]), np.minimum(ends.max(0), half[:, 0])
    across = 1 - cosine**2
    nearest = (along_u - cosine * along_v) / np.maximum(across, 1e-12)
    nearest = np.where(across > 1e-12, nearest, (low + high) / 2).clip(low, np.maximum(low, high))
    s = np.stack([low, nearest, high], 1)
    t = s * cosine[:, None] - along_v[:, None]
    way = (b - a)[:, None] + t[..., None] * v[:, None] - s[..., None] * u[:, None]  # from axis to axis, (k, 3, 3)
    distance = np.maximum(np.linalg.norm(way, axis=2), 1e-12)
    normal = way / distance[..., None]
    leaning = np.abs((normal * u[:, None]).sum(2))
    depth = radius[:, :1] * np.sqrt(1 - leaning.clip(0, 1) ** 2) + radius[:, 1:] - distance
    beside = (high - low > np.maximum(depth[:, 1], 0)) & (leaning[:, 1] < LEANING)
    both = np.minimum(depth[:, 0], depth[:, 2]) > 0
    inner = (nearest > low) & (nearest < high) & ~both
    row, k = np.nonzero(beside[:, None] & np.stack([np.ones_like(inner), inner, np.ones_like(inner)], 1))
    x = b[row] + t[row, k, None] * v[row] - (radius[row, 1] - depth[row, k] / 2)[:, None] * normal[row, k]
    return row, x, normal[row, k], depth[row, k], beside
