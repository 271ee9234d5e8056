"""Surfaces made from volumes, kept in the cache: they cost seconds to make and milliseconds to read."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from puncture_twin.planning.anatomy.body import cut_ends
from puncture_twin.planning.anatomy.body.body_mask import CtImage, ct_image
from puncture_twin.planning.anatomy.body.cut_ends import Box, Content, FieldOfView
from puncture_twin.planning.anatomy.body.tables import PATIENT, Shown
from puncture_twin.planning.anatomy.skin import Skin, skin_from_label, skin_from_mesh, skin_of_image
from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.base.cache.array_cache import Cache
from puncture_twin.planning.base.cache.entry_file import Arrays
from puncture_twin.planning.base.cache.source_stamp import source_stamp
from puncture_twin.planning.formats.guard import guard_mesh
from puncture_twin.planning.formats.labels.label_sources import refuse_label_map
from puncture_twin.planning.formats.labels.labelmaps import (
    ROUNDED_BY,
    LabelEnds,
    LabelMap,
    label_ends,
    label_mesh,
    labelmap_of,
    segment_names,
)
from puncture_twin.planning.formats.volumes.volume_files import Volume, VolumeSource, canonical
from puncture_twin.planning.geometry.mesh import TriangleMesh

Value = TypeVar("Value")

ENDS = ("last", "area_mm2", "thick", "wide")
"""Fields of `Content` that have a value by axis and end."""
READERS = "puncture_twin.planning.case.named_files"
"""The module that knows every reader of volumes. A surface is made from what they read, and is made anew where one of
them has changed; nothing here imports them, so that a case without DICOM does not load its library."""
ROUNDING = 1e-12
"""By so much a unit vector's length may be off 1."""
LARGEST, MASK_BYTES = 4, 3
"""Voxels are held in memory where they take one of so many parts of it at most; and bytes of a voxel for what is found
in a CT: the body, and what was not measured."""


class Present(NamedTuple):
    """The labels of a map or mask that have a voxel, ascending, how far its values are off whole numbers, and ends."""

    labels: tuple[int, ...]
    rounded_by: float
    ends: LabelEnds

    def notes(self, path: Path) -> tuple[str, ...]:
        """Notes for a person on how a file was read."""
        said = f"{path.name}: its labels differ from whole numbers by up to {self.rounded_by:.2g} and were rounded"
        return (said,) if self.rounded_by else ()


@dataclass(frozen=True)
class VolumeSurfaces:
    """The surfaces of one label map or CT. Its voxels are decoded only if something is not in the cache."""

    source: VolumeSource
    sha256: tuple[str, ...]
    cache: Cache

    @property
    def path(self) -> Path:
        """The volume's name."""
        return self.source.path

    @property
    def voxel_ct(self) -> Floats:
        """The edges of a voxel as columns, shape (3, 3), mm."""
        return self.source.grid.T_ct_index[:3, :3]

    @cached_property
    def volume(self) -> Volume:
        """The volume itself."""
        return self.source.volume()

    @cached_property
    def labelmap(self) -> LabelMap:
        """The label map itself."""
        return self.held("label map", lambda: labelmap_of(self.volume), lambda labels: labels.labels.nbytes)

    @property
    def names(self) -> dict[int, str] | None:
        """The names that the file holds for its labels."""
        return segment_names(self.source.grid.fields, self.path)

    def present(self) -> Present:
        """The labels that have a voxel, at least one."""
        return self._kept("labels present", lambda: _of_present(self.labelmap), _to_present)

    def mask(self) -> Present:
        """The voxels' value in a file that is one structure's mask; none where it is empty."""

        def make() -> Arrays:
            labels = labelmap_of(self.volume, may_be_empty=True)
            refuse_label_map(labels)
            return _of_present(labels)

        return self._kept("mask label", make, partial(_to_present, fewest=0, most=1))

    def label(self, label: int) -> TriangleMesh:
        """The surface of one label, LPS mm."""
        return self._kept(
            f"label {label}", lambda: mesh_arrays(label_mesh(self.labelmap, label, where=self.path)), cached_mesh
        )

    @cached_property
    def ct_image(self) -> CtImage:
        """All voxels of the CT."""

        def make() -> CtImage:
            return ct_image(vars(self).pop("volume", None) or self.source.volume())  # nobody asks for it again

        return self.held("CT", make, lambda image: image.hu.nbytes)

    def imaged(
        self,
        label: int | None = None,
        organs: Iterable[tuple[TriangleMesh, float]] = (),
        *,
        shown: Shown = PATIENT,
        stated: Collection[str] | None = None,
    ) -> Imaged:
        """A scanner's image of a body, without padding around it; of a body's label in a map, or of a CT (None).

        ``shown`` is what a person says of the image (of a phantom see `cut_ends`), ``stated`` the sides at which it was
        cut.
        """

        def measured() -> Arrays:
            if label is None:
                return _of_content(self.ct_image.content)
            labels = canonical(self.labelmap.labels, self.labelmap.T_ct_index)
            return _of_content(cut_ends.content_of(labels.values == label, labels.T_ct_index))

        content, organs = self._kept(f"content {label}", measured, _to_content), tuple(organs)

        def cut_sides() -> Bools:
            return cut_ends.cut_ends(content, organs, whole=shown.phantom)

        by = ((mesh.digest, voxel_mm) for mesh, voxel_mm in organs)
        key = (*self._key(f"ends {label}"), shown.phantom, *by)
        if stated is None:
            cut = self.cache.memory.get(key, cut_sides, lambda sides: sides.nbytes)
        else:
            cut = cut_ends.stated_ends(stated)
        notes = cut_ends.end_warnings(content, cut, shown.phantom and stated is None)
        return Imaged(self, content.box(cut), label, notes, replace(shown, whole=bool(content.inside)))

    def held(self, what: str, make: Callable[[], Value], size: Callable[[Value], int]) -> Value:
        """Value made from this file, cached in memory alone, where that does not displace everything else."""
        memory = self.cache.memory

        def held_bytes(value: Value) -> int:
            return size(value) if size(value) * LARGEST <= memory.most_bytes else memory.most_bytes + 1

        return memory.get(self._key(what), make, held_bytes)

    def holds(self, what: str) -> bool:
        """Whether memory has what is `held` under this name."""
        return self.cache.memory.contains(self._key(what))

    def _key(self, what: str) -> tuple[str, ...]:
        return (__name__, what, self.path.name, *self.sha256)

    def kept(
        self, made_from: Mapping[str, Any], make: Callable[[], Arrays], read: Callable[[Arrays], Value], *, by: str
    ) -> Value:
        """Value made from this file and from what ``made_from`` states, cached; see `Cache.value`."""
        return self.cache.value({"files": self.sha256, "readers": _readers(), **made_from}, make, read, by=by)

    def _kept(self, what: str, make: Callable[[], Arrays], read: Callable[[Arrays], Value]) -> Value:
        return self.kept({"what": what}, make, read, by=__name__)


@dataclass(frozen=True)
class Imaged:
    """A scanner's image of a body: a CT, or a body's label, without padding around it."""

    surfaces: VolumeSurfaces
    box: Box  # the part that was seen, voxels of the canonical order
    label: int | None  # of the body; None where this is a CT
    notes: tuple[str, ...]  # what was left out, one sentence each
    shown: Shown

    @cached_property
    def image(self) -> CtImage:
        """The CT."""

        def make() -> CtImage:
            return self.surfaces.ct_image.within(self.box, self.shown)

        return self.surfaces.held(f"CT {self.box} {self.shown}", make, lambda image: image.hu.size * MASK_BYTES)

    def release(self) -> None:
        """Let go of the voxels; what asks for them again decodes them again."""
        for holder, names in ((self, ("image",)), (self.surfaces, ("ct_image", "labelmap", "volume"))):
            for name in names:
                vars(holder).pop(name, None)

    def skin(self) -> Skin:
        """The body's skin."""

        def make() -> Arrays:
            if self.label is None:
                return _of_skin(skin_of_image(self.image))
            return _of_skin(skin_from_label(self.surfaces.labelmap, self.label, self.box))

        skin = self.kept({"what": "skin", "label": self.label}, make, _to_skin, by=__name__)
        return replace(skin, warnings=(*self.notes, *skin.warnings))

    def kept(
        self, made_from: Mapping[str, Any], make: Callable[[], Arrays], read: Callable[[Arrays], Value], *, by: str
    ) -> Value:
        """A value made from this image, cached; see `VolumeSurfaces.kept`."""
        return self.surfaces.kept({"box": self.box, "shown": asdict(self.shown), **made_from}, make, read, by=by)


def cached_skin(mesh: TriangleMesh, cut: Sequence[str], cache: Cache) -> Skin:
    """`skin_from_mesh` of a mesh and the sides at which the body was cut, from the cache."""
    made_from = {"what": "skin of a mesh", "mesh": mesh.digest, "cut": list(cut)}
    return cache.value(made_from, lambda: _of_skin(skin_from_mesh(mesh, cut)), _to_skin, by=__name__)


@cache
def _readers() -> str:
    return source_stamp(READERS)


def mesh_arrays(mesh: TriangleMesh, number: int | str = "") -> Arrays:
    """A surface for the cache, and what takes longest to find of it; see `cached_mesh`."""
    facts = np.array([mesh.closed, mesh.wound_alike])
    return {f"vertices{number}": mesh.vertices, f"faces{number}": mesh.faces, f"facts{number}": facts}


def _of_skin(skin: Skin) -> Arrays:
    view = skin.field_of_view
    box = {} if view is None else {"T_ct_box": view.T_ct_box, "size_mm": view.size_mm, "cut": view.cut}
    warnings = np.array(skin.warnings, dtype=np.str_)
    normals = {} if skin.normals is None else {"normals": skin.normals}
    return {**mesh_arrays(skin.mesh), **box, **normals, "cut_faces": skin.cut_faces, "warnings": warnings}


def _to_skin(stored: Arrays) -> Skin:
    view = FieldOfView(stored["T_ct_box"], stored["size_mm"], stored["cut"]) if "T_ct_box" in stored else None
    mesh, cut_faces = cached_mesh(stored), stored["cut_faces"]
    if cut_faces.shape != (len(mesh.faces),):
        raise ValueError("one flag for each triangle")
    normals = stored.get("normals")
    if normals is not None and (normals.dtype != np.float64 or normals.shape != mesh.vertices.shape):
        raise ValueError("one normal for each vertex")
    if normals is not None and not np.abs(np.linalg.norm(normals, axis=1) - 1.0).max(initial=0.0) <= ROUNDING:
        raise ValueError("normals of length 1")
    return Skin(mesh, cut_faces, view, tuple(str(warning) for warning in stored["warnings"]), normals)


def cached_mesh(stored: Arrays, number: int | str = "") -> TriangleMesh:
    """A surface, which went through the guard before it was stored, and does again: kept files may be anything.

    Its ``vertices``, ``faces`` and ``facts`` (closed, wound alike) have a number behind their names where there are
    several. Raises KeyError, TypeError, InputError: It is none.
    """
    vertices, faces, facts = (stored[f"{name}{number}"] for name in ("vertices", "faces", "facts"))
    if vertices.dtype != np.float64 or faces.dtype != np.int32 or facts.dtype != np.bool_ or facts.shape != (2,):
        raise TypeError("a mesh of other types than ours")
    return guard_mesh(vertices, faces, where="cache").known(closed=bool(facts[0]), wound_alike=bool(facts[1]))


def _of_present(labels: LabelMap) -> Arrays:
    present = np.array(labels.labels_present(), np.int64)
    return {"labels": present, "rounded_by": np.array(labels.rounded_by), **label_ends(labels)._asdict()}


def _to_present(stored: Arrays, fewest: int = 1, most: float = np.inf) -> Present:
    labels, rounded_by = stored["labels"], float(stored["rounded_by"])
    whole = labels.ndim == 1 and labels.dtype == np.int64 and fewest <= len(labels) <= most
    if not whole or not 0.0 <= rounded_by <= ROUNDED_BY:
        raise ValueError("no list of labels")
    ends = LabelEnds(*(stored[name] for name in LabelEnds._fields))
    shapes = [one.shape for one in ends] == [(len(labels), 3, 2)] * 2 + [(len(labels),)]
    if not shapes or [one.dtype.kind for one in ends] != ["i", "f", "b"]:
        raise ValueError("no ends of its labels")
    return Present(tuple(labels.tolist()), rounded_by, ends)


def _of_content(content: Content) -> Arrays:
    return {name: np.array(getattr(content, name)) for name in ("shape", "T_ct_index", *ENDS)}


def _to_content(stored: Arrays) -> Content:
    ends, shape, T_ct_index = [stored[name] for name in ENDS], stored["shape"], stored["T_ct_index"]
    if any(array.shape != (3, 2) for array in ends) or (shape.shape, T_ct_index.shape) != ((3,), (4, 4)):
        raise ValueError("three axes with two ends")
    return Content(tuple(shape.tolist()), T_ct_index, *ends)
