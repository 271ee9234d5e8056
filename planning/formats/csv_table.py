"""CSV tables: lines, numbers, and tables whose columns come in groups, such as the twelve of a pose.

A table is read whole, or refused with file and line. What is no row is passed over: lines that start with #, empty
ones, and those of nothing but commas, as spreadsheets write them. In a table with groups the first column names the
row; groups follow it in a fixed order, each whole or absent. A pose is nine numbers of its rotation, by rows, and its
place in mm.
"""

import csv
import io
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats, read_only
from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.base.files import decode_text
from puncture_twin.planning.formats.guard import MAX_COORDINATE_MM, ROTATION_TOLERANCE
from puncture_twin.planning.geometry.rigid import pose

MOST_NAMED = 8
"""Columns that a refusal names at most of a kind."""


class CsvLine(NamedTuple):
    """A line of a CSV: its number in the file, from 1, and its fields."""

    line: int
    fields: list[str]


class _Uncommented(Iterator[str]):
    """The lines of a text without its comments: lines between two rows that start with #."""

    def __init__(self, text: str, where: str, mark: str | None) -> None:
        self._mark = mark  # of a comment
        self._lines = enumerate(io.StringIO(text, newline=""), start=1)
        self._where = where
        self.number = 0  # of the line given last
        self.within = False  # whether that line's row, which may have line breaks in quotes, has not ended
        self.width = 0  # fields of a row whose first may be any name; 0 where none may start with #

    def __next__(self) -> str:
        for number, line in self._lines:
            self.number = number
            if self.within or line.lstrip()[:1] != self._mark:
                self.within = True
                return line
            if 0 < self.width <= line.rstrip(", \t\r\n").count(",") + 1:
                allowed = "comments with fewer fields, or the name in quotes where it is a row"
                where = f"{self._where}, line {self.number}"
                refuse("starts with # like a comment, but has the fields of a row", where, allowed, "comment_or_row")
        raise StopIteration


def csv_lines(
    data: bytes, where: str, allowed: str, *, named: bool = False, blanks: bool = False, mark: str | None = "#"
) -> Iterator[CsvLine]:
    """The header and the rows of a CSV; comments (#), empty lines and lines of nothing but commas are passed over.

    Args:
        named: The first column may hold any name: what may be a row or a comment is refused.
        blanks: Where the header has no comma, blanks separate the fields.
        mark: What a comment starts with; None where a row may start with any, such as that of a path.

    Raises:
        InputError: It is no CSV; names the line, and what is ``allowed``.
    """
    text = decode_text(data, where)
    lines = _Uncommented(text, where, mark)
    header = next((line for line in text.splitlines() if line.strip() and line.lstrip()[0] != mark), "")
    by_blanks = blanks and "," not in header
    rows = (line.split() for line in lines) if by_blanks else csv.reader(lines, strict=True)
    try:
        for fields in rows:
            lines.within = False
            if any(field.strip() for field in fields) and not _is_comment(fields, mark):
                lines.width = lines.width or named * len(fields)
                yield CsvLine(lines.number, fields)
    except csv.Error as error:
        place = f"{where}, line {lines.number}"
        raise InputError(f"is not a CSV file ({error})", where=place, allowed=allowed, code="not_csv") from error


def _is_comment(fields: Sequence[str], mark: str | None) -> bool:
    """Whether these are a comment as a spreadsheet writes it: in one cell, in quotes if it holds a comma."""
    return fields[0].lstrip()[:1] == mark and not any(field.strip() for field in fields[1:])


def row_numbers(row: Sequence[str], header: Sequence[str], wanted: Sequence[str], where: str) -> list[float]:
    """A row's numbers in the columns wanted. Raises InputError: fields unlike the header, or one that is not finite."""
    if len(row) != len(header):
        refuse(f"{len(row)} fields", where, f"{len(header)} fields, as in the header", "ragged_row")
    return [parse_coordinate(row[header.index(name)].strip(), f"{where}, {name}") for name in wanted]


def parse_coordinate(text: str, where: str) -> float:
    """A finite decimal number. Raises InputError: anything else, such as a decimal comma, NaN or an empty field."""
    allowed = "a finite number with a decimal point"
    if "_" in text:  # Python would read 1_0 as 10
        refuse(f"{text[:40]!r} is not a number", where, allowed, "not_a_number")
    try:
        number = float(text)
    except ValueError as error:
        raise InputError(f"{text[:40]!r} is not a number", where=where, allowed=allowed, code="not_a_number") from error
    if not math.isfinite(number):
        refuse(f"{text[:40]!r} is not finite", where, allowed, "not_finite")
    return number


class Layout(NamedTuple):
    """Groups of columns that a table may have, and which of them belong together."""

    groups: Mapping[str, tuple[str, ...]]  # columns by the name of their group, in the file's order
    any_of: tuple[frozenset[str], ...]  # of each set one group or more is needed
    one_of: frozenset[str] = frozenset()  # of these exactly one, where there are any
    needs: Mapping[str, str] = MappingProxyType({})  # a group, and the one without which it does not stand

    def fault(self, present: Sequence[str]) -> str:
        """Why these groups, in the file's order, do not belong together; empty where they do."""
        lacking = [some for some in self.any_of if not some.intersection(present)]
        lacking += [frozenset({need}) for group, need in self.needs.items() if group in present and need not in present]
        one = [group for group in present if group in self.one_of]
        lacking += [self.one_of] if self.one_of and not one else []
        if lacking:
            return f"lacks {self._columns([group for group in self.groups if group in lacking[0]], ' or ')}"
        return f"has {self._columns(one, ' and ')} at once" if len(one) > 1 else ""

    def _columns(self, groups: Sequence[str], between: str) -> str:
        return between.join(some_names(self.groups[group]) for group in groups)


def some_names(names: Sequence[str]) -> str:
    """Names in one line; of more than ``MOST_NAMED`` the first and the last."""
    return ", ".join(names) if len(names) <= MOST_NAMED else f"{', '.join(names[: MOST_NAMED - 1])} .. {names[-1]}"


def columns_fault(header: Sequence[str], wanted: Sequence[str]) -> str:
    """What a header lacks, has unasked, has twice or has in another order than is wanted; empty where it is that."""
    if tuple(header) == tuple(wanted):
        return ""
    lacks = [name for name in wanted if name not in header]
    placed = [(f"{name[:40]!r} (column {at})", name) for at, name in enumerate(header, start=1)]
    unknown = [place for place, name in placed if name not in wanted]
    again = [place for at, (place, name) in enumerate(placed) if name in wanted and name in header[:at]]
    faults = ("lacks", lacks), ("has the unknown", unknown), ("repeats", again)
    if found := [f"{verb} {some_names(names)}" for verb, names in faults if names]:
        return "; ".join(found) if header else "is missing"
    place, belongs = next((place, name) for (place, own), name in zip(placed, wanted, strict=True) if own != name)
    return f"has {place} where {belongs} belongs"


class GroupedTable(NamedTuple):
    """The rows of a table."""

    names: tuple[str, ...]
    numbers: Mapping[str, Floats]  # shape (n, k) of each group that is there
    poses: Mapping[str, Floats]  # shape (n, 4, 4), mm, not yet checked, of each group that is a pose
    texts: Mapping[str, tuple[str, ...]]  # of each column of text that is there


def parse_table(
    content: bytes,
    path: Path,
    layout: Layout,
    example: Sequence[str],
    *,
    first: str = "name",
    texts: frozenset[str] = frozenset(),
) -> GroupedTable:
    """The rows of a table. Raises InputError: another header, no row, one of another length, or no finite number.

    Args:
        layout: Columns that it may have behind the first one.
        example: Groups of a usual file, for the error.
        texts: Groups of one column that is text.
    """
    groups = layout.groups
    allowed = ", ".join((first, *(column for group in example for column in groups[group])))
    lines = [line for line in csv_lines(content, str(path), allowed) if not line.fields[0].startswith("#")]
    header = tuple(field.strip() for field in lines[0].fields) if lines else ()
    present = [group for group, columns in groups.items() if {*columns} & {*header}]
    wanted = (first, *(column for group in present for column in groups[group]))
    if faults := [fault for fault in (columns_fault(header, wanted), layout.fault(present)) if fault]:
        refuse(f"the header {'; '.join(faults)}", path, allowed, "wrong_columns")
    plain = [group for group in present if group not in texts]
    numeric = [column for group in plain for column in groups[group]]
    rows = [row_numbers(fields, header, numeric, f"{path}, line {line}") for line, fields in lines[1:]]
    if not rows:
        refuse("no row", path, "one row or more", "empty")
    parts = np.split(np.array(rows), np.cumsum([len(groups[group]) for group in plain])[:-1], axis=1)
    numbers = dict(zip(plain, parts, strict=True))
    poses = {group: _poses(part) for group, part in numbers.items() if groups[group] == pose_columns(group)}
    names = tuple(fields[0].strip() for _, fields in lines[1:])
    at_text = {group: header.index(groups[group][0]) for group in present if group in texts}
    stated = {group: tuple(fields[at].strip() for _, fields in lines[1:]) for group, at in at_text.items()}
    return GroupedTable(names, numbers, poses, stated)


def table_text(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A CSV; a float in full."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([header, *rows])
    return text.getvalue()


def pose_columns(letter: str) -> tuple[str, ...]:
    """The twelve columns of a pose."""
    return (*(f"{letter}_r{i}{j}" for i in "123" for j in "123"), *(f"{letter}_{axis}_mm" for axis in "xyz"))


def _poses(values: Floats) -> Floats:
    """Poses (n, 4, 4), mm, not yet checked, of their columns (n, 12)."""
    return pose(values[:, :9].reshape(-1, 3, 3), values[:, 9:])


def pose_values(T: Floats) -> Floats:
    """The columns (n, 12) of poses (n, 4, 4)."""
    return np.column_stack([T[:, :3, :3].reshape(-1, 9), T[:, :3, 3]])


def finite_rows(values: Floats, what: str, names: Sequence[str], *, widths: tuple[int, ...]) -> Floats:
    """A read-only copy of an array with a row per pose, shape (n, k), k one of ``widths``, all finite and in range.

    Raises InputError: another shape, or a number that is not finite or out of range; names the pose.
    """
    array = read_only(values)
    if array.ndim != 2 or len(array) != len(names) or array.shape[1] not in widths:
        wanted = " or ".join(f"({len(names)}, {width})" for width in widths)
        refuse(f"{what} has shape {array.shape}", "recording", wanted, "wrong_shape")
    bad = np.asarray(~(np.isfinite(array) & (np.abs(array) <= MAX_COORDINATE_MM)).all(axis=1))
    allowed = f"numbers within {MAX_COORDINATE_MM:g}"
    refuse_first(bad, names, what, "is not finite or out of range", allowed, "not_finite")
    return array


def rigid_poses(T: Floats, what: str, names: Sequence[str]) -> Floats:
    """A read-only copy of poses (n, 4, 4). Raises InputError: another shape, or one that is no rigid motion."""
    array = read_only(T)
    if array.shape != (len(names), 4, 4):
        refuse(f"{what} has shape {array.shape}", "recording", f"({len(names)}, 4, 4)", "wrong_shape")
    finite_rows(array.reshape(len(names), 16), what, names, widths=(16,))
    R = array[:, :3, :3]
    error = np.abs(R.transpose(0, 2, 1) @ R - np.eye(3)).max(axis=(1, 2))
    bad = (error > ROTATION_TOLERANCE) | (np.linalg.det(R) < 0) | (np.abs(array[:, 3] - [0, 0, 0, 1]).max(axis=1) > 0)
    allowed = f"a rotation (R^T R = 1 to {ROTATION_TOLERANCE:g}, determinant +1) and a translation, last row 0 0 0 1"
    refuse_first(bad, names, what, "is not a rigid motion", allowed, "not_rigid")
    return array


def pose_names(names: Sequence[str], n: int) -> tuple[str, ...]:
    """Names of n poses; numbers where none are given. Raises InputError: no pose, or a name missing or used twice."""
    names = tuple(names) or tuple(str(i + 1) for i in range(n))
    if n == 0 or len(names) != n or len(set(names)) != n:
        refuse(f"{n} poses and {len(set(names))} different names", "recording", "one name per pose", "duplicate_name")
    return names


def refuse_first(
    bad: NDArray[np.bool_], names: Sequence[str], what: str, problem: str, allowed: str, code: str
) -> None:
    """Refuse the first pose that is bad, shape (n,); none where none is."""
    if bad.any():
        refuse(f"{what} of pose {names[int(np.argmax(bad))]} {problem}", "recording", allowed, code)
