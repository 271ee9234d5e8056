"""What a folder holds for a case: CT, segmentations and lists of markers, told by content."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np

from puncture_twin.planning.anatomy.surfaces import VolumeSurfaces
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.files import is_folder, is_plain_file
from puncture_twin.planning.formats.dicom.recognise import list_folder
from puncture_twin.planning.formats.dicom.storage import Kind
from puncture_twin.planning.formats.labels.labelmaps import labelmap_of
from puncture_twin.planning.formats.labels.mask_folder import MASK_ENDINGS, UNREAD, UNREAD_VOLUMES
from puncture_twin.planning.formats.labels.slicer_segments import SEGMENT_ENDING
from puncture_twin.planning.formats.points.point_files import NamedPoints, read_points
from puncture_twin.planning.formats.volumes.nrrd_header import is_layered
from puncture_twin.planning.formats.volumes.volume_files import NIFTI_ENDINGS, NRRD_ENDINGS, Volume
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.planning.geometry.units import Unit
from puncture_twin.planning.init.file_masks import dicom_masks, layered_masks
from puncture_twin.planning.init.label_files import Mask, Masks, label_file, mask_of
from puncture_twin.planning.init.mesh_folder import is_mesh, mesh_folder
from puncture_twin.planning.init.segmentation import Place, Segmentation

DEPTH = 2
"""Levels of folders below the one that is given."""
AIR_HU = -200
"""A CT of a body shows something less dense than fat: air or lung."""
MOST_LABELS = 1000
"""A map with more different labels is an image."""
DRAWN = (Kind.SEGMENTATION, Kind.STRUCTURE_SET)
POINT_ENDINGS = (".csv", ".mrk.json", ".fcsv")
MOST_ENTRIES = 5_000
"""Files and folders of a patient's folder; more are a disk, or a DICOM archive."""
LEAST_MARKERS = 3
"""Fewer register nothing."""
MANIFEST = "manifest.json"
"""A folder that holds it was written by this program."""


@dataclass(frozen=True)
class Wanted:
    """What the user says of the files.

    Attributes:
        space: Of meshes, and of lists that do not say theirs.
        naming: Of label maps without names.
        unit: Of meshes.
        ct: The CT, where there are several.
        segmentation: The label map or folder, where there are several.
    """

    space: Space
    naming: str | None = None
    unit: Unit | None = None
    ct: str | None = None
    segmentation: str | None = None

    def takes(self, kind: str, name: str) -> bool:
        """Whether a file may be the CT (``ct``), or a segmentation (``labels``)."""
        stated = self.ct if kind == "ct" else self.segmentation
        return stated is None or name == stated or name.startswith(f"{stated.rstrip('/')}/")


@dataclass(frozen=True, eq=False)
class Ct:
    """A CT, with the surfaces that are found in it."""

    source: str
    surfaces: VolumeSurfaces


@dataclass(frozen=True, eq=False)
class Markers:
    """A list of named points."""

    source: str
    points: NamedPoints


@dataclass(eq=False)
class Found:
    """What a folder holds.

    Attributes:
        cts: CTs.
        segmentations: Label maps, masks, meshes.
        markers: Lists of at least three points.
        problems: What could not be read or told, one line each.
        notes: What is neither.
        drawn: DICOM files of structures, which are read once the CT is known.
    """

    cts: list[Ct] = field(default_factory=list)
    segmentations: list[Segmentation] = field(default_factory=list)
    markers: list[Markers] = field(default_factory=list)
    problems: list[InputError] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    drawn: list[tuple[str, Kind]] = field(default_factory=list)


def find(place: Place, wanted: Wanted) -> Found:
    """Look through a folder and the folders below it, `DEPTH` levels deep.

    Args:
        place: The case's folder.
        wanted: What the user says of the files.

    Raises:
        InputError: A folder that cannot be read, or is no patient's.
    """
    found = Found()
    for folder, files in _folders(place.folder, DEPTH):
        _Looker(place, wanted, folder, files, found).look()
    ct = found.cts[0].surfaces.source if found.cts else None
    for name, kind in found.drawn:
        try:
            found.segmentations.append(dicom_masks(place, name, kind, ct))
        except InputError as error:
            found.problems.append(error)
    return found


def _folders(folder: Path, depth: int) -> Iterator[tuple[Path, list[Path]]]:
    """A folder with its files, and those below it, but for hidden ones and this program's outputs."""
    entries = _entries(folder)
    yield folder, [one for one in entries if is_plain_file(one)]
    if depth > 0:
        for one in entries:
            if is_folder(one) and not is_plain_file(one / MANIFEST):
                yield from _folders(one, depth - 1)


def _entries(folder: Path) -> list[Path]:
    """What lies in a folder, sorted, but for hidden files.

    Raises:
        InputError: It cannot be read, or holds too much.
    """
    allowed = f"a readable folder of one patient, with up to {MOST_ENTRIES} files"
    try:
        found = sorted(one for one in folder.iterdir() if not one.name.startswith("."))
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=folder, allowed=allowed) from error
    if len(found) > MOST_ENTRIES:
        raise InputError(f"holds {len(found)} files", where=folder, allowed=allowed)
    return found


class _Looker:
    """Asks each kind's recogniser about one folder."""

    def __init__(self, place: Place, wanted: Wanted, folder: Path, files: Sequence[Path], found: Found) -> None:
        self._place = place
        self._wanted = wanted
        self._found = found
        self._folder = folder
        self._source = folder.relative_to(place.folder).as_posix()
        self._names = [one.relative_to(place.folder).as_posix() for one in files]

    def look(self) -> None:
        """DICOM, volumes, meshes, points."""
        self._dicom()
        labels = [name for name in self._names if self._wanted.takes("labels", name)]
        unread = [name for name in labels if name.lower().endswith(UNREAD_VOLUMES)]
        self._found.problems += [InputError(UNREAD, where=self._place.folder / name, allowed="") for name in unread]
        self._volumes([name for name in self._names if name.lower().endswith(NIFTI_ENDINGS + NRRD_ENDINGS)])
        self._meshes([name for name in labels if is_mesh(name)])
        for name in self._names:
            if name.lower().endswith(POINT_ENDINGS):
                self._points(name)

    def _dicom(self) -> None:
        """Each CT series of the folder: it is named by the folder, or where there are several by a file of each."""
        try:
            files = list_folder(self._folder)
            series = {one.series_uid: one.name for one in reversed(files) if one.is_slice}
            names = {uid: (PurePosixPath(self._source) / file).as_posix() for uid, file in series.items()}
            for name in sorted(names.values()) if len(names) > 1 else [self._source][: len(names)]:
                if self._wanted.takes("ct", name):
                    self._found.cts.append(Ct(name, self._place.volume(name)))
        except InputError as error:
            self._found.problems.append(error)
            return
        for one in files:
            name = (PurePosixPath(self._source) / one.name).as_posix()
            if one.kind in DRAWN and self._wanted.takes("labels", name):
                self._found.drawn.append((name, one.kind))
        others = Counter(one.sop_class for one in files if one.kind not in {Kind.CT, *DRAWN})
        for kind, count in sorted(others.items()):
            self._found.notes.append(f"{self._source}: {count} {kind} left out")

    def _volumes(self, names: Sequence[str]) -> None:
        """CTs and label maps one by one; masks together, as a folder of masks where it holds nothing else."""
        masks: list[Mask] = []
        empty: list[str] = []
        for name in names:
            try:
                self._volume(name, masks, empty)
            except InputError as error:
                self._found.problems.append(error)
        if not masks:
            return
        alone = len(masks) + len(empty) == len(names) and all(one.lower().endswith(MASK_ENDINGS) for one in names)
        numbered = dict(enumerate(masks, start=1))
        said = () if alone or not empty else (f"empty masks, so that nothing is there: {', '.join(empty)}",)
        self._found.segmentations.append(Masks(self._place, self._source, numbered, said, alone))

    def _volume(self, name: str, masks: list[Mask], empty: list[str]) -> None:
        if not any(self._wanted.takes(kind, name) for kind in ("ct", "labels")):
            return
        if name.lower().endswith(SEGMENT_ENDING) and is_layered(self._place.content(name), self._place.folder / name):
            if self._wanted.takes("labels", name):
                self._found.segmentations.append(layered_masks(self._place, name))
            return
        surfaces = self._place.volume(name)
        kind = volume_kind(surfaces.volume)
        if kind != "other" and not self._wanted.takes(kind, name):
            return
        if kind == "ct":
            self._found.cts.append(Ct(name, surfaces))
        elif kind == "labels" and surfaces.names is None and self._wanted.naming is None:
            labels = labelmap_of(surfaces.volume, may_be_empty=True)
            if len(labels.boxes) > 1:
                self._label_file(name, surfaces)
            elif (mask := mask_of(name, labels)) is not None:
                masks.append(mask)
            else:
                empty.append(name.rpartition("/")[2])
        elif kind == "labels":
            self._label_file(name, surfaces)
        else:
            self._refuse_spoiled_mask(surfaces.volume, name)
            self._found.notes.append(f"{name}: neither a CT in Hounsfield units nor labels; left out")

    def _refuse_spoiled_mask(self, volume: Volume, name: str) -> None:
        """A probability, or a mask with -1 or without background: an organ that would be left out."""
        low, high = float(volume.values.min()), float(volume.values.max())
        if low >= -1 and high <= 1 and self._wanted.takes("labels", name):
            what = f"values from {low:.3g} to {high:.3g} are neither a mask nor a CT"
            raise InputError(what, where=self._place.folder / name, allowed="0 and one other whole number in a mask")

    def _label_file(self, name: str, surfaces: VolumeSurfaces) -> None:
        self._found.segmentations.append(label_file(self._place, name, surfaces, self._wanted.naming))

    def _meshes(self, names: Sequence[str]) -> None:
        if not names:
            return
        try:
            found = mesh_folder(self._place, self._source, names, self._wanted.space, self._wanted.unit)
            self._found.segmentations.append(found)
        except InputError as error:
            self._found.problems.append(error)

    def _points(self, name: str) -> None:
        """Other tables are no lists of points, and no problem."""
        try:
            points = read_points(self._place.folder / name, default_space=self._wanted.space, default_unit=Unit.MM)
        except InputError:
            return
        if len(points.names) >= LEAST_MARKERS:
            self._found.markers.append(Markers(name, points))


def volume_kind(volume: Volume) -> str:
    """What a volume shows: ``ct`` (Hounsfield units), ``labels`` (few whole numbers from 0 on), or ``other``."""
    values = volume.values
    low, high = float(values.min()), float(values.max())
    if low <= AIR_HU:
        return "ct" if high > 0 else "other"
    if low < 0 or high > np.iinfo(np.uint16).max:
        return "other"
    whole = values.astype(np.uint16)
    if values.dtype.kind == "f" and not np.array_equal(whole, values):
        return "other"
    counts = np.bincount(whole.ravel(order="K"))
    return "labels" if counts[0] > 0 and np.count_nonzero(counts) <= MOST_LABELS else "other"
