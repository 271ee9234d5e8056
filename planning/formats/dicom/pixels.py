"""Stored values of a DICOM image: as many bits as its header says, no more and no fewer bytes."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydicom.dataset import Dataset
from pydicom.pixels.decoders.base import Decoder, get_decoder
from pydicom.uid import UID

from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.formats.dicom import dicom_file
from puncture_twin.planning.formats.dicom.dicom_file import name, refuse_syntax, refused_if_damaged, value, whole
from puncture_twin.planning.formats.dicom.storage import PLAIN

MAX_SIDE = 4096
"""Most pixels along a row or a column: twice the finest scanner's."""
MAX_FRAMES = 20_000
"""Most frames of a file."""


@dataclass(frozen=True)
class PixelLayout:
    """Storage of an image's values."""

    frames: int  # images in the file
    rows: int
    columns: int
    allocated: int  # bits of a cell
    stored: int  # of them, the bits of a value: the lowest
    signed: bool  # whether values are two's complements
    # stored values, lowest and highest, that were not measured; None where the header names none
    padding: tuple[int, int] | None


def pixel_layout(data: Dataset, where: str) -> PixelLayout:
    """Storage of an image's values. Raises InputError: colours, an unusual layout, no pixels, or too few or many."""
    if (meaning := dicom_file.text(data, "PhotometricInterpretation", where=where)) != "MONOCHROME2":
        what = f"{name('PhotometricInterpretation')} is {meaning or 'missing'}"
        refuse(what, where, "MONOCHROME2", "unsupported_feature")
    whole(data, "SamplesPerPixel", low=1, high=1, where=where)
    allocated = whole(data, "BitsAllocated", low=8, high=32, where=where)
    if allocated % 8 or allocated == 24:
        refuse(f"{name('BitsAllocated')} is {allocated}", where, "8, 16 or 32", "unsupported_feature")
    stored = whole(data, "BitsStored", low=1, high=allocated, where=where)
    whole(data, "HighBit", low=stored - 1, high=stored - 1, where=where)
    signed = bool(whole(data, "PixelRepresentation", low=0, high=1, where=where))
    rows, columns, frames = sizes(data, where)
    layout = PixelLayout(frames, rows, columns, allocated, stored, signed, _padding(data, stored, signed, where))
    check_length(data, frames * rows * columns * allocated // 8, where)
    return layout


def sizes(data: Dataset, where: str) -> tuple[int, int, int]:
    """Rows, columns and frames of an image. Raises InputError: missing or implausible."""
    rows, columns = (whole(data, keyword, low=1, high=MAX_SIDE, where=where) for keyword in ("Rows", "Columns"))
    several = "NumberOfFrames" in data
    return (rows, columns, whole(data, "NumberOfFrames", low=1, high=MAX_FRAMES, where=where) if several else 1)


def check_length(data: Dataset, promised: int, where: str) -> None:
    """Refuse plain pixels of another length than their header promises, but for one byte where that is odd."""
    pixels = value(data, "PixelData", where=where)
    if not isinstance(pixels, bytes):
        refuse(f"{name('PixelData')} is missing", where, "an image with pixels", "missing_tag")
    if data.file_meta.TransferSyntaxUID in PLAIN and len(pixels) != promised + promised % 2:
        what = f"{name('PixelData')} has {len(pixels)} bytes, but the header states {promised}"
        refuse(what, where, "a complete file", "size_mismatch")


def stored_values(data: Dataset, layout: PixelLayout, where: str) -> NDArray[Any]:
    """Stored values (frames, rows, columns), without bits above them. Raises InputError: no decoder, or damaged."""
    shape = (layout.frames, layout.rows, layout.columns)
    if data.file_meta.TransferSyntaxUID in PLAIN:
        cells = np.frombuffer(data.PixelData, f"<u{layout.allocated // 8}", int(np.prod(shape)))
    else:
        cells = np.concatenate([one.ravel() for one in decoded_frames(data, where, raw=True)])
    if cells.size != np.prod(shape) or cells.dtype.itemsize * 8 != layout.allocated:
        what = f"the compressed pixels hold {cells.size} values of {cells.dtype}, but the header states {shape}"
        refuse(what, where, "a complete file", "size_mismatch")
    above = layout.allocated - layout.stored
    typed = cells.reshape(shape).view(f"{'i' if layout.signed else 'u'}{layout.allocated // 8}")
    return typed if above == 0 else (typed << above) >> above


def decoded_frames(data: Dataset, where: str, *, raw: bool) -> Iterator[NDArray[Any]]:
    """The frames one by one, each of shape (rows, columns) or (rows, columns, samples), plain or compressed.

    ``raw``: stored values as they are; else luminance and chrominance become RGB. Raises InputError: no decoder for the
    transfer syntax, or damaged pixels.
    """
    syntax = data.file_meta.TransferSyntaxUID
    decoder = _decoder(syntax, where)
    frames: Iterator[tuple[NDArray[Any], object]]
    if syntax in PLAIN:  # one by one: the library's own loop takes frames behind the first of YBR_FULL_422 for longer
        frames = (decoder.as_array(data, raw=raw, index=k) for k in range(sizes(data, where)[2]))
    else:
        # Every installation has Pillow; GDCM prints what a damaged JPEG has on the terminal.
        quiet = "pillow" if not raw and "pillow" in decoder.available_plugins else ""
        frames = decoder.iter_array(data, raw=raw, decoding_plugin=quiet)
    while True:
        with refused_if_damaged(where):
            try:
                frame = next(frames, None)
            except Exception as error:  # the decoders promise no kind of error
                what = f"transfer syntax {syntax.name} ({syntax}): its pixels cannot be decoded ({str(error)[:150]})"
                raise InputError(what, where=where, allowed=dicom_file.HOW_TO_CONVERT, code="not_decoded") from error
        if frame is None:
            return
        yield np.ascontiguousarray(frame[0])


def _decoder(syntax: UID, where: str) -> Decoder:
    """The decoder of a transfer syntax, one that is installed."""
    with refused_if_damaged(where):
        if not syntax.is_transfer_syntax or not (syntax.is_compressed or syntax in PLAIN):
            refuse_syntax(syntax, where)
        try:
            decoder = get_decoder(syntax)
        except NotImplementedError:
            refuse_syntax(syntax, where)
        if not decoder.is_available:
            what = f"transfer syntax {syntax.name} ({syntax}) needs a decoder that is not installed"
            refuse(what, where, f"{dicom_file.HOW_TO_CONVERT}; or pip install python-gdcm", "no_decoder")
        return decoder


def _padding(data: Dataset, stored: int, signed: bool, where: str) -> tuple[int, int] | None:
    """The range of stored values that mean "not measured"."""
    if value(data, "PixelPaddingValue", where=where) is None:
        return None
    stated = [dicom_file.number(data, "PixelPaddingValue", where=where)]
    if value(data, "PixelPaddingRangeLimit", where=where) is not None:
        stated.append(dicom_file.number(data, "PixelPaddingRangeLimit", where=where))
    # As so many bits hold them: writers state a padding with the sign of another type.
    ends = [int(end) % (1 << stored) for end in stated]
    plain = [end - (1 << stored) if signed and end >= 1 << (stored - 1) else end for end in ends]
    return min(plain), max(plain)
