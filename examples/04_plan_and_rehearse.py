"""From a case to a motion of the arm, rehearsed where the truth differs from the belief.

python examples/04_plan_and_rehearse.py [CASE] [PLAN_FILE]
"""

import sys
import tempfile
from math import isnan
from pathlib import Path

import puncture_twin as pt
from puncture_twin.meshes import folder


def main() -> None:
    """Search with the arm, plan, write the plan, read it back (which checks it again), and rehearse it."""
    case = sys.argv[1] if len(sys.argv) > 1 else folder() / "abdomen"
    context = pt.prepare(case)
    try:
        plan = pt.plan(context)
    except pt.NoAnswerError as error:
        sys.exit(f"no plan: {error}")
    with tempfile.TemporaryDirectory() as scratch:
        file = Path(sys.argv[2]) if len(sys.argv) > 2 else Path(scratch) / "plan.json"
        pt.write_plan(plan, file)
        plan = pt.read_plan(file, context)
    print(f"approach {plan.approach.times_s[-1]:.1f} s, insertion {plan.insertion.times_s[-1]:.1f} s")
    done = pt.rehearse(context, plan)
    expected = plan.expected_target_error_mm
    known = (
        "nobody knows what to expect without markers" if isnan(expected) else f"{expected:.2f} mm (rms) was expected"
    )
    print(f"the tip ended {done.tip_error_mm:.2f} mm from the target; {known}")
    if done.truth_is_belief:
        print("the patient lay exactly where they were believed to lie: that is the joints' error alone")
    print(f"contacts: {', '.join(one.body for one in done.contacts) or 'none'}")


if __name__ == "__main__":
    main()
