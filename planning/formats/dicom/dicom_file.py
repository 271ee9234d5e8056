"""The data set of a DICOM file's bytes, once its magic, its transfer syntax and its wholeness are checked.

Whole is a data set in which every element lies inside its parent, every sequence is closed, and tags rise. The library
that reads values takes what is left of an element that was cut short, and keeps the last of two elements of one tag: a
contour or a frame would be lost without a word. So the nesting is checked first (DICOM PS3.5, chapter 7).
"""

import io
import math
import struct
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

from pydicom.datadict import dictionary_VR, tag_for_keyword
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.filereader import read_dataset
from pydicom.multival import MultiValue
from pydicom.uid import UID

from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.base.text import plural
from puncture_twin.planning.formats.dicom.storage import IMPLICIT, META_START, NOT_READ, is_dicom

ALLOWED = "a complete DICOM file"


@contextmanager
def refused_if_damaged(where: str | Path) -> Iterator[None]:
    """Context with one InputError for whatever the library raises for damaged values, and without its warnings."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except InputError:
        raise
    except Exception as error:  # the library promises no kind of error for bytes that are damaged
        what = f"damaged ({type(error).__name__}: {str(error)[:200]})"
        plain = what.encode("ascii", "replace").decode()
        raise InputError(plain, where=where, allowed=ALLOWED, code="file_damaged") from error


def parse_dicom(content: bytes, path: Path) -> Dataset:
    """A read file's data set with ``file_meta``. Raises InputError: no DICOM, damaged, cut, deflated or big endian."""
    if not is_dicom(content[:META_START]):
        refuse("not a DICOM file: no DICM at byte 128", path, ALLOWED, "wrong_format")
    with refused_if_damaged(path):
        stream = io.BytesIO(content)
        meta = read_meta(stream)
        syntax = UID(meta.TransferSyntaxUID)
        if not syntax:
            refuse("its meta information names no transfer syntax", path, ALLOWED, "missing_tag")
        if syntax in NOT_READ:
            refuse_syntax(syntax, path)
        body = memoryview(content)[stream.tell() :]
        implicit = syntax == IMPLICIT
        # Without the zeros that some programs write behind a data set.
        length = _Walk(body, path).data_set(0, len(body), implicit=implicit, depth=0, closed=False)
        dataset = read_dataset(io.BytesIO(body[:length]), implicit, True)
        dataset.file_meta = meta
        return dataset


def read_meta(stream: BinaryIO) -> FileMetaDataset:
    """The meta information of a DICOM file, whose data set begins where the stream then is; its syntax may be empty."""
    stream.seek(META_START)
    meta = FileMetaDataset(read_dataset(stream, False, True, stop_when=lambda tag, *_: tag.group != 2))
    meta.TransferSyntaxUID = UID(str(meta.get("TransferSyntaxUID", "")).strip(" \0"))
    return meta


HOW_TO_CONVERT = "Explicit VR Little Endian; convert it with 'gdcmconv --raw IN OUT' or 'dcmdjpeg IN OUT'"


def refuse_syntax(syntax: UID, where: str | Path) -> NoReturn:
    """Raise the error of a file in a transfer syntax that is not read."""
    refuse(f"transfer syntax {syntax.name} ({syntax})", where, HOW_TO_CONVERT, "transfer_syntax")


MAX_TEXT = 200
"""Most characters of a name or a description; standard types hold 64."""


def value(data: Dataset, keyword: str, *, where: str) -> Any:
    """The value of an element; None where it is absent or empty."""
    with refused_if_damaged(where):
        stored = data[keyword].value if keyword in data else None
    return None if stored is None or stored == "" else stored


def numbers(data: Dataset, keyword: str, count: int, *, where: str) -> tuple[float, ...]:
    """An element's value as so many finite numbers. Raises InputError: missing, of another count, or not finite."""
    stored = value(data, keyword, where=where)
    with refused_if_damaged(f"{where}: {keyword}"):
        plain = tuple(float(one) for one in _listed(stored))
    if len(plain) != count or not all(map(math.isfinite, plain)):
        what = f"{name(keyword)} is missing" if stored is None else f"{name(keyword)} is {str(stored)[:100]}"
        refuse(what, where, plural(count, "finite number"), "missing_tag" if stored is None else "bad_tag")
    return plain


def number(data: Dataset, keyword: str, *, where: str) -> float:
    """One finite number; see `numbers`."""
    return numbers(data, keyword, 1, where=where)[0]


def whole(data: Dataset, keyword: str, *, low: int, high: int, where: str) -> int:
    """An element's value as one whole number between two others. Raises InputError: missing, not whole or outside."""
    stated = number(data, keyword, where=where)
    if stated != int(stated) or not low <= stated <= high:
        refuse(f"{name(keyword)} is {stated:g}", where, f"a whole number from {low} to {high}", "bad_tag")
    return int(stated)


def text(data: Dataset, keyword: str, *, where: str) -> str:
    """The value as text without surrounding spaces, "" where absent; unprintable characters become ``?``."""
    stored = value(data, keyword, where=where)
    plain = "" if stored is None else str(stored).strip(" \0")[:MAX_TEXT]
    return "".join(letter if letter.isprintable() else "?" for letter in plain)


def texts(data: Dataset, keyword: str, *, where: str) -> tuple[str, ...]:
    """The values of an element as texts, none where it is absent."""
    return tuple(str(one).strip() for one in _listed(value(data, keyword, where=where)))


def _listed(stored: Any) -> list[Any]:
    return list(stored) if isinstance(stored, MultiValue | list | tuple) else [] if stored is None else [stored]


def sop_class_of(data: Dataset, *, where: str) -> str:
    """SOP class of a data set; where it does not say, that of its file's meta information."""
    own = text(data, "SOPClassUID", where=where)
    return own or text(data.file_meta, "MediaStorageSOPClassUID", where=where)


def items(data: Dataset, keyword: str, *, where: str) -> list[Dataset]:
    """The items of a sequence, none where it is absent. Raises InputError: it is no sequence."""
    stored = value(data, keyword, where=where)
    if stored is None:
        return []
    with refused_if_damaged(where):
        listed = list(stored)
    if not all(isinstance(one, Dataset) for one in listed):
        refuse(f"{name(keyword)} is not a sequence", where, "a sequence of items", "bad_tag")
    return listed


def name(keyword: str) -> str:
    """Text of a keyword with its tag."""
    tag = tag_for_keyword(keyword) or 0
    return f"{keyword} ({tag >> 16:04X},{tag & 0xFFFF:04X})"


UNDEFINED = 0xFFFFFFFF
ITEM, ITEM_END, SEQUENCE_END = 0xFFFEE000, 0xFFFEE00D, 0xFFFEE0DD
PIXEL_DATA = 0x7FE00010
LONG_FORM = frozenset((b"OB", b"OD", b"OF", b"OL", b"OV", b"OW", b"SQ", b"SV", b"UC", b"UN", b"UR", b"UT", b"UV"))
"""Value representations whose length has four bytes."""
SHORT_FORM = frozenset(b"AE AS AT CS DA DS DT FD FL IS LO LT PN SH SL SS ST TM UI UL US".split())
MAX_DEPTH = 16
"""Most sequences in sequences; structured reports go deeper, images and contours do not reach half of it."""
MAX_ELEMENTS = 3_000_000
"""Most elements of a file: a multi-frame image of 10,000 slices has a tenth of it."""


class _Walk:
    """One pass over a data set."""

    def __init__(self, data: memoryview, where: Path) -> None:
        self._data, self._where, self._count = data, where, 0

    def data_set(self, at: int, end: int, *, implicit: bool, depth: int, closed: bool) -> int:
        """Offset at which a data set ends: at ``end``, at the latest, or where ``closed``, at its delimiter."""
        if depth > MAX_DEPTH:
            self._refuse(f"sequences in sequences, {depth} deep", at)
        last = -1
        while closed or at < end:
            if depth == 0 and not any(self._data[at : at + 8]) and not bytes(self._data[at:end]).strip(b"\0"):
                return at
            tag = self._tag(at, end)
            if closed and tag == ITEM_END:
                return at + 8
            if tag <= last:
                self._refuse(f"element {_shown(tag)} comes after {_shown(last)}", at)
            last = tag
            at = self._element(tag, at, end, implicit=implicit, depth=depth)
        return at

    def _element(self, tag: int, at: int, end: int, *, implicit: bool, depth: int) -> int:
        """Offset at which an element ends."""
        kind, at, length = self._head(tag, at, end, implicit=implicit)
        if length == UNDEFINED:
            if tag == PIXEL_DATA and kind in (b"OB", b"OW"):
                return self._fragments(at, end)
            if kind not in (b"SQ", b"UN"):
                self._refuse(f"element {_shown(tag)} has no length", at)
            return self._items(at, end, implicit=implicit or kind == b"UN", depth=depth + 1, closed=True)
        if at + length > end:
            what = f"cut short: element {_shown(tag)} promises {length} bytes, and {end - at} are left"
            self._refuse(what, at, "file_cut")
        if kind == b"UN" and _known(tag) == b"SQ":
            self._refuse(f"sequence {_shown(tag)} is stored without its value representation", at)
        if kind == b"SQ":
            self._items(at, at + length, implicit=implicit, depth=depth + 1, closed=False)
        return at + length

    def _head(self, tag: int, at: int, end: int, *, implicit: bool) -> tuple[bytes, int, int]:
        """Value representation, the value's first byte and its length."""
        if implicit:
            return _known(tag), at + 8, struct.unpack_from("<L", self._data, at + 4)[0]
        kind = bytes(self._data[at + 4 : at + 6])
        if kind in SHORT_FORM:
            return kind, at + 8, struct.unpack_from("<H", self._data, at + 6)[0]
        if kind not in LONG_FORM:
            self._refuse(f"element {_shown(tag)} has the unknown value representation {kind!r}", at)
        if at + 12 > end:
            self._refuse("cut short within the header of an element", at, "file_cut")
        return kind, at + 12, struct.unpack_from("<L", self._data, at + 8)[0]

    def _items(self, at: int, end: int, *, implicit: bool, depth: int, closed: bool) -> int:
        """Offset at which the items of a sequence end."""
        while closed or at < end:
            tag, length = self._tag(at, end), struct.unpack_from("<L", self._data, at + 4)[0]
            if closed and tag == SEQUENCE_END:
                return at + 8
            if tag != ITEM:
                self._refuse(f"element {_shown(tag)} in place of a sequence item", at)
            if length == UNDEFINED:
                at = self.data_set(at + 8, end, implicit=implicit, depth=depth, closed=True)
                continue
            if at + 8 + length > end:
                self._refuse("cut short within a sequence item", at, "file_cut")
            at = self.data_set(at + 8, at + 8 + length, implicit=implicit, depth=depth, closed=False)
        return at

    def _fragments(self, at: int, end: int) -> int:
        """Offset at which compressed pixels end."""
        while True:
            tag, length = self._tag(at, end), struct.unpack_from("<L", self._data, at + 4)[0]
            if tag == SEQUENCE_END:
                return at + 8
            if tag != ITEM or at + 8 + length > end:
                self._refuse("cut short within the compressed pixels", at, "file_cut")
            at += 8 + length

    def _tag(self, at: int, end: int) -> int:
        self._count += 1
        if self._count > MAX_ELEMENTS:
            self._refuse(f"more than {MAX_ELEMENTS} elements", at)
        if at + 8 > end:
            self._refuse("cut short: it ends within an element", at, "file_cut")
        group, element = struct.unpack_from("<HH", self._data, at)
        return int(group << 16 | element)

    def _refuse(self, what: str, at: int, code: str = "file_damaged") -> NoReturn:
        refuse(f"{what} (byte {at} of the data set)", self._where, "a complete DICOM file", code)


def _known(tag: int) -> bytes:
    """The value representation of the dictionary; UN for private and unknown tags."""
    try:
        return dictionary_VR(tag).split()[0].encode()
    except KeyError:
        return b"UN"


def _shown(tag: int) -> str:
    return f"({tag >> 16:04X},{tag & 0xFFFF:04X})"
