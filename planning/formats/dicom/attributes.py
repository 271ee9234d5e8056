"""Values of a DICOM data set as plain numbers and texts; what is missing or of another type is named."""

from __future__ import annotations

import math
from typing import Any

from pydicom.datadict import tag_for_keyword
from pydicom.dataset import Dataset
from pydicom.multival import MultiValue

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.formats.dicom.dicom_file import refused_if_damaged

MAX_TEXT = 200
"""Characters of a name or a description; standard types hold 64."""


def value(data: Dataset, keyword: str, *, where: str) -> Any:
    """The value of an element; None where it is absent or empty."""
    with refused_if_damaged(where):
        found = data[keyword].value if keyword in data else None
    return None if found is None or found == "" else found


def has(data: Dataset, keyword: str) -> bool:
    """Whether an element is there, empty or not."""
    return keyword in data


def numbers(data: Dataset, keyword: str, count: int, *, where: str) -> tuple[float, ...]:
    """So many finite numbers.

    Raises:
        InputError: Missing, of another count, or not finite.
    """
    found = value(data, keyword, where=where)
    listed = list(found) if isinstance(found, MultiValue | list | tuple) else [] if found is None else [found]
    with refused_if_damaged(f"{where}: {keyword}"):
        plain = tuple(float(one) for one in listed)
    if len(plain) != count or not all(map(math.isfinite, plain)):
        what = f"{name(keyword)} is missing" if found is None else f"{name(keyword)} is {str(found)[:100]}"
        raise InputError(what, where=where, allowed=f"{count} finite number{'s' if count > 1 else ''}")
    return plain


def number(data: Dataset, keyword: str, *, where: str) -> float:
    """One finite number; see `numbers`."""
    return numbers(data, keyword, 1, where=where)[0]


def whole(data: Dataset, keyword: str, *, low: int, high: int, where: str) -> int:
    """One whole number between two others.

    Raises:
        InputError: Missing, not whole or out of range.
    """
    found = number(data, keyword, where=where)
    if found != int(found) or not low <= found <= high:
        raise InputError(f"{name(keyword)} is {found:g}", where=where, allowed=f"a whole number from {low} to {high}")
    return int(found)


def text(data: Dataset, keyword: str, *, where: str) -> str:
    """A text without the spaces around it, the empty one where there is none; unprintable characters become ``?``."""
    found = value(data, keyword, where=where)
    plain = "" if found is None else str(found).strip(" \0")[:MAX_TEXT]
    return "".join(letter if letter.isprintable() else "?" for letter in plain)


def texts(data: Dataset, keyword: str, *, where: str) -> tuple[str, ...]:
    """Texts, none where the element is absent."""
    found = value(data, keyword, where=where)
    listed = list(found) if isinstance(found, MultiValue | list | tuple) else [] if found is None else [found]
    return tuple(str(one).strip() for one in listed)


def items(data: Dataset, keyword: str, *, where: str) -> list[Dataset]:
    """The items of a sequence, none where it is absent.

    Raises:
        InputError: It is no sequence.
    """
    found = value(data, keyword, where=where)
    if found is None:
        return []
    with refused_if_damaged(where):
        listed = list(found)
    if not all(isinstance(one, Dataset) for one in listed):
        raise InputError(f"{name(keyword)} is no sequence", where=where, allowed="a sequence of items")
    return listed


def name(keyword: str) -> str:
    """A keyword with its tag, as people look it up."""
    tag = tag_for_keyword(keyword) or 0
    return f"{keyword} ({tag >> 16:04X},{tag & 0xFFFF:04X})"
