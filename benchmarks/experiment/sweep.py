"""The sweep: how far the virtual TCP leaves its point, by motors and by impedance, on the embedded carton."""

from dataclasses import replace

import numpy as np

from benchmarks.experiment.row import Row
from puncture_twin.meshes import folder
from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.case.tables import RehearsalSection
from puncture_twin.planning.search.context import prepare
from puncture_twin.planning.sweep.sweep_planner import plan_sweep
from puncture_twin.twin.rehearsal.rehearsal import execute_sweep

START, END, REJECTED = (tuple(np.radians(pair)) for pair in ((22.0, 208.0), (40.0, 224.0), (22.0, 260.0)))


def rows() -> list[Row]:
    """Every demand on a sweep."""
    context = prepare(folder() / "carton" / "case_m.toml")
    plan = plan_sweep(context, START, END, seed=1, progress=lambda done, total: None)
    planned = plan.off_point_mm(flange_pose(plan.model, plan.sweep.q)).max()
    found = [
        Row("swept", f"{plan.sweep.duration_s:.1f} s, {len(plan.angles)} directions", "", plan.stopped == ""),
        Row.at_most("planned motion off its point, mm", planned, 0.05),
    ]
    for control in ("position", "impedance"):
        case = replace(context.case, rehearsal=RehearsalSection(control=control))
        swept = execute_sweep(plan, case, context.anatomy, context.placement.T_base_ct)
        found.append(Row.at_most(f"virtual TCP off its point, {control}, largest, mm", swept.off_mm.max(), 0.05))
        found.append(Row.at_most(f"contacts, {control}", len(swept.contacts), 0))
    stopped = plan_sweep(context, START, REJECTED, seed=1, progress=lambda done, total: None).stopped
    found.append(Row("toward a rejected direction", stopped[:70], "stops, with the reason", bool(stopped)))
    return found
