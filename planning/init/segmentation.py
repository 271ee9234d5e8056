"""What every kind of segmentation answers, whatever file or folder it comes from: the seam of the finder."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import NamedTuple, Protocol

from puncture_twin.planning.anatomy.default_roles import DefaultRole
from puncture_twin.planning.anatomy.surfaces import VolumeSurfaces
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import Cache
from puncture_twin.planning.base.input_file import read_input
from puncture_twin.planning.base.progress import Names, unnamed
from puncture_twin.planning.formats.dicom.choose_series import choose_series
from puncture_twin.planning.formats.dicom.ct_series import parse_series
from puncture_twin.planning.formats.dicom.storage import is_series
from puncture_twin.planning.formats.volumes.volume_files import MAX_FILE_BYTES, data_file
from puncture_twin.planning.formats.volumes.volume_source import Content, VolumeFile
from puncture_twin.planning.geometry.mesh import TriangleMesh

HOLDS_TARGET = "it holds the target too, and its name is not known as that of an organ that a needle crosses"
"""Why a structure is unknown."""


class Assigned(NamedTuple):
    """What the case says of one structure.

    Attributes:
        label: Its number within the segmentation.
        name: Its name.
        kind: ``target``, ``avoid``, ``unknown``, ``traverse``, ``ignore`` or ``skin``.
        margin_mm: The clearance that it demands.
        line: Of the table of default roles.
    """

    label: int
    name: str
    kind: str
    margin_mm: float
    line: DefaultRole


class Segmentation(Protocol):
    """Structures of one file or folder.

    Attributes:
        source: The file or folder, relative to the case's.
        names: Label to name, of the structures that are there.
        notes: What a person should be told, one sentence each.
        voxel_ct: Shape (3, 3), the edges of its voxels as columns, mm; None of meshes.
    """

    @property
    def source(self) -> str: ...  # noqa: D102  the class says it
    @property
    def names(self) -> Mapping[int, str]: ...  # noqa: D102
    @property
    def notes(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def voxel_ct(self) -> Floats | None: ...  # noqa: D102

    def near(self, point_ct: Floats) -> tuple[int, ...]:
        """The labels whose box holds a point (3,), LPS mm."""

    def surface(self, label: int) -> TriangleMesh:
        """The surface of one structure, LPS mm."""

    def section(self, rows: Sequence[Assigned]) -> str:
        """The part of the case file that names all of its structures."""


@dataclass(frozen=True)
class Place:
    """The folder of the case, where surfaces are kept, and who is told the name of each file that is read."""

    folder: Path
    cache: Cache
    progress: Names = unnamed

    def volume(self, name: str) -> VolumeSurfaces:
        """A volume file of the folder, or a DICOM series.

        Raises:
            InputError: It cannot be read.
        """
        read = self.content
        if is_series(self.folder / name):
            return self._series(name, read)
        content = read(name)
        beside = data_file(content, self.folder / name)
        names = (name,) if beside is None else (name, str(PurePosixPath(name).with_name(beside)))
        hashes = [hashlib.sha256(content).hexdigest(), *(hashlib.sha256(read(one)).hexdigest() for one in names[1:])]
        source = VolumeFile(self.folder / name, names, read)
        return VolumeSurfaces(source, (*hashes, *source.part), self.cache)

    def content(self, name: str) -> bytes:
        """The bytes of a file of the folder."""
        self.progress(name)
        return read_input(self.folder / name, max_bytes=MAX_FILE_BYTES, where=str(self.folder / name))

    def _series(self, name: str, read: Content) -> VolumeSurfaces:
        """A folder with one series, or the series of one file."""
        path = self.folder / name
        chosen = choose_series(path)
        inside = PurePosixPath(name) if chosen.folder == path else PurePosixPath(name).parent
        files = [str(inside / file) for file in chosen.names]
        hashes = tuple(hashlib.sha256(read(file)).hexdigest() for file in files)
        return VolumeSurfaces(parse_series(path, files, read, chosen.notes), hashes, self.cache)


def quoted(text: str) -> str:
    """A text as TOML writes it."""
    return json.dumps(text, ensure_ascii=False)


def margin_line(row: Assigned) -> str:
    """The margin of a ``[[structure]]`` with its reason; empty where it demands none."""
    if row.kind not in {"avoid", "unknown"}:
        return ""
    change = f'# {HOLDS_TARGET}: role = "traverse", without a margin, if a path may cross it\n'
    reason = f"margin_mm = {row.margin_mm:g}  # {row.line.group}: {row.line.reason}\n"
    return reason + (change if row.kind == "unknown" else "")


def rules_text(rows: Sequence[Assigned]) -> str:
    """The lists and the table of a ``[[structures]]``: each structure by its own name, with the reason of its line."""
    parts = []
    for kind in ("target", "traverse", "ignore"):
        names = [row.name for row in rows if row.kind == kind]
        if names:
            parts.append(f"{kind} = [\n" + "".join(f"    {quoted(name)},\n" for name in names) + "]\n")
    for kind, head in (("avoid", ""), ("unknown", f"# {HOLDS_TARGET}: into traverse = [...] if a path may cross it\n")):
        demanding = [row for row in rows if row.kind == kind]
        if demanding:
            parts.append(f"\n[structures.{kind}]  # margins, mm\n{head}{_grouped(demanding)}")
    return "".join(parts)


def _grouped(rows: Sequence[Assigned]) -> str:
    """The rows of each line of the table below its reason, in the order of the rows."""
    lines = dict.fromkeys(row.line for row in rows)
    parts = []
    for line in lines:
        parts.append(f"# {line.group}: {line.reason}\n")
        parts += [f"{quoted(row.name)} = {row.margin_mm:g}\n" for row in rows if row.line == line]
    return "".join(parts)
