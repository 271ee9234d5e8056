"""Export: written, read back, compared with the plan and the arm's limits, and only then published."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.files import atomic
from puncture_twin.planning.base.provenance import Input
from puncture_twin.planning.collision.checker import StateChecker
from puncture_twin.planning.export.blends import blend_radii_mm
from puncture_twin.planning.export.csv_times import csv_text, read_csv
from puncture_twin.planning.export.motion import check_sampled
from puncture_twin.planning.export.program import program_of, waypoint_rows
from puncture_twin.planning.export.program_check import check_program
from puncture_twin.planning.export.ros2 import TIME_RESOLUTION_S, read_ros2, ros2_text
from puncture_twin.planning.export.urscript import read_urscript, urscript_text
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.plan.plan_check import check_geometry


@dataclass(frozen=True, eq=False)
class Exported:
    """A published file.

    Attributes:
        path: Where it lies.
        format_name: One of ``FORMATS``.
        notes: What whoever runs it should know, one sentence each.
        inputs: Every file that decided it.
        plan: What it holds.
    """

    path: Path
    format_name: str
    notes: tuple[str, ...]
    inputs: tuple[Input, ...]
    plan: Plan


class _Draft(NamedTuple):
    """A text that was read back and found to be the plan, with its notes."""

    text: str
    notes: tuple[str, ...] = ()


def export_plan(
    plan: Plan, format_name: str, folder: Path, *, source: Path, checker: StateChecker | None = None
) -> Exported:
    """Write a plan for a robot.

    Args:
        plan: A plan that has been read (and so checked), or made.
        format_name: ``urscript``, ``ros2`` or ``csv``.
        folder: Where the file goes, under the plan file's name.
        source: The plan's file, for its name and for errors.
        checker: Of the plan's own case, against which the plan has been checked (``plan_check``); without it nothing is
            known beside the plan's way, so no corner is rounded, and the file says so.

    Raises:
        InputError: Another format, a plan that contradicts itself, or a number beyond the arm's limits; then nothing
            is written.
    """
    path = folder / export_name(source, format_name)
    check_geometry(plan, source)
    if len(plan.insertion.q) < 2:
        raise InputError("the insertion is a single state", where=source, allowed="a motion")
    checked = FORMATS[format_name][1](plan, source, checker)
    with atomic(path) as temporary:
        temporary.write_bytes(checked.text.encode("ascii"))
    return Exported(path, format_name, checked.notes, plan.inputs, plan)


def export_name(source: Path, format_name: str) -> str:
    """The file's name: that of the plan's file, with the format's end.

    Raises:
        InputError: Another format.
    """
    if format_name not in FORMATS:
        raise InputError(f"format '{format_name}'", where="export", allowed=", ".join(FORMATS))
    return f"{source.stem}{FORMATS[format_name][0]}"


def _urscript(plan: Plan, source: Path, checker: StateChecker | None) -> _Draft:
    rows = waypoint_rows(plan)
    waypoints = plan.approach.q[rows]
    blends = None if checker is None or len(rows) < 3 else blend_radii_mm(checker, waypoints)
    program = program_of(plan, blends)
    text = urscript_text(program, plan, case_checked=checker is not None)
    check_program(read_urscript(text, where=source), plan, blends, where=source)
    if len(program.stream_q):
        return _Draft(text, ("the approach is smooth and streamed (servoj): the controller follows it with a lag",))
    rounded = 0 if blends is None else int(np.count_nonzero(blends))
    why = "" if checker is not None else "; corners are only rounded where the case shows them free: name it"
    return _Draft(text, (f"{len(program.moves)} joint moves, {rounded} of them rounding a corner{why}",))


def _ros2(plan: Plan, source: Path, checker: StateChecker | None) -> _Draft:
    text, model = ros2_text(plan, case_checked=checker is not None), plan.model
    check_sampled(read_ros2(text, model, where=source), plan, time_resolution_s=TIME_RESOLUTION_S, where=source)
    return _Draft(text, ("two messages: send 'insertion' only when the operator says so",))


def _csv(plan: Plan, source: Path, checker: StateChecker | None) -> _Draft:
    text = csv_text(plan, case_checked=checker is not None)
    check_sampled(read_csv(text, where=source), plan, time_resolution_s=0.0, where=source)
    return _Draft(text)


FORMATS: Mapping[str, tuple[str, Callable[[Plan, Path, StateChecker | None], _Draft]]] = MappingProxyType(
    {"urscript": (".script", _urscript), "ros2": (".ros2.yaml", _ros2), "csv": (".csv", _csv)}
)
"""Format to the file name's end and who writes it."""
