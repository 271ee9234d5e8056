"""A volume before its voxels are decoded: which files it is made of, where it lies, and how to get the voxels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol

from puncture_twin.planning.formats.volumes.volume_files import Volume, parse_header, parse_volume
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid, VolumeHeader

Content = Callable[[str], bytes]
"""The bytes of a file by its name: those that were hashed, each time."""


class VolumeSource(Protocol):
    """A volume in one file, in two, or in a folder of slices.

    Attributes:
        path: What was named.
        files: Every file that decides a voxel or its place, as the content is wanted it.
        part: Which part of these files it is, where they hold several volumes.
        notes: What a person should be told of how it was read, one sentence each.
        grid: Where the voxels lie, LPS mm.
    """

    @property
    def path(self) -> Path: ...  # noqa: D102  the class says it
    @property
    def files(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def part(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def notes(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def grid(self) -> VolumeGrid: ...  # noqa: D102

    def volume(self) -> Volume:
        """The volume with its voxels, which are decoded at each call."""


@dataclass(frozen=True)
class VolumeFile:
    """A volume in one file, or in a header and a file of voxels beside it.

    Attributes:
        path: What was named.
        files: That file, and the one beside it.
        content: Gives the bytes of both.
    """

    path: Path
    files: tuple[str, ...]
    content: Content
    part: tuple[str, ...] = ()

    @cached_property
    def grid(self) -> VolumeHeader:
        """Where the voxels lie, LPS mm, as the checked header states it."""
        return parse_header(self.content(self.files[0]), self.path)

    @property
    def notes(self) -> tuple[str, ...]:
        """What a person should be told of how the header was read."""
        return self.grid.notes

    def volume(self) -> Volume:
        """The volume with its voxels."""
        header, *data = (self.content(name) for name in self.files)
        return parse_volume(header, self.path, data[0] if data else None)
