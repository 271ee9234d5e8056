"""In which order places are visited: the shortest tour from home through all of them and back."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

RESOLUTION = 1e-9
"""Of costs, in their unit: sums of whole multiples are exact."""


def shortest_tour(cost: ArrayLike) -> tuple[int, ...]:
    """The order of n places of least total cost, by dynamic programming over subsets; of equal ones the first in order.

    Where costs are symmetric, a tour and its reverse cost the same: sums of rounded floats would choose between them.

    Source: Held and Karp 1962, "A dynamic programming approach to sequencing problems". 2^n n^2 steps: n to a dozen.

    Args:
        cost: Shape (n + 1, n + 1), symmetric or not: from row to column; the last row and column are home.

    Returns:
        The places 0 to n - 1 in order.

    >>> shortest_tour([[0, 9, 1, 9], [9, 0, 9, 1], [9, 1, 0, 9], [1, 9, 9, 0]])
    (0, 2, 1)
    """
    of = np.rint(np.asarray(cost, dtype=np.float64) / RESOLUTION).astype(np.int64).tolist()
    n = len(of) - 1
    best: dict[tuple[int, int], tuple[int, tuple[int, ...]]] = {(1 << k, k): (of[n][k], (k,)) for k in range(n)}
    for size in range(2, n + 1):
        for places in combinations(range(n), size):
            whole = sum(1 << k for k in places)
            for last in places:
                before = (best[whole & ~(1 << last), k] for k in places if k != last)
                best[whole, last] = min((so_far + of[order[-1]][last], (*order, last)) for so_far, order in before)
    whole = (1 << n) - 1
    return min((best[whole, last][0] + of[last][n], best[whole, last][1]) for last in range(n))[1]
