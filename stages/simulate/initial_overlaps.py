"""Overlaps of rigid bodies at the start, which are kept.

Reconstructed objects overlap by the errors of their surfaces, which contacts would turn into speed. The overlap that
two parts have at the start is therefore no contact: a contact begins where the overlap exceeds it, until they have been
separated. Nothing is pushed apart, and what was once separated does not sink in again.
"""

from __future__ import annotations

import numpy as np

APART = 20  # substeps without overlap after which two parts count as separated: the solver may miss a deep contact


class InitialOverlaps:
    """The overlap allowed to each pair of geometries that overlapped at the start [units of the simulation]."""

    def __init__(self, model, data):
        """`data` has the contacts at the start."""
        deep = data.contact.dist < 0
        self._pairs, row = np.unique(np.sort(data.contact.geom[deep], 1), axis=0, return_inverse=True)
        self.allowed = np.zeros(len(self._pairs))
        np.maximum.at(self.allowed, row.ravel(), -data.contact.dist[deep])
        self._apart = np.zeros(len(self._pairs), int)  # substeps since the last overlap
        self._row = np.full((model.ngeom,) * 2, -1, np.int32)
        for a, b in ((0, 1), (1, 0)):
            self._row[self._pairs[:, a], self._pairs[:, b]] = np.arange(len(self._pairs))
        self._bodies = model.geom_bodyid[self._pairs]

    def subtract(self, data, fixed: np.ndarray) -> None:
        """Subtract the allowed overlaps from those of the contacts; `fixed` masks bodies that do not move.

        Between mj_fwdPosition, which finds the contacts, and mj_fwdVelocity. Pairs of fixed bodies keep theirs.
        """
        if not len(self._pairs):
            return
        contact = data.contact
        row = self._row[contact.geom[:, 0], contact.geom[:, 1]]
        known = np.flatnonzero(row >= 0)
        free = ~fixed[self._bodies].all(1)
        self._apart[free] += 1
        self._apart[row[known[contact.dist[known] < 0]]] = 0
        self.allowed[self._apart > APART] = 0.0
        address = contact.efc_address[known]
        active = address >= 0
        data.efc_pos[address[active]] += self.allowed[row[known[active]]]
