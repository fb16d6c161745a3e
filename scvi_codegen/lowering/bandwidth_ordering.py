"""Bandwidth-reducing ordering of the coordinates.

Two coordinates are coupled if a mixed second derivative of the Lagrangian does not vanish. The Newton matrix has a
block for every coupled pair; in a good ordering the blocks are in a narrow band, outside of which nothing is stored or
computed. An open chain has bandwidth 1, a closed one 2, and if all coordinates are coupled the band is the whole
matrix.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

__all__ = ["bandwidth", "places"]

Pairs = Iterable[tuple[int, int]]


def bandwidth(pairs: Pairs, places: tuple[int, ...]) -> int:
    """Return the largest distance of two coupled coordinates in an ordering.

    >>> bandwidth([(0, 2), (1, 2)], (0, 1, 2))
    2
    """
    return max((abs(places[i] - places[j]) for i, j in pairs), default=0)


def places(pairs: Pairs, count: int) -> tuple[int, ...]:
    """Return the position of each coordinate: the original order, or reverse Cuthill-McKee if that is narrower.

    >>> places([(0, 2), (1, 2)], 3)
    (2, 0, 1)
    """
    coupled = {(max(pair), min(pair)) for pair in pairs if pair[0] != pair[1]}
    original = tuple(range(count))
    if bandwidth(coupled, original) <= 1 or 2 * len(coupled) == count * (count - 1):
        return original
    found = _cuthill_mckee(coupled, count)
    return found if bandwidth(coupled, found) < bandwidth(coupled, original) else original


def _cuthill_mckee(coupled: set[tuple[int, int]], count: int) -> tuple[int, ...]:
    # Imported here because SciPy is slow to import and most systems do not need it.
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    rows, columns = np.array(sorted(coupled | {(j, i) for i, j in coupled})).T
    graph = csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    order = reverse_cuthill_mckee(graph, symmetric_mode=True)
    return tuple(int(place) for place in np.argsort(order))
