"""The bytes of a DICOM file to its data set, once its magic, its transfer syntax and its wholeness are checked."""

from __future__ import annotations

import io
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.filereader import read_dataset
from pydicom.tag import BaseTag
from pydicom.uid import UID

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.formats.dicom.encoding_check import whole_length
from puncture_twin.planning.formats.dicom.storage import BIG_ENDIAN, DEFLATED, IMPLICIT, META_START, is_dicom

MAX_INFLATED_BYTES = 1 << 26
"""Of one deflated file: two slices of the largest size, or 128 of the usual one; a bomb ends here."""
ALLOWED = "a complete DICOM file"


@contextmanager
def refused_if_damaged(where: str | Path) -> Iterator[None]:
    """Turn whatever the library raises for damaged values into one error, and keep its warnings off the terminal.

    Raises:
        InputError: The library could not read the file.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except InputError:
        raise
    except Exception as error:  # the library promises no kind of error for bytes that are damaged
        what = f"damaged ({type(error).__name__}: {str(error)[:200]})"
        raise InputError(what.encode("ascii", "replace").decode(), where=where, allowed=ALLOWED) from error


def parse_dicom(content: bytes, path: Path) -> Dataset:
    """The data set of a file that has been read, with its ``file_meta``.

    Args:
        content: The whole file.
        path: Its name, for messages.

    Raises:
        InputError: No DICOM, damaged, cut short, inflating to too much, or big endian.
    """
    if not is_dicom(content[:META_START]):
        raise InputError("no DICOM file: DICM does not stand at byte 128", where=path, allowed=ALLOWED)
    with refused_if_damaged(path):
        stream = io.BytesIO(content)
        meta = read_meta(stream)
        syntax = UID(meta.TransferSyntaxUID)
        body = _body(memoryview(content)[stream.tell() :], syntax, path)
        implicit = syntax == IMPLICIT
        length = whole_length(body, implicit=implicit, where=path)
        found = read_dataset(io.BytesIO(body[:length]), implicit, True)
        found.file_meta = meta
        return found


def read_meta(stream: BinaryIO) -> FileMetaDataset:
    """The meta information of a DICOM file, whose data set begins where the stream then is; its syntax may be empty."""
    stream.seek(META_START)
    meta = FileMetaDataset(read_dataset(stream, False, True, stop_when=_behind_meta))
    meta.TransferSyntaxUID = UID(str(meta.get("TransferSyntaxUID", "")).strip(" \0"))
    return meta


def _behind_meta(tag: BaseTag, vr: str | None, length: int) -> bool:
    return tag.group != 2


def _body(data: memoryview, syntax: UID, path: Path) -> memoryview:
    """The data set's own bytes, inflated where they are deflated."""
    if not syntax:
        raise InputError("its meta information names no transfer syntax", where=path, allowed=ALLOWED)
    if syntax == BIG_ENDIAN:
        raise InputError(f"transfer syntax {syntax.name} ({syntax})", where=path, allowed=how_to_convert())
    if syntax != DEFLATED:
        return data
    inflater = zlib.decompressobj(-zlib.MAX_WBITS)
    inflated = inflater.decompress(data, MAX_INFLATED_BYTES)
    if not inflater.eof:
        more = len(inflated) >= MAX_INFLATED_BYTES
        what = (
            f"inflates to more than {MAX_INFLATED_BYTES} bytes" if more else "cut short: its deflated data do not end"
        )
        raise InputError(what, where=path, allowed=ALLOWED)
    return memoryview(inflated)


def how_to_convert() -> str:
    """What to do with a file in a transfer syntax that is not read."""
    return "Explicit VR Little Endian; convert it with 'gdcmconv --raw IN OUT' or 'dcmdjpeg IN OUT'"
