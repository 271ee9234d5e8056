"""A segmentation, whatever file or folder it comes from; a folder of meshes, whose unit is guessed by their extent.

Is what is named like the body its outline? A path crosses the skin anyway, so an outline is left out; a ball in the
body that somebody called ``External`` or ``patient`` is not.
"""

import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy

from puncture_twin.planning.anatomy.default_roles import BODY, NOT_ANNOTATED, DefaultRole, default_role
from puncture_twin.planning.anatomy.skin import Skin, flat_ends, skin_from_mesh
from puncture_twin.planning.anatomy.surfaces import VolumeSurfaces
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import Cache
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.progress import Names, unnamed
from puncture_twin.planning.base.provenance import InputFiles
from puncture_twin.planning.case.named_files import CaseVolumes
from puncture_twin.planning.formats.meshes.mesh_files import UP_NOT_STATED, mesh_extent, read_mesh
from puncture_twin.planning.formats.volumes.volume_files import MAX_FILE_BYTES
from puncture_twin.planning.geometry.containment import Side, side_of
from puncture_twin.planning.geometry.mesh import TriangleMesh, spread_on
from puncture_twin.planning.geometry.spaces import Space, Unit, Up

CASE_FILE = "case.toml"
"""File name of the new case."""
STATED = DefaultRole("stated", (), "unknown", 0.0, "stated to init")
"""Default role of a name whose role a person states."""
HOLDS_TARGET = "it also contains the target, and its name is not known as an organ that a needle may cross"
"""Reason of the role ``unknown``."""


class Assigned(NamedTuple):
    """The role and margin of one structure in the case, with the reason."""

    label: int
    name: str
    kind: str  # ``target``, ``avoid``, ``unknown``, ``traverse``, ``ignore`` or ``skin``
    margin_mm: float  # the clearance that it demands
    line: DefaultRole  # of the table of default roles


@dataclass(frozen=True, eq=False)
class Segmentation:
    """The structures of one file or folder of any kind."""

    source: str  # the file or folder, relative to the case's
    names: Mapping[int, str]  # label to name, of the structures that are there
    near: Callable[[Floats], tuple[int, ...]]  # the labels whose box holds a point (3,), LPS mm
    surface: Callable[[int], TriangleMesh]  # of one structure, LPS mm
    # one structure as the skin of the body, with what the image cut; an `InputError` where it cannot be one
    skin: Callable[[int], Skin]
    section: Callable[[Sequence[Assigned]], str]  # the part of the case file that names all of its structures
    voxel_ct: Floats | None = None  # shape (3, 3), the edges of its voxels as columns, mm; None of meshes
    notes: tuple[str, ...] = ()  # what a person should be told, one sentence each


def in_boxes(boxes: Mapping[int, Floats], point_ct: Floats) -> tuple[int, ...]:
    """The labels whose box, shape (2, 3), holds a point (3,); LPS mm."""
    return tuple(label for label, (low, high) in boxes.items() if np.all((low <= point_ct) & (point_ct <= high)))


@dataclass(frozen=True)
class Place:
    """The folder of the case, the cache of its surfaces, and the callback with each file that is read."""

    folder: Path
    cache: Cache
    progress: Names = unnamed
    files: InputFiles = field(init=False)
    volumes: CaseVolumes = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "files", InputFiles(self.folder))
        object.__setattr__(self, "volumes", CaseVolumes(self.files, self.folder / CASE_FILE))

    def volume(self, name: str) -> VolumeSurfaces:
        """A volume file of the folder, or a DICOM series. Raises InputError: it cannot be read."""
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


def structure_text(row: Assigned, source: str, more: str = "") -> str:
    """The ``[[structure]]`` of one with a source of its own: the source's lines, then lines behind its margin."""
    head = f"[[structure]]\nname = {quoted(row.name)}\n{source}"
    return f'{head}role = "{row.kind}"\n{margin_line(row)}{more}'


def rules_text(rows: Sequence[Assigned]) -> str:
    """The lists and the table of a ``[[structures]]``: each structure by its own name, with the reason of its line.

    The skin is ignored among them: a ``[[structure]]`` of its own, `label_text`, says what it is.
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
            parts.append(f"\n[structures.{kind}]  # margins, mm\n{head}")
        for line in dict.fromkeys(row.line for row in demanding):
            parts.append(f"# {line.group}: {line.reason}\n")
            parts += [f"{quoted(row.name)} = {row.margin_mm:g}\n" for row in demanding if row.line == line]
    return "".join(parts)


def label_text(row: Assigned, file: str, label: int) -> str:
    """The ``[[structure]]`` of a label of a map."""
    return structure_text(row, f"labelmap = {quoted(file)}\nlabel = {label}\n")


LEAST_EXTENT = ((Unit.MM, 130.0), (Unit.CM, 5.0), (Unit.M, 0.0))
"""Least diagonal of all meshes together, by unit that is guessed. A body in mm, with its skin, is seldom smaller than
130 mm, and in cm (13 to 130) seldom larger; in metres it is smaller than 5."""
BOTH_MM_AND_CM = (130.0, 250.0)
"""A diagonal between these is a child's or a limb's in mm, or an adult's in cm, ten times as wide."""


def mesh_name(file: str) -> str:
    """The name of the structure in a file: the file's own, without its ending.

    >>> mesh_name("organs/right lung.stl")
    'right lung'
    """
    return file.rpartition("/")[2].rpartition(".")[0]


def mesh_folder(
    place: Place, source: str, names: Sequence[str], space: Space, stated: Unit | None, up: Up | None
) -> Segmentation:
    """The meshes of a folder, in the unit that their extent tells where none is stated; of GLB ``up`` must be.

    Raises InputError: a mesh that cannot be read, two of one name, or a unit that is not told by their extent.
    """
    if len(set(map(mesh_name, names))) < len(names):
        refuse("two meshes have the same name", place.folder / source, "one mesh per structure", "duplicate_name")
    if up is None and any(name.lower().endswith(".glb") for name in names):
        what = f"GLB: {UP_NOT_STATED} (--up y rotates them to z up, --up z keeps them)"
        refuse(what, place.folder / source, "--up y or --up z", "up_not_stated")
    extents = [mesh_extent(place.folder / name) for name in names]
    boxes = np.stack([one.box for one in extents])
    diagonal = float(np.linalg.norm(boxes[:, 1].max(axis=0) - boxes[:, 0].min(axis=0)))
    if stated is None and BOTH_MM_AND_CM[0] <= diagonal < BOTH_MM_AND_CM[1]:
        what = f"{diagonal:.0f} units from corner to corner: a small body in mm, or a large one in cm"
        refuse(what, place.folder / source, "--unit mm or --unit cm", "unit_not_stated")
    unit = stated or next(one for one, least in LEAST_EXTENT if diagonal >= least)
    guess = "as stated" if stated else "inferred from their size (--unit overrides it)"
    counts = Counter(one.space for one in extents)
    spaces = [f"{one}, as {count} of their files state" for one, count in counts.items() if one]
    spaces += [f"{space}, not stated in {counts[None]} of them"] if counts[None] else []
    said = (
        f"{source}: {len(names)} meshes in {unit} ({guess}) and {' and '.join(spaces)}, "
        f"together {diagonal * unit.mm:.0f} mm from corner to corner; mesh files do not state their unit"
    )
    files = dict(enumerate(sorted(names), start=1))
    read = partial(read_mesh, unit=unit, space=space, space_is_default=True, up=up)

    @cache
    def meshes() -> Mapping[int, TriangleMesh]:
        return {number: read(place.folder / file) for number, file in files.items()}

    def single(row: Assigned) -> str:
        ends = flat_ends(meshes()[row.label]) if row.kind == "skin" else ()
        listed = ", ".join(map(quoted, ends))
        cut = f"cut = [{listed}]  # flat there: the scan ended; [] if all of it is skin\n" if ends else ""
        up_line = "" if up is None else f'up = "{up}"\n'
        return structure_text(row, f'mesh = {quoted(files[row.label])}\nunit = "{unit}"\n{up_line}', cut)

    return Segmentation(
        source,
        {number: mesh_name(file) for number, file in files.items()},
        near=lambda point_ct: in_boxes({number: mesh.bounds for number, mesh in meshes().items()}, point_ct),
        surface=lambda label: meshes()[label],
        skin=lambda label: skin_from_mesh(meshes()[label], flat_ends(meshes()[label])),
        section=lambda rows: "\n".join(single(row) for row in rows if row.kind != "ignore"),
        notes=(said,),
    )


NEAR_MM, NEAR = 8.0, 0.02
"""An outline follows the skin to 8 mm: the coarsest voxels in use are 6 mm wide. In a small body, such as an animal's,
an organ is so near to it too: there to 2 % of the box's diagonal."""
MOST_OF_SKIN = 0.7
"""Fraction of the skin that a shell or the whole body covers; what covers it is crossed by every path."""
PART_OF_SKIN, MOST_OF_OUTLINE = 0.25, 0.6
"""A body that was cropped, or cut at its limbs, covers a part of the skin, and is bounded by it but for the cuts."""
POINTS, PLACES = 4_000, 200_000
"""Points that are asked about, and places of the other surface that they are compared with: on 2 square metres these
lie 3 mm apart, so that what is within 8 mm is found."""
LEAST_HELD = 0.9
"""Fraction of the other structures that the skin contains: a line or bed may have been drawn too, and lies outside."""
SLACK_MM = 2.0
"""How far a structure may reach out of the skin's box: both were drawn."""


class Structure(NamedTuple):
    """One structure of a segmentation."""

    segmentation: Segmentation
    label: int

    @property
    def name(self) -> str:
        """Its name in its segmentation."""
        return self.segmentation.names[self.label]

    @property
    def surface(self) -> TriangleMesh:
        """Its surface, LPS mm."""
        return self.segmentation.surface(self.label)


def structures_of(segmentations: Sequence[Segmentation]) -> list[Structure]:
    """Every structure of some segmentations."""
    return [Structure(one, label) for one in segmentations for label in one.names]


def skin_of(segmentations: Sequence[Segmentation], stated: str | None) -> Structure | None:
    """The structure that is stated to be the skin, else the largest that is named like the body; None for neither."""
    every = structures_of(segmentations)
    named = [one for one in every if (named_like_body(one.name) if stated is None else one.name == stated)]
    return max(named, key=lambda one: float(np.ptp(one.surface.bounds, axis=0).prod()), default=None)


def skin_problems(candidate: Structure, segmentations: Sequence[Segmentation]) -> Iterator[str]:
    """Why what is named like the skin cannot be it: what lies outside of a skin counts as air beside the patient."""
    boxes = [one.surface.bounds for one in structures_of(segmentations) if one != candidate]
    low, high = candidate.surface.bounds
    held = [bool(np.all((one[0] >= low - SLACK_MM) & (one[1] <= high + SLACK_MM))) for one in boxes]
    if sum(held) < LEAST_HELD * len(held):
        noun = "meshes" if candidate.segmentation.voxel_ct is None else "structures"
        yield f"'{candidate.name}' is named like the skin, but contains {sum(held)} of the {len(held)} other {noun}"


class Agreement(NamedTuple):
    """How well a structure agrees with the body's skin."""

    skin_covered: float  # of the skin, the fraction that it is near to; faces where the scan cut the body do not count
    on_skin: float  # of its own surface, the fraction that is near to the skin


@dataclass(frozen=True, eq=False)
class Outlines:
    """The structures that are named like the body, compared with its skin."""

    segmentations: Sequence[Segmentation]
    skin: Skin
    stated: frozenset[str] = frozenset()  # the names of those that a person states to be the skin, or to be left out

    @cached_property
    def _named(self) -> dict[str, tuple[TriangleMesh, Agreement]]:
        meshes = {one.name: one.surface for one in structures_of(self.segmentations) if named_like_body(one.name)}
        return {name: (mesh, agreement(mesh, self.skin)) for name, mesh in meshes.items()}

    def at(self, point_ct: Floats) -> frozenset[str]:
        """The names of those that are outlines of the body, or of the part of it that holds a point (3,), LPS mm."""
        names = set(self.stated)
        for name, (mesh, one) in self._named.items():
            part = one.skin_covered >= PART_OF_SKIN and one.on_skin >= MOST_OF_OUTLINE
            if one.skin_covered >= MOST_OF_SKIN or (part and side_of(mesh, point_ct) is Side.INSIDE):
                names.add(name)
        return frozenset(names)

    def notes(self, point_ct: Floats) -> Iterator[str]:
        """A sentence for a person about each that is named like an outline and is none."""
        for name in sorted(self._named.keys() - self.at(point_ct)):
            _, fit = self._named[name]
            yield (
                f"'{name}' is named like the outline of the body, but covers {fit.skin_covered:.0%} of the skin, and "
                f"{fit.on_skin:.0%} of it is there: treated as an ordinary structure (if it is the outline: ignore)"
            )


def named_like_body(name: str) -> bool:
    """Whether a structure is called as outlines of the body are."""
    return default_role(name, "other") == BODY


def agreement(mesh: TriangleMesh, skin: Skin) -> Agreement:
    """Agreement of a surface with the skin, by points of both."""
    within_mm = min(NEAR_MM, NEAR * float(np.linalg.norm(np.ptp(skin.mesh.bounds, axis=0))))
    open_skin = ~skin.cut_faces if not skin.cut_faces.all() else skin.cut_faces
    seen = TriangleMesh(skin.mesh.vertices, skin.mesh.faces[open_skin])
    covered = fraction_near(spread_on(seen, POINTS).points, mesh, within_mm)
    return Agreement(covered, fraction_near(spread_on(mesh, POINTS).points, skin.mesh, within_mm))


def fraction_near(points: Floats, other: TriangleMesh, within_mm: float) -> float:
    """The fraction of points (n, 3) that lie so near to a surface, by points of that."""
    distance, _ = scipy.spatial.cKDTree(spread_on(other, PLACES).points).query(points, distance_upper_bound=within_mm)
    return float(np.isfinite(distance).mean())


BORDER_MM = 2.0
"""The surfaces of two labels that border on each other are this near: both lie between the same voxels."""
MOST_OF_BORDER, ALL_ROUND = 0.5, 0.9
"""Of the target's surface, which an organ about it borders on; one below the organ's surface has more. What goes all
round holds it: the target was carved out of it, and no path comes to it otherwise."""


def bordering(target: str | None, segmentations: Sequence[Segmentation]) -> dict[str, float]:
    """Fraction of the target's surface that each structure borders on whose box may go round it."""
    every = structures_of(segmentations)
    fractions = {}
    for own in (one for one in every if one.name == target):
        points = spread_on(own.surface, POINTS).points
        for one in (one for one in every if one.name != target):
            mesh = one.surface
            low, high = mesh.bounds
            if np.all((points >= low - BORDER_MM) & (points <= high + BORDER_MM), axis=1).mean() >= MOST_OF_BORDER:
                fractions[one.name] = fraction_near(points, mesh, BORDER_MM)
    return fractions


def carved_notes(rows: Sequence[Assigned], target: str | None, border: Mapping[str, float]) -> Iterator[str]:
    """A sentence about each avoided structure that goes round the target's."""
    for row in rows:
        if row.kind == "avoid" and border.get(row.name, 0.0) >= MOST_OF_BORDER:
            yield (
                f"'{row.name}' surrounds '{target}' without containing it, as if cut out around it, and is avoided "
                f"by {row.margin_mm:g} mm: no path through it is safe. If a path may cross it, make it traverse in "
                "the case"
            )
