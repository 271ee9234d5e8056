"""A chosen path of a case for programs that show it: files for 3D Slicer, or DICOM objects for the scan's archive.

The arm is not needed; without it Slicer gets no transform.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from puncture_twin.planning.base.errors import refuse, require_extra
from puncture_twin.planning.base.output.manifest import read_output
from puncture_twin.planning.base.output.output_set import Draft, writing
from puncture_twin.planning.base.provenance import Input, InputFiles, inputs_document, read_inputs
from puncture_twin.planning.base.strict_json import array, fitting, number, parse_json
from puncture_twin.planning.base.text import Shown
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.named_files import CaseVolumes
from puncture_twin.planning.export import archive, slicer
from puncture_twin.planning.export.archive import (
    DICOM,
    ArchiveContent,
    Quantity,
    Region,
    archive_files,
    rod_points,
    surface_points,
)
from puncture_twin.planning.export.slicer import SLICER, SceneContent, entry_area, slicer_files
from puncture_twin.planning.formats.dicom.ct_series import CtSeries
from puncture_twin.planning.formats.guard import guard_transform
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.plan.plan_check import check_plan
from puncture_twin.planning.search.candidates import Candidates, Pick
from puncture_twin.planning.search.choice import Choice, choose, choose_stated, with_file_read
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.search.table import to_table
from puncture_twin.twin.jobs.patient.main_job import is_plan, read_noted_plan
from puncture_twin.twin.jobs.patient.run import writing_of
from puncture_twin.twin.report.present import Block, Section, Warn, text

PATH_FORMATS = (SLICER, DICOM)
NO_APPROACH = "directions checked; no approach planned"
PLANNED = "the direction is the plan's, checked again with its motion"
NO_DEVICE = "Research software, not a medical device."
OF_ONE_SEARCH = frozenset({"rank", "window", "cost", "pareto"})
"""Columns that compare a direction with the others of its search: they say nothing of it alone."""
UNITS = {"_mm": "mm", "_deg": "deg"}  # endings of columns to units
CONFIRMATION = "a confirm.json of this version"
MAX_CONFIRMATION_BYTES = 5_000_000
CONFIRMED = ("lateral_mm", "depth_mm", "angle_deg", "inserted_mm", "sagitta_mm")
STATED = ("verdict", "structure", "in_predicted_region")
AIMED = ("by_mm", "turn_deg", "p_hit", "lateral_mm")
"""Numbers and words of a confirmation, and numbers of what it says is to be done next."""


@dataclass(frozen=True, repr=False)
class Written(Shown):
    """The files of one export."""

    format_name: str
    files: tuple[Path, ...]
    facts: Mapping[str, Any]
    """What they hold, as plain values."""
    said: Sequence[Section]
    """For a person: the same, and what whoever opens them should know."""
    inputs: tuple[Input, ...]

    @property
    def path(self) -> Path:
        """The first of them."""
        return self.files[0]

    def summary(self) -> dict[str, Any]:
        """As plain values."""
        inputs, files = inputs_document(self.inputs), [str(file) for file in self.files]
        return {"format": self.format_name, **self.facts, "inputs": inputs, "files": files}

    def text(self) -> str:
        """As lines."""
        return text(self.said)


def _of_path(name: str, files: tuple[Path, ...], path: str, notes: Sequence[str], warnings: Sequence[str],
             inputs: tuple[Input, ...]) -> Written:  # fmt: skip
    facts = {"path": path, "notes": list(notes), "warnings": list(warnings)}
    lines: list[Block] = [Warn(tuple(map(str, files))), *notes, *(f"warning: {one}" for one in warnings)]
    return Written(name, files, facts, [Section(f"{name}: {path}", lines)], inputs)


def put(draft: Draft, made: Mapping[str, str | bytes]) -> tuple[Path, ...]:
    """Write files into a draft; returns where they will lie."""
    for name, content in made.items():
        (draft.folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
    return draft.final(draft.folder / name for name in made)


def export_path(
    context: CaseContext, format_name: str, out: Path, choice: Choice, source: Path | None = None
) -> Written:
    """Search, and write the chosen path and the safe entry area as one set.

    Args:
        source: A plan of the case, whose direction is chosen after it was checked again; anything else is passed over.

    Raises:
        InputError: There is nothing of what was chosen, a plan that does not hold, the case has no patient space, or
            for DICOM no DICOM series as its CT.
        NoAnswerError: Nothing is safe, or what was chosen is not.
    """
    case, note = context.case, context.watcher.note
    scan = _series(case) if format_name == DICOM else None
    choice, plan = with_file_read(case, choice), None
    read: tuple[Input, ...] = ()
    if source is not None and is_plan(source):
        planned, plan = read_noted_plan(source, note)
        check_plan(plan, context, source)
        choice, read = Choice(angles=(plan.theta, plan.beta)), (planned,)
    inputs = (*read, *choice.read, *case.inputs)
    if not choice.of_grid:
        choose_stated(context, choice)  # before the search is made for nothing
    names = archive.NAMES if scan is not None else slicer.NAMES
    with writing_of(context, out, f"export {format_name}", names, (*read, *choice.read)) as draft:
        found = context.search()
        chosen = choose(context, found, choice)
        pick = Pick(chosen.candidates, int(chosen.rows[0]))
        name = f"path theta {pick.theta_deg:.6g} beta {pick.beta_deg:.6g}"
        made: Mapping[str, str | bytes]
        if scan is None:
            drawn = SceneContent(name, pick.candidates.path.entry_ct[pick.row], entry_area(found), context.placement)
            files = slicer_files(case, drawn)
            made, notes = files.texts, files.notes
        else:
            made, notes = archive_files(scan, _archived(context, scan, found, pick)), (NO_DEVICE,)
        written = put(draft, made)
    said = (NO_APPROACH if plan is None else PLANNED, f"arm: {found.arm_note}", *notes)
    return _of_path(format_name, written, name, said, context.anatomy.warnings, inputs)


def export_confirmation(source: Path, scan: Path, out: Path, note: Callable[[str], None]) -> Written:
    """Write the needle of a ``confirm.json`` on the slices of the very control scan that was confirmed."""
    require_extra("dicom", f"--format {DICOM}")
    read = read_output(source, max_bytes=MAX_CONFIRMATION_BYTES)
    document = parse_json(read.data, where=source, allowed=CONFIRMATION)
    with fitting(source, CONFIRMATION):
        own = {one.sha256 for one in read_inputs(document["inputs"]) if one.role.startswith("control")}
        T_scan_ct = guard_transform(document["frames"]["T_scan_ct"], where=f"{source}: T_scan_ct")
        path = apply(T_scan_ct, array(document["path_ct_mm"], (len(document["path_ct_mm"]), 3)))
        radius_mm, aim = number(document["diameter_mm"]) / 2, document["next_aim"]
        numbers = {name: document[name] for name in CONFIRMED} | {f"next_{name}": aim[name] for name in AIMED}
        quantities = tuple(_quantity(name, number(value)) for name, value in numbers.items() if value is not None)
        words = {name: document[name] for name in STATED} | {"next": aim["kind"]}
    place = scan.resolve()
    files = InputFiles(place.parent)
    volumes = CaseVolumes(files, place.parent / "--scan")
    volumes.read("ct", place.name, key="--scan")
    series = volumes.series(place.name)
    if series is None:
        what = "no DICOM series: there is no study that the objects could belong to"
        refuse(what, scan, "the control scan as DICOM", "no_dicom_series")
    if {one.sha256 for one in files.inputs} != own:
        refuse("it is not the scan that was confirmed", scan, "the one that confirm --scan was given", "input_changed")
    said = (("use", NO_DEVICE), *((name, str(value)) for name, value in words.items() if value not in (None, "")))
    rod = Region("needle in the scan", "needle", rod_points(path, radius_mm, archive.finest_mm(series)))
    made = archive_files(series, ArchiveContent("Needle confirmed", (rod,), {"needle": path}, quantities, said))
    inputs = (read.input("confirmation"), *files.inputs)
    with writing(out, f"export {DICOM}", inputs=inputs, names=archive.NAMES, note=note) as draft:
        written = put(draft, made)
    return _of_path(DICOM, written, f"needle, {words['verdict']}", (NO_DEVICE,), (), inputs)


def _series(case: Case) -> CtSeries:
    require_extra("dicom", f"--format {DICOM}")
    name = case.skin_section.ct or case.ct.file
    series = case.volumes.series(name)
    if series is None:
        what = "no CT" if name is None else f"'{name}' is no DICOM series"
        allowed = (
            f'a case whose CT is the folder of a DICOM series ([ct] file = "FOLDER"); --format {SLICER} needs none'
        )
        refuse(f"{what}: there is no study that the objects could belong to", case.path, allowed, "no_dicom_series")
    return series


def _archived(context: CaseContext, scan: CtSeries, found: Candidates, pick: Pick) -> ArchiveContent:
    """Windows and needle as regions, the path as a line, and what the table knows of the direction."""
    case, area = context.case, entry_area(found)
    entry, target, step = pick.candidates.path.entry_ct[pick.row], case.target_ct, archive.finest_mm(scan)
    of_face = area.window[area.faces[:, 0]] if len(area.faces) else np.zeros(0, np.int64)
    windows = [
        Region(f"entry window {number}", "skin", surface_points(area.points_ct, area.faces[of_face == number], step))
        for number in np.unique(of_face).tolist()
    ]
    rod = rod_points(np.stack([target, entry]), case.needle.diameter_mm / 2, step)
    row = to_table(pick.candidates).slice(pick.row, 1).to_pylist()[0]
    known = {name: value for name, value in row.items() if value not in (None, "") and name not in OF_ONE_SEARCH}
    numbers = {name: float(value) for name, value in known.items() if type(value) in (int, float)}
    quantities = tuple(_quantity(name, value) for name, value in numbers.items())
    sentences = ((name, str(value)) for name, value in known.items() if name not in numbers)
    return ArchiveContent(
        "Planned needle path",
        (Region("planned needle", "needle", rod), *windows),
        {"path from skin to target": np.stack([entry, target]), "target": target[None]},
        quantities,
        (("use", NO_DEVICE), ("case", case.name), ("arm", found.arm_note), *sentences),
    )


def _quantity(name: str, value: float) -> Quantity:
    return Quantity(name, value, UNITS.get(f"_{name.rpartition('_')[2]}", ""))
