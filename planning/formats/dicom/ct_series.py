"""A CT series as a volume in Hounsfield units and LPS mm."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.files import read_input
from puncture_twin.planning.formats.dicom.dicom_file import parse_dicom, text
from puncture_twin.planning.formats.dicom.pixels import PixelLayout, pixel_layout, stored_values
from puncture_twin.planning.formats.dicom.recognise import choose_series, described
from puncture_twin.planning.formats.dicom.slices import (
    Slice,
    Stack,
    StraightGrid,
    moved,
    slices_of,
    stack_of,
    straight_grid,
)
from puncture_twin.planning.formats.volumes.volume_files import MAX_FILE_BYTES, Content, Volume
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid, check_affine, check_shape

LOSSY = "{} files have lossy compression, so their values are not exact"
CLASS_IN_META = "{} files state no SOP class; the one in their meta information was used"
SCOUTS = "{} frames are scouts (by their type) and were left out"
UNMEASURED_HU = -2000.0
"""Written where the scanner did not measure: far below air, so that nothing takes it for air or body."""


@dataclass(frozen=True, eq=False)
class _Series:
    """Facts of the headers of all files together."""

    stack: Stack
    grid: StraightGrid
    layouts: dict[str, PixelLayout]
    series_uid: str
    frame_of_reference: str
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class CtSeries:
    """A CT series in one folder. Its headers are read once, its pixels at each call of `volume`."""

    path: Path
    files: tuple[str, ...]  # every file of the series, by its key in ``content``
    content: Content
    aside: tuple[str, ...] = ()
    part: tuple[str, ...] = ()

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on what was left out, and what was done to the slices."""
        notes = list(self.aside)
        if (tilt := self._series.grid.tilt_deg) > 0:
            notes.append(
                f"{self.path.name}: scanned with the gantry tilted by {tilt:.1f} degrees; its slices were moved to "
                "a rectangular grid, and the part that they do not cover counts as not scanned"
            )
        return (*notes, *self._series.notes)

    @property
    def frame_of_reference(self) -> str:
        """The UID of the coordinates in which it lies; empty where it is not stated."""
        return self._series.frame_of_reference

    @property
    def series_uid(self) -> str:
        """The UID of the series."""
        return self._series.series_uid

    @property
    def stack(self) -> Stack:
        """The slices as they were scanned."""
        return self._series.stack

    @property
    def slice_shape(self) -> tuple[int, int]:
        """Columns and rows of a slice as it was scanned."""
        layout = next(iter(self._series.layouts.values()))
        return layout.columns, layout.rows

    @cached_property
    def grid(self) -> VolumeGrid:
        """Grid of `volume`'s voxels, LPS mm. Raises InputError: headers that make no volume, or no trusted one."""
        straight = self._series.grid
        shape = check_shape(straight.shape, where=self.path)
        return VolumeGrid(shape, check_affine(straight.T_ct_index, where=self.path), {})

    def volume(self) -> Volume:
        """The voxels in HU, single precision; ``UNMEASURED_HU`` where unmeasured. Raises InputError: damaged."""
        grid, series = self.grid, self._series
        values = np.empty(grid.shape, np.float32, order="F")
        places: dict[str, list[int]] = {}
        for number, one in enumerate(series.stack.slices):
            places.setdefault(one.file, []).append(number)
        for file, numbers in places.items():
            layout = series.layouts[file]
            frames = stored_values(parse_dicom(self.content(file), Path(file)), layout, file)
            for number in numbers:
                one = series.stack.slices[number]
                stored = frames[one.frame]
                scaled = stored.astype(np.float64) * one.slope + one.intercept
                if layout.padding is not None:
                    low, high = layout.padding
                    scaled[(stored >= low) & (stored <= high)] = np.nan
                image = np.asarray(scaled.T, np.float32)
                values[:, :, number] = _filled(moved(image, series.grid.shifts[number], grid.shape[:2]))
        return Volume(values, grid.T_ct_index, self.path)

    @cached_property
    def _series(self) -> _Series:
        every: list[Slice] = []
        layouts: dict[str, PixelLayout] = {}
        stated = set()
        counts = Counter[str]()
        for file in self.files:
            data = parse_dicom(self.content(file), Path(file))
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
            series, frames = (len({one[at] for one in stated}) for at in (0, 1))
            what = f"files of {series} series and {frames} frames of reference"
            refuse(what, self.path, "one of each", "several_series")
        ((series_uid, frame_of_reference),) = stated
        stack = stack_of(every, self.path)
        rows, columns = _one_size(layouts, self.path)
        grid = straight_grid(stack, rows, columns, self.path)
        notes = tuple(f"{self.path.name}: {note.format(count)}" for note, count in counts.items() if count)
        return _Series(stack, grid, layouts, series_uid, frame_of_reference, notes)


def _filled(image: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.where(np.isnan(image), np.float32(UNMEASURED_HU), image)


def _one_size(layouts: dict[str, PixelLayout], path: Path) -> tuple[int, int]:
    first, size = "", (0, 0)
    for file, layout in layouts.items():
        if first and (layout.rows, layout.columns) != size:
            what = f"{first} has {size[0]} x {size[1]} pixels, {file} has {layout.rows} x {layout.columns}"
            refuse(what, path, "slices of the same size", "mixed_geometry")
        first, size = file, (layout.rows, layout.columns)
    return size


def parse_series(path: Path, files: Sequence[str], content: Content, aside: tuple[str, ...] = ()) -> CtSeries:
    """A series whose headers have been checked."""
    series = CtSeries(path, tuple(files), content, aside)
    _ = series.grid
    return series


def read_series(path: Path) -> Volume:
    """The CT of a folder with one series, or of a file's series in it. Raises InputError: anything wrong with it."""
    chosen = choose_series(path)

    def content(name: str) -> bytes:
        return read_input(chosen.folder / name, max_bytes=MAX_FILE_BYTES, where=str(chosen.folder / name))

    return parse_series(path, chosen.names, content, chosen.notes).volume()
