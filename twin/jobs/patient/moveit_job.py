"""A plan for MoveIt and ROS 2: the scene, the goals, the arm with its needle and a sender, as one set."""

from __future__ import annotations

from pathlib import Path

from puncture_twin.planning.base.files import atomic
from puncture_twin.planning.base.output.manifest import read_output
from puncture_twin.planning.base.output.output_set import writing
from puncture_twin.planning.export.exporter import Exported
from puncture_twin.planning.export.moveit.moveit_files import MOVEIT, moveit_files, moveit_names
from puncture_twin.planning.plan.plan_check import with_case_arm
from puncture_twin.planning.plan.plan_document import MAX_PLAN_BYTES, parse_plan
from puncture_twin.planning.plan.recheck import check_plan, with_case_warnings
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.search.selection.choice import Choice
from puncture_twin.twin.jobs.patient.main_job import plan_case

NOTES = (
    "scene, goals, arm with needle and a sender: read the sender before it is run; it asks before each phase",
    "send 'insertion' only when the operator says so; no controller of ROS stops at tissue",
    "nothing here has been run against a controller or MoveIt: the messages were compared with their definitions",
    "the URDF names the meshes of this installation by absolute addresses",
)


def export_to_moveit(context: CaseContext, plan_path: Path | None, out: Path, choice: Choice) -> Exported:
    """Check a plan against its case again, or make it; write the four files.

    Args:
        context: The case.
        plan_path: The plan; None plans what is chosen, into the same folder.
        out: Where they go.
        choice: Of the candidate, where there is no plan yet.

    Raises:
        InputError: A plan that cannot be used, does not hold any more, or breaks a limit of the arm.
        NoAnswerError: No plan.
    """
    note = context.watcher.note
    if plan_path is None:
        plan_case(context, out, choice)
        plan_path = out / "plan.json"
    found = read_output(plan_path, max_bytes=MAX_PLAN_BYTES)
    if found.note:
        note(f"warning: {found.note}")
    source, plan = found.input("plan"), parse_plan(found.data, plan_path)
    check_plan(plan, context, plan_path, seed=context.case.rehearsal.seed)
    plan = with_case_warnings(with_case_arm(plan, context.case), context)
    names, inputs = moveit_names(plan_path.stem), (source, *plan.inputs)
    texts = moveit_files(plan, context.case, context.anatomy, source=plan_path)
    made_from = {source.path: source.sha256}
    with writing(out, f"export {names[0]}", inputs=inputs, names=names, made_from=made_from, note=note) as draft:
        for name, text in texts.items():
            with atomic(draft.folder / name) as temporary:
                temporary.write_text(text, encoding="ascii")
    path = draft.final(tuple(draft.folder / name for name in names))[0]
    return Exported(path, MOVEIT, NOTES, inputs, plan)
