"""Export: written, read back, compared with the plan and the arm's limits, and only then published.

Other packages add formats by the entry point group `GROUP`; what they write is held to the same.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.base.files import atomic
from puncture_twin.planning.base.provenance import Input
from puncture_twin.planning.base.text import Shown, plural
from puncture_twin.planning.export.program import (
    SampledMotion,
    check_program,
    check_sampled,
    heading,
    program_of,
)
from puncture_twin.planning.export.ros2 import TIME_RESOLUTION_S, read_ros2, ros2_text
from puncture_twin.planning.export.urscript import read_urscript, urscript_text
from puncture_twin.planning.motion.trajectory import Trajectory
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.plan.plan_check import check_geometry

COLUMNS = ("phase", "time_s", *(f"q{joint}_rad" for joint in range(1, 7)))

NOTES = (
    "joint angles of the controller, base to wrist 3; each phase starts at rest, at time 0",
    "the operator starts the insertion: nothing in this table waits",
)


def csv_text(plan: Plan, *, case_checked: bool) -> str:
    """The plan as CSV, with comment lines (#) above its header."""
    lines = [*heading(plan, NOTES, case_checked=case_checked), ",".join(COLUMNS)]
    for phase in SampledMotion._fields:
        trajectory = getattr(plan, phase)
        for time, row in zip(trajectory.times_s.tolist(), trajectory.q.tolist(), strict=True):
            lines.append(",".join([phase, repr(time), *map(repr, row)]))
    return "\n".join(lines) + "\n"


def read_csv(text: str, *, where: Path) -> SampledMotion:
    """Read such a CSV back."""
    rows = list(csv.reader(io.StringIO("\n".join(line for line in text.splitlines() if not line.startswith("#")))))
    if not rows or tuple(rows[0]) != COLUMNS:
        refuse("the table has another header", where, ",".join(COLUMNS), "wrong_columns")
    phases: dict[str, list[list[float]]] = {phase: [] for phase in SampledMotion._fields}
    for number, row in enumerate(rows[1:], start=2):
        try:
            phases[row[0]].append([float(cell) for cell in row[1:]])
        except (KeyError, IndexError, ValueError) as error:
            allowed = f"{' or '.join(phases)} and seven numbers"
            what = f"row {number} of the table: {error}"
            raise InputError(what, where=where, allowed=allowed, code="not_a_number") from error
        if len(row) != len(COLUMNS):
            refuse(f"row {number} has {len(row)} cells", where, f"{len(COLUMNS)} cells", "ragged_row")
    tables = [np.array(table).reshape(-1, 7) for table in phases.values()]
    return SampledMotion(*(Trajectory(table[:, 0], table[:, 1:]) for table in tables))


@dataclass(frozen=True, eq=False, repr=False)
class Exported(Shown):
    """A published file."""

    path: Path
    format_name: str
    notes: tuple[str, ...]
    inputs: tuple[Input, ...]
    plan: Plan


class _Draft(NamedTuple):
    """A text that was read back and equals the plan, with its notes."""

    text: str
    notes: tuple[str, ...] = ()


def export_plan(plan: Plan, format_name: str, folder: Path, *, source: Path, case_checked: bool = False) -> Exported:
    """Write a plan for a robot.

    Args:
        plan: A plan that has been read (and so checked), or made.
        folder: Where the file goes, under the plan file's name.
        source: The plan's file, for its name and for errors.
        case_checked: Whether the plan has been checked against its own case (``plan_check``), which the file says.

    Raises:
        InputError: Another format, a plan that contradicts itself, or a number beyond the arm's limits; then nothing
            is written.
    """
    path = folder / export_name(source, format_name)
    check_geometry(plan, source)
    if len(plan.insertion.q) < 2:
        refuse("the insertion is a single state", source, "a motion", "no_motion")
    checked = format_of(format_name)[1](plan, source, case_checked)
    with atomic(path) as temporary:
        temporary.write_bytes(checked.text.encode("ascii"))
    return Exported(path, format_name, checked.notes, plan.inputs, plan)


def export_name(source: Path, format_name: str) -> str:
    """Name of an export: that of the plan's file, with the format's ending."""
    return f"{source.stem}{format_of(format_name)[0]}"


def _urscript(plan: Plan, source: Path, case_checked: bool) -> _Draft:
    program = program_of(plan)
    text = urscript_text(program, plan, case_checked=case_checked)
    check_program(read_urscript(text, where=source), plan, where=source)
    if len(program.stream_q):
        return _Draft(text, ("the approach is smooth and streamed (servoj): the controller follows it with a lag",))
    return _Draft(text, (f"{plural(len(program.moves), 'joint move')}, with a stop after each",))


def _ros2(plan: Plan, source: Path, case_checked: bool) -> _Draft:
    text, model = ros2_text(plan, case_checked=case_checked), plan.model
    check_sampled(read_ros2(text, model, where=source), plan, time_resolution_s=TIME_RESOLUTION_S, where=source)
    return _Draft(text, ("two messages: send 'insertion' only when the operator says so",))


class Exporter(NamedTuple):
    """A format: how a plan is written, and how that is read back, to be held against the plan before it is published.

    Attributes:
        ending: Of the file's name, such as ``.csv``.
        write: ``write(plan, case_checked=bool)``: an ASCII text.
        read: ``read(text, where=path)``: the motion that the text holds, as a robot would take it.
        time_resolution_s: To which times are written.
    """

    ending: str
    write: Callable[..., str]
    read: Callable[..., SampledMotion]
    time_resolution_s: float = 0.0
    notes: tuple[str, ...] = ()

    def draft(self, plan: Plan, source: Path, case_checked: bool) -> _Draft:
        """The text, read back and equal to the plan."""
        text = self.write(plan, case_checked=case_checked)
        check_sampled(self.read(text, where=source), plan, time_resolution_s=self.time_resolution_s, where=source)
        return _Draft(text, self.notes)


Drafting = Callable[[Plan, Path, bool], _Draft]

FORMATS: Mapping[str, tuple[str, Drafting]] = MappingProxyType(
    {
        "urscript": (".script", _urscript),
        "ros2": (".ros2.yaml", _ros2),
        "csv": (".csv", Exporter(".csv", csv_text, read_csv).draft),
    }
)
"""Format to the file name's end and who writes it."""

GROUP = "puncture_twin.exporters"
"""Of entry points: a format's name to an `Exporter`. None takes the place of a name in `FORMATS`."""


def format_names() -> tuple[str, ...]:
    """Those of `FORMATS`, and those that installed packages add."""
    return (*FORMATS, *sorted(entry_points(group=GROUP).names - FORMATS.keys()))


def format_of(name: str) -> tuple[str, Drafting]:
    """The ending of a format's files, and who writes them."""
    if name in FORMATS:
        return FORMATS[name]
    if name not in format_names():
        raise InputError(f"format '{name}'", where="export", allowed=", ".join(format_names()), code="unknown_format")
    entry = entry_points(group=GROUP)[name]
    try:
        found: object = entry.load()
    except (ImportError, AttributeError) as error:
        found = error
    if isinstance(found, Exporter) and found.ending.startswith(".") and found.ending != ".json":
        return found.ending, found.draft
    where, allowed = f"{GROUP}: {entry.value}", "an Exporter with another file ending than a plan's"
    raise InputError(f"format '{name}': {found!r}", where=where, allowed=allowed, code="no_exporter")
