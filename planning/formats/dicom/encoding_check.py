"""Whether the bytes of a DICOM data set are whole: every element inside its parent, every sequence closed, in order.

The library that reads values takes what is left of an element that was cut short, and keeps the last of two elements of
one tag. A contour or a frame would be lost without a word; so the nesting is checked first (DICOM PS3.5, chapter 7).
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import NoReturn

from pydicom.datadict import dictionary_VR

from puncture_twin.planning.base.errors import InputError

UNDEFINED = 0xFFFFFFFF
ITEM, ITEM_END, SEQUENCE_END = 0xFFFEE000, 0xFFFEE00D, 0xFFFEE0DD
PIXEL_DATA = 0x7FE00010
LONG_FORM = frozenset((b"OB", b"OD", b"OF", b"OL", b"OV", b"OW", b"SQ", b"SV", b"UC", b"UN", b"UR", b"UT", b"UV"))
"""Value representations whose length has four bytes."""
SHORT_FORM = frozenset(
    b"AE AS AT CS DA DS DT FD FL IS LO LT PN SH SL SS ST TM UI UL US".split(),
)
MAX_DEPTH = 16
"""Sequences in sequences; structured reports go deeper, images and contours do not reach half of it."""
MAX_ELEMENTS = 3_000_000
"""In one file: a multi-frame image of 10,000 slices has a tenth of it."""


def whole_length(data: memoryview, *, implicit: bool, where: Path) -> int:
    """Bytes of a data set without the zeros that some programs write behind it.

    Args:
        data: The data set, behind its file's meta information, little endian.
        implicit: Whether value representations are left out.
        where: The file, for the message.

    Raises:
        InputError: An element that ends outside of its parent, a sequence without an end, elements out of order, or
            more of them than any image has.
    """
    return _Walk(data, where).data_set(0, len(data), implicit=implicit, depth=0, closed=False)


class _Walk:
    """One pass over a data set."""

    def __init__(self, data: memoryview, where: Path) -> None:
        self._data = data
        self._where = where
        self._count = 0

    def data_set(self, at: int, end: int, *, implicit: bool, depth: int, closed: bool) -> int:
        """Offset at which a data set ends that begins at an offset.

        Args:
            at: Its first byte.
            end: The first byte behind it, or behind all that may hold it.
            implicit: Whether value representations are left out.
            depth: How many sequences it lies in.
            closed: Whether a delimiter ends it, and not its length.
        """
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
                self._refuse(f"element {_shown(tag)} stands behind {_shown(last)}", at)
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
            self._refuse(f"cut short: element {_shown(tag)} promises {length} bytes, and {end - at} are left", at)
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
            self._refuse("cut short within an element's head", at)
        return kind, at + 12, struct.unpack_from("<L", self._data, at + 8)[0]

    def _items(self, at: int, end: int, *, implicit: bool, depth: int, closed: bool) -> int:
        """Offset at which the items of a sequence end."""
        while closed or at < end:
            tag, length = self._tag(at, end), struct.unpack_from("<L", self._data, at + 4)[0]
            if closed and tag == SEQUENCE_END:
                return at + 8
            if tag != ITEM:
                self._refuse(f"element {_shown(tag)} in the place of a sequence's item", at)
            if length == UNDEFINED:
                at = self.data_set(at + 8, end, implicit=implicit, depth=depth, closed=True)
                continue
            if at + 8 + length > end:
                self._refuse("cut short within a sequence's item", at)
            at = self.data_set(at + 8, at + 8 + length, implicit=implicit, depth=depth, closed=False)
        return at

    def _fragments(self, at: int, end: int) -> int:
        """Offset at which compressed pixels end."""
        while True:
            tag, length = self._tag(at, end), struct.unpack_from("<L", self._data, at + 4)[0]
            if tag == SEQUENCE_END:
                return at + 8
            if tag != ITEM or at + 8 + length > end:
                self._refuse("cut short within the compressed pixels", at)
            at += 8 + length

    def _tag(self, at: int, end: int) -> int:
        self._count += 1
        if self._count > MAX_ELEMENTS:
            self._refuse(f"more than {MAX_ELEMENTS} elements", at)
        if at + 8 > end:
            self._refuse("cut short: it ends within an element", at)
        group, element = struct.unpack_from("<HH", self._data, at)
        return int(group << 16 | element)

    def _refuse(self, what: str, at: int) -> NoReturn:
        raise InputError(f"{what} (byte {at} of the data set)", where=self._where, allowed="a complete DICOM file")


def _known(tag: int) -> bytes:
    """The value representation of the dictionary; UN for private and unknown tags."""
    try:
        return dictionary_VR(tag).split()[0].encode()
    except KeyError:
        return b"UN"


def _shown(tag: int) -> str:
    return f"({tag >> 16:04X},{tag & 0xFFFF:04X})"
