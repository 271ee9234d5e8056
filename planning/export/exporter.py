"""Export of a plan: written, read back, compared with the plan and the arm's limits, and only then published.

Other packages add formats by the entry point group `GROUP`; what they write is held to the same.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.base.files import atomic
from puncture_twin.planning.base.provenance import Input
from puncture_twin.planning.base.text import Shown
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.export import program as programs
from puncture_twin.planning.export.program import SampledMotion, check_sampled, heading
from puncture_twin.planning.export.ros2 import TIME_RESOLUTION_S, read_ros2, ros2_text
from puncture_twin.planning.export.urscript import read_urscript, urscript_text
from puncture_twin.planning.formats.csv_table import columns_fault, csv_lines, row_numbers
from puncture_twin.planning.motion.path_check import MAX_SWEEP_MM
from puncture_twin.planning.motion.trajectory import Trajectory
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.plan.plan_check import check_geometry

GRID_MM = MAX_SWEEP_MM / 2.0
"""Grid of states: none of the triangle is farther from a checked one than half of ``MAX_SWEEP_MM``."""
LARGEST_BLEND_MM = 5.0
"""The first radius tried: enough not to stop, small against the space that a plan leaves."""
SMALLEST_BLEND_MM = 1.0
"""Radii are halved down to this; then the arm stops at the waypoint."""
LARGEST_FRACTION = 0.45
"""Fraction of each segment, so that two blends never overlap: the controller skips a waypoint whose blend overlaps the
next."""
SAMPLES = 400
"""Samples along a segment, to find where the tip comes within the radius."""


def blend_radii_mm(checker: CellChecker, waypoints: Floats) -> Floats:
    """Blend radius of each waypoint (k, 6), rad, between the ends, shape (k - 2,), mm; 0 where no corner may be cut.

    ``checker`` has the plan's own scene; its tool has the needle whose tip is the TCP.
    """
    radii = np.zeros(max(len(waypoints) - 2, 0))
    for at, (before, corner, after) in enumerate(zip(waypoints, waypoints[1:], waypoints[2:], strict=False)):
        radius = LARGEST_BLEND_MM  # the largest one tried that is free
        while radius >= SMALLEST_BLEND_MM and radii[at] == 0.0:
            starts, ends = (_fraction_within(checker, corner, other, radius) for other in (before, after))
            if max(starts, ends) <= LARGEST_FRACTION:
                states = _triangle(checker, corner, starts * (before - corner), ends * (after - corner))
                if all(checker.contact(q, needle_may_touch_patient=False) is None for q in states):
                    radii[at] = radius
            radius /= 2.0
    return radii


def _fraction_within(checker: CellChecker, corner: Floats, other: Floats, radius_mm: float) -> float:
    """The last fraction of the path from a corner at which the tip is still within a radius of it, or the next sample.

    1 where the tip is so near the other end, so that half of the distance between two tips bounds both radii.
    """
    fractions = np.linspace(0.0, 1.0, SAMPLES + 1)
    poses = flange_pose(checker.model, corner + fractions[:, None] * (other - corner))
    tips = poses[:, :3, 3] + checker.tool.needle_length_mm * poses[:, :3, 2]
    far = np.linalg.norm(tips - tips[0], axis=1)  # mm from the tip at the corner
    if radius_mm > LARGEST_FRACTION * far[-1]:
        return 1.0
    return float(fractions[min(SAMPLES, int(np.flatnonzero(far <= radius_mm)[-1]) + 1)])


def _triangle(checker: CellChecker, corner: Floats, back: Floats, ahead: Floats) -> Floats:
    """States of a triangle, (m, 6), in rays from its corner: neighbours on a ray or across are within ``GRID_MM``."""
    rays, steps = 1, 1
    while True:
        fraction = np.linspace(0.0, 1.0, rays + 1)[:, None, None]
        along = np.linspace(0.0, 1.0, steps + 1)[None, :, None]
        grid = corner + along * ((1.0 - fraction) * back + fraction * ahead)
        outward = max(float(checker.sweep_mm(ray).max()) for ray in grid)
        across = max(float(checker.sweep_mm(arc).max()) for arc in grid.swapaxes(0, 1)[1:])
        if max(outward, across) <= GRID_MM:
            return grid[:, 1:].reshape(-1, 6)
        rays = math.ceil(rays * max(1.0, across / GRID_MM))  # refine until neighbours are near enough
        steps = math.ceil(steps * max(1.0, outward / GRID_MM))


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
    """Read such a CSV back; what is no motion is refused."""
    lines = list(csv_lines(text.encode(), str(where), ",".join(COLUMNS)))
    if fault := columns_fault(lines[0].fields if lines else (), COLUMNS):
        refuse(f"the header {fault}", where, ",".join(COLUMNS), "wrong_columns")
    phases: dict[str, list[list[float]]] = {phase: [] for phase in SampledMotion._fields}
    for line, fields in lines[1:]:
        place = f"{where}, line {line}"
        if fields[0] not in phases:
            refuse(f"phase {fields[0][:40]!r}", place, " or ".join(phases), "unknown_name")
        phases[fields[0]].append(row_numbers(fields, COLUMNS, COLUMNS[1:], place))
    tables = [np.array(table).reshape(-1, 7) for table in phases.values()]
    return SampledMotion(*(Trajectory(table[:, 0], table[:, 1:]) for table in tables))


@dataclass(frozen=True, eq=False, repr=False)
class Exported(Shown):
    """A published file of an export."""

    path: Path
    format_name: str
    notes: tuple[str, ...]
    inputs: tuple[Input, ...]
    plan: Plan


class _Draft(NamedTuple):
    text: str
    notes: tuple[str, ...] = ()


def export_plan(
    plan: Plan, format_name: str, folder: Path, *, source: Path, checker: CellChecker | None = None
) -> Exported:
    """The file of a plan for a robot, written and checked.

    Args:
        checker: Of the plan's own case, against which the plan has been checked (``plan_check``); without it nothing is
            known off the plan's path, so no corner is rounded, and the file says so.

    Raises:
        InputError: Another format, a plan that contradicts itself, or a number beyond the arm's limits;
            then nothing is written.
    """
    path = folder / export_name(source, format_name)
    check_geometry(plan, source)
    if len(plan.insertion.q) < 2:
        refuse("the insertion is a single state", source, "a motion", "no_motion")
    checked = format_of(format_name)[1](plan, source, checker)
    with atomic(path) as temporary:
        temporary.write_bytes(checked.text.encode("ascii"))
    return Exported(path, format_name, checked.notes, plan.inputs, plan)


def export_name(source: Path, format_name: str) -> str:
    """Name of an export: that of the plan's file, with the format's ending."""
    return f"{source.stem}{format_of(format_name)[0]}"


def _urscript(plan: Plan, source: Path, checker: CellChecker | None) -> _Draft:
    rows = programs.waypoint_rows(plan)
    waypoints = plan.approach.q[rows]
    blends = None if checker is None or len(rows) < 3 else blend_radii_mm(checker, waypoints)
    program = programs.program_of(plan, blends)
    text = urscript_text(program, plan, case_checked=checker is not None)
    programs.check_program(read_urscript(text, where=source), plan, blends, where=source)
    if len(program.stream_q):
        return _Draft(text, ("the approach is smooth and streamed (servoj): the controller follows it with a lag",))
    rounded = 0 if blends is None else int(np.count_nonzero(blends))
    why = "" if checker is not None else "; without the case, corners are not rounded (--case)"
    return _Draft(text, (f"{len(program.moves)} joint moves, {rounded} of them rounding a corner{why}",))


def _ros2(plan: Plan, source: Path, checker: CellChecker | None) -> _Draft:
    text, model = ros2_text(plan, case_checked=checker is not None), plan.model
    check_sampled(read_ros2(text, model, where=source), plan, time_resolution_s=TIME_RESOLUTION_S, where=source)
    return _Draft(text, ("two messages: send 'insertion' only when the operator says so",))


class Exporter(NamedTuple):
    """A format of plans: written, read back, and compared with the plan before it is published."""

    ending: str
    """Ending of the file's name, such as ``.csv``."""
    write: Callable[..., str]
    """``write(plan, case_checked=bool)``: an ASCII text."""
    read: Callable[..., SampledMotion]
    """``read(text, where=path)``: the motion that the text holds, as a robot would take it."""
    time_resolution_s: float = 0.0
    """Resolution to which times are written, s."""
    notes: tuple[str, ...] = ()

    def draft(self, plan: Plan, source: Path, checker: CellChecker | None) -> _Draft:
        """The text, read back and equal to the plan."""
        text = self.write(plan, case_checked=checker is not None)
        check_sampled(self.read(text, where=source), plan, time_resolution_s=self.time_resolution_s, where=source)
        return _Draft(text, self.notes)


Drafting = Callable[[Plan, Path, CellChecker | None], _Draft]
FORMATS: Mapping[str, tuple[str, Drafting]] = MappingProxyType(
    {
        "urscript": (".script", _urscript),
        "ros2": (".ros2.yaml", _ros2),
        "csv": (".csv", Exporter(".csv", csv_text, read_csv).draft),
    }
)
"""Format to the file name's end and who writes it."""
GROUP = "puncture_twin.exporters"
"""Group of entry points: a format's name to an `Exporter`. None takes the place of a name in `FORMATS`."""


def format_names() -> tuple[str, ...]:
    """Names of the formats of `FORMATS` and of those that installed packages add."""
    return (*FORMATS, *sorted(entry_points(group=GROUP).names - FORMATS.keys()))


def format_of(name: str) -> tuple[str, Drafting]:
    """The ending of a format's files, and who writes them. Raises InputError: no such format, or no `Exporter`."""
    if name in FORMATS:
        return FORMATS[name]
    if name not in format_names():
        raise InputError(f"format '{name}'", where="export", allowed=", ".join(format_names()), code="unknown_format")
    entry = entry_points(group=GROUP)[name]
    try:
        loaded: object = entry.load()
    except (ImportError, AttributeError) as error:
        loaded = error
    if isinstance(loaded, Exporter) and loaded.ending.startswith(".") and loaded.ending != ".json":
        return loaded.ending, loaded.draft
    where, allowed = f"{GROUP}: {entry.value}", "an Exporter with another file ending than a plan's"
    raise InputError(f"format '{name}': {loaded!r}", where=where, allowed=allowed, code="no_exporter")
