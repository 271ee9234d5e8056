"""The contents of a folder of DICOM files, from the headers alone."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from pydicom.datadict import tag_for_keyword
from pydicom.dataset import Dataset
from pydicom.filereader import read_dataset
from pydicom.uid import UID

from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.base.files import is_folder
from puncture_twin.planning.base.text import first_few
from puncture_twin.planning.formats.dicom import dicom_file, storage
from puncture_twin.planning.formats.folder import FILE, FOLDER, HIDDEN, Entry, entries, unaccounted

MAX_FILES = 50_000
"""Most files of a folder; the longest series have some 5,000 slices."""
NO_SLICES = frozenset(("LOCALIZER", "SCOUT", "TOPOGRAM", "SCREEN SAVE", "DOSE_INFO", "DOSE", "SUMMARY", "PROTOCOL"))
"""Values of ImageType that are no slices: scouts, and pages of text that are stored among the slices."""
_TAGS = [
    tag_for_keyword(keyword) or 0
    for keyword in (
        *("SOPClassUID", "SOPInstanceUID", "ImageType", "SeriesDescription", "SeriesInstanceUID"),
        *("AcquisitionDate", "SeriesDate", "StudyDate"),
        *("SeriesNumber", "ImagePositionPatient", "ImageOrientationPatient", "FrameOfReferenceUID"),
    )
]
_LAST_TAG = max(_TAGS)
_META_CLASS = "MediaStorageSOPClassUID"
DATE_DIGITS = 8


@dataclass(frozen=True)
class DicomFile:
    """A DICOM file by its header."""

    name: str
    kind: storage.Kind
    sop_class: str  # what the standard calls this class
    series_uid: str
    series: str  # its number and description, as a person knows it
    frame_of_reference: str  # the coordinates in which it lies, or the empty string
    is_slice: bool  # whether it is a CT image, and no scout or page of text
    date: str  # when it was taken, as ``2019-11-04``; the empty string where the file does not say


def recognise(path: Path) -> DicomFile | None:
    """The kind of a file by its header; None for no DICOM file. Raises InputError: its header is damaged."""
    try:
        with path.open("rb") as stream:
            if not storage.is_dicom(stream.read(storage.META_START)):
                return None
            with dicom_file.refused_if_damaged(path):
                meta = dicom_file.read_meta(stream)
                if (syntax := meta.TransferSyntaxUID) in storage.NOT_READ:
                    sop_class, other = dicom_file.text(meta, _META_CLASS, where=str(path)), storage.Kind.OTHER
                    if not sop_class or storage.kind_of(sop_class) is not other:
                        dicom_file.refuse_syntax(UID(syntax), path)
                    return DicomFile(path.name, other, UID(sop_class).name, "", UID(syntax).name, "", False, "")
                implicit = meta.TransferSyntaxUID == storage.IMPLICIT
                header = read_dataset(
                    stream, implicit, True, stop_when=lambda tag, *_: tag > _LAST_TAG, specific_tags=list(_TAGS)
                )
                header.file_meta = meta
    except OSError as error:
        what = f"cannot be read ({error.strerror})"
        raise InputError(what, where=path, allowed="a readable file", code="unreadable") from error
    return described(header, path)


def described(data: Dataset, path: Path) -> DicomFile:
    """Description of a data set by its own header. Raises InputError: its header is damaged."""
    where = str(path)
    sop_class = dicom_file.sop_class_of(data, where=where)
    kind = storage.kind_of(sop_class)
    with dicom_file.refused_if_damaged(path):
        called = UID(sop_class).name if sop_class else "no SOP class"
    text = partial(dicom_file.text, data, where=where)
    number, description = text("SeriesNumber"), text("SeriesDescription")
    types = {part.upper() for part in dicom_file.texts(data, "ImageType", where=where)}
    placed = "ImagePositionPatient" in data or "ImageOrientationPatient" in data or "SECONDARY" not in types
    series_uid, frame_of_reference = text("SeriesInstanceUID"), text("FrameOfReferenceUID")
    dates = map(text, ("AcquisitionDate", "SeriesDate", "StudyDate"))  # read as far as the first that is one
    date = next((one for one in dates if len(one) == DATE_DIGITS and one.isascii() and one.isdigit()), "")
    date = date and f"{date[:4]}-{date[4:6]}-{date[6:]}"
    series = f"{number or '?'} {description or 'without description'}"
    is_slice = kind is storage.Kind.CT and placed and not types & NO_SLICES
    return DicomFile(path.name, kind, called, series_uid, series, frame_of_reference, is_slice, date)


def list_folder(folder: Path) -> tuple[tuple[DicomFile, ...], tuple[Entry, ...]]:
    """Every DICOM file of a folder by name, and every other entry. Raises InputError: too many, or a damaged one."""
    listed = entries(folder, most=MAX_FILES)
    recognised = {one: recognise(folder / one.name) for one in listed if one.what == FILE}
    for one in recognised.values():
        if one is not None and not one.name.isprintable():
            refuse(f"file name {one.name!a}", folder, "names of printable characters", "bad_name")
    files = tuple(one for one in recognised.values() if one is not None)
    return files, tuple(one for one in listed if recognised.get(one) is None)


SHOWN, LOOKED_AT = 6, 100
"""Series that a message lists, and files of a folder next to the slices that are opened."""


@dataclass(frozen=True)
class SeriesFiles:
    """The files of one CT series."""

    folder: Path
    names: tuple[str, ...]
    notes: tuple[str, ...]  # what else lies in the folder and was left out, one sentence


def choose_series(path: Path) -> SeriesFiles:
    """The files of the CT series that a path means. Raises InputError: none there, several, or a file of no series."""
    folder = path if is_folder(path) else path.parent
    files, others = list_folder(folder)
    slices = [one for one in files if one.is_slice]
    if folder != path:
        named = next((one for one in files if one.name == path.name), None)
        if named is None or not named.is_slice:
            what = "not a DICOM file" if named is None else f"{named.sop_class}, not a CT slice"
            refuse(what, path, "a slice of a CT series, or the folder of a series", "not_a_ct")
        slices = [one for one in slices if one.series_uid == named.series_uid]
    _check_one_series(slices, files, others, path)
    names = tuple(one.name for one in slices)
    read = {one.name: Entry(one.name, FILE) for one in files}
    left = unaccounted(folder, (*others, *read.values()), lambda path: path.name in read)
    if lost := [one for one in left if _may_be_slice(one, names)]:
        what = f"other files, possibly slices, cannot be read: {first_few([one.line for one in lost])}"
        allowed = "every slice of the series as a complete DICOM file (download or copy it again, or move it elsewhere)"
        refuse(what, path, allowed, "slices_not_read")
    below = [one for one in others if one.what == FOLDER and _contains_dicom(folder / one.name)]
    aside = [one for one in files if one.name not in set(names)]
    kinds = Counter(
        f"{one.sop_class} '{one.series}'" if one.kind is storage.Kind.CT else one.sop_class for one in aside
    )
    shown = [*(f"{count} {name}" for name, count in kinds.most_common()), *(f"DICOM in {one.name}" for one in below)]
    note = f"{path.name}: other files next to the CT series were left out: {first_few(shown)}"
    return SeriesFiles(folder, names, (note,) if shown else ())


def _may_be_slice(one: Entry, names: Sequence[str]) -> bool:
    """Whether an unreadable file may be a slice: by its ending, or that of a part of one."""
    endings = {Path(name).suffix.lower() for name in names} | {".dcm", ".ima"}
    named = {end for end in map(str.lower, Path(one.name).suffixes) if not end[1:].isdigit()} & endings
    return one.what != FOLDER and bool(one.what not in (FILE, HIDDEN) or named)


def _contains_dicom(folder: Path) -> bool:
    """Whether slices may lie in a folder next to the series, by its first files."""
    return any(storage.is_dicom_file(folder / one.name) for one in entries(folder, most=MAX_FILES)[:LOOKED_AT])


def _check_one_series(
    slices: Sequence[DicomFile], found: Sequence[DicomFile], others: Sequence[Entry], path: Path
) -> None:
    if not slices:
        classes = Counter(one.sop_class for one in found)
        shown = [f"{count} {name}" for name, count in classes.most_common()] or ["not a DICOM file"]
        allowed = "a folder with a CT series (subfolders are not searched)"
        refuse(f"no CT series here: {first_few([*shown, *(one.line for one in others)])}", path, allowed, "no_ct")
    series: dict[str, list[DicomFile]] = {}
    for one in slices:
        series.setdefault(one.series_uid, []).append(one)
    if len(series) > 1:
        listed = [
            f"{len(files)} file{'' if len(files) == 1 else 's'} of '{files[0].series}' (such as {files[0].name}, "
            f"UID {uid or 'missing'})"
            for uid, files in list(series.items())[:SHOWN]
        ]
        more = f"; and {len(series) - SHOWN} more" if len(series) > SHOWN else ""
        allowed = "one series: give one of its files instead of the folder"
        refuse(f"{len(series)} CT series: {'; '.join(listed)}{more}", path, allowed, "several_series")
