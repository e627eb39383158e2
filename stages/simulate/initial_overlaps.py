"""Overlaps of rigid bodies at the start, which are kept.

Reconstructed objects overlap by the errors of their surfaces, which contacts would turn into speed. The overlap that
two parts have at the start is therefore no contact: a contact begins where the overlap exceeds it. The overlap that is
allowed follows the actual one down. So nothing is pushed apart, and what has left an overlap, by being lifted or by
sliding, does not sink in again.
"""

from __future__ import annotations

import numpy as np

WINDOW = 20  # substeps of which the deepest overlap is taken: the solver may miss a deep contact


class AllowedOverlaps:
    """The overlap allowed to each of some pairs: that of the start, later the deepest of some substeps if less."""

    def __init__(self, at_start: np.ndarray):
        self.depth = at_start.copy()
        self._deepest, self._substeps = np.zeros_like(at_start), 0

    def note(self, pairs: tuple[np.ndarray, ...], depth: np.ndarray, free: np.ndarray) -> None:
        """Take the overlaps of a substep, at indices `pairs`; those pairs that are not `free` keep theirs."""
        np.maximum.at(self._deepest, pairs, depth)
        self._substeps += 1
        if self._substeps % WINDOW == 0:
            self.depth = np.where(free, np.minimum(self.depth, self._deepest), self.depth)
            self._deepest[:] = 0.0


class InitialOverlaps:
    """The overlap allowed to each pair of geometries that overlapped at the start [units of the simulation]."""

    def __init__(self, model, data):
        """`data` has the contacts at the start."""
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
        """Subtract the allowed overlaps from the first `count` contacts; `fixed` masks bodies that do not move.

        Between mj_fwdPosition, which finds the contacts, and mj_fwdVelocity. Pairs of fixed bodies keep theirs.
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
