"""Choice of a candidate by a person: the best, one of a rank or window, of two angles, or of an entry into the skin.

`choose` returns the rows of one choice; `read_entries` and `read_targets` read many choices from a file, one a row.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from puncture_twin.planning.base.arguments import checked_degrees, is_kind, shown_value
from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.errors import NoAnswerError, refuse
from puncture_twin.planning.base.files import read_input, unfinished_warnings
from puncture_twin.planning.base.provenance import Input, content_input
from puncture_twin.planning.base.text import plural
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.entry import angles
from puncture_twin.planning.formats.csv_table import CsvLine, columns_fault, csv_lines, row_numbers
from puncture_twin.planning.formats.points import (
    MAX_FILE_BYTES,
    parse_points,
    parse_triple,
    typed_point,
)
from puncture_twin.planning.geometry.spaces import Space, to_lps
from puncture_twin.planning.search.candidates import Candidates, Pick
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.search.explain import Explanation, reason_text

NEAR_ENTRY_MM = 10.0
"""How far from the skin entry of its path a point may be that is to be that entry: a hand's precision on a screen."""
FILES = (".mrk.json", ".fcsv", ".csv")
"""Endings of files that may hold an entry."""
MOST_POINTS = 2
"""Points in a file with one entry, at most: both ends of a line."""
LEAST_LEVER_MM = 1.0
"""A point nearer to the target than this gives no direction."""


@dataclass(frozen=True)
class Choice:
    """A person's choice of a candidate; with nothing stated, the best one that the arm can approach."""

    angles: tuple[float, float] | None = None  # θ and β, rad
    rank: int | None = None  # 1 is the best candidate
    window: int | None = None  # 1 is the window of the best candidate: then the best of this window
    entry_mm: tuple[float, float, float] | None = None
    """Where the needle is to enter the skin, in the case's space, as it is typed."""
    entry_file: Path | None = None
    """A markups file that holds the entry instead; `with_file_read` reads it."""
    read: tuple[Input, ...] = ()  # that file, once it has been read

    @property
    def of_grid(self) -> bool:
        """Whether the choice is made among the results of a search."""
        return self.angles is None and self.entry_mm is None and self.entry_file is None

    def text(self, space: Space) -> str:
        """Text of the choice, such as "rank 3"; an entry in the case's space."""
        if self.angles is not None:
            return "its angles"
        if self.entry_file is not None and self.entry_mm is None:
            return f"entry of {self.entry_file.name}"
        if self.entry_mm is not None:
            return f"entry ({', '.join(f'{mm:g}' for mm in self.entry_mm)}) mm {space}"
        return f"window {self.window}" if self.window is not None else f"rank {self.rank or 1}"


BEST = Choice()
"""The choice with nothing stated."""


class Chosen(NamedTuple):
    """Candidates, and the rows of them that were chosen, in the order of preference."""

    candidates: Candidates
    rows: Ints


def choose(context: CaseContext, candidates: Candidates | None, choice: Choice) -> Chosen:
    """The candidates that a choice leaves, in the order of preference; of the grid None searches it.

    Raises:
        InputError: A rank or window that there is not, or a point that is no skin entry.
        NoAnswerError: Nothing is safe, or the chosen direction is rejected: says why.
    """
    if not choice.of_grid:
        return choose_stated(context, choice)
    candidates = context.own(candidates)
    rows = candidates.ranked
    if not len(rows):
        raise NoAnswerError("no candidate is safe", counts=candidates.counts(), code="no_safe_direction")
    windows = 0 if choice.window is None else len(candidates.windows)
    numbers = (choice.rank, len(rows), "--rank", "safe candidate"), (choice.window, windows, "--window", "window")
    for number, count, where, what in numbers:
        if number is not None and not 1 <= number <= count:
            there = "there is" if count == 1 else "there are"
            refuse(f"{number}: {there} {plural(count, what)}", where, f"1 to {count}", "out_of_range")
    if choice.rank is not None:
        rows = rows[choice.rank - 1 : choice.rank]
    elif choice.window is not None:
        rows = rows[candidates.windows.of_row[rows] == choice.window]
    return Chosen(candidates, rows)


def choose_stated(context: CaseContext, choice: Choice) -> Chosen:
    """The one candidate of a choice by angles or by entry, without a search; errors as of `choose`.

    Raises:
        InputError: A point that is no skin entry, or its file. Raises NoAnswerError: It is rejected: says why.
    """
    choice = with_file_read(context.case, choice)
    checked = context.check(*chosen_angles(context.case, choice))
    refuse_other_entry(context.case, checked, choice)
    if not checked.safe[0]:
        at = checked.at(0)
        where = f"theta {at['theta_deg']:.4g} deg, beta {at['beta_deg']:.4g} deg"
        what = f"{where} is rejected: {reason_text(checked, 0)}"
        raise NoAnswerError(what, counts=checked.counts(), code="direction_rejected")
    return Chosen(checked, np.zeros(1, np.int64))


def explain_choice(context: CaseContext, choice: Choice, candidates: Candidates | None = None) -> Explanation:
    """Explain a choice, safe or not, with the search of the case where it is of one; None searches."""
    if choice.of_grid:
        chosen, rows = choose(context, candidates, choice)
        return context.explain(chosen.theta[rows[0]], chosen.beta[rows[0]])
    choice = with_file_read(context.case, choice)
    explained = context.explain(*chosen_angles(context.case, choice))
    refuse_other_entry(context.case, explained.candidates, choice)
    return replace(explained, read=choice.read)


def chosen_angles(case: Case, choice: Choice) -> tuple[float, float]:
    """θ and β (rad) of a choice by angles or by entry. Raises InputError: An entry on the target itself."""
    if choice.angles is not None:
        return choice.angles
    lever = _entry_ct(case, choice) - case.target_ct
    reach = float(np.linalg.norm(lever))
    if not reach >= LEAST_LEVER_MM:
        refuse(f"{reach:.2g} mm from the target", "--entry", "a point on the skin", "entry_at_target")
    theta, beta = angles((lever / reach) @ case.T_ct_entry[:3, :3])
    return float(theta), float(beta)


def parse_choice(
    theta_deg: float | None, beta_deg: float | None, rank: int | None, window: int | None, entry: str | None
) -> Choice:
    """A choice from what a person typed.

    Raises:
        InputError: Two choices at once, one angle alone, or an entry that is not X,Y,Z.
    """
    if (theta_deg is None) != (beta_deg is None):
        refuse("one angle alone gives no direction", "--theta, --beta", "both", "one_angle")
    stated = {"--theta and --beta": theta_deg, "--rank": rank, "--window": window, "--entry": entry}
    names = [name for name, value in stated.items() if value is not None]
    if len(names) > 1:
        refuse(f"{', '.join(names)} at once", "choice", "one of them", "conflicting_options")
    angles = None if theta_deg is None or beta_deg is None else (np.radians(theta_deg), np.radians(beta_deg))
    if entry is not None and entry.lower().endswith(FILES):
        return Choice(entry_file=Path(entry))
    entry_mm = None if entry is None else parse_triple(entry, "--entry", "X,Y,Z in mm, in the case's space")
    return Choice(angles, rank, window, entry_mm)


def with_file_read(case: Case, choice: Choice) -> Choice:
    """The choice with the entry that its file holds: one point, or the end of a line whose other end is the target.

    Raises:
        InputError: A file that cannot be read, more points, or a line that does not end on the target.
    """
    path = choice.entry_file
    if path is None or choice.entry_mm is not None:
        return choice
    data = read_input(path, max_bytes=MAX_FILE_BYTES, where=str(path))
    points = parse_points(data, path, default_space=case.space).points
    if len(points) > MOST_POINTS:
        refuse(f"{len(points)} points", path, "one point, or a line from entry to target", "wrong_count")
    distances = np.linalg.norm(points - case.target_ct, axis=1)
    if len(points) == MOST_POINTS and distances.min() > NEAR_ENTRY_MM:
        allowed = f"a line with one end within {NEAR_ENTRY_MM:g} mm of the target"
        refuse(f"neither end is at the target: {distances.min():.1f} mm away", path, allowed, "line_misses_target")
    x, y, z = to_lps(points[[int(np.argmax(distances))]], case.space)[0].tolist()  # the change of signs undoes itself
    return replace(choice, entry_mm=(x, y, z), read=(content_input("entry", str(path), data),))


def _entry_ct(case: Case, choice: Choice) -> Floats:
    return np.asarray(to_lps(np.array([choice.entry_mm]), case.space)[0])


def refuse_other_entry(case: Case, checked: Candidates, choice: Choice) -> None:
    """Refuse a point from which a straight path enters the skin somewhere else."""
    real = checked.path.entry_ct[0]
    if choice.entry_mm is None or not np.isfinite(real).all():
        return
    apart = float(np.linalg.norm(real - _entry_ct(case, choice)))
    if apart > NEAR_ENTRY_MM:
        place = ", ".join(f"{mm:.1f}" for mm in to_lps(real[None], case.space)[0])
        what = f"the path from this point enters the skin {apart:.1f} mm away, at ({place}) mm {case.space}"
        refuse(what, "--entry", f"a point on the skin, to {NEAR_ENTRY_MM:g} mm", "entry_elsewhere")


ANGLES = ("theta_deg", "beta_deg")
ALLOWED_ANGLES = "a header with theta_deg, beta_deg and optionally name; then the same number of fields in every line"
ALLOWED_ENTRIES = f"points (a header name,x_mm,y_mm,z_mm), or {ALLOWED_ANGLES}"
GREATEST = (180.0, 360.0)
"""The largest θ and β, degrees."""


class Listed(NamedTuple):
    """One row of a list of directions or targets: its number from 1, its name or "", its point in the case's space.

    Its choice is the direction; of a list of targets, whatever was chosen for all.
    """

    number: int
    name: str
    point_mm: tuple[float, float, float] | None
    choice: Choice


class ReadList(NamedTuple):
    """The rows of a list, its file, and warnings about it."""

    rows: tuple[Listed, ...]
    input: Input
    warnings: tuple[str, ...]


def read_entries(path: Path, case: Case) -> ReadList:
    """Entries as points (CSV in the case's space, or Slicer's lists), or a CSV of angles.

    Raises:
        InputError: A file that cannot be read, or a line that is none; names the line.
    """
    data = read_input(path, max_bytes=MAX_FILE_BYTES, where=str(path))
    if path.suffix.lower() == ".csv":
        lines = csv_lines(data, str(path), ALLOWED_ENTRIES, named=True)
        header = next(lines, None)
        if header is not None and set(ANGLES) & {field.strip() for field in header.fields}:
            return _list("entries", path, data, _angle_rows([header, *lines], path))
    points = _points(data, path, case)
    return _list("entries", path, data, [one._replace(choice=Choice(entry_mm=one.point_mm)) for one in points])


def read_targets(path: Path, case: Case, choice: Choice) -> ReadList:
    """Targets as points, in the case's space or in the file's own; the same choice for each."""
    data = read_input(path, max_bytes=MAX_FILE_BYTES, where=str(path))
    return _list("targets", path, data, [one._replace(choice=choice) for one in _points(data, path, case)])


def _list(kind: str, path: Path, data: bytes, rows: Sequence[Listed]) -> ReadList:
    warnings = unfinished_warnings(data, path.name) if path.suffix.lower() in (".csv", ".fcsv") else ()
    return ReadList(tuple(rows), content_input(kind, str(path), data), warnings)


def _points(data: bytes, path: Path, case: Case) -> list[Listed]:
    listed = parse_points(data, path, default_space=case.space)
    typed = to_lps(listed.points, case.space).tolist()  # the change of signs undoes itself
    named = enumerate(zip(listed.names, typed, strict=True), start=1)
    return [Listed(number, name, (x, y, z), Choice()) for number, (name, (x, y, z)) in named]


def _angle_rows(lines: Sequence[CsvLine], path: Path) -> list[Listed]:
    header = [field.strip() for field in lines[0].fields]
    wanted = {*ANGLES} | ({*header} & {"name"})  # in any order
    if fault := columns_fault(header, sorted(wanted, key=lambda name: (*header, name).index(name))):
        refuse(f"the header {fault}", path, ALLOWED_ANGLES, "wrong_columns")
    if len(lines) < 2:
        refuse("no line", path, ALLOWED_ANGLES, "empty")
    rows = []
    for number, (line, fields) in enumerate(lines[1:], 1):
        where = f"{path}, line {line}"
        theta, beta = row_numbers(fields, header, ANGLES, where)
        for name, angle, most in zip(ANGLES, (theta, beta), GREATEST, strict=True):
            if not 0.0 <= angle <= most:
                refuse(f"{name} {angle:g}", where, f"0 to {most:g}", "out_of_range")
        name = fields[header.index("name")].strip() if "name" in header else ""
        rows.append(Listed(number, name, None, parse_choice(theta, beta, None, None, None)))
    return rows


def stated_choice(
    where: str,
    context: CaseContext,
    theta_deg: float | None,
    beta_deg: float | None,
    candidate: Pick | None,
    window: int | None,
    entry: ArrayLike | None,
) -> Choice:
    """The one choice that was stated.

    Raises:
        InputError: Two of them, half of one, a value outside of its range, or a candidate of another case.
    """
    for name, angle, most in zip(ANGLES, (theta_deg, beta_deg), GREATEST, strict=True):
        if angle is not None:
            checked_degrees([angle], most, f"{where}: {name}")
    if entry is not None:
        entry = str(entry) if isinstance(entry, str | Path) else typed_point(entry, f"{where}: entry")
    stated = parse_choice(theta_deg, beta_deg, None, window, entry)
    if candidate is None:
        return stated
    if stated != Choice():
        refuse("a candidate beside another choice", where, "one of them", "conflicting_options")
    candidates, row = candidate
    if not is_kind("Candidates", candidates):
        what = f"a candidate of a value {shown_value(candidates)}"
        refuse(what, where, "candidates.best or candidates.pick(row)", "wrong_type")
    candidates, row = context.own(candidates).pick(row)  # the angles of another case's are another path here
    return Choice(angles=(float(candidates.theta[row]), float(candidates.beta[row])))
