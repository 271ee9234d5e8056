"""Which files make the CT that was named: those of a folder with one series, or of the series of a file in it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.formats.dicom.recognise import DicomFile, list_folder
from puncture_twin.planning.formats.dicom.storage import Kind

SHOWN = 6
"""Series and left-out files that a message lists."""


@dataclass(frozen=True)
class SeriesFiles:
    """The files of one CT series.

    Attributes:
        folder: Where they are.
        names: Their names there, sorted.
        series_uid: The series.
        notes: What else lies in the folder and was left out, one sentence.
    """

    folder: Path
    names: tuple[str, ...]
    series_uid: str
    notes: tuple[str, ...]


def choose_series(path: Path) -> SeriesFiles:
    """The files of the CT series that a path means.

    Args:
        path: A folder that holds one CT series, or a file of the series.

    Raises:
        InputError: No CT series there, several, or a file that is no slice of one.
    """
    folder = path if path.is_dir() else path.parent
    found = list_folder(folder)
    slices = [one for one in found if one.is_slice]
    if folder != path:
        named = next((one for one in found if one.name == path.name), None)
        if named is None or not named.is_slice:
            what = "no DICOM file" if named is None else f"{named.sop_class}, no slice of a CT"
            raise InputError(what, where=path, allowed="a slice of a CT series, or its folder")
        slices = [one for one in slices if one.series_uid == named.series_uid]
    _check_one_series(slices, found, path)
    names = tuple(one.name for one in slices)
    aside = [one for one in found if one.name not in set(names)]
    return SeriesFiles(folder, names, slices[0].series_uid, _notes(aside, path))


def _check_one_series(slices: Sequence[DicomFile], found: Sequence[DicomFile], path: Path) -> None:
    if not slices:
        classes = Counter(one.sop_class for one in found)
        shown = ", ".join(f"{count} {name}" for name, count in classes.most_common(SHOWN)) or "no DICOM file"
        below = (
            "" if found or not any(one.is_dir() for one in path.iterdir()) else "; the folders in it were not entered"
        )
        raise InputError(f"no CT series here: {shown}{below}", where=path, allowed="a folder with a CT series")
    series: dict[str, list[DicomFile]] = {}
    for one in slices:
        series.setdefault(one.series_uid, []).append(one)
    if len(series) > 1:
        listed = [
            f"{_count(files)} of '{files[0].series}' (such as {files[0].name}, UID {uid or 'missing'})"
            for uid, files in list(series.items())[:SHOWN]
        ]
        more = f"; and {len(series) - SHOWN} more" if len(series) > SHOWN else ""
        what = f"{len(series)} CT series: {'; '.join(listed)}{more}"
        raise InputError(what, where=path, allowed="one series: name one of its files instead of the folder")


def _notes(aside: Sequence[DicomFile], path: Path) -> tuple[str, ...]:
    if not aside:
        return ()
    kinds = Counter(f"{one.sop_class} '{one.series}'" if one.kind is Kind.CT else one.sop_class for one in aside)
    shown = ", ".join(f"{count} {name}" for name, count in kinds.most_common(SHOWN))
    more = f", {len(kinds) - SHOWN} kinds more" if len(kinds) > SHOWN else ""
    return (f"{path.name}: files beside the CT series were left out: {shown}{more}",)


def _count(files: Sequence[DicomFile]) -> str:
    return f"{len(files)} file{'' if len(files) == 1 else 's'}"
