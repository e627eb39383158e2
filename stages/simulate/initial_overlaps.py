"""Overlaps of rigid bodies at the start, which are kept.

Reconstructed objects overlap by the errors of their surfaces, which contacts would turn into speed. The overlap that
two parts have at the start is therefore no contact. The overlap allowed to them decreases with the overlap itself and
never grows again, so that nothing is pushed apart, and what was once separated does not sink in again. Parts that
overlap by more than half the thickness of the thinner one, where the direction of a contact says nothing, do not touch
until they are separated; nor do parts that a lift put into others.
"""

from __future__ import annotations

import numpy as np

MAX_OVERLAP = 0.5  # of parts that touch at the start, relative to the thickness of the thinner one
NO_CONTACT = 1e3  # allowed overlap of parts that do not touch [units]
MEMORY = 0.95  # of the largest overlap, in a substep: a contact that is missed once is not taken for a separation
SEPARATED = 1e-3  # [units]


class InitialOverlaps:
    """The overlap allowed to each pair of geometries that overlapped at the start [units of the simulation]."""

    def __init__(self, mujoco, model, data):
        """`data` has the contacts as seen in the photos, without lifts."""
        self._model = model
        thickness = 2 * model.geom_size.min(1)  # of meshes the half sizes along the principal axes
        thickness[model.geom_type != mujoco.mjtGeom.mjGEOM_MESH] = np.inf
        pairs, overlap = _overlaps(data)
        overlap[overlap > MAX_OVERLAP * thickness[pairs].min(1)] = NO_CONTACT
        self._set(pairs, overlap)

    def _set(self, pairs: np.ndarray, allowed: np.ndarray) -> None:
        self._pairs, self.allowed = pairs, allowed
        self._recent = allowed.clip(max=1.0)  # overlap, as a maximum that decays
        self._row = np.full((self._model.ngeom,) * 2, -1, np.int32)
        for a, b in ((0, 1), (1, 0)):
            self._row[pairs[:, a], pairs[:, b]] = np.arange(len(pairs))
        self._bodies = self._model.geom_bodyid[pairs]

    def add_lifted(self, data) -> None:
        """Add the overlaps of the start, with lifts: parts that a lift put deeper into others do not touch at first."""
        pairs, overlap = _overlaps(data)
        row = self._row[pairs[:, 0], pairs[:, 1]]
        known = row >= 0
        deeper = known & (overlap > self.allowed[row] + SEPARATED)
        self.allowed[row[deeper]] = NO_CONTACT
        new = np.full((~known).sum(), NO_CONTACT)
        self._set(np.concatenate([self._pairs, pairs[~known]]), np.concatenate([self.allowed, new]))

    def subtract(self, data, fixed: np.ndarray) -> None:
        """Subtract the allowed overlaps from those of the contacts; `fixed` masks bodies that do not move.

        Between mj_fwdPosition, which finds the contacts, and mj_fwdVelocity. Pairs of fixed bodies keep theirs.
        """
        if not len(self._pairs):
            return
        contact = data.contact
        row = self._row[contact.geom[:, 0], contact.geom[:, 1]]
        known = np.flatnonzero(row >= 0)
        overlap = np.zeros(len(self._pairs))
        np.maximum.at(overlap, row[known], -contact.dist[known])
        free = ~fixed[self._bodies].all(1)
        self._recent = np.maximum(overlap, MEMORY * self._recent, where=free, out=self._recent)
        changed = free & ((self.allowed < NO_CONTACT) | (self._recent < SEPARATED))
        self.allowed[changed] = np.minimum(self.allowed, self._recent)[changed]
        address = contact.efc_address[known]
        active = address >= 0
        data.efc_pos[address[active]] += self.allowed[row[known[active]]]


def _overlaps(data) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (k, 2) of geometries that overlap, and the deepest overlap of each."""
    deep = data.contact.dist < 0
    pairs, row = np.unique(np.sort(data.contact.geom[deep], 1), axis=0, return_inverse=True)
    overlap = np.zeros(len(pairs))
    np.maximum.at(overlap, row.ravel(), -data.contact.dist[deep])
    return pairs, overlap
