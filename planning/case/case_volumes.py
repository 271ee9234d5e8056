"""The volumes that a case names: each is read once with all of its files, and kept as the source that they make."""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.provenance import InputFiles
from puncture_twin.planning.case.tables.structures_section import StructuresSection
from puncture_twin.planning.formats.dicom.storage import is_series
from puncture_twin.planning.formats.labels.slicer_segments import SEGMENT_ENDING, parse_segments
from puncture_twin.planning.formats.volumes.volume_files import MAX_FILE_BYTES, data_file
from puncture_twin.planning.formats.volumes.volume_source import VolumeFile, VolumeSource

if TYPE_CHECKING:  # the library behind them is loaded where a case names DICOM
    from puncture_twin.planning.formats.dicom.ct_series import CtSeries
    from puncture_twin.planning.formats.dicom.named_masks import NamedMasks

VOLUME_ROLES = ("labelmap", "ct")
"""What a volume is to a case; a file that it needs beside it is its ``data``."""


class CaseVolumes:
    """The CT and the label maps of a case.

    Args:
        files: Reads and hashes the files.
        path: The case file, to whose folder names are relative.
    """

    def __init__(self, files: InputFiles, path: Path) -> None:
        self._files = files
        self._path = path
        self._sources: dict[str, VolumeSource] = {}
        self._series: dict[str, CtSeries] = {}
        self._masks: dict[str, NamedMasks] = {}

    def read(self, role: str, name: str, *, key: str) -> None:
        """Read every file of a volume; those that hold its voxels decide as much as its header.

        Args:
            role: One of ``VOLUME_ROLES``.
            name: As the case states it.
            key: Of the case, for errors.

        Raises:
            InputError: A file that is missing, too large or not readable, or a header that is damaged.
        """
        path = self._path.parent / name
        if role == "ct" and is_series(path):
            self._sources[name] = self._series[name] = self._read_series(path, name, key)
            return
        content = self._files.read(role, name, max_bytes=MAX_FILE_BYTES, key=key, where=self._path)
        beside = data_file(content, path)
        names = (name,) if beside is None else (name, str(PurePosixPath(name).with_name(beside)))
        for data in names[1:]:
            self._files.read(f"{role} data", data, max_bytes=MAX_FILE_BYTES, key=key, where=self._path)
        self._sources[name] = VolumeFile(path, names, self._files.content)

    def source(self, name: str) -> VolumeSource:
        """The volume of this name."""
        return self._sources[name]

    def read_masks(self, section: StructuresSection, case_ct: str | None) -> None:
        """The structures of a SEG (DICOM, or Slicer's .seg.nrrd) or RTSTRUCT whose file has been read, and its CT.

        Other sections have none.

        Args:
            section: Names the file, and the CT series on which it was drawn where that is not the case's.
            case_ct: The CT of the case, or None.

        Raises:
            InputError: Structures that cannot be trusted, or that were drawn in other coordinates.
        """
        name = section.seg or section.rtstruct
        if name is None:
            return
        if section.seg is not None and name.lower().endswith(SEGMENT_ENDING):
            self._add_masks(name, parse_segments(self._path.parent / name, name, self._files.content))
            return
        from puncture_twin.planning.formats.dicom.named_masks import check_frame_of_reference
        from puncture_twin.planning.formats.dicom.segmentation import parse_segmentation
        from puncture_twin.planning.formats.dicom.structure_set import parse_structure_set

        series, shown = self._series.get(section.ct or case_ct or ""), self._series.get(case_ct or "")
        path = self._path.parent / name
        if series is not None and shown is not None:
            check_frame_of_reference(series.frame_of_reference, shown, series.path)
        if section.rtstruct is None:
            found = parse_segmentation(path, name, self._files.content, series)
        elif series is None:
            what = f"rtstruct '{name}' needs the CT on which it was drawn, as a DICOM series"
            raise InputError(what, where=self._path, allowed='ct = "FOLDER" beside it, or as the CT of the case')
        else:
            found = parse_structure_set(path, name, self._files.content, series)
        self._add_masks(name, found)

    def _add_masks(self, name: str, found: NamedMasks) -> None:
        self._masks[name] = found
        self._sources |= {_key(name, called): mask for called, mask in found.masks.items()}

    def masks(self, name: str) -> dict[str, str]:
        """The structures of such a file: each one's name to that of its volume; none of another file."""
        return {called: _key(name, called) for called in self._masks[name].masks} if name in self._masks else {}

    def mask_notes(self, name: str) -> tuple[str, ...]:
        """What to tell of the structures of such a file."""
        return self._masks[name].notes if name in self._masks else ()

    def _read_series(self, path: Path, name: str, key: str) -> CtSeries:
        """A folder of slices, or the series of one: every slice is a file that decides."""
        from puncture_twin.planning.formats.dicom.ct_series import parse_series
        from puncture_twin.planning.formats.dicom.recognise import choose_series

        chosen = choose_series(path)
        folder = PurePosixPath(name) if chosen.folder == path else PurePosixPath(name).parent
        files = [str(folder / file) for file in chosen.names]
        for file in files:
            self._files.read("ct", file, max_bytes=MAX_FILE_BYTES, key=key, where=self._path)
        return parse_series(path, files, self._files.content, chosen.notes)


def _key(file: str, called: str) -> str:
    """The name of one structure's volume."""
    return f"{file}#{called}"
