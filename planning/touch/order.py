"""In which order places are visited: the shortest tour from home through all of them and back."""

from __future__ import annotations

from itertools import combinations

from puncture_twin.planning.base.arrays import Floats


def shortest_tour(cost: Floats) -> tuple[int, ...]:
    """The order of n places of least total cost, by dynamic programming over subsets.

    Source: Held and Karp 1962, "A dynamic programming approach to sequencing problems". 2^n n^2 steps: n to a dozen.

    Args:
        cost: Shape (n + 1, n + 1), symmetric or not: from row to column; the last row and column are home.

    Returns:
        The places 0 to n - 1 in order.

    >>> shortest_tour(np.abs(np.subtract.outer([1.0, 5.0, 3.0, 0.0], [1.0, 5.0, 3.0, 0.0])))
    (0, 1, 2)
    """
    n = len(cost) - 1
    best = {(1 << k, k): (float(cost[n, k]), -1) for k in range(n)}
    for size in range(2, n + 1):
        for places in combinations(range(n), size):
            whole = sum(1 << k for k in places)
            for last in places:
                before = whole & ~(1 << last)
                best[whole, last] = min((best[before, k][0] + float(cost[k, last]), k) for k in places if k != last)
    whole = (1 << n) - 1
    last = min(range(n), key=lambda k: (best[whole, k][0] + float(cost[k, n]), k))
    order = []
    while last >= 0:
        order.append(last)
        whole, last = whole & ~(1 << last), best[whole, last][1]
    return tuple(order[::-1])
