"""Search every direction, and rank the safe ones by a cost of your own.

python examples/03_rank_by_your_own_cost.py [CASE]
"""

import sys

import numpy as np

import puncture_twin as pt
from puncture_twin.meshes import folder


def main() -> None:
    """Prefer the shortest path, with a penalty below 5 mm of clearance. What is safe does not change by it."""
    case = sys.argv[1] if len(sys.argv) > 1 else folder() / "abdomen"
    candidates = pt.search(pt.prepare(case, arm=False))
    cost = candidates.path.length + 20.0 * np.clip(5.0 - candidates.clearance.least, 0.0, None)
    mine = pt.rerank(candidates, cost)
    print(f"{candidates.safe.sum()} of {len(candidates)} directions are {candidates.safe_text}")
    print("rank  theta   beta   path mm  clearance mm  rank by the case's cost")
    for row in mine.ranked[:5]:
        angles = f"{np.degrees(mine.theta[row]):5.1f}  {np.degrees(mine.beta[row]):5.1f}"
        lengths = f"{mine.path.length[row]:8.1f}  {mine.clearance.least[row]:12.1f}"
        print(f"{mine.ranking.rank[row]:4d}  {angles}  {lengths}  {candidates.ranking.rank[row]:5d}")


if __name__ == "__main__":
    main()
