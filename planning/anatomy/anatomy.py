"""The structures of a case, with roles and margins, from meshes or label maps, and the skin."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.body.support import support_warnings
from puncture_twin.planning.anatomy.scan import Scan
from puncture_twin.planning.anatomy.second_witness import Named
from puncture_twin.planning.anatomy.skin import Skin, flat_ends, skin_from_mesh
from puncture_twin.planning.anatomy.surfaces import VolumeSurfaces
from puncture_twin.planning.base.cache.array_cache import NO_CACHE, Cache
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.case_file import StructureSection, StructuresSection
from puncture_twin.planning.case.case_schema import count_difference
from puncture_twin.planning.formats.labels.naming import BUILT_IN, RuleKind, names_for, select
from puncture_twin.planning.formats.meshes.mesh_files import mesh_warnings, parse_mesh
from puncture_twin.planning.formats.volumes.volume_files import NRRD_ENDINGS
from puncture_twin.planning.geometry.containment import Side, side_of
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.spaces import Space, parse_space, parse_unit
from puncture_twin.planning.geometry.triangle_distance import squared_distance

Progress = Callable[[str], None]

UNNAMED_SHOWN = 8
"""Labels that a warning lists; a person looks at the map for the rest."""
OUTSIDE_BODY, ATTACHED_LIMB = "outside_body", "attached_limb"
UNNAMED_DENSE, UNNAMED_GAS = "unnamed_dense", "unnamed_gas"
"""Names of the structures that the CT adds."""

OUTSIDE_NOT_KNOWN = (
    "outside of the body: not known (no CT; [ct] file names one), so table, clothes and arms count as air"
)

LIMB_ATTACHED = (
    f"a limb seems to be pressed against the part of the body that holds the target; paths through it are "
    f"unknown_region ({ATTACHED_LIMB})"
)

MOST_ROOM = 0.02
"""Of a body, that a CT beside its skin may show as the room's air: an open mouth and nose hold less."""
CT_SHIFTED = (
    "the CT {name} shows {fraction:.0%} of what the skin encloses as the room's air: it is likely shifted against the "
    "skin (a slip of space, another position or breath); what it adds (outside_body, unnamed_dense, unnamed_gas) lies "
    "elsewhere then"
)

LABELS_TRUSTED = "search.trust_labels: what the CT shows inside the body beside the structures is not checked"

ON_SURFACE_MM = 1e-3
"""A target this close to its structure's surface lies on it: meshes in single precision round to 1e-5 mm."""


class Role(StrEnum):
    """What a structure means to a needle."""

    AVOID = "avoid"
    TRAVERSE = "traverse"
    TARGET = "target"
    SKIN = "skin"
    UNKNOWN = "unknown"


@dataclass(frozen=True, eq=False)
class Structure:
    """A named surface with a role.

    Attributes:
        name: Unique in the case.
        role: What it means to the needle.
        margin_mm: The clearance that it demands, where its role demands one.
        mesh: In the CT frame, mm.
        source: The file it comes from, and the label in it.
        outside: Whether it is outside of the body, where the needle waits at its standoff: it is then checked
            against the needle's axis up to where the flange waits, not only to where the flange ends.
    """

    name: str
    role: Role
    margin_mm: float
    mesh: TriangleMesh
    source: str
    outside: bool = False

    @property
    def demands_margin(self) -> bool:
        """Whether a needle too close to it is rejected."""
        return self.role in {Role.AVOID, Role.UNKNOWN}


@dataclass(frozen=True, eq=False)
class Anatomy:
    """What a needle must be checked against, and what could not be known.

    Attributes:
        structures: All structures of the body but the skin; the CT's unnamed dense components and gas among them.
        skin: The body's surface.
        warnings: One sentence each.
        surroundings: Solids outside of the body: what the CT shows there, obstacles, the gantry.
        scan: The CT of the case, or None.
        ignored: Names of labels that the case leaves out on purpose.
    """

    structures: tuple[Structure, ...]
    skin: Skin
    warnings: tuple[str, ...]
    surroundings: tuple[Structure, ...] = ()
    scan: Scan | None = None
    ignored: tuple[str, ...] = ()

    @property
    def checked(self) -> tuple[Structure, ...]:
        """Everything that a direction is checked against, structures first."""
        return self.structures + self.surroundings

    def structure(self, name: str) -> Structure:
        """The structure of this name.

        Raises:
            InputError: There is none.
        """
        for structure in self.structures:
            if structure.name == name:
                return structure
        names = ", ".join(s.name for s in self.structures)
        raise InputError(f"no structure '{name}'", where="anatomy", allowed=names)


def load_anatomy(case: Case, progress: Progress | None = None, cache: Cache = NO_CACHE) -> Anatomy:
    """Read every structure of a case, and hold the target against them.

    Args:
        case: The validated case.
        progress: Called with the name of each structure as it is read.
        cache: Where surfaces of volumes are kept.

    Raises:
        InputError: A file that cannot be trusted, a label that no rule names, or a target that contradicts them.
    """
    loader = _Loader(case, progress or (lambda _: None), cache)
    structures = [loader.one(section) for section in case.structure if section.role != "skin"]
    for section in case.structures:
        structures.extend(loader.many(section))
    skin_section = _skin_section(case)
    skin = loader.skin(skin_section)
    _check_count(case, structures)
    _check_demands(case, structures)
    outside: tuple[Structure, ...] = ()
    scan = loader.scan(skin_section, skin)
    if scan is None:
        loader.warnings.append(OUTSIDE_NOT_KNOWN)
    else:
        outside = _outside(case, scan, loader.warnings)
        if (fraction := scan.room_in_skin()) > MOST_ROOM:
            loader.warnings.append(CT_SHIFTED.format(name=scan.name, fraction=fraction))
        if any(structure.name == ATTACHED_LIMB for structure in outside):
            loader.warnings.append(LIMB_ATTACHED)
        if case.ct.trust_labels:
            loader.warnings.append(LABELS_TRUSTED)
        structures.extend(_unnamed(case, scan, structures))
    _check_names(case, [*structures, *outside])
    warnings = [*loader.warnings, *loader.unnamed_warnings(), *skin.warnings]
    for structure in structures:
        warnings.extend(mesh_warnings(structure.mesh, structure.name))
    _check_target(case, structures, skin)
    return Anatomy(tuple(structures), skin, tuple(warnings), outside, scan, tuple(loader.ignored))


def _outside(case: Case, scan: Scan, warnings: list[str]) -> tuple[Structure, ...]:
    """What the CT shows outside of the body that is not air, and limbs that are pressed against it."""
    outside = scan.outside(case.ct.air_hu)
    warnings.extend(support_warnings(outside.supported, outside.open_faces))
    found = ((OUTSIDE_BODY, outside.mesh), (ATTACHED_LIMB, scan.attached_limbs(case.target_ct)))
    return tuple(
        Structure(name, Role.UNKNOWN, case.ct.margin_mm, mesh, f"{scan.name}: {name}", outside=True)
        for name, mesh in found
        if mesh is not None
    )


def _unnamed(case: Case, scan: Scan, structures: Sequence[Structure]) -> Iterator[Structure]:
    """What the CT shows inside the body that no structure names, unless the labels are trusted."""
    if case.ct.trust_labels:
        return
    named = [Named(structure.name, structure.mesh) for structure in structures]
    unnamed = scan.unnamed(named, case.ct.dense_hu)
    for name, mesh in ((UNNAMED_DENSE, unnamed.dense), (UNNAMED_GAS, unnamed.gas)):
        if mesh is not None:
            yield Structure(name, Role.UNKNOWN, case.ct.margin_mm, mesh, f"{scan.name}: {name}")


def load_skin(case: Case, cache: Cache = NO_CACHE) -> Skin:
    """The skin of a case alone.

    Raises:
        InputError: A file that cannot be trusted.
    """
    return _Loader(case, lambda _: None, cache).skin(_skin_section(case))


def _skin_section(case: Case) -> StructureSection:
    return next(section for section in case.structure if section.role == "skin")


class _Loader:
    """Reads the sources of one case, each volume at most once."""

    def __init__(self, case: Case, progress: Progress, cache: Cache) -> None:
        self._case = case
        self._progress = progress
        self._cache = cache
        self._volumes: dict[str, VolumeSurfaces] = {}
        self.warnings: list[str] = []
        self.ignored: list[str] = []

    def one(self, section: StructureSection) -> Structure:
        """One structure from a mesh or a label."""
        self._progress(section.name)
        if section.mesh is not None:
            mesh, source = self._mesh(section), section.mesh
        else:
            mesh, source = self._label(section), f"{section.labelmap}:{section.label}"
        return Structure(section.name, Role(section.role), section.margin_mm or 0.0, mesh, source)

    def many(self, section: StructuresSection) -> list[Structure]:
        """All labels of one map that the rules do not ignore."""
        volume = self._labels(section.labelmap)
        rules = select(
            names_for(section.naming, self._case.folder, self._case.files.content, volume),
            volume.labels_present(),
            avoid=section.avoid,
            traverse=section.traverse,
            ignore=section.ignore,
            target=section.target,
            all_named=section.naming in BUILT_IN,
            where=self._case.path,
        )
        self.warnings.extend(rules.warnings)
        structures = []
        for rule in rules.rules:
            if rule.kind is RuleKind.IGNORE:
                self.ignored.append(rule.name)
                continue
            self._progress(rule.name)
            source = f"{section.labelmap}:{rule.label}"
            role = Role(rule.kind.value)
            structures.append(Structure(rule.name, role, rule.margin_mm, volume.label(rule.label), source))
        return structures

    def unnamed_warnings(self) -> list[str]:
        """Maps from which the case takes single labels, and which hold others that nobody names."""
        named: dict[str, set[int]] = {}
        for section in self._case.structure:
            if section.labelmap is not None and section.label is not None:
                named.setdefault(section.labelmap, set()).add(section.label)
        whole = {section.labelmap for section in self._case.structures}
        return [w for name, labels in sorted(named.items()) if name not in whole for w in self._unnamed(name, labels)]

    def _unnamed(self, name: str, labels: set[int]) -> list[str]:
        volume = self._labels(name)
        others = [label for label in volume.labels_present() if label not in labels]
        if not others:
            return []
        names = (volume.names or {}) if name.lower().endswith(NRRD_ENDINGS) else {}
        shown = [f"{label} {names[label]}" if label in names else str(label) for label in others[:UNNAMED_SHOWN]]
        more = f" and {len(others) - len(shown)} more" if len(others) > len(shown) else ""
        return [f"{name} holds labels that the case does not name, and they count as free: {', '.join(shown)}{more}"]

    def skin(self, section: StructureSection) -> Skin:
        """The body's surface, from whatever the case names."""
        self._progress(section.name)
        if section.ct is not None:
            return self._volume(section.ct).skin_of_ct()
        if section.labelmap is not None and section.label is not None:
            return self._labels(section.labelmap).skin_of_label(section.label)
        mesh = self._mesh(section)
        ends = () if self._case.space is Space.LOCAL or section.cut is not None else flat_ends(mesh)
        if ends:
            raise InputError(
                f"skin mesh {section.mesh} ends flat at its {', '.join(ends)} side: was the body cut there?",
                where=self._case.path,
                allowed=f"cut = {json.dumps(ends)} where no skin is, or cut = [] if all of it is skin",
            )
        return skin_from_mesh(mesh, section.cut or ())

    def scan(self, skin_section: StructureSection, skin: Skin) -> Scan | None:
        """The CT of the case: of its skin, or the one that ``[ct]`` names; None where there is none."""
        own, named = skin_section.ct, self._case.ct.file
        if own is not None and named not in {None, own}:
            raise InputError(
                f"[ct] file '{named}' is not the CT of the skin, '{own}'",
                where=self._case.path,
                allowed="one CT: leave out [ct] file where the skin comes from a CT",
            )
        name = own or named
        if name is None:
            return None
        self._progress("CT beside the structures")
        scan = Scan(name, self._volume(name), None if own else skin)
        if not scan.holds(self._case.target_ct):
            raise InputError(
                f"[ct] file '{name}' does not show the target: a slip of file or space?",
                where=self._case.path,
                allowed="a CT that holds the target, in the space of the structures",
            )
        return scan

    def _mesh(self, section: StructureSection) -> TriangleMesh:
        where = f"{self._case.path}: structure '{section.name}'"
        if section.mesh is None or section.unit is None:
            raise InputError("no mesh with a unit", where=where, allowed="mesh and unit")
        space = parse_space(section.space or self._case.space, where=where)
        unit = parse_unit(section.unit, where=where)
        return parse_mesh(self._case.files.content(section.mesh), self._file(section.mesh), unit=unit, space=space)

    def _label(self, section: StructureSection) -> TriangleMesh:
        if section.labelmap is None or section.label is None:
            raise InputError(f"'{section.name}' has no source", where=self._case.path, allowed="mesh or labelmap")
        return self._labels(section.labelmap).label(section.label)

    def _labels(self, name: str) -> VolumeSurfaces:
        if self._case.space is Space.LOCAL:
            raise InputError(
                f'label map {name} in a case of space "local"', where=self._case.path, allowed='space "LPS" or "RAS"'
            )
        return self._volume(name)

    def _volume(self, name: str) -> VolumeSurfaces:
        if name not in self._volumes:
            source = self._case.volumes.source(name)
            hashes = tuple(self._case.files.sha256(file) for file in source.files)
            self._volumes[name] = VolumeSurfaces(source, hashes, self._cache)
            self.warnings.extend(source.notes)
        return self._volumes[name]

    def _file(self, name: str) -> Path:
        return self._case.folder / name


def _check_count(case: Case, structures: list[Structure]) -> None:
    """Of a case that states how many structures it has; before the CT adds others."""
    wrong = "" if case.stated_structures is None else count_difference(case.stated_structures, len(structures) + 1)
    if wrong:
        raise InputError(wrong, where=case.path, allowed="the number of structures that are read")


def _check_names(case: Case, structures: list[Structure]) -> None:
    names = [structure.name for structure in structures]
    twice = sorted(name for name, count in Counter(names).items() if count > 1)
    if twice:
        raise InputError(f"structure '{twice[0]}' stands twice", where=case.path, allowed="unique names")
    if case.target_structure not in names:
        raise InputError(
            f"target.structure '{case.target_structure}' is no structure of the case",
            where=case.path,
            allowed=", ".join(names),
        )


def _check_demands(case: Case, structures: list[Structure]) -> None:
    """Where nothing demands a margin every path is "safe", which says nothing about a patient."""
    if not any(structure.demands_margin for structure in structures):
        raise InputError(
            "no structure is to be avoided, so that no verdict would say anything about safety",
            where=case.path,
            allowed='at least one structure of role "avoid" or "unknown"',
        )


def surface_distance(mesh: TriangleMesh, point: NDArray[np.float64]) -> float:
    """Distance of a point (3,) from a surface, on either side, mm."""
    return float(np.sqrt(squared_distance(point, mesh.triangles).min()))


def _in_box(mesh: TriangleMesh, point: NDArray[np.float64]) -> bool:
    low, high = mesh.bounds
    return bool(np.all((low <= point) & (point <= high)))


def _check_target(case: Case, structures: list[Structure], skin: Skin) -> None:
    """A target must lie inside the skin and its own structure, and inside nothing that is to be avoided."""
    point = ", ".join(f"{x:.1f}" for x in case.target_ct)
    if side_of(skin.mesh, case.target_ct) is Side.OUTSIDE:
        raise InputError(f"target ({point}) lies outside the skin", where=case.path, allowed="a point in the body")
    for structure in structures:
        if structure.name != case.target_structure and not _in_box(structure.mesh, case.target_ct):
            continue
        side = side_of(structure.mesh, case.target_ct)
        if structure.role is Role.AVOID and side is Side.INSIDE:
            raise InputError(
                f"target ({point}) lies inside '{structure.name}', which is to be avoided",
                where=case.path,
                allowed="a target outside every 'avoid' structure",
            )
        if structure.name != case.target_structure:
            continue
        if structure.role is not Role.TARGET:
            raise InputError(
                f"target.structure '{structure.name}' has role '{structure.role}'",
                where=case.path,
                allowed='role "target" for the structure that holds the target',
            )
        if side is Side.OUTSIDE and (gap := surface_distance(structure.mesh, case.target_ct)) > ON_SURFACE_MM:
            raise InputError(
                f"target ({point}) lies {gap:.1f} mm outside its structure '{structure.name}'",
                where=case.path,
                allowed="a point inside target.structure",
            )
