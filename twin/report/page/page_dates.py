"""When a page was made and when its scan was taken: a printed page without a date belongs to nobody."""

from __future__ import annotations

import os
from datetime import UTC, datetime
from typing import Any

from puncture_twin.planning.formats.dicom.storage import is_dicom_file

EPOCH = "SOURCE_DATE_EPOCH"
"""Seconds since 1970 that stand for "now", as tools take them that make the same bytes on every day."""


def dates_text(case: Any) -> str:
    """The day of the page and of its scan."""
    return f"Made on {made_on()} (UTC); scan of {scan_date(case) or 'a date that its files do not state'}."


def made_on() -> str:
    """Today, UTC."""
    stated = os.environ.get(EPOCH, "")
    at = datetime.fromtimestamp(int(stated), UTC) if stated.isascii() and stated.isdigit() else datetime.now(UTC)
    return at.date().isoformat()


def scan_date(case: Any) -> str:
    """The day of the first CT slice among a case's inputs; the empty string where none says so (as in NIfTI)."""
    for one in case.inputs:
        path = case.path.parent / one.path
        if is_dicom_file(path):
            from puncture_twin.planning.formats.dicom.recognise import recognise  # with pydicom: few cases need it

            found = recognise(path)
            if found is not None and found.is_slice:
                return found.date
    return ""
