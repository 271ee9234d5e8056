"""The files that a case names, each with its role, key and largest size; its volumes, each read once with its files.

And what a case leaves open: whether it and its lists are whole, by their ends, and where its robot is.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, NamedTuple

from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.files import unfinished_warnings
from puncture_twin.planning.base.provenance import InputFiles
from puncture_twin.planning.case.case_file import CaseFile
from puncture_twin.planning.case.tables import StructuresSection
from puncture_twin.planning.formats import itk_transform, points
from puncture_twin.planning.formats.dicom.storage import is_dicom_file, is_series
from puncture_twin.planning.formats.labels import label_sources, naming
from puncture_twin.planning.formats.labels.label_sources import mask_files, structure_name
from puncture_twin.planning.formats.meshes import mesh_files as meshes
from puncture_twin.planning.formats.volumes import volume_files as volumes
from puncture_twin.planning.formats.volumes.volume_files import MAX_FILE_BYTES, VolumeFile, VolumeSource, data_file

if TYPE_CHECKING:
    from puncture_twin.planning.formats.dicom.ct_series import CtSeries
    from puncture_twin.planning.formats.dicom.named_masks import NamedMasks

MASK_ROLE = "mask "
"""How the role of a mask begins; its structure's name follows."""


class NamedFile(NamedTuple):
    """A file that a case names."""

    role: str
    name: str
    key: str
    max_bytes: int


def read_named_files(content: CaseFile, path: Path, files: InputFiles, case_volumes: CaseVolumes) -> tuple[str, ...]:
    """Read and hash whatever the case names, each file once, what costs little first; what is left open, in sentences.

    Raises InputError: a file is missing, too large, another than its key says, or cut; or one among masks is not read.
    """
    single = list(named_files(content))
    masks = list(_masks(content, path, single))
    for one in single:
        if one.role not in VOLUME_ROLES:
            files.read(one.role, one.name, max_bytes=one.max_bytes, key=one.key, where=path)
    warnings = wholeness_warnings(content, files, path)
    for one in (*single, *masks):
        if one.role in VOLUME_ROLES or one.role.startswith(MASK_ROLE):
            case_volumes.read(one.role, one.name, key=one.key)
    for many in content.structures:
        case_volumes.read_masks(many, content.ct_name)
    return warnings


def named_files(content: CaseFile) -> Iterator[NamedFile]:
    """Every file that a case names, and folders with a CT, in the order of its sections; of folders of masks none."""
    most = volumes.MAX_FILE_BYTES
    rows = list[tuple[str, str | None, str, int]]()
    rows.append(("target", content.target.points, "target.points", points.MAX_FILE_BYTES))
    for one in content.structure:
        key = f"structure '{one.name}'"
        rows.append((f"mesh {one.name}", one.mesh, key, meshes.MAX_FILE_BYTES))
        rows += [("labelmap", one.labelmap, key, most), ("ct", one.ct, key, most)]
    for number, many in enumerate(content.structures, start=1):
        key = f"structures number {number}"
        rows += [(role, getattr(many, role), f"{key}.{role}", most) for role in ("labelmap", "seg", "rtstruct", "ct")]
        if many.naming is not None and naming.is_naming_file(many.naming):
            rows.append(("naming", many.naming, f"{key}.naming", naming.MAX_CSV_BYTES))
    rows.append(("ct", content.ct.file, "ct.file", most))
    for side in ("markers_ct", "markers_base", "transform"):
        file: str | None = getattr(content.registration, side, None)
        largest = itk_transform.most_bytes(file) if file and side == "transform" else points.MAX_FILE_BYTES
        rows.append((side, file, f"registration.{side}", largest))
    rows.append(("truth_base", content.rehearsal.truth_base, "rehearsal.truth_base", points.MAX_FILE_BYTES))
    yield from (NamedFile(role, name, key, most) for role, name, key, most in rows if name is not None)


def _masks(content: CaseFile, path: Path, single: Sequence[NamedFile]) -> Iterator[NamedFile]:
    """Every mask of the folders of masks: also an empty one decides what is there."""

    def place(name: str) -> Path:
        return Path(os.path.normpath(path.parent / name))

    single_files = [*(one.name for one in single), path.name, getattr(content.tool, "mesh", None), content.robot.urdf]
    folders = [many.masks for many in content.structures if many.masks is not None]
    named = {place(name) for name in (*single_files, *folders) if name is not None}
    cts = [place(one.name) for one in single if one.role == "ct"]
    series = {*cts, *(one.parent for one in cts)}

    def known(one: Path) -> bool:
        normal = Path(os.path.normpath(one))
        return normal in named or (normal.parent in series and is_dicom_file(one))

    for number, many in enumerate(content.structures, start=1):
        if many.masks is not None:
            key = f"structures number {number}.masks"
            for file in mask_files(path.parent / many.masks, known, where=f"{path}: {key}"):
                name = str(PurePosixPath(many.masks) / file)
                yield NamedFile(f"{MASK_ROLE}{structure_name(file)}", name, key, volumes.MAX_FILE_BYTES)


VOLUME_ROLES = ("labelmap", "ct")
"""Roles of volumes in a case; a file of voxels beside a header has the role with ``data`` behind it."""


class CaseVolumes:
    """The CT and the label maps of a case, by names relative to the folder of its file."""

    def __init__(self, files: InputFiles, path: Path) -> None:
        self._files, self._path = files, path
        self._sources: dict[str, VolumeSource] = {}
        self._series: dict[str, CtSeries] = {}
        self._masks: dict[str, NamedMasks] = {}

    def read(self, role: str, name: str, *, key: str) -> None:
        """Read every file of a volume: those with its voxels decide too. Raises InputError: unreadable, or damaged."""
        path = self._path.parent / name
        if role == "ct" and is_series(path):
            from puncture_twin.planning.formats.dicom.ct_series import parse_series
            from puncture_twin.planning.formats.dicom.recognise import choose_series

            chosen = choose_series(path)  # a folder of slices, or the series of one: every slice decides
            folder = PurePosixPath(name) if chosen.folder == path else PurePosixPath(name).parent
            files = [str(folder / file) for file in chosen.names]
            for file in files:
                self._files.read("ct", file, max_bytes=MAX_FILE_BYTES, key=key, where=self._path)
            series = parse_series(path, files, self._files.content, chosen.notes)
            self._sources[name] = self._series[name] = series
            return
        content = self._files.read(role, name, max_bytes=MAX_FILE_BYTES, key=key, where=self._path)
        data_name = data_file(content, path)
        names = (name,) if data_name is None else (name, str(PurePosixPath(name).with_name(data_name)))
        for data in names[1:]:
            self._files.read(f"{role} data", data, max_bytes=MAX_FILE_BYTES, key=key, where=self._path)
        self._sources[name] = VolumeFile(path, names, self._files.content)

    def source(self, name: str) -> VolumeSource:
        """The volume of this name."""
        return self._sources[name]

    def series(self, name: str | None) -> CtSeries | None:
        """The DICOM series of this name; None where it is a file of another kind."""
        return self._series.get(name or "")

    def read_masks(self, section: StructuresSection, case_ct: str | None) -> None:
        """Read the structures of a SEG (DICOM, or Slicer's .seg.nrrd) or RTSTRUCT; without one, none.

        They were drawn on the CT series that the section names, or on the case's.
        Raises InputError: they cannot be trusted, or were drawn in other coordinates.
        """
        name = section.seg or section.rtstruct
        if name is None:
            return
        if section.seg is not None and name.lower().endswith(label_sources.SEGMENT_ENDING):
            segments = label_sources.parse_segments(self._path.parent / name, name, self._files.content)
        else:
            segments = self._drawn(section, name, case_ct)
        self._masks[name] = segments
        self._sources |= {_key(name, called): mask for called, mask in segments.masks.items()}

    def _drawn(self, section: StructuresSection, name: str, case_ct: str | None) -> NamedMasks:
        """The structures of a DICOM file."""
        from puncture_twin.planning.formats.dicom.named_masks import check_frame_of_reference
        from puncture_twin.planning.formats.dicom.segmentation import parse_segmentation
        from puncture_twin.planning.formats.dicom.structure_set import parse_structure_set

        series, shown = self._series.get(section.ct or case_ct or ""), self._series.get(case_ct or "")
        path = self._path.parent / name
        if series is not None and shown is not None:
            check_frame_of_reference(series.frame_of_reference, shown, series.path)
        if section.rtstruct is None:
            return parse_segmentation(path, name, self._files.content, series)
        if series is None:
            what = f"rtstruct '{name}' needs the CT on which it was drawn, as a DICOM series"
            refuse(what, self._path, 'ct = "FOLDER" next to it, or as the CT of the case', "rtstruct_without_ct")
        return parse_structure_set(path, name, self._files.content, series)

    def masks(self, name: str) -> dict[str, str]:
        """The structures of such a file: each one's name to that of its volume; none of another file."""
        return {called: _key(name, called) for called in self._masks[name].masks} if name in self._masks else {}

    def mask_notes(self, name: str) -> tuple[str, ...]:
        """Notes on the structures of a file of masks."""
        return self._masks[name].notes if name in self._masks else ()


def _key(file: str, called: str) -> str:
    return f"{file}#{called}"


TOP_COUNT_NOTE = (
    "structures = N is at the top of the case, so a cut after the last structure would go unnoticed; state it in "
    "[end], the file's last table"
)
NOT_LAST_NOTE = "[end] is not the last table of the case: a cut after it would go unnoticed"
_HEADER = re.compile(r"^[ \t]*\[{1,2}[ \t]*([^\[\]\n]+?)[ \t]*\]{1,2}[ \t]*(?:#.*)?$", re.MULTILINE)
"""The header of a table, on a line of its own."""
LINE_FILES = (".csv", ".fcsv")
"""Endings of lists that are read line by line: one that was cut within a number is another number, and looks whole."""


def wholeness_warnings(content: CaseFile, files: InputFiles, path: Path) -> tuple[str, ...]:
    """Sentences on files that may not be whole. Raises InputError: a list whose last line does not end."""
    for name in dict.fromkeys(one.path for one in files.inputs if one.path.lower().endswith(LINE_FILES)):
        for said in unfinished_warnings(files.content(name), name):
            refuse(said, path, "files in which every line ends with a line break", "file_cut")
    if content.end is None:
        return (TOP_COUNT_NOTE,)
    headers = _HEADER.findall(files.content(path.name).decode("utf-8"))
    return () if headers and headers[-1] == "end" else (NOT_LAST_NOTE,)
