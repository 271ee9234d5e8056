"""The command that checks a list: which list it is, and what it is read and written with."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.files import check_writable
from puncture_twin.planning.base.progress import Watcher
from puncture_twin.planning.geometry.spaces import to_lps
from puncture_twin.planning.search.context import CaseContext, prepare
from puncture_twin.planning.search.selection.choice import BEST, Choice
from puncture_twin.planning.search.selection.listed import Listed, read_entries, read_targets

if TYPE_CHECKING:
    from puncture_twin.twin.jobs.choosing.row_by_row import CheckedList


def lists_of(
    entries: Path | None, targets: Path | None, choice: Choice, *, picture: Path | None, out_dir: Path | None
) -> bool:
    """Whether a list is to be checked.

    Raises:
        InputError: Two lists, a list of directions beside a choice, a picture of a list, or a folder without a list.
    """
    if entries is not None and targets is not None:
        raise InputError("two lists", where="--entries, --targets", allowed="one of them")
    if entries is not None and choice != BEST:
        raise InputError("a list of entries beside a choice", where="--entries", allowed="the list alone")
    if (entries or targets) is not None and picture is not None:
        raise InputError("a picture is of one candidate", where="--picture", allowed="check without a list")
    if (entries or targets) is None and out_dir is not None:
        raise InputError("one candidate is printed, not written", where="--out", allowed="--entries or --targets")
    return (entries or targets) is not None


def check_list(
    path: Path,
    entries: Path | None,
    targets: Path | None,
    choice: Choice,
    *,
    out_dir: Path | None,
    arm: bool | None,
    watcher: Watcher,
) -> CheckedList:
    """Check a list of entries or of targets; written where a folder is named.

    Raises:
        InputError: A case, list or folder that cannot be used. A row that cannot be checked is a row that says so.
    """
    from puncture_twin.twin.jobs.choosing.row_by_row import check_entries, check_targets, write_checked

    out = None if out_dir is None else check_writable(out_dir)
    context = prepare(path, arm=arm, watcher=watcher)

    def aimed(row: Listed) -> CaseContext:
        point = to_lps(np.array([row.point_mm]), context.case.space)[0]
        return prepare(path, arm=arm, target_ct=point)

    if entries is not None:
        checked = check_entries(context, read_entries(entries, context.case))
    else:
        assert targets is not None
        checked = check_targets(context, read_targets(targets, context.case, choice), aimed)
    return checked if out is None else write_checked(checked, context, out)
