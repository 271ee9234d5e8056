"""Search every direction with distances of your own, and rank the safe ones by a cost of your own.

python examples/03_rank_by_your_own_cost.py [CASE]
"""

import sys
from dataclasses import replace

import numpy as np

import puncture_twin as pt
from puncture_twin.meshes import folder
from puncture_twin.planning.clearance.fast_engine import FastEngine

SMOOTHED_MM = 0.5
"""So much the organs of this CT may have lost when their surfaces were smoothed."""


class SmoothedEngine(FastEngine):
    """Clearance to surfaces that may lie nearer than they are drawn: any class that implements `ClearanceEngine`."""

    def measure(self, target_ct, outward_ct, length, *, shown=True):
        """The exact distances, less what smoothing may have taken."""
        axes = super().measure(target_ct, outward_ct, length, shown=shown)
        return replace(axes, distance=np.maximum(axes.distance - SMOOTHED_MM, 0.0))


def main() -> None:
    """Prefer the shortest path, with a penalty below 5 mm of clearance. What is safe does not change by a cost."""
    case = sys.argv[1] if len(sys.argv) > 1 else folder() / "abdomen"
    exact = pt.search(pt.prepare(case, arm=False))
    candidates = pt.search(pt.prepare(case, arm=False, engine=SmoothedEngine))
    cost = candidates.path.length + 20.0 * np.clip(5.0 - candidates.clearance.least, 0.0, None)
    mine = pt.rerank(candidates, cost)
    print(f"{candidates.safe.sum()} of {len(candidates)} directions are {candidates.safe_text}")
    print(f"{exact.safe.sum()} with the surfaces as they are drawn")
    print("rank  theta   beta   path mm  clearance mm  rank by the case's cost")
    for row in mine.ranked[:5]:
        angles = f"{mine.theta_deg[row]:5.1f}  {mine.beta_deg[row]:5.1f}"
        lengths = f"{mine.path.length[row]:8.1f}  {mine.clearance.least[row]:12.1f}"
        print(f"{mine.ranking.rank[row]:4d}  {angles}  {lengths}  {candidates.ranking.rank[row]:5d}")


if __name__ == "__main__":
    main()
