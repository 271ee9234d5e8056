"""The target that a case states: coordinates, or a name in a list of points."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from puncture_twin.planning.base.arrays import Floats, read_only
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.provenance import InputFiles
from puncture_twin.planning.case.case_file import CaseFile
from puncture_twin.planning.formats.points.point_files import parse_points
from puncture_twin.planning.geometry.spaces import Space, to_lps


def target_of(content: CaseFile, path: Path, space: Space, files: InputFiles) -> Floats:
    """The point to reach, shape (3,), LPS (or the case's local frame) mm, read-only.

    Args:
        content: The case file.
        path: Where it is, for errors.
        space: The case's.
        files: What it names, read.

    Raises:
        InputError: A list of points that cannot be read, or that lacks the target's name.
    """
    target = content.target
    if target.position_mm is not None:
        return read_only(to_lps(np.asarray([target.position_mm]), space)[0])
    assert target.points is not None  # held by the schema
    listed = parse_points(files.content(target.points), path.parent / target.points, default_space=space)
    if target.name not in listed.names:
        names = ", ".join(listed.names)
        raise InputError(f"target.name '{target.name}' is not in {target.points}", where=path, allowed=names)
    return read_only(listed.points[listed.names.index(target.name)].copy())
