"""Assignment of films to participants, and their order."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Sequence


def assign_films(cells: Sequence[str], participants: int, films: int, seed: int) -> list[list[int]]:
    """For each participant, the indices of the films to show, in order.

    `cells` holds the cell (model and split) of each film. A participant sees equally many films of each cell, or one
    more, as long as the cell has films. Over all participants, cells, and films within a cell, are shown equally often.
    Orders are random.
    """
    rng, shown, total = random.Random(seed), [0] * len(cells), Counter()
    orders = []
    for _ in range(participants):
        left, taken, order = set(range(len(cells))), Counter(), []
        while left and len(order) < films:
            i = min(left, key=lambda i: (taken[cells[i]], total[cells[i]], shown[i], rng.random()))  # noqa: B023
            left.remove(i)
            order.append(i)
            shown[i] += 1
            taken[cells[i]] += 1
            total[cells[i]] += 1
        rng.shuffle(order)
        orders.append(order)
    return orders
