"""In which order places are visited: the shortest tour from home through all of them and back."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike


def shortest_tour(cost: ArrayLike) -> tuple[int, ...]:
    """The order of n places of least total cost, by dynamic programming over subsets.

    Source: Held and Karp 1962, "A dynamic programming approach to sequencing problems". 2^n n^2 steps: n to a dozen.

    Args:
        cost: Shape (n + 1, n + 1), symmetric or not: from row to column; the last row and column are home.

    Returns:
        The places 0 to n - 1 in order.

    >>> shortest_tour([[0, 9, 1, 9], [9, 0, 9, 1], [9, 1, 0, 9], [1, 9, 9, 0]])
    (0, 2, 1)
    """
    of = np.asarray(cost, dtype=np.float64)
    n = len(of) - 1
    best = {(1 << k, k): (float(of[n][k]), -1) for k in range(n)}
    for size in range(2, n + 1):
        for places in combinations(range(n), size):
            whole = sum(1 << k for k in places)
            for last in places:
                before = whole & ~(1 << last)
                best[whole, last] = min((best[before, k][0] + float(of[k][last]), k) for k in places if k != last)
    whole = (1 << n) - 1
    last = min(range(n), key=lambda k: (best[whole, k][0] + float(of[k][n]), k))
    order = []
    while last >= 0:
        order.append(last)
        whole, last = whole & ~(1 << last), best[whole, last][1]
    return tuple(order[::-1])
