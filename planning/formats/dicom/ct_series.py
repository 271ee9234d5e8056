"""A CT series as a volume in Hounsfield units and LPS mm."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.files import read_input
from puncture_twin.planning.formats.dicom.dicom_file import parse_dicom, text
from puncture_twin.planning.formats.dicom.pixels import PixelLayout, pixel_layout, stored_values
from puncture_twin.planning.formats.dicom.recognise import choose_series, described
from puncture_twin.planning.formats.dicom.slices import Slice, Stack, moved, slices_of, stack_of, straight_grid
from puncture_twin.planning.formats.volumes.volume_files import MAX_FILE_BYTES, Content, Volume
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid, check_affine, check_shape

LOSSY = "{} files have lossy compression, so their values are not exact"
CLASS_IN_META = "{} files state no SOP class; the one in their meta information was used"
SCOUTS = "{} frames are scouts (by their type) and were left out"
TILTED = (
    "scanned with the gantry tilted by {:.1f} degrees; its slices were moved to a rectangular grid, and the part that "
    "they do not cover counts as not scanned"
)
UNMEASURED_HU = -2000.0
"""Value where the scanner did not measure: far below air, so that nothing takes it for air or body."""


@dataclass(frozen=True, eq=False)
class CtSeries:
    """A CT series in one folder. Its headers were read once, its pixels are read at each call of `volume`."""

    path: Path
    files: tuple[str, ...]  # every file of the series, by its key in ``content``
    content: Content
    notes: tuple[str, ...]  # what was left out, and what was done to the slices
    frame_of_reference: str  # the UID of the coordinates in which it lies; empty where it is not stated
    stack: Stack  # the slices as they were scanned
    layouts: dict[str, PixelLayout]  # of each file
    slice_shape: tuple[int, int]  # columns and rows of a slice as it was scanned
    shifts: Floats  # shape (n, 2), where pixel (0, 0) of each slice lies in the grid, in pixels
    grid: VolumeGrid  # of `volume`'s voxels, LPS mm
    part: tuple[str, ...] = ()

    def volume(self) -> Volume:
        """The voxels in HU, single precision; ``UNMEASURED_HU`` where unmeasured. Raises InputError: damaged."""
        values = np.empty(self.grid.shape, np.float32, order="F")
        places: dict[str, list[int]] = {}
        for number, one in enumerate(self.stack.slices):
            places.setdefault(one.file, []).append(number)
        for file, numbers in places.items():
            layout = self.layouts[file]
            frames = stored_values(parse_dicom(self.content(file), Path(file)), layout, file)
            for number in numbers:
                one = self.stack.slices[number]
                stored = frames[one.frame]
                scaled = stored.astype(np.float64) * one.slope + one.intercept
                if layout.padding is not None:
                    low, high = layout.padding
                    scaled[(stored >= low) & (stored <= high)] = np.nan
                image = moved(np.asarray(scaled.T, np.float32), self.shifts[number], self.grid.shape[:2])
                values[:, :, number] = np.where(np.isnan(image), np.float32(UNMEASURED_HU), image)
        return Volume(values, self.grid.T_ct_index, self.path)


def parse_series(path: Path, files: Sequence[str], content: Content, aside: tuple[str, ...] = ()) -> CtSeries:
    """A series whose headers have been checked; ``aside``: notes. Raises InputError: no volume, or no trusted one."""
    every: list[Slice] = []
    layouts: dict[str, PixelLayout] = {}
    stated, counts = set[tuple[str, str]](), Counter[str]()
    for file in files:
        data = parse_dicom(content(file), Path(file))
        header = described(data, Path(file))
        if not header.is_slice:
            refuse(f"{header.sop_class}, not a CT slice", file, "an unchanged file", "not_a_ct")
        stated.add((header.series_uid, header.frame_of_reference))
        layouts[file] = pixel_layout(data, file)
        own = slices_of(data, file, layouts[file].frames)
        every += own
        counts[LOSSY] += text(data, "LossyImageCompression", where=file) == "01"
        counts[CLASS_IN_META] += not text(data, "SOPClassUID", where=file)
        counts[SCOUTS] += layouts[file].frames - len(own)
    if len(stated) != 1:
        series, references = (len({one[at] for one in stated}) for at in (0, 1))
        refuse(f"files of {series} series and {references} frames of reference", path, "one of each", "several_series")
    ((_, frame),) = stated
    stack = stack_of(every, path)
    rows, columns = _one_size(layouts, path)
    straight = straight_grid(stack, rows, columns, path)
    notes = [f"{path.name}: {note.format(count)}" for note, count in counts.items() if count]
    if straight.tilt_deg > 0:
        notes.insert(0, f"{path.name}: {TILTED.format(straight.tilt_deg)}")
    grid = VolumeGrid(check_shape(straight.shape, where=path), check_affine(straight.T_ct_index, where=path), {})
    size, shifts = (columns, rows), straight.shifts
    return CtSeries(path, tuple(files), content, (*aside, *notes), frame, stack, layouts, size, shifts, grid)


def _one_size(layouts: dict[str, PixelLayout], path: Path) -> tuple[int, int]:
    """Rows and columns of every file."""
    for (first, one), (file, other) in pairwise(layouts.items()):
        if (other.rows, other.columns) != (one.rows, one.columns):
            what = f"{first} has {one.rows} x {one.columns} pixels, {file} has {other.rows} x {other.columns}"
            refuse(what, path, "slices of the same size", "mixed_geometry")
    last = next(reversed(layouts.values()))
    return last.rows, last.columns


def read_series(path: Path) -> Volume:
    """The CT of a folder with one series, or of a file's series in it. Raises InputError: anything wrong with it."""
    chosen = choose_series(path)

    def content(name: str) -> bytes:
        return read_input(chosen.folder / name, max_bytes=MAX_FILE_BYTES, where=str(chosen.folder / name))

    return parse_series(path, chosen.names, content, chosen.notes).volume()
