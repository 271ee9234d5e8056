"""Grey pictures from files: PNG, and DICOM of one frame or many, each whole or refused; the size of a pixel in mm.

A picture library shows what is left of a PNG that was cut, and fills the rest with black. So its chunks are checked
first (PNG specification, third edition, chapter 5). A DICOM picture of ultrasound says by its regions what a pixel
measures (PS3.3, C.8.5.5); the one region of tissue is cut out, for its surroundings are text.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from pydicom.dataset import Dataset

from puncture_twin.planning.base.arrays import Pixels
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.files import read_input
from puncture_twin.planning.base.provenance import Input, content_input
from puncture_twin.planning.formats.dicom.dicom_file import items, number, numbers, parse_dicom, text, value, whole
from puncture_twin.planning.formats.dicom.pixels import MAX_SIDE, check_length, pixel_layout, sizes, stored_values
from puncture_twin.planning.formats.dicom.storage import META_START, PLAIN, is_dicom

MAX_BYTES = 1_000_000_000
"""Of one file: 2,000 frames of 800 x 600."""

PNG_START = b"\x89PNG\r\n\x1a\n"
MINMAX = ("Min", "Max")
CENTIMETRES, TISSUE_2D = 3, 1
"""Codes of a region's unit and format."""

SAME_SIZE = 1e-3
"""Sizes of a pixel that differ by a smaller fraction are one: headers keep four digits."""


class GreyFrames(NamedTuple):
    """The pictures of one file."""

    grey: NDArray[np.uint8]
    """Shape (frames, rows, columns)."""
    pixel_mm: tuple[float, float] | None
    """Width and height of a pixel, where the file says it."""
    source: Input


def read_frames(path: Path) -> GreyFrames:
    """The pictures of a PNG or DICOM file; which of both it is, its first bytes say.

    Raises:
        InputError: It is neither, cut short, in colour or of more than 8 bits, or contradicts itself.
    """
    content = read_input(path, max_bytes=MAX_BYTES, where=str(path))
    source = content_input("picture", path.name, content)
    if is_dicom(content[:META_START]):
        return GreyFrames(*_dicom_frames(parse_dicom(content, path), str(path)), source)
    return GreyFrames(parse_png(content, path)[None], None, source)


def parse_png(content: bytes, path: Path) -> Pixels:
    """The grey picture of a PNG that has been read, shape (rows, columns).

    Raises:
        InputError: It is no whole PNG of one grey channel with 8 bits.
    """
    _check_chunks(content, path)
    width, height, depth, colour = struct.unpack(">LLBB", content[16:26])
    if max(width, height) > MAX_SIDE or (depth, colour) != (8, 0):
        what = f"is no picture of one grey channel with 8 bits, or larger than {MAX_SIDE} pixels"
        refuse(what, path, "a PNG of 8-bit grey", "not_grey")
    grey = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    if grey is None:
        refuse("damaged: its pixels cannot be decoded", path, "a PNG of 8-bit grey", "file_damaged")
    return np.asarray(grey, dtype=np.uint8)


def png_bytes(grey: Pixels) -> bytes:
    """A picture as PNG, lossless."""
    return bytes(cv2.imencode(".png", grey)[1].tobytes())


def _check_chunks(content: bytes, path: Path) -> None:
    """Every chunk has its length and its checksum, up to the last one."""
    allowed = "a whole PNG of 8-bit grey, or DICOM"
    if not content.startswith(PNG_START):
        refuse("is neither PNG nor DICOM", path, allowed, "wrong_format")
    at, kind, data = len(PNG_START), b"", b""
    while kind != b"IEND":
        head = content[at : at + 8]
        length = struct.unpack(">L", head[:4])[0] if len(head) == 8 else len(content)
        kind, end = head[4:], at + 12 + length
        if end > len(content):
            refuse(f"cut short: it ends at byte {len(content)} within a chunk", path, allowed, "file_cut")
        if zlib.crc32(content[at + 4 : end - 4]) != struct.unpack(">L", content[end - 4 : end])[0]:
            refuse(f"damaged: the checksum of the chunk at byte {at} is another", path, allowed, "file_damaged")
        data += content[at + 8 : end - 4] if kind == b"IDAT" else b""
        at = end
    unpacker = zlib.decompressobj()
    try:
        for begin in range(0, len(data), 1 << 16):
            unpacker.decompress(data[begin : begin + (1 << 16)])
    except zlib.error:
        refuse("damaged: its pixels cannot be unpacked", path, allowed, "file_damaged")
    if not unpacker.eof:
        refuse("cut short: its pixels have no end", path, allowed, "file_cut")


def _dicom_frames(data: Dataset, where: str) -> tuple[NDArray[np.uint8], tuple[float, float] | None]:
    """All frames, cut to the region of tissue where one is named, and the size of a pixel."""
    cells, region = _cells(data, where), _region(data, where)
    spacing, size = None, None
    if value(data, "PixelSpacing", where=where) is not None:
        down, along = numbers(data, "PixelSpacing", 2, where=where)
        spacing = (along, down)
    if region is not None:
        cells, size = _cut_out(cells, region, where)
    if spacing is not None and size is not None and not np.allclose(spacing, size, rtol=SAME_SIZE):
        what = f"PixelSpacing {spacing[0]:g} x {spacing[1]:g} mm, but its region {size[0]:g} x {size[1]:g} mm"
        refuse(what, where, "one size of a pixel", "pixel_size")
    if not (cells == cells[..., :1]).all():
        refuse("is in colour", where, "grey pictures", "not_grey")
    return np.ascontiguousarray(cells[..., 0]), size or spacing


def _cut_out(cells: NDArray[np.uint8], region: Dataset, where: str) -> tuple[NDArray[np.uint8], tuple[float, float]]:
    """The region of all frames (frames, rows, columns, channels), and the size of its pixel, mm."""
    rows, columns = cells.shape[1:3]
    x0, x1 = (
        whole(region, f"RegionLocation{key}X{i}", low=0, high=columns - 1, where=where) for i, key in enumerate(MINMAX)
    )
    y0, y1 = (
        whole(region, f"RegionLocation{key}Y{i}", low=0, high=rows - 1, where=where) for i, key in enumerate(MINMAX)
    )
    if x1 <= x0 or y1 <= y0:
        refuse(f"a region from {x0}, {y0} to {x1}, {y1}", where, "a region with an area", "bad_tag")
    width, height = (10.0 * number(region, f"PhysicalDelta{axis}", where=where) for axis in "XY")
    return cells[:, y0 : y1 + 1, x0 : x1 + 1], (width, height)


def _region(data: Dataset, where: str) -> Dataset | None:
    """The one region that shows a slice of tissue in cm; None where no region is named."""
    regions = items(data, "SequenceOfUltrasoundRegions", where=where)

    def is_slice(one: Dataset) -> bool:
        keys = ("RegionSpatialFormat", "PhysicalUnitsXDirection", "PhysicalUnitsYDirection")
        return [whole(one, key, low=0, high=1 << 16, where=where) for key in keys] == [TISSUE_2D, *[CENTIMETRES] * 2]

    slices = [one for one in regions if is_slice(one)]
    if regions and len(slices) != 1:
        refuse(f"{len(slices)} regions of tissue in cm", where, "one region", "unsupported_feature")
    return slices[0] if slices else None


def _cells(data: Dataset, where: str) -> NDArray[np.uint8]:
    """All frames, shape (frames, rows, columns, channels)."""
    if text(data, "PhotometricInterpretation", where=where) != "RGB":
        layout = pixel_layout(data, where)
        if layout.signed or layout.stored != 8 or layout.allocated != 8:
            refuse(f"greys of {layout.stored} bits", where, "8 bits without sign", "not_grey")
        return np.asarray(stored_values(data, layout, where), dtype=np.uint8)[..., None]
    rows, columns, frames = sizes(data, where)
    keys = ("SamplesPerPixel", "BitsAllocated", "BitsStored", "PlanarConfiguration")
    samples, allocated, stored, planar = (whole(data, key, low=0, high=64, where=where) for key in keys)
    if (samples, allocated, stored) != (3, 8, 8) or data.file_meta.TransferSyntaxUID not in PLAIN:
        refuse("RGB that is compressed or not 3 x 8 bits", where, "RGB without compression", "unsupported_feature")
    check_length(data, 3 * frames * rows * columns, where)
    shape = (frames, 3, rows, columns) if planar else (frames, rows, columns, 3)
    cells = np.frombuffer(data.PixelData, np.uint8, int(np.prod(shape))).reshape(shape)
    return np.moveaxis(cells, 1, -1) if planar else cells
