"""The CT, segmentations and lists of markers of a folder, recognised by content."""

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.surfaces import VolumeSurfaces
from puncture_twin.planning.base.arrays import label_counts
from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.formats import folder as folders
from puncture_twin.planning.formats.dicom.recognise import list_folder
from puncture_twin.planning.formats.dicom.storage import Kind
from puncture_twin.planning.formats.folder import FILE, FOLDER, NOT_READ, STRUCTURE_LIKE, Entry, entries, unaccounted
from puncture_twin.planning.formats.labels.label_sources import (
    MASK_ENDINGS,
    SEGMENT_ENDING,
    not_read,
    refuse_same_name,
    structure_name,
)
from puncture_twin.planning.formats.labels.labelmaps import NAME_ENDINGS, labelmap_of, whole_labels
from puncture_twin.planning.formats.meshes.mesh_files import MESH_SUFFIXES
from puncture_twin.planning.formats.points import NamedPoints, read_points
from puncture_twin.planning.formats.volumes.nrrd_header import is_layered
from puncture_twin.planning.formats.volumes.volume_files import NIFTI_ENDINGS, NRRD_ENDINGS, Volume
from puncture_twin.planning.geometry.spaces import Space, Unit, Up
from puncture_twin.planning.init.label_files import Mask, file_masks, is_named_by_table, label_file, mask_of, masks_of
from puncture_twin.planning.init.overrides import Overrides
from puncture_twin.planning.init.segmentation import Place, Segmentation, mesh_folder

DEPTH = 2
"""Levels of folders below the one that is given."""
AIR_HU = -200
"""A CT of a body shows something less dense than fat: air or lung."""
MOST_LABELS, FEW_LABELS = 1000, 20
"""A map with more different labels is an image, and one with fewer is none."""
MANY_PAIRS, LEAST_ALIKE = 1000, 0.5
"""Of so many pairs of neighbours more than half are alike in labels (97 to 99 % where it was tried; in a CT 3 %)."""
MOST_AIR = 200
"""Up to here the most frequent value of an image without Hounsfield units is taken for air that is stored from 0 on."""
OTHER = "other"
LEFT_OUT = "--ignore"
DRAWN = {Kind.SEGMENTATION: "seg", Kind.STRUCTURE_SET: "rtstruct"}
"""DICOM files of structures, and the key of the case for each."""
POINT_ENDINGS = (".csv", ".mrk.json", ".fcsv")
MOST_ENTRIES = 5_000
"""Files and folders of a patient's folder; more are a disk, or a DICOM archive."""
LEAST_MARKERS = 3
"""Least points of a list of markers: fewer register nothing."""


@dataclass(frozen=True)
class Wanted:
    """Statements of the user about the files."""

    space: Space  # of meshes, and of lists that do not say theirs
    naming: str | None = None  # of label maps without names
    unit: Unit | None = None
    ct: str | None = None  # the CT, where there are several
    segmentation: str | None = None  # the label map or folder, where there are several
    up: Up | None = None  # the axis of meshes that is up
    overrides: Overrides = field(default_factory=Overrides)

    def takes(self, kind: str, name: str) -> bool:
        """Whether a file may be the CT (``ct``), or a segmentation (``labels``)."""
        if self.overrides.leaves_out(name):
            return False
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
class Contents:
    """The contents of a folder: CTs, segmentations, markers, and what was not read."""

    cts: list[Ct] = field(default_factory=list)
    segmentations: list[Segmentation] = field(default_factory=list)
    markers: list[Markers] = field(default_factory=list)  # lists of at least three points
    problems: list[InputError] = field(default_factory=list)  # what could not be read or told, one line each
    passed: list[tuple[str, str]] = field(default_factory=list)  # what was not read, with the reason
    # DICOM files of structures, which are read once the CT is known
    drawn: list[tuple[str, Kind]] = field(default_factory=list)


def find(place: Place, wanted: Wanted) -> Contents:
    """Look through a folder and those below it, `DEPTH` deep. Raises InputError: one is unreadable, or no patient's."""
    contents = Contents()
    for folder, listed, entered in _folders(place.folder, DEPTH):
        _Looker(place, wanted, folder, listed, contents).look(entered)
    ct = contents.cts[0].source if contents.cts else None
    for name, kind in contents.drawn:
        try:
            contents.segmentations.append(file_masks(place, name, DRAWN[kind], ct))
        except InputError as error:
            contents.problems.append(error)
    return contents


def _folders(folder: Path, depth: int) -> Iterator[tuple[Path, tuple[Entry, ...], frozenset[str]]]:
    """A folder, what lies in it and which folders in it are entered, and those below it; none passed over."""
    allowed = f"a readable folder of one patient, with up to {MOST_ENTRIES} files"
    listed = entries(folder, most=MOST_ENTRIES, allowed=allowed)
    below = [folder / one.name for one in listed if one.what == FOLDER] if depth > 0 else []
    entered = [one for one in below if not folders.is_passed_over(one)]
    yield folder, listed, frozenset(one.name for one in entered)
    for one in entered:
        yield from _folders(one, depth - 1)


class _Looker:
    """Sorts one folder's files into the contents, by each kind's recogniser."""

    def __init__(self, place: Place, wanted: Wanted, folder: Path, listed: tuple[Entry, ...], into: Contents) -> None:
        self._place, self._wanted, self._into, self._folder, self._listed = place, wanted, into, folder, listed
        self._source = folder.relative_to(place.folder).as_posix()
        self._names = [self._name(one.name) for one in listed if one.what == FILE]
        self._read: set[str] = set()
        self._left_out = [name for one in listed if wanted.overrides.leaves_out(name := self._name(one.name))]
        self._only = ""

    def _name(self, entry: str) -> str:
        return (PurePosixPath(self._source) / entry).as_posix()

    def look(self, entered: Collection[str]) -> None:
        """Sort the folder's DICOM, volumes, meshes and points, and what is none of these."""
        self._dicom()
        volumes = [name for name in self._names if name.lower().endswith(NIFTI_ENDINGS + NRRD_ENDINGS)]
        meshes = [name for name in self._names if name.lower().endswith(MESH_SUFFIXES)]
        named = (self._name(one) for one in entered if not self._hollow(one))
        self._read.update(volumes, meshes, named, self._left_out)
        self._into.passed += [(name, LEFT_OUT) for name in self._left_out]
        self._volumes(volumes)
        if meshes and not volumes:
            self._only = "meshes"
        wanted = self._wanted
        if taken := [name for name in meshes if wanted.takes("labels", name)]:
            with self._noting("FILE"):
                segmentation = mesh_folder(self._place, self._source, taken, wanted.space, wanted.unit, wanted.up)
                self._into.segmentations.append(segmentation)
        for name in self._names:
            if name.lower().endswith(POINT_ENDINGS):
                try:
                    points = read_points(self._place.folder / name, default_space=wanted.space, default_unit=Unit.MM)
                except InputError as error:
                    if not name.lower().endswith(".csv"):  # other tables are no lists of points, and no problem
                        self._into.passed.append((name, error.what))
                    continue
                if len(points.names) >= LEAST_MARKERS:
                    self._into.markers.append(Markers(name, points))
        self._account()

    def _hollow(self, name: str) -> bool:
        """Whether a folder is named like a structure, and nothing lies in it: one that was not fetched or unpacked."""
        folder = self._folder / name
        like = STRUCTURE_LIKE.search(name)
        return bool(like) and not unaccounted(folder, entries(folder, most=MOST_ENTRIES), lambda _: False)

    def _account(self) -> None:
        """Refuse what was not read where it may be a structure, and else note it."""

        def known(path: Path) -> bool:
            name = path.relative_to(self._place.folder).as_posix()
            table = not self._only and path.name.lower().endswith(NAME_ENDINGS)
            return name in self._read or (table and not STRUCTURE_LIKE.search(path.name))

        images = {structure_name(one) for one in (*(ct.source for ct in self._into.cts), *dict(self._into.passed))}
        of_image = [one for one in self._listed if one.name.endswith(".npz") and one.name[:-4] in images]
        left = [*unaccounted(self._folder, self._listed, known), *of_image]  # nnU-Net's stand beside labels
        lost: dict[str, Entry] = {}
        for one in left:
            if self._wanted.takes("labels", self._name(one.name)):
                if (
                    not self._only
                    and one.what == FOLDER
                    and (below := folders.structure_below(self._folder / one.name))
                ):
                    lost[one.name] = one._replace(what=f"is nested too deep to search, with {below}")
                elif self._only or STRUCTURE_LIKE.search(one.name):
                    lost[one.name] = one
        if lost:
            with self._noting(self._name(next(iter(lost)))):
                raise not_read([*lost.values()], self._only or "files", self._folder)
        self._into.passed += [(self._name(one.name), one.what or NOT_READ) for one in left if one.name not in lost]

    def _dicom(self) -> None:
        """Add each CT series of the folder, named by the folder, or where there are several by a file of each."""
        try:
            files, _ = list_folder(self._folder)
            self._read.update(self._name(one.name) for one in files)
            series = {one.series_uid: one.name for one in reversed(files) if one.is_slice}
            names = {uid: self._name(file) for uid, file in series.items()}
            for name in sorted(names.values()) if len(names) > 1 else [self._source][: len(names)]:
                if self._wanted.takes("ct", name):
                    self._into.cts.append(Ct(name, self._place.volume(name)))
        except InputError as error:
            self._into.problems.append(error)
            self._read.update(self._names)
            return
        for one in files:
            name = self._name(one.name)
            if one.kind in DRAWN and self._wanted.takes("labels", name):
                self._into.drawn.append((name, one.kind))
        others = Counter(one.sop_class for one in files if one.kind not in {Kind.CT, *DRAWN})
        self._into.passed += [(self._source, f"{count} {kind}") for kind, count in sorted(others.items())]

    @contextmanager
    def _noting(self, name: str) -> Iterator[None]:
        """Context in which a refusal becomes one of the problems; a file can be left out."""
        try:
            yield
        except InputError as error:
            error.allowed += f"; or --ignore {name}: its content then counts as free"
            self._into.problems.append(error)

    def _volumes(self, names: Sequence[str]) -> None:
        """Add CTs and label maps one by one; masks together, as a folder of masks where it holds nothing else."""
        masks: list[Mask] = []
        empty: list[str] = []
        for name in names:
            with self._noting(name):
                self._volume(name, masks, empty)
        aside = {one.source for one in self._into.cts} | {name for name, _ in self._into.passed}
        only = len(set(names) - aside) == 1
        for mask in tuple(masks):
            with self._noting(mask.file):
                if is_named_by_table(self._place, mask.file, mask.label, only):
                    masks.remove(mask)
                    self._label_file(mask.file, self._place.volume(mask.file))
        if not masks:
            return
        with self._noting("FILE"):
            refuse_same_name([one.file for one in masks], where=self._folder)
        alone = len(masks) + len(empty) == len(names) and all(one.lower().endswith(MASK_ENDINGS) for one in names)
        alone = alone and not self._left_out
        self._only = "masks" if alone else ""
        said = () if alone or not empty else (f"empty masks: {', '.join(empty)}",)
        self._into.segmentations.append(masks_of(self._place, self._source, masks, said, whole_folder=alone))

    def _volume(self, name: str, masks: list[Mask], empty: list[str]) -> None:
        if not any(self._wanted.takes(kind, name) for kind in ("ct", "labels")):
            return
        if name.lower().endswith(SEGMENT_ENDING) and is_layered(self._place.content(name), self._place.folder / name):
            if self._wanted.takes("labels", name):
                self._into.segmentations.append(file_masks(self._place, name, "seg", None))
            return
        surfaces = self._place.volume(name)
        self._read.update(surfaces.source.files)
        kind, why = volume_kind(surfaces.volume)
        if kind != OTHER and not self._wanted.takes(kind, name):
            return
        if kind == "ct":
            self._into.cts.append(Ct(name, surfaces))
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
            low, high = float(surfaces.volume.values.min()), float(surfaces.volume.values.max())
            if low >= -1 and high <= 1 and self._wanted.takes("labels", name):
                what = f"values from {low:.3g} to {high:.3g} are neither a mask nor a CT"
                refuse(what, self._place.folder / name, "0 and one other whole number in a mask", "not_a_mask")
            self._into.passed.append((name, why))

    def _label_file(self, name: str, surfaces: VolumeSurfaces) -> None:
        self._into.segmentations.append(label_file(self._place, name, surfaces, self._wanted.naming))


def volume_kind(volume: Volume) -> tuple[str, str]:
    """A volume's kind: ``ct`` (Hounsfield units), ``labels`` (few whole numbers from 0 on), or ``other``, and why.

    Raises InputError: a label map that was blended by an interpolation.
    """
    low, high = float(volume.values.min()), float(volume.values.max())
    if low <= AIR_HU:
        return ("ct", "") if high > 0 else (OTHER, f"no CT: nothing is above 0, from {low:g} to {high:g}")
    try:
        whole, _ = whole_labels(volume.values, volume.path)
    except InputError as error:
        if error.code == "labels_blended":
            raise
        return OTHER, f"{error.what}, and for Hounsfield units nothing is below {AIR_HU}"
    counts = label_counts(whole.T, round(high))  # as it lies in a file: the first index runs fastest
    different = np.count_nonzero(counts)
    if different > MOST_LABELS or (different > FEW_LABELS and _differs_everywhere(whole)):
        air = int(np.argmax(counts))
        offset = ": is an offset of -1024 missing, or is it no CT?" if air <= MOST_AIR else ""
        return OTHER, f"not in Hounsfield units, its air is {air}{offset}"
    return ("labels", "") if counts[0] > 0 else (OTHER, "no voxel is 0, the label of the background")


def _differs_everywhere(whole: NDArray[np.integer]) -> bool:
    """Whether most neighbours differ, as the noise of an image makes them: within labels nearly all are alike."""
    near, far = whole[:-1], whole[1:]
    inside = (near > 0) & (far > 0)
    pairs, alike = np.count_nonzero(inside), np.count_nonzero(inside & (near == far))
    return bool(pairs > MANY_PAIRS and alike < LEAST_ALIKE * pairs)
