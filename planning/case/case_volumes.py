"""The volumes that a case names: each is read once with all of its files, and kept as the source that they make."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

from puncture_twin.planning.base.provenance import InputFiles
from puncture_twin.planning.formats.dicom.choose_series import choose_series, is_series
from puncture_twin.planning.formats.dicom.ct_series import CtSeries, parse_series
from puncture_twin.planning.formats.volumes.volume_files import MAX_FILE_BYTES, data_file
from puncture_twin.planning.formats.volumes.volume_source import VolumeFile, VolumeSource

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
            self._sources[name] = self._series(path, name, key)
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

    def _series(self, path: Path, name: str, key: str) -> CtSeries:
        """A folder of slices, or the series of one: every slice is a file that decides."""
        chosen = choose_series(path)
        folder = PurePosixPath(name) if chosen.folder == path else PurePosixPath(name).parent
        files = [str(folder / file) for file in chosen.names]
        for file in files:
            self._files.read("ct", file, max_bytes=MAX_FILE_BYTES, key=key, where=self._path)
        return parse_series(path, files, self._files.content, chosen.notes)
