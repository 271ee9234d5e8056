"""The files that a case names: each with its role, the key that names it, and how large it may be."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from puncture_twin.planning.base.provenance import InputFiles
from puncture_twin.planning.case.case_file import CaseFile
from puncture_twin.planning.case.case_volumes import VOLUME_ROLES, CaseVolumes
from puncture_twin.planning.case.tables.structures_section import StructuresSection
from puncture_twin.planning.case.whole_case import wholeness_warnings
from puncture_twin.planning.formats import itk_transform
from puncture_twin.planning.formats.dicom.storage import is_dicom_file
from puncture_twin.planning.formats.labels import naming
from puncture_twin.planning.formats.labels.mask_folder import mask_files, structure_name
from puncture_twin.planning.formats.meshes import mesh_files as meshes
from puncture_twin.planning.formats.points import point_files as points
from puncture_twin.planning.formats.volumes import volume_files as volumes

MASK_ROLE = "mask "
"""How the role of a mask begins; its structure's name follows."""


class NamedFile(NamedTuple):
    """A file that a case names."""

    role: str
    name: str
    key: str
    max_bytes: int


def read_named_files(content: CaseFile, path: Path, files: InputFiles, case_volumes: CaseVolumes) -> tuple[str, ...]:
    """Read and hash whatever the case names, each file once; what costs little first.

    Args:
        content: The case file.
        path: Where it is.
        files: Takes what is read.
        case_volumes: Takes the volumes.

    Returns:
        What is left open about being whole, one sentence each.

    Raises:
        InputError: A file that is missing, too large or not what its key says, or a list that was cut; what lies among
            masks and is not read.
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
    if content.target.points is not None:
        yield NamedFile("target", content.target.points, "target.points", points.MAX_FILE_BYTES)
    for one in content.structure:
        key = f"structure '{one.name}'"
        if one.mesh is not None:
            yield NamedFile(f"mesh {one.name}", one.mesh, key, meshes.MAX_FILE_BYTES)
        if one.labelmap is not None:
            yield NamedFile("labelmap", one.labelmap, key, volumes.MAX_FILE_BYTES)
        if one.ct is not None:
            yield NamedFile("ct", one.ct, key, volumes.MAX_FILE_BYTES)
    for number, many in enumerate(content.structures, start=1):
        yield from _many_files(many, f"structures number {number}")
        if many.naming is not None and naming.is_naming_file(many.naming):
            yield NamedFile("naming", many.naming, f"structures number {number}.naming", naming.MAX_CSV_BYTES)
    if content.ct.file is not None:
        yield NamedFile("ct", content.ct.file, "ct.file", volumes.MAX_FILE_BYTES)
    for side in ("markers_ct", "markers_base", "transform"):
        file = getattr(content.registration, side, None)
        if file is not None:
            most = itk_transform.most_bytes(file) if side == "transform" else points.MAX_FILE_BYTES
            yield NamedFile(side, file, f"registration.{side}", most)
    if content.rehearsal.truth_base is not None:
        yield NamedFile("truth_base", content.rehearsal.truth_base, "rehearsal.truth_base", points.MAX_FILE_BYTES)


def _many_files(many: StructuresSection, key: str) -> Iterator[NamedFile]:
    """A label map, or the file that holds masks."""
    if many.labelmap is not None:
        yield NamedFile("labelmap", many.labelmap, f"{key}.labelmap", volumes.MAX_FILE_BYTES)
    for role in ("seg", "rtstruct"):
        if (file := getattr(many, role)) is not None:
            yield NamedFile(role, file, f"{key}.{role}", volumes.MAX_FILE_BYTES)
    if many.ct is not None:
        yield NamedFile("ct", many.ct, f"{key}.ct", volumes.MAX_FILE_BYTES)


def _masks(content: CaseFile, path: Path, single: Sequence[NamedFile]) -> Iterator[NamedFile]:
    """Every mask of the folders of masks: also an empty one decides what is there."""

    def place(name: str) -> Path:
        return Path(os.path.normpath(path.parent / name))

    beside = [*(one.name for one in single), path.name, getattr(content.tool, "mesh", None), content.robot.urdf]
    folders = [many.masks for many in content.structures if many.masks is not None]
    named = {place(name) for name in (*beside, *folders) if name is not None}
    cts = [place(one.name) for one in single if one.role == "ct"]
    series = {*cts, *(one.parent for one in cts)}

    def known(one: Path) -> bool:
        here = Path(os.path.normpath(one))
        return here in named or (here.parent in series and is_dicom_file(one))

    for number, many in enumerate(content.structures, start=1):
        if many.masks is not None:
            key = f"structures number {number}.masks"
            for file in mask_files(path.parent / many.masks, known, where=f"{path}: {key}"):
                name = str(PurePosixPath(many.masks) / file)
                yield NamedFile(f"{MASK_ROLE}{structure_name(file)}", name, key, volumes.MAX_FILE_BYTES)
