"""Exports: a chosen path, with the arm or without, as files for 3D Slicer or DICOM objects for the scan's archive.

And a plan for a robot; and the table of candidates as CSV or JSON, read back and equal before it is shown.
"""

import csv
import io
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from puncture_twin.planning.base.errors import InputError, refuse, require_extra
from puncture_twin.planning.base.files import check_writable
from puncture_twin.planning.base.output.manifest import read_output
from puncture_twin.planning.base.output.output_set import Draft, writing
from puncture_twin.planning.base.progress import Silent, Watcher
from puncture_twin.planning.base.provenance import Input, InputFiles, inputs_document, read_inputs
from puncture_twin.planning.base.strict_json import array, fitting, number, parse_json
from puncture_twin.planning.base.text import Shown
from puncture_twin.planning.budget.guidance import check_ways
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.named_files import CaseVolumes
from puncture_twin.planning.export import archive, slicer
from puncture_twin.planning.export.exporter import export_name, export_plan, format_names
from puncture_twin.planning.export.moveit import MOVEIT, moveit_files, moveit_names
from puncture_twin.planning.export.slicer import SLICER, SceneContent, entry_area, slicer_files
from puncture_twin.planning.formats.dicom.ct_series import CtSeries
from puncture_twin.planning.formats.guard import guard_transform
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.plan.plan_check import check_plan, with_case_arm
from puncture_twin.planning.plan.plan_document import write_plan
from puncture_twin.planning.search.candidates import ANGLE_DIGITS, Candidates, Pick
from puncture_twin.planning.search.choice import BEST, Choice, choose, choose_stated, with_file_read
from puncture_twin.planning.search.context import CaseContext, prepare
from puncture_twin.planning.search.explain import Explanation
from puncture_twin.planning.search.table import to_table
from puncture_twin.twin.jobs.patient.main_job import case_of, is_plan, plan_case, read_noted_plan, search_case
from puncture_twin.twin.jobs.patient.run import case_draft
from puncture_twin.twin.report.present import Block, Section, Warn, text

Note = Callable[[str], None]  # shows one line
PATH_FORMATS = (SLICER, archive.DICOM)
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
TABLE = "candidates.parquet"
CANDIDATES_CSV = "candidates-csv"
CANDIDATE_FORMATS = (CANDIDATES_CSV, "candidates-json")
ALLOWED = "a case, or the candidates.parquet of a search, or its folder"
MAX_TABLE_BYTES = 4_000_000_000  # twice a million directions with 60 structures
ROUNDED = ("theta_deg", "beta_deg")  # tables of older versions have 59.99999999999999 for 60


@dataclass(frozen=True, repr=False)
class Written(Shown):
    """The files of one export."""

    format_name: str
    files: tuple[Path, ...]
    facts: Mapping[str, Any]
    """Content of the files, as plain values."""
    said: Sequence[Section]
    """Content for a person, and what whoever opens the files should know."""
    inputs: tuple[Input, ...]

    @property
    def path(self) -> Path:
        """The first of the files."""
        return self.files[0]

    def summary(self) -> dict[str, Any]:
        """The export as plain values."""
        inputs, files = inputs_document(self.inputs), [str(file) for file in self.files]
        return {"format": self.format_name, **self.facts, "inputs": inputs, "files": files}

    def text(self) -> str:
        """The export as lines of text."""
        return text(self.said)


def _written_path(name: str, files: tuple[Path, ...], path: str, notes: Sequence[str], warnings: Sequence[str],
             inputs: tuple[Input, ...]) -> Written:  # fmt: skip
    facts = {"path": path, "notes": list(notes), "warnings": list(warnings)}
    lines: list[Block] = [Warn(tuple(map(str, files))), *notes, *(f"warning: {one}" for one in warnings)]
    return Written(name, files, facts, [Section(f"{name}: {path}", lines)], inputs)


def _put(draft: Draft, contents: Mapping[str, str | bytes]) -> tuple[Path, ...]:
    """Write files into a draft; returns where they will lie."""
    for name, content in contents.items():
        (draft.folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
    return draft.final(draft.folder / name for name in contents)


def export_path(
    context: CaseContext, format_name: str, out: Path, choice: Choice, source: Path | None = None
) -> Written:
    """Search, and write the chosen path and the safe entry area as one set.

    Of a plan of the case as source the direction is chosen, after it was checked again; anything else is passed over.
    Raises InputError: There is nothing of what was chosen, a plan that does not hold, the case has no patient space, or
    for DICOM no DICOM series as its CT. NoAnswerError: Nothing is safe, or what was chosen is not.
    """
    case, note = context.case, context.watcher.note
    scan = _series(case) if format_name == archive.DICOM else None
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
    with case_draft(context, out, f"export {format_name}", names, (*read, *choice.read)) as draft:
        candidates = context.search()
        chosen = choose(context, candidates, choice)
        pick = Pick(chosen.candidates, int(chosen.rows[0]))
        name = f"path theta {pick.theta_deg:.6g} beta {pick.beta_deg:.6g}"
        contents: Mapping[str, str | bytes]
        if scan is None:
            entry_ct, area = pick.candidates.path.entry_ct[pick.row], entry_area(candidates)
            files = slicer_files(case, SceneContent(name, entry_ct, area, context.placement))
            contents, notes = files.texts, files.notes
        else:
            contents, notes = archive.archive_files(scan, _archived(context, scan, candidates, pick)), (NO_DEVICE,)
        written = _put(draft, contents)
    said = (NO_APPROACH if plan is None else PLANNED, f"arm: {candidates.arm_note}", *notes)
    return _written_path(format_name, written, name, said, context.anatomy.warnings, inputs)


def export_confirmation(source: Path, scan: Path, out: Path, note: Note) -> Written:
    """Write the needle of a ``confirm.json`` on the slices of the very control scan that was confirmed."""
    require_extra("dicom", f"--format {archive.DICOM}")
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
    rod = archive.Region("needle in the scan", "needle", archive.rod_points(path, radius_mm, archive.finest_mm(series)))
    contents = archive.archive_files(
        series, archive.ArchiveContent("Needle confirmed", (rod,), {"needle": path}, quantities, said)
    )
    inputs = (read.input("confirmation"), *files.inputs)
    with writing(out, f"export {archive.DICOM}", inputs=inputs, names=archive.NAMES, note=note) as draft:
        written = _put(draft, contents)
    return _written_path(archive.DICOM, written, f"needle, {words['verdict']}", (NO_DEVICE,), (), inputs)


def _series(case: Case) -> CtSeries:
    require_extra("dicom", f"--format {archive.DICOM}")
    name = case.skin_section.ct or case.ct.file
    series = case.volumes.series(name)
    if series is None:
        what = "no CT" if name is None else f"'{name}' is no DICOM series"
        allowed = (
            f'a case whose CT is the folder of a DICOM series ([ct] file = "FOLDER"); --format {SLICER} needs none'
        )
        refuse(f"{what}: there is no study that the objects could belong to", case.path, allowed, "no_dicom_series")
    return series


def _archived(context: CaseContext, scan: CtSeries, candidates: Candidates, pick: Pick) -> archive.ArchiveContent:
    case, area = context.case, entry_area(candidates)
    entry, target, step = pick.candidates.path.entry_ct[pick.row], case.target_ct, archive.finest_mm(scan)
    of_face = area.window[area.faces[:, 0]] if len(area.faces) else np.zeros(0, np.int64)
    of_window = {k: area.faces[of_face == k] for k in np.unique(of_face).tolist()}
    windows = [
        archive.Region(f"entry window {k}", "skin", archive.surface_points(area.points_ct, faces, step))
        for k, faces in of_window.items()
    ]
    rod = archive.rod_points(np.stack([target, entry]), case.needle.diameter_mm / 2, step)
    row = to_table(pick.candidates).slice(pick.row, 1).to_pylist()[0]
    known = {name: value for name, value in row.items() if value not in (None, "") and name not in OF_ONE_SEARCH}
    numbers = {name: float(value) for name, value in known.items() if type(value) in (int, float)}
    quantities = tuple(_quantity(name, value) for name, value in numbers.items())
    sentences = ((name, str(value)) for name, value in known.items() if name not in numbers)
    return archive.ArchiveContent(
        "Planned needle path",
        (archive.Region("planned needle", "needle", rod), *windows),
        {"path from skin to target": np.stack([entry, target]), "target": target[None]},
        quantities,
        (("use", NO_DEVICE), ("case", case.name), ("arm", candidates.arm_note), *sentences),
    )


def _quantity(name: str, value: float) -> archive.Quantity:
    return archive.Quantity(name, value, UNITS.get(f"_{name.rpartition('_')[2]}", ""))


def table_of(source: Path, choice: Choice) -> Path | None:
    """The table that a source is or holds; None of a case, whose folder has a ``case.toml``."""
    if choice != BEST or is_plan(source):
        refuse("a table holds all candidates", source, f"{ALLOWED}; no choice", "conflicting_options")
    if source.suffix.lower() == ".parquet":
        return source
    table = source / TABLE
    return table if table.is_file() and not (source / "case.toml").is_file() else None


def export_candidates(table_path: Path, format_name: str, out: Path, note: Note) -> Written:
    """Write a table of candidates as text, beside its own set or elsewhere."""
    output = read_output(table_path, max_bytes=MAX_TABLE_BYTES)
    if output.note:
        note(f"warning: {output.note}")
    try:
        table = pq.read_table(pa.BufferReader(output.data))
    except (pa.ArrowException, OSError) as error:
        what = f"no Parquet file ({str(error)[:100]})"
        raise InputError(what, where=table_path, allowed=ALLOWED, code="not_parquet") from error
    if b"run" not in (table.schema.metadata or {}) or not {*ROUNDED, "verdict"} <= set(table.column_names):
        refuse("no table of candidates", table_path, ALLOWED, "no_such_file")
    source, run = output.input("candidates"), json.loads(table.schema.metadata[b"run"])
    inputs, name = (source, *read_inputs(run["inputs"])), f"candidates.{format_name.removeprefix('candidates-')}"
    columns = {name: column.to_pylist() for name, column in zip(table.column_names, table.columns, strict=True)}
    columns |= {name: [round(value, ANGLE_DIGITS) for value in columns[name]] for name in ROUNDED}
    rows = [list(row) for row in zip(*columns.values(), strict=True)]
    if format_name == CANDIDATES_CSV:  # which has no place for the run; the manifest lists the inputs
        text = csv_text(table.column_names, rows)
        read = _read_csv(text, table)
    else:
        text = json.dumps({"run": run, "columns": table.column_names, "rows": rows}, allow_nan=False) + "\n"
        document = parse_json(text.encode(), where="candidates.json", allowed="what was written")
        read = document["rows"] if document["columns"] == table.column_names else []
    if read != rows:
        raise ArithmeticError(f"{name} does not read back as the table")
    made_from = {source.path: source.sha256}
    with writing(out, f"export {name}", inputs=inputs, names=(name,), made_from=made_from, note=note) as draft:
        files = _put(draft, {name: text})
    said = [Section(f"{format_name}: {len(rows)} rows in {files[0]}", [])]
    return Written(format_name, files, {"rows": len(rows)}, said, inputs)


def csv_text(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A table as CSV; what has no value is empty."""

    def field(value: Any) -> str:
        text = "" if value is None else str(value)
        return text.lower() if isinstance(value, bool) else text

    stream = io.StringIO(newline="")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([field(value) for value in row] for row in rows)
    return stream.getvalue()


def _read_csv(text: str, table: pa.Table) -> list[list[Any]]:
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    next(reader)
    kinds = [_value_of(kind) for kind in table.schema.types]
    return [[kind(field) for kind, field in zip(kinds, fields, strict=True)] for fields in reader]


def _value_of(kind: pa.DataType) -> Callable[[str], Any]:
    if pa.types.is_string(kind):
        return str
    if pa.types.is_boolean(kind):
        return {"true": True, "false": False}.get
    number: Callable[[str], Any] = int if pa.types.is_integer(kind) else float
    return lambda field: None if field == "" else number(field)


MOVEIT_NOTES: tuple[str, ...] = (
    "files: scene, goals, arm with needle, and a sender; read the sender before you run it; it asks before each phase",
    "send 'insertion' only when the operator says so; no ROS controller stops at tissue",
    "never run on a controller or in MoveIt; the messages were only compared with their definitions",
    "the URDF refers to this installation's meshes by absolute paths",
)


def export_robot(
    plan_path: Path, format_name: str, out: Path, context: CaseContext | None, note: Note, *, seed: int | None = None
) -> Written:
    """Write a plan for a robot; with its case, after it has been checked again, and with rounded corners where free.

    For MoveIt and ROS 2, which need the case: the scene, the goals, the arm with its needle and a sender, as one set.
    The plan must state the seed, by default the case's.
    """
    source, plan = read_noted_plan(plan_path, note)
    if context is not None:
        check_plan(plan, context, plan_path, seed=context.case.rehearsal.seed if seed is None else seed)
        check_ways(context, plan, plan_path)
    moves: Mapping[str, str] = {}
    if context is not None and format_name == MOVEIT:
        plan = with_case_arm(plan, context.case)
        moves = moveit_files(plan, context.case, context.anatomy, source=plan_path)
    names = moveit_names(plan_path.stem) if moves else (export_name(plan_path, format_name),)
    inputs, made_from = (source, *plan.inputs), {source.path: source.sha256}
    with writing(out, f"export {names[0]}", inputs=inputs, names=names, made_from=made_from, note=note) as draft:
        if moves:
            files, notes = _put(draft, moves), MOVEIT_NOTES
        else:
            checker = None if context is None or context.reach is None else context.reach.checker
            done = export_plan(plan, format_name, draft.folder, source=plan_path, checker=checker)
            files, notes = draft.final((done.path,)), done.notes
    theta, beta = float(np.degrees(plan.theta)), float(np.degrees(plan.beta))
    facts = {
        "theta_deg": theta,
        "beta_deg": beta,
        "notes": list(notes),
        "warnings": list(plan.warnings),
        "case_checked": context is not None,
    }
    lines = [f"direction: theta {theta:g} deg, beta {beta:g} deg", *notes]
    if context is None:
        lines.append("the plan was not checked against its case again; --case CASE does so")
    said = [Section(f"{format_name}: {files[0]}", lines), *(Section(f"warning: {one}", []) for one in plan.warnings)]
    return Written(format_name, files[:1], facts, said, inputs)


def export_value(
    source: Plan | Candidates | Explanation, format_name: str, folder: Path | str, context: CaseContext | None
) -> Written:
    """Write what is in memory: a plan for a robot, a table, or a checked direction for 3D Slicer or an archive."""
    refuse_format(format_name)
    kind = Candidates if format_name in CANDIDATE_FORMATS else Explanation if format_name in PATH_FORMATS else Plan
    if not isinstance(source, kind):
        what = f"'{format_name}' is not written from a value of type {type(source).__name__}"
        refuse(what, "export", f"one of type {kind.__name__}", "wrong_type")
    if context is None and format_name in (MOVEIT, *PATH_FORMATS):
        refuse(f"the scene of {format_name} is the case's", "export", "context=... beside it", "missing_option")
    if context is not None and not isinstance(source, Plan):
        context.own(source if isinstance(source, Candidates) else source.candidates)
    out, note = check_writable(folder), Silent().note
    if isinstance(source, Candidates):
        return export_candidates(source.write(out), format_name, out, note)
    if isinstance(source, Explanation):
        assert context is not None
        one = source.candidates
        return export_path(context, format_name, out, Choice(angles=(float(one.theta[0]), float(one.beta[0]))))
    with writing(out, "plan", inputs=source.inputs, names=("plan.json",)) as draft:
        write_plan(source, draft.folder / "plan.json")
    return export_robot(out / "plan.json", format_name, out, context, note, seed=source.seed)


def refuse_format(name: str) -> None:
    """Refuse a format that nothing writes."""
    known = (*format_names(), MOVEIT, *PATH_FORMATS, *CANDIDATE_FORMATS)
    if name not in known:
        refuse(f"format '{name}' is not known", "--format", ", ".join(known), "unknown_format")


def export_source(
    source: Path, case: Path | None, format_name: str, out: Path, choice: Choice, watcher: Watcher, scan: Path | None
) -> Written:
    """Write a case's plan, or a plan that is there, or what else of a case a format holds.

    The source is a case, a plan, for tables a table or its folder, or a confirmation, which has a control scan. Raises
    NoAnswerError: No plan.
    """
    if format_name in CANDIDATE_FORMATS:
        table = table_of(source, choice)
        if table is None:
            search_case(prepare(source, watcher=watcher), out, pictures=False)
            table = out / TABLE
        return export_candidates(table, format_name, out, watcher.note)
    if scan is not None:
        if format_name != archive.DICOM or choice != BEST or case is not None or not is_plan(source):
            allowed = f"--format {archive.DICOM} alone, with a confirm.json"
            refuse("a control scan belongs to a confirmation", "--scan", allowed, "conflicting_options")
        return export_confirmation(source, scan, out, watcher.note)
    planned_case = case_of(source, case, choice)
    if format_name in (MOVEIT, *PATH_FORMATS) and planned_case is None:
        refuse(f"{format_name} shows the case", source, "export plan.json --case CASE", "missing_option")
    context = None if planned_case is None else prepare(planned_case, watcher=watcher)
    if context is not None and format_name in PATH_FORMATS:
        return export_path(context, format_name, out, choice, source)
    if context is not None and not is_plan(source):
        plan_case(context, out, choice)
        source = out / "plan.json"
    return export_robot(source, format_name, out, context, watcher.note)
