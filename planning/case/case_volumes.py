"""The volumes that a case names: each is read once with all of its files, and kept as the source that they make."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

from puncture_twin.planning.base.provenance import InputFiles
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
        content = self._files.read(role, name, max_bytes=MAX_FILE_BYTES, key=key, where=self._path)
        beside = data_file(content, self._path.parent / name)
        names = (name,) if beside is None else (name, str(PurePosixPath(name).with_name(beside)))
        for data in names[1:]:
            self._files.read(f"{role} data", data, max_bytes=MAX_FILE_BYTES, key=key, where=self._path)
        self._sources[name] = VolumeFile(self._path.parent / name, names, self._files.content)

    def source(self, name: str) -> VolumeSource:
        """The volume of this name."""
        return self._sources[name]
