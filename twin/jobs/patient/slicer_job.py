"""A chosen path of a case for 3D Slicer; the arm is not needed, and without it there is no transform."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from puncture_twin.planning.base.output.output_set import writing
from puncture_twin.planning.base.provenance import Input, inputs_document
from puncture_twin.planning.export.slicer.entry_area import entry_area
from puncture_twin.planning.export.slicer.slicer_files import NAMES, SLICER, Drawn, slicer_files
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.search.selection.choice import Choice, choose, choose_stated, with_file_read

NO_APPROACH = "the directions were checked; no approach of the arm was planned"


@dataclass(frozen=True)
class SlicerExport:
    """What was written.

    Attributes:
        files: Where they lie.
        path: The direction that the line shows.
        notes: What whoever opens them should know, one sentence each.
        warnings: Of the case.
        inputs: Every file that decided them.
    """

    files: tuple[Path, ...]
    path: str
    notes: tuple[str, ...]
    warnings: tuple[str, ...]
    inputs: tuple[Input, ...]

    def summary(self) -> dict[str, Any]:
        """As plain values."""
        return {
            "format": SLICER,
            "path": self.path,
            "notes": list(self.notes),
            "warnings": list(self.warnings),
            "inputs": inputs_document(self.inputs),
            "files": [str(file) for file in self.files],
        }

    def text(self) -> str:
        """As lines."""
        lines = [*self.notes, *(f"warning: {one}" for one in self.warnings)]
        return "\n".join(
            [f"{SLICER}: {self.path}", *(f"  {file}" for file in self.files), *(f"  {one}" for one in lines)]
        )


def export_to_slicer(context: CaseContext, out: Path, choice: Choice) -> SlicerExport:
    """Search, and write the chosen path, the safe entry area, markers, transform and scene as one set.

    Raises:
        InputError: There is nothing of what was chosen, or the case has no patient space.
        NoAnswerError: Nothing is safe, or what was chosen is not.
    """
    case, stages = context.case, context.stages
    choice = with_file_read(case, choice)
    inputs = (*choice.read, *case.inputs)
    if not choice.of_grid:
        choose_stated(context, choice)  # before the search is made for nothing
    with writing(
        out, f"export {SLICER}", inputs=inputs, seconds=stages.seconds, names=NAMES, note=context.watcher.note
    ) as draft:
        found = context.search()
        chosen = choose(context, found, choice)
        row = int(chosen.rows[0])
        at = chosen.candidates.at(row)
        name = f"path theta {at['theta_deg']:.6g} beta {at['beta_deg']:.6g}"
        drawn = Drawn(name, chosen.candidates.path.entry_ct[row], entry_area(found), context.placement)
        made = slicer_files(case, drawn)
        for file, text in made.texts.items():
            (draft.folder / file).write_text(text, encoding="utf-8")
    files = draft.final(tuple(draft.folder / file for file in made.texts))
    return SlicerExport(
        files, name, (NO_APPROACH, f"arm: {found.arm_note}", *made.notes), tuple(context.anatomy.warnings), inputs
    )
