"""A format of your own: run-twin export PLAN --format degrees.

In the pyproject.toml of your package, whose module holds what stands here:

    [project.entry-points."puncture_twin.exporters"]
    degrees = "your_package.your_module:DEGREES"

What is written is read back and held against the plan and the arm's limits before it is published.
python examples/06_export_your_own_format.py [CASE]
"""

import sys

import numpy as np

import puncture_twin as pt
from puncture_twin.meshes import folder
from puncture_twin.planning.export.exporter import Exporter, SampledMotion
from puncture_twin.planning.motion.trajectory import Trajectory


def write(plan, case_checked):
    """A block a phase: seconds and six angles in degrees a line."""
    blocks = [np.column_stack([one.times_s, np.degrees(one.q)]) for one in (plan.approach, plan.insertion)]
    lines = ["\n".join(" ".join(map(repr, row)) for row in block.tolist()) for block in blocks]
    return f"# {'checked against its case' if case_checked else 'not checked'}\n" + "\n\n".join(lines) + "\n"


def read(text, where):
    """What a robot would take from it."""
    blocks = [np.loadtxt(block.splitlines(), ndmin=2) for block in text.split("\n\n")]
    return SampledMotion(*(Trajectory(block[:, 0], np.radians(block[:, 1:])) for block in blocks))


DEGREES = Exporter(".degrees.txt", write, read, notes=("the insertion is for the operator to start",))

if __name__ == "__main__":
    context = pt.prepare(sys.argv[1] if len(sys.argv) > 1 else folder() / "abdomen")
    plan = pt.plan(context)
    print(write(plan, case_checked=True))
