"""Grey pictures from files: PNG, and DICOM of one frame or many, each whole or refused; the size of a pixel in mm.

A picture library shows what is left of a PNG that was cut, and fills the rest with black. So its chunks are checked
first (PNG specification, third edition, chapter 5). A DICOM picture of ultrasound says by its regions what a pixel
measures (PS3.3, C.8.5.5); the one region of tissue is cut out, for its surroundings are text. Colour is what machines
store greys in; what is coloured within the region (flow, rulers) is no tissue, and made known.
"""

import struct
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from pydicom.dataset import Dataset

from puncture_twin.planning.base.arrays import Pixels
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.files import read_input
from puncture_twin.planning.base.provenance import Input, content_input
from puncture_twin.planning.formats.dicom.dicom_file import items, number, numbers, parse_dicom, text, value, whole
from puncture_twin.planning.formats.dicom.pixels import MAX_SIDE, check_length, decoded_frames, pixel_layout, sizes
from puncture_twin.planning.formats.dicom.storage import META_START, is_dicom

MAX_BYTES = 1_000_000_000
"""Most bytes of a file: 2,000 frames of 800 x 600."""

PNG_START = b"\x89PNG\r\n\x1a\n"
TWO_D, TISSUE, CENTIMETRES = 1, 1, 3
"""Codes of a region's format, content and unit: a box of colour flow lies within one of tissue."""

COLOURS = ("RGB", "YBR_FULL", "YBR_FULL_422", "YBR_ICT", "YBR_RCT")
LUMINANCE = (0.299, 0.587, 0.114)

NEARLY_GREY = 24
"""Greatest difference between a grey pixel's channels: JPEG keeps brightness and colour apart, and rounds both."""

MOST_COLOURED = 0.5  # fraction of coloured pixels above which colour is no drawing on a grey picture
SAME_SIZE = 1e-3
"""Sizes of a pixel that differ by a smaller fraction are one: headers keep four digits."""


class GreyFrames(NamedTuple):
    """The pictures of one file."""

    grey: NDArray[np.uint8]
    """Shape (frames, rows, columns)."""
    coloured: NDArray[np.bool_] | None
    """Pixels in which something coloured was drawn, of the same shape; None where there are none."""
    pixel_mm: tuple[float, float] | None
    """Width and height of a pixel, where the file says it."""
    source: Input


def read_frames(path: Path) -> GreyFrames:
    """The pictures of a whole PNG or DICOM file, grey and of 8 bits; which of both it is, its first bytes say."""
    content = read_input(path, max_bytes=MAX_BYTES, where=str(path))
    source = content_input("picture", path.name, content)
    if is_dicom(content[:META_START]):
        return GreyFrames(*_dicom_frames(parse_dicom(content, path), str(path)), source)
    return GreyFrames(parse_png(content, path)[None], None, None, source)


def parse_png(content: bytes, path: Path) -> Pixels:
    """The grey picture of a PNG that has been read, shape (rows, columns): whole, and of one channel of 8 bits."""
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


def _dicom_frames(
    data: Dataset, where: str
) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None, tuple[float, float] | None]:
    """All frames, cut to the region of tissue where one is named, their coloured pixels, and the size of a pixel."""
    count, box, region_size = _layout(data, where)
    spacing = None
    if value(data, "PixelSpacing", where=where) is not None:
        down, along = numbers(data, "PixelSpacing", 2, where=where)
        spacing = (along, down)
    if spacing is not None and region_size is not None and not np.allclose(spacing, region_size, rtol=SAME_SIZE):
        (across, down), (width, height) = spacing, region_size
        what = f"PixelSpacing {across:g} x {down:g} mm, but its region {width:g} x {height:g} mm"
        refuse(what, where, "one size of a pixel", "pixel_size")
    frames = [_grey(cells[box]) for cells in decoded_frames(data, where, raw=False)]
    grey = np.stack([one[0] for one in frames]) if frames else np.zeros((0, 1, 1), np.uint8)
    coloured = np.stack([one[1] for one in frames]) if frames else np.zeros((0, 1, 1), bool)
    if len(grey) != count or grey.dtype != np.uint8:
        refuse(f"{len(grey)} frames of {grey.dtype}", where, f"{count} of 8 bits, as in its header", "size_mismatch")
    if coloured.mean() > MOST_COLOURED:
        what = f"is in colour: {100 * coloured.mean():.0f} % of its pixels"
        refuse(what, where, "grey pictures; coloured drawings on them, but no colour map of the tissue", "not_grey")
    return grey, coloured if coloured.any() else None, region_size or spacing


def _grey(cells: NDArray[Any]) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """A frame's luminance (ITU-R BT.601), and which pixels are in colour; those get the median of all others."""
    if cells.ndim == 2:
        return cells, np.zeros(cells.shape, bool)
    coloured = np.ptp(cells, axis=2) > NEARLY_GREY
    grey = np.round(cells @ LUMINANCE).astype(cells.dtype)
    if coloured.any() and not coloured.all():
        grey[coloured] = np.median(grey[~coloured])
    return grey, coloured


def _layout(data: Dataset, where: str) -> tuple[int, tuple[slice, slice], tuple[float, float] | None]:
    """Number of frames, rows and columns of the region of tissue, and its pixel, of an image of 8 bits a sample."""
    rows, columns, frames = sizes(data, where)
    if rows * columns * frames > MAX_BYTES:
        what = f"{frames} frames of {columns} x {rows} pixels"
        refuse(what, where, f"at most {MAX_BYTES:,} pixels a file", "file_size")
    meaning = text(data, "PhotometricInterpretation", where=where)
    if meaning in COLOURS:
        keys = ("SamplesPerPixel", "BitsAllocated", "BitsStored")
        bits = tuple(whole(data, key, low=0, high=64, where=where) for key in keys)
        check_length(data, frames * rows * columns * (2 if meaning == "YBR_FULL_422" else 3), where)
    else:
        layout = pixel_layout(data, where)
        bits = (3 * (not layout.signed), layout.allocated, layout.stored)
    if bits != (3, 8, 8):
        refuse(f"samples of {bits[2]} bits", where, "8 bits without sign, 3 a coloured pixel", "not_grey")
    regions = items(data, "SequenceOfUltrasoundRegions", where=where)

    def is_slice(one: Dataset) -> bool:
        """Whether a region shows a slice of tissue in cm."""
        keys = ("RegionSpatialFormat", "RegionDataType", "PhysicalUnitsXDirection", "PhysicalUnitsYDirection")
        codes = [whole(one, key, low=0, high=1 << 16, where=where) for key in keys]
        return codes == [TWO_D, TISSUE, CENTIMETRES, CENTIMETRES]

    slices = [one for one in regions if is_slice(one)]
    if not regions:
        return frames, (slice(None), slice(None)), None
    if len(slices) != 1:
        refuse(f"{len(slices)} regions of tissue in cm", where, "one region", "unsupported_feature")
    (region,) = slices
    x0, x1, y0, y1 = (
        whole(region, f"RegionLocation{key}{axis}{i}", low=0, high=most - 1, where=where)
        for axis, most in (("X", columns), ("Y", rows))
        for i, key in enumerate(("Min", "Max"))
    )
    if x1 <= x0 or y1 <= y0:
        refuse(f"a region from {x0}, {y0} to {x1}, {y1}", where, "a region with an area", "bad_tag")
    width, height = (10.0 * number(region, f"PhysicalDelta{axis}", where=where) for axis in "XY")
    return frames, (slice(y0, y1 + 1), slice(x0, x1 + 1)), (width, height)
