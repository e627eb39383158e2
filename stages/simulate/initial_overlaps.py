"""Initial overlaps of rigid bodies, which are allowed so that they do not push bodies apart.

Reconstructed objects overlap because of errors of their surfaces, which contact forces would turn into speed. The
initial overlap of a pair is therefore subtracted from its penetration depths. The allowed overlap decreases with the
actual one, so that bodies that have left an overlap, because they were lifted or slid, do not sink in again.
"""

from __future__ import annotations

import numpy as np

WINDOW = 20  # substeps over which the deepest overlap is taken, since the solver may miss a deep contact


class AllowedOverlaps:
    """The allowed overlap of each pair: the initial one, reduced to the deepest one of each WINDOW of substeps."""

    def __init__(self, at_start: np.ndarray):
        self.depth = at_start.copy()
        self._deepest, self._substeps = np.zeros_like(at_start), 0

    def note(self, pairs: tuple[np.ndarray, ...], depth: np.ndarray, free: np.ndarray) -> None:
        """Record the overlaps `depth` of a substep at the indices `pairs`; pairs that are not `free` are unchanged."""
        np.maximum.at(self._deepest, pairs, depth)
        self._substeps += 1
        if self._substeps % WINDOW == 0:
            self.depth = np.where(free, np.minimum(self.depth, self._deepest), self.depth)
            self._deepest[:] = 0.0


class InitialOverlaps:
    """The allowed overlaps of the pairs of geometries that overlap at the start [simulation units]."""

    def __init__(self, model, data):
        """`data` has the initial contacts."""
        deep = (data.contact.dist < 0) & (data.contact.exclude == 0)
        self._pairs, row = np.unique(np.sort(data.contact.geom[deep], 1), axis=0, return_inverse=True)
        at_start = np.zeros(len(self._pairs))
        np.maximum.at(at_start, row.ravel(), -data.contact.dist[deep])
        self.allowed = AllowedOverlaps(at_start)
        self._row = np.full((model.ngeom,) * 2, -1, np.int32)
        for a, b in ((0, 1), (1, 0)):
            self._row[self._pairs[:, a], self._pairs[:, b]] = np.arange(len(self._pairs))
        self._bodies = model.geom_bodyid[self._pairs]

    def subtract(self, data, fixed: np.ndarray, count: int) -> None:
        """Subtract the allowed overlaps from the depths of the first `count` contacts.

        To be called between mj_fwdPosition, which finds the contacts, and mj_fwdVelocity. `fixed` masks bodies that do
        not move; the allowed overlaps of pairs of them do not change.
        """
        if not len(self._pairs):
            return
        contact = data.contact
        row = self._row[contact.geom[:count, 0], contact.geom[:count, 1]]
        known = np.flatnonzero((row >= 0) & (contact.exclude[:count] == 0))
        self.allowed.note((row[known],), -contact.dist[known], ~fixed[self._bodies].all(1))
        address = contact.efc_address[known]
        active = address >= 0
        data.efc_pos[address[active]] += self.allowed.depth[row[known[active]]]
