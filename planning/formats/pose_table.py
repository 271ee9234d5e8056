"""A CSV whose columns come in groups, such as the twelve of a pose: read whole, or refused with file and line.

The first column names the row; groups follow it in a fixed order, each whole or absent. Lines that start with # are
passed over. A pose is nine numbers of its rotation, by rows, and its place in mm.
"""

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats, read_only
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.formats.guard import MAX_COORDINATE_MM, ROTATION_TOLERANCE
from puncture_twin.planning.formats.points import csv_lines, row_numbers
from puncture_twin.planning.geometry.rigid import pose

Groups = Mapping[str, tuple[str, ...]]
"""Columns by the name of their group, in the file's order."""


class GroupedTable(NamedTuple):
    """The rows of a table."""

    names: tuple[str, ...]
    numbers: Mapping[str, Floats]  # shape (n, k) of each group that is there
    texts: Mapping[str, tuple[str, ...]]  # of each column of text that is there


def parse_table(
    content: bytes,
    path: Path,
    groups: Groups,
    fits: Callable[[frozenset[str]], bool],
    example: Sequence[str],
    *,
    first: str = "name",
    texts: frozenset[str] = frozenset(),
) -> GroupedTable:
    """The rows of a table. Raises InputError: another header, no row, one of another length, or no finite number.

    Args:
        groups: Columns that it may have behind the first one.
        fits: Whether the groups that are there belong together.
        example: Groups of a usual file, for the error.
        texts: Groups of one column that is text.
    """
    allowed = ", ".join((first, *(column for group in example for column in groups[group])))
    lines = [one for one in csv_lines(content, str(path), allowed) if not one.fields[0].startswith("#")]
    header = tuple(field.strip() for field in lines[0].fields) if lines else ()
    found, at = [], 1
    for group, columns in groups.items():
        if header[at : at + len(columns)] == columns:
            found.append(group)
            at += len(columns)
    if header[:1] != (first,) or at != len(header) or not fits(frozenset(found)):
        refuse(f"columns {', '.join(header)[:200] or 'none'}", f"{path}, header", allowed, "wrong_columns")
    wanted = [column for group in found if group not in texts for column in groups[group]]
    rows = [row_numbers(fields, header, wanted, f"{path}, line {line}") for line, fields in lines[1:]]
    if not rows:
        refuse("no row", path, "one row or more", "empty")
    plain = [group for group in found if group not in texts]
    parts = np.split(np.array(rows), np.cumsum([len(groups[group]) for group in plain])[:-1], axis=1)
    words = {group: header.index(groups[group][0]) for group in found if group in texts}
    names = tuple(fields[0].strip() for _, fields in lines[1:])
    said = {group: tuple(fields[at].strip() for _, fields in lines[1:]) for group, at in words.items()}
    return GroupedTable(names, dict(zip(plain, parts, strict=True)), said)


def table_text(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A CSV; a float in full."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([header, *rows])
    return text.getvalue()


def pose_columns(letter: str) -> tuple[str, ...]:
    """The twelve columns of a pose."""
    return (*(f"{letter}_r{i}{j}" for i in "123" for j in "123"), *(f"{letter}_{axis}_mm" for axis in "xyz"))


def poses_of(values: Floats) -> Floats:
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
