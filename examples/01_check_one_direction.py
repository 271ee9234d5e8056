"""Is one entry direction safe, and if not, what is in its path?

    python examples/01_check_one_direction.py [CASE] [THETA_DEG] [BETA_DEG]

CASE is a case file of your own CT (docs/how-to/your-own-case.md), or its folder; without one, the embedded abdomen.
"""

import sys

import puncture_twin as pt
from puncture_twin.meshes import folder


def main() -> None:
    """Check one direction against the organs alone, and print every constraint with its number."""
    case = sys.argv[1] if len(sys.argv) > 1 else folder() / "abdomen"
    theta_deg, beta_deg = (float(word) for word in (sys.argv[2:4] or ("30", "100")))
    context = pt.prepare(case, arm=False)
    explained = pt.check(context, theta_deg, beta_deg)
    print("safe for the organs" if explained.safe else "rejected")
    print(explained.text())


if __name__ == "__main__":
    main()
