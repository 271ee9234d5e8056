"""What lies in a folder of DICOM files, told from the headers alone."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from pydicom.datadict import tag_for_keyword
from pydicom.dataset import Dataset
from pydicom.filereader import read_dataset
from pydicom.tag import BaseTag

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.input_file import read_input
from puncture_twin.planning.formats.dicom.attributes import has, text, texts
from puncture_twin.planning.formats.dicom.dicom_file import parse_dicom, read_meta, refused_if_damaged
from puncture_twin.planning.formats.dicom.storage import DEFLATED, IMPLICIT, META_START, Kind, is_dicom, kind_of
from puncture_twin.planning.formats.volumes.volume_files import MAX_FILE_BYTES

MAX_FILES = 50_000
"""In one folder; the longest series have some 5,000 slices."""
NO_SLICES = frozenset(("LOCALIZER", "SCOUT", "TOPOGRAM", "SCREEN SAVE", "DOSE_INFO", "DOSE", "SUMMARY", "PROTOCOL"))
"""Of ImageType: scouts, and pages of text that are stored among the slices."""
_TAGS = [
    tag_for_keyword(keyword) or 0
    for keyword in (
        *("SOPClassUID", "SOPInstanceUID", "ImageType", "SeriesDescription", "SeriesInstanceUID"),
        *("AcquisitionDate", "SeriesDate", "StudyDate"),
        *("SeriesNumber", "ImagePositionPatient", "ImageOrientationPatient", "FrameOfReferenceUID"),
    )
]
_LAST_TAG = max(_TAGS)

DATE_DIGITS = 8


@dataclass(frozen=True)
class DicomFile:
    """A DICOM file by its header.

    Attributes:
        name: The file's name in its folder.
        kind: By its SOP class.
        sop_class: What the standard calls this class.
        series_uid: The series that it belongs to.
        series: Its number and description, as a person knows it.
        frame_of_reference: The coordinates in which it lies, or the empty string.
        is_slice: Whether it is a CT image, and no scout or page of text.
        date: When it was taken, as ``2019-11-04``; the empty string where the file does not say.
    """

    name: str
    kind: Kind
    sop_class: str
    series_uid: str
    series: str
    frame_of_reference: str
    is_slice: bool
    date: str


def recognise(path: Path) -> DicomFile | None:
    """What a file is; None if it is no DICOM file.

    Raises:
        InputError: It begins as DICOM, and its header is damaged.
    """
    try:
        with path.open("rb") as stream:
            if not is_dicom(stream.read(META_START)):
                return None
            with refused_if_damaged(path):
                syntax = read_meta(stream).TransferSyntaxUID
                header = None if syntax == DEFLATED else _header(stream, implicit=syntax == IMPLICIT)
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=path, allowed="a readable file") from error
    if header is None:
        content = read_input(path, max_bytes=MAX_FILE_BYTES, where=str(path))
        return described(parse_dicom(content, path), path)
    return described(header, path)


def described(data: Dataset, path: Path) -> DicomFile:
    """What a data set that was read says that it is.

    Raises:
        InputError: Its header is damaged.
    """
    where = str(path)
    sop_class = text(data, "SOPClassUID", where=where)
    kind = kind_of(sop_class)
    with refused_if_damaged(path):
        called = data.SOPClassUID.name if sop_class else "no SOP class"
    number, description = (text(data, keyword, where=where) for keyword in ("SeriesNumber", "SeriesDescription"))
    types = {part.upper() for part in texts(data, "ImageType", where=where)}
    placed = has(data, "ImagePositionPatient") or has(data, "ImageOrientationPatient") or "SECONDARY" not in types
    return DicomFile(
        name=path.name,
        kind=kind,
        sop_class=called,
        series_uid=text(data, "SeriesInstanceUID", where=where),
        series=f"{number or '?'} {description or 'without description'}",
        frame_of_reference=text(data, "FrameOfReferenceUID", where=where),
        is_slice=kind is Kind.CT and placed and not types & NO_SLICES,
        date=_date(data, where),
    )


def _date(data: Dataset, where: str) -> str:
    """Of the acquisition, else of its series or study: eight digits, all else is none."""
    stated = (text(data, keyword, where=where) for keyword in ("AcquisitionDate", "SeriesDate", "StudyDate"))
    plain = next((one for one in stated if len(one) == DATE_DIGITS and one.isascii() and one.isdigit()), "")
    return plain and f"{plain[:4]}-{plain[4:6]}-{plain[6:]}"


def list_folder(folder: Path) -> tuple[DicomFile, ...]:
    """Every DICOM file of a folder, by name; folders in it are not entered.

    Raises:
        InputError: Too many files, one that begins as DICOM and is damaged, or one whose name cannot be printed.
    """
    try:
        names = sorted(entry.name for entry in os.scandir(folder) if entry.is_file())
    except (OSError, ValueError) as error:
        raise InputError(f"cannot be listed ({error})", where=folder, allowed="a readable folder") from error
    if len(names) > MAX_FILES:
        raise InputError(f"{len(names)} files", where=folder, allowed=f"at most {MAX_FILES} files in one folder")
    found = [one for name in names if (one := recognise(folder / name)) is not None]
    for one in found:
        if not one.name.isprintable():
            raise InputError(f"file name {one.name!a}", where=folder, allowed="names of printable characters")
    return tuple(found)


def _header(stream: BinaryIO, *, implicit: bool) -> Dataset:
    return read_dataset(stream, implicit, True, stop_when=_is_enough, specific_tags=list(_TAGS))


def _is_enough(tag: BaseTag, vr: str | None, length: int) -> bool:
    return tag > _LAST_TAG
