"""What every kind of segmentation answers, whatever file or folder it comes from: the seam of the finder."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, Protocol

from puncture_twin.planning.anatomy.default_roles import NOT_ANNOTATED, DefaultRole
from puncture_twin.planning.anatomy.skin import Skin
from puncture_twin.planning.anatomy.surfaces import VolumeSurfaces
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import Cache
from puncture_twin.planning.base.progress import Names, unnamed
from puncture_twin.planning.base.provenance import InputFiles
from puncture_twin.planning.case.named_files import CaseVolumes
from puncture_twin.planning.formats.volumes.volume_files import MAX_FILE_BYTES
from puncture_twin.planning.geometry.mesh import TriangleMesh

CASE_FILE = "case.toml"
"""What the new case will be called."""

STATED = DefaultRole("stated", (), "unknown", 0.0, "stated to init")
"""Of a role that a person states."""

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

    def skin(self, label: int) -> Skin:
        """One structure as the skin of the body, with what the image cut.

        Raises:
            InputError: It cannot be one.
        """

    def section(self, rows: Sequence[Assigned]) -> str:
        """The part of the case file that names all of its structures."""


@dataclass(frozen=True)
class Place:
    """The folder of the case, where surfaces are kept, and who is told the name of each file that is read."""

    folder: Path
    cache: Cache
    progress: Names = unnamed
    files: InputFiles = field(init=False)
    volumes: CaseVolumes = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "files", InputFiles(self.folder))
        object.__setattr__(self, "volumes", CaseVolumes(self.files, self.folder / CASE_FILE))

    def volume(self, name: str) -> VolumeSurfaces:
        """A volume file of the folder, or a DICOM series.

        Raises:
            InputError: It cannot be read.
        """
        self.progress(name)
        self.volumes.read("ct", name, key=name)
        return self.surfaces(name)

    def content(self, name: str) -> bytes:
        """The bytes of a file of the folder."""
        self.progress(name)
        return self.files.read("file", name, max_bytes=MAX_FILE_BYTES, key=name, where=self.folder / CASE_FILE)

    def surfaces(self, name: str) -> VolumeSurfaces:
        """The surfaces of a volume that was read, or of one structure of a file of structures."""
        self.files.release()
        source = self.volumes.source(name)
        return VolumeSurfaces(source, (*map(self.files.sha256, source.files), *source.part), self.cache)


def quoted(text: str) -> str:
    """A text as TOML writes it."""
    return json.dumps(text, ensure_ascii=False)


def margin_line(row: Assigned) -> str:
    """The margin of a ``[[structure]]`` with its reason; empty where it demands none."""
    if row.kind not in {"avoid", "unknown"}:
        return ""
    change = f'# {HOLDS_TARGET}: role = "traverse", without a margin, if a path may cross it\n'
    reason = f"margin_mm = {row.margin_mm:g}  # {row.line.group}: {row.line.reason}\n"
    return reason + (change if row.kind == "unknown" and row.line not in {NOT_ANNOTATED, STATED} else "")


def rules_text(rows: Sequence[Assigned]) -> str:
    """The lists and the table of a ``[[structures]]``: each structure by its own name, with the reason of its line.

    The skin is ignored among them: a ``[[structure]]`` of its own, `skin_text`, says what it is.
    """
    parts = []
    for kind in ("target", "traverse", "ignore"):
        names = [row.name for row in rows if row.kind == kind or (row.kind, kind) == ("skin", "ignore")]
        if names:
            parts.append(f"{kind} = [\n" + "".join(f"    {quoted(name)},\n" for name in names) + "]\n")
    for kind, head in (("avoid", ""), ("unknown", f"# {HOLDS_TARGET}: into traverse = [...] if a path may cross it\n")):
        demanding = [row for row in rows if row.kind == kind]
        if demanding:
            head = "" if all(row.line in {NOT_ANNOTATED, STATED} for row in demanding) else head
            parts.append(f"\n[structures.{kind}]  # margins, mm\n{head}{_grouped(demanding)}")
    return "".join(parts)


def skin_text(name: str, file: str, label: int) -> str:
    """The ``[[structure]]`` of a label that is the skin."""
    return f'\n[[structure]]\nname = {quoted(name)}\nlabelmap = {quoted(file)}\nlabel = {label}\nrole = "skin"\n'


def _grouped(rows: Sequence[Assigned]) -> str:
    """The rows of each line of the table below its reason, in the order of the rows."""
    lines = dict.fromkeys(row.line for row in rows)
    parts = []
    for line in lines:
        parts.append(f"# {line.group}: {line.reason}\n")
        parts += [f"{quoted(row.name)} = {row.margin_mm:g}\n" for row in rows if row.line == line]
    return "".join(parts)
