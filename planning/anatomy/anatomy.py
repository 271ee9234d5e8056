"""The structures of a case, with roles and margins, and the skin: from meshes, label maps, folders of masks, a CT."""

import json
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.body.tables import Shown, support_warnings
from puncture_twin.planning.anatomy.scan import Outside, Scan
from puncture_twin.planning.anatomy.skin import Skin, flat_ends
from puncture_twin.planning.anatomy.structure import Role as Role, Structure as Structure
from puncture_twin.planning.anatomy.surfaces import Imaged, VolumeSurfaces, cached_skin
from puncture_twin.planning.anatomy.unseen import beyond_images, beyond_labels
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import NO_CACHE, Cache
from puncture_twin.planning.base.errors import Finding, Severity, refuse
from puncture_twin.planning.base.progress import Names, unnamed
from puncture_twin.planning.base.text import did_you_mean, first_few, plural
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.case_file import count_difference
from puncture_twin.planning.case.tables import StructureSection, StructuresSection
from puncture_twin.planning.formats.labels.label_sources import check_one_grid
from puncture_twin.planning.formats.labels.labelmaps import LabelEnds, frame, framed_surface
from puncture_twin.planning.formats.labels.naming import BUILT_IN, LabelRule, RuleKind, names_for, select
from puncture_twin.planning.formats.meshes.mesh_files import cached_mesh_warnings, parse_mesh
from puncture_twin.planning.formats.volumes.volume_files import NRRD_ENDINGS
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid, refuse_lost_grid
from puncture_twin.planning.geometry.containment import contains
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.planning.geometry.spaces import Space, Unit, Up, parse_space, parse_unit
from puncture_twin.planning.geometry.triangle_distance import squared_distance

EMPTY_MASKS = "{folder}: {empty}: {names}"


class StructureSources:
    """Reads the sources of one case, each volume at most once."""

    def __init__(self, case: Case, progress: Names, cache: Cache) -> None:
        self._case = case
        self._progress = progress
        self._cache = cache
        self._volumes: dict[str, VolumeSurfaces] = {}
        self._imaged: dict[tuple[str, int | None], Imaged] = {}
        self.ends: dict[str, LabelEnds] = {}
        """Of the labels in each label map and mask that was read, by its name as the case writes it. But the skin's: a
        body that goes on says nothing of where the organs in it were searched."""
        self.warnings: list[str] = []
        self.ignored: list[str] = []

    def one(self, section: StructureSection) -> Structure:
        """One structure from a mesh or a label."""
        self._progress(section.name)
        if section.mesh is not None:
            mesh, source, voxel_ct = self._mesh(section), section.mesh, None
        else:
            if section.labelmap is None or section.label is None:
                refuse(f"'{section.name}' has no source", self._case.path, "mesh or labelmap", "missing_source")
            volume, source = self._labels(section.labelmap), f"{section.labelmap}:{section.label}"
            mesh, voxel_ct = volume.label(section.label), volume.voxel_ct
        role, margin_mm = Role(section.role), section.margin_mm or 0.0
        return Structure(section.name, role, margin_mm, mesh, source, voxel_ct=voxel_ct)

    def many(self, section: StructuresSection) -> list[partial[Structure]]:
        """All labels of a map, or masks of a folder, that the rules do not ignore; their surfaces are made on call."""
        if section.mask_set is not None:
            return self._masks(section, section.mask_set)
        name = section.source
        volume = self._labels(name)
        names = names_for(section.naming, self._case.folder, self._case.files.content, volume)
        rules = self._kept_rules(section, names, volume.present().labels)
        return [partial(self._ruled, rule, volume, name, rule.label) for rule in rules]

    def _ruled(self, rule: LabelRule, volume: VolumeSurfaces | None, file: str, label: int) -> Structure:
        """The structure that a rule names; a volume that nobody holds is opened for it alone."""
        self._progress(rule.name)
        volume = volume or self._open(file)
        role, mesh = Role(rule.kind.value), volume.label(label)
        return Structure(rule.name, role, rule.margin_mm, mesh, f"{file}:{label}", voxel_ct=volume.voxel_ct)

    def _masks(self, section: StructuresSection, folder: str) -> list[partial[Structure]]:
        """One structure a mask (a file or part of one) that is not empty; one mask's voxels at a time are in memory."""
        self._refuse_local(folder, "masks")
        files = self._case.masks(folder)
        self.warnings.extend(self._case.volumes.mask_notes(folder))
        grids = {one: self._case.volumes.source(one).grid for one in files.values()}
        check_one_grid(grids, where=self._file(folder))
        self._check_grid(next(iter(grids.values())), folder)
        names = dict(enumerate(files, start=1))
        masks = {number: self._open(files[name]).mask() for number, name in names.items()}
        self.ends |= {file: mask.ends for file, mask in zip(files.values(), masks.values(), strict=True)}
        present = [number for number, mask in masks.items() if mask.labels]
        self.warnings.extend(said for number, mask in masks.items() for said in mask.notes(Path(files[names[number]])))
        if empty := [name for number, name in names.items() if number not in present]:
            count = plural(len(empty), "empty mask")
            self.warnings.append(EMPTY_MASKS.format(folder=folder, empty=count, names=first_few(empty)))
        rules = self._kept_rules(section, names, present)
        return [partial(self._ruled, rule, None, files[rule.name], *masks[rule.label].labels) for rule in rules]

    def _kept_rules(
        self, section: StructuresSection, names: Mapping[int, str], present: Collection[int]
    ) -> Iterator[LabelRule]:
        """The rules of those that are present; names of what is ignored are noted."""
        roles = {role: getattr(section, role) for role in ("avoid", "unknown", "traverse", "ignore", "target")}
        all_named = section.naming in BUILT_IN
        selection = select(names, present, **roles, all_named=all_named, where=self._case.path)
        self.warnings.extend(selection.warnings)
        self.ignored.extend(rule.name for rule in selection.rules if rule.kind is RuleKind.IGNORE)
        yield from (rule for rule in selection.rules if rule.kind is not RuleKind.IGNORE)

    def unnamed_warnings(self) -> Iterator[str]:
        """Maps from which the case takes single labels, and which hold others that nobody names."""
        whole = {section.source for section in self._case.structures}
        listed = {(section.labelmap or "", section.label) for section in self._case.structure}
        for name in sorted({name for name, _ in listed} - whole - {""}):
            volume = self._labels(name)
            others = [label for label in volume.present().labels if (name, label) not in listed]
            names = (volume.names or {}) if name.lower().endswith(NRRD_ENDINGS) else {}
            if others:
                shown = first_few([f"{label} {names[label]}" if label in names else str(label) for label in others])
                yield f"{name} has labels that the case does not list; they count as free: {shown}"

    def skin(self, section: StructureSection, structures: Sequence[Structure] = ()) -> Skin:
        """The body's surface, from whatever the case names; where structures within it are cut, the body is too."""
        self._progress(section.name)
        if volume := section.ct or section.labelmap:
            return self._seen(volume, section.label, structures, section.cut).skin()
        mesh, kept = self._mesh(section), self._cache.memory
        local = self._case.space is Space.LOCAL or section.cut is not None
        ends = () if local else kept.get((flat_ends.__name__, mesh.digest), partial(flat_ends, mesh), len)
        if ends:
            what = f"skin mesh {section.mesh} has a flat end at side {', '.join(ends)}: was the body cut there?"
            allowed = f"cut = {json.dumps(ends)} where there is no skin, or cut = [] if all of it is skin"
            refuse(what, self._case.path, allowed, "skin_cut_unstated")
        return cached_skin(mesh, section.cut or (), self._cache)

    def _seen(
        self, name: str, label: int | None, structures: Sequence[Structure], stated: Sequence[str] | None
    ) -> Imaged:
        """Voxels of a CT, or of a body's label, that show the body's outside."""
        if (name, label) not in self._imaged:
            volume = self._volume(name) if label is None else self._labels(name)
            organs, ct = [(one.mesh, one.voxel_mm) for one in structures], self._case.ct
            shown = Shown(self._case.region == "phantom", ct.arms, ct.table)
            imaged, target_ct = partial(volume.imaged, label, organs, stated=stated), self._case.target_ct
            seen = imaged(shown=shown)
            of_skin = label is None and name == self._case.skin_section.ct
            if shown.phantom and of_skin and not contains(seen.skin().mesh, target_ct):
                seen = imaged(shown=replace(shown, about=tuple(target_ct.tolist())))  # of several phantoms another
            self._imaged[name, label] = seen
        return self._imaged[name, label]

    def scan(self, skin_section: StructureSection, skin: Skin, structures: Sequence[Structure] = ()) -> Scan | None:
        """The CT of the case: of its skin, or the one that ``[ct]`` names; None where there is none."""
        own, named = skin_section.ct, self._case.ct.file
        if own is not None and named not in {None, own}:
            allowed = "one CT: omit [ct] file if the skin comes from a CT"
            refuse(f"[ct] file '{named}' is not the CT of the skin, '{own}'", self._case.path, allowed, "several_cts")
        name = own or named
        if name is None:
            return None
        self._progress("CT with the structures")
        seen = self._seen(name, None, structures, skin_section.cut if own else None)
        if not seen.surfaces.source.grid.contains(self._case.target_ct):
            what = f"[ct] file '{name}' does not contain the target: wrong file or space?"
            allowed = "a CT that contains the target, in the space of the structures"
            refuse(what, self._case.path, allowed, "target_outside_ct")
        return Scan(name, seen, None if own else skin)

    def _mesh(self, section: StructureSection) -> TriangleMesh:
        where = f"{self._case.path}: structure '{section.name}'"
        if section.mesh is None or section.unit is None:
            refuse("no mesh with a unit", where, "mesh and unit", "missing_source")
        file, by_default = self._file(section.mesh), section.space is None
        space = parse_space(section.space, where=where) if section.space else self._case.space
        unit = parse_unit(section.unit, where=where)
        read_as = unit, space, by_default, section.up
        key = (__name__, self._case.files.sha256(section.mesh), file.suffix.lower(), *read_as)
        return self._cache.memory.get(key, partial(self._parsed, section.mesh, *read_as), lambda mesh: mesh.nbytes)

    def _parsed(self, name: str, unit: Unit, space: Space, by_default: bool, up: Up | None) -> TriangleMesh:
        content = self._case.files.content(name)
        return parse_mesh(content, self._file(name), unit=unit, space=space, space_is_default=by_default, up=up)

    def _labels(self, name: str) -> VolumeSurfaces:
        self._refuse_local(name, "label map")
        known, volume = name in self._volumes, self._volume(name)
        if not known:
            self._check_grid(volume.source.grid, name)
            present = volume.present()
            skin = self._case.skin_section
            organs = [(skin.labelmap, skin.label) != (name, label) for label in present.labels]
            self.ends[name] = present.ends.only(np.array(organs))
            self.warnings.extend(present.notes(volume.path))
        return volume

    def _check_grid(self, grid: VolumeGrid, name: str) -> None:
        ct = self._case.skin_section.ct or self._case.ct.file
        if ct is not None:
            refuse_lost_grid(grid, self._case.volumes.source(ct).grid, where=self._file(name))

    def _refuse_local(self, name: str, kind: str) -> None:
        if self._case.space is Space.LOCAL:
            refuse(f'{kind} {name} in a case of space "local"', self._case.path, 'space "LPS" or "RAS"', "local_space")

    def _volume(self, name: str) -> VolumeSurfaces:
        if name not in self._volumes:
            self._volumes[name] = self._open(name)
            self.warnings.extend(self._volumes[name].source.notes)
        return self._volumes[name]

    def _open(self, name: str) -> VolumeSurfaces:
        """A volume held by its caller alone, so that its voxels are freed with it."""
        source = self._case.volumes.source(name)
        hashes = (self._case.files.sha256(file) for file in source.files)
        return VolumeSurfaces(source, (*hashes, *source.part), self._cache)

    def _file(self, name: str) -> Path:
        return self._case.folder / name


OUTSIDE_BODY, ATTACHED_LIMB = "outside_body", "attached_limb"
UNNAMED_DENSE, UNNAMED_GAS = "unnamed_dense", "unnamed_gas"
"""Names of the structures that the CT adds."""
OUTSIDE_NOT_KNOWN = (
    "outside the body: not known (no CT; [ct] file can state one), so table, clothes and arms count as air"
)
LIMB_ATTACHED = "a limb seems to be pressed against the trunk"
NO_ARMS = '[ct] arms = "none"'
"""The second overrules the rule."""
UNNAMED_FREE = '[ct] unnamed = "free": what the CT shows inside the body outside the structures is not checked'
CELLS, OWN_TARGET = 24, "target.hit_radius_mm"
"""Cells along the diameter of the target's own ball, and where that comes from."""


@dataclass(frozen=True, eq=False)
class Anatomy:
    """All solids that a needle is checked against, and the warnings on what could not be known."""

    structures: tuple[Structure, ...]
    """All structures of the body but the skin; the CT's unnamed dense components and gas among them."""
    skin: Skin
    warnings: tuple[str, ...]
    surroundings: tuple[Structure, ...] = ()
    """Solids outside of the body: what the CT shows there, obstacles, the gantry."""
    scan: Scan | None = None
    ignored: tuple[str, ...] = ()
    """Names of labels that the case leaves out on purpose."""
    couch: TriangleMesh | None = None
    """What lies beyond what the body lies on in the CT, or None where no CT shows it."""
    findings: tuple[Finding, ...] = ()
    """The warnings and further findings, with code and numbers."""

    @property
    def checked(self) -> tuple[Structure, ...]:
        """Everything that a direction is checked against, structures first."""
        return self.structures + self.surroundings

    def structure(self, name: str) -> Structure:
        """The structure of this name. Raises InputError: There is none."""
        names = [structure.name for structure in self.structures]
        if name not in names:
            what = f"no structure '{name}'{did_you_mean(name, names)}"
            refuse(what, "anatomy", ", ".join(names), "unknown_structure")
        return self.structures[names.index(name)]


def load_anatomy(case: Case, progress: Names = unnamed, cache: Cache = NO_CACHE) -> Anatomy:
    """Read every structure of a case. What they say of each other and of the target: `planning.evidence.checks`.

    Raises InputError: A file that cannot be trusted, or a label that no rule names.
    """
    loader = StructureSources(case, progress, cache)
    reads = [partial(loader.one, section) for section in case.structure if section.role != "skin"]
    reads += [one for section in case.structures for one in loader.many(section)]
    if wrong := count_difference(case.stated_structures, len(reads) + 1):  # before surfaces are made
        refuse(wrong, case.path, "the number of structures that are read", "structures_miscounted")
    structures = [read() for read in reads]
    skin = loader.skin(case.skin_section, structures)
    if case.region != "phantom" and not any(structure.demands_margin for structure in structures):
        what = 'no structure has role "avoid" or "unknown", so no verdict would say anything about safety'
        refuse(what, case.path, 'a structure of role "avoid" or "unknown", or region = "phantom"', "nothing_to_avoid")
    structures.extend(own_target(case))
    outside: tuple[Structure, ...] = ()
    guesses: list[Finding] = []
    couch: TriangleMesh | None = None
    scan, left_out = loader.scan(case.skin_section, skin, structures), tuple(loader.unnamed_warnings())
    if scan is None:
        loader.warnings.append(OUTSIDE_NOT_KNOWN)
    else:
        progress("what the CT shows outside of the body")
        shown = scan.outside(case.ct.air_hu)
        outside, couch = _outside(case, scan, shown, structures, loader.warnings), shown.couch
        for limb in (structure.mesh for structure in outside if structure.name == ATTACHED_LIMB):
            guesses.append(guessed(ATTACHED_LIMB, LIMB_ATTACHED, limb.volume / 1e3, body_side(limb, skin), NO_ARMS))
        if case.ct.unnamed == "free":
            loader.warnings.append(UNNAMED_FREE)
        progress("unnamed tissue in the body")
        structures.extend(_unnamed(case, scan, structures))
    unseen = beyond_images(case, skin, scan, cache.memory)
    beyond, ending = beyond_labels(case, skin, structures, loader.ends, cache.memory)
    outside = (*outside, *unseen.structures)
    structures.extend(beyond)
    _check_names(case, [*structures, *outside])
    read = {one.name: one.mesh for one in structures if one.source != OWN_TARGET}  # the ball is ours
    of_meshes = cached_mesh_warnings(read, cache)
    warnings = (*loader.warnings, *ending, *left_out, *skin.warnings, *of_meshes)
    findings = (*guesses, *unseen.findings)
    return Anatomy(tuple(structures), skin, warnings, outside, scan, tuple(loader.ignored), couch, findings)


def guessed(code: str, what: str, volume: float, side: str, overrule: str) -> Finding:
    """Sentence on what a rule guessed of an image: how much, where, which picture shows it, what overrules it."""
    said = (
        f"{what}: {volume / 1000:.1f} l at its {side} side (see slices.png); paths through it are unknown_region "
        f"({code}); if that is wrong: {overrule}"
    )
    return Finding(code, Severity.WARNING, said, {"volume_ml": volume, "side": side, "overruled_by": overrule})


def body_side(mesh: TriangleMesh, skin: Skin) -> str:
    """The side of the body at which a solid's centre of mass lies: left, right, front or back."""
    a, b, c = np.moveaxis(mesh.triangles - mesh.bounds[0], 1, 0)
    weight = np.einsum("ij,ij->i", a, np.cross(b, c))  # of the tetrahedron between each triangle and the corner
    middle = mesh.bounds[0] + weight @ (a + b + c) / (4.0 * weight.sum())
    (x, y, _), half = middle - skin.mesh.bounds.mean(axis=0), np.ptp(skin.mesh.bounds, axis=0) / 2
    if abs(x) / half[0] >= abs(y) / half[1]:
        return "left" if x > 0 else "right"
    return "back" if y > 0 else "front"


def _outside(
    case: Case, scan: Scan, outside: Outside, structures: Sequence[Structure], warnings: list[str]
) -> tuple[Structure, ...]:
    """Surfaces of what the CT shows outside of the body that is not air, and of limbs pressed against it."""
    if case.ct.table != "none":
        warnings.extend(support_warnings(outside.couch is not None, outside.open_faces))
    limbs = scan.attached_limbs(case.target_ct, [one for one in structures if one.source != OWN_TARGET])
    return tuple(_unknown(case, scan, {OUTSIDE_BODY: outside.mesh, ATTACHED_LIMB: limbs}, outside=True))


def _unnamed(case: Case, scan: Scan, structures: Sequence[Structure]) -> Iterator[Structure]:
    """Surfaces of what the CT shows inside the body that no structure names, unless the case declares it free."""
    if case.ct.unnamed == "free":
        return iter(())
    written, balls = ([one for one in structures if (one.source == OWN_TARGET) == own] for own in (False, True))
    unnamed = scan.unnamed(written, case.ct.dense_hu)
    if any(scan.may_hold(unnamed, ball.mesh) for ball in balls):  # else it is the same for every target
        unnamed = scan.unnamed([*written, *balls], case.ct.dense_hu)
    return _unknown(case, scan, {UNNAMED_DENSE: unnamed.dense, UNNAMED_GAS: unnamed.gas}, outside=False)


def _unknown(
    case: Case, scan: Scan, meshes: Mapping[str, TriangleMesh | None], *, outside: bool
) -> Iterator[Structure]:
    margin_mm, voxel_ct = case.ct.margin_mm, scan.source.surfaces.voxel_ct
    for name, mesh in meshes.items():
        if mesh is not None:
            yield Structure(name, Role.UNKNOWN, margin_mm, mesh, f"{scan.name}: {name}", outside, voxel_ct)


def load_skin(case: Case, cache: Cache = NO_CACHE) -> Skin:
    """The skin of a case alone. Raises InputError: A file that cannot be trusted."""
    return StructureSources(case, lambda _: None, cache).skin(case.skin_section)


def load_couch(case: Case, skin: Skin, cache: Cache = NO_CACHE) -> TriangleMesh | None:
    """The surfaces beyond what the body lies on in the case's CT, as `Anatomy.couch`.

    Raises InputError: A CT that cannot be trusted, or does not show the target.
    """
    scan = StructureSources(case, lambda _: None, cache).scan(case.skin_section, skin)
    return None if scan is None else scan.outside(case.ct.air_hu).couch


def _check_names(case: Case, structures: list[Structure]) -> None:
    names = [structure.name for structure in structures]
    twice = sorted(name for name, count in Counter(names).items() if count > 1)
    if twice:
        refuse(f"structure '{twice[0]}' appears twice", case.path, "unique names", "duplicate_name")
    if case.target_structure not in names:
        what = (
            f"target.structure '{case.target_structure}' is not a structure of the case"
            f"{did_you_mean(case.target_structure, names)}"
        )
        refuse(what, case.path, ", ".join(names), "unknown_structure")


def surface_distance(mesh: TriangleMesh, point: NDArray[np.float64]) -> float:
    """Distance of a point (3,) from a surface, on either side, mm."""
    return float(np.sqrt(squared_distance(point, mesh.triangles).min()))


def own_target(case: Case) -> Iterator[Structure]:
    """The target as a structure of its own, where the case names none that holds it."""
    if case.own_target and case.hit_radius_mm is not None:
        mesh = ball(case.target_ct, case.hit_radius_mm)
        yield Structure(case.target_structure, Role.TARGET, 0.0, mesh, OWN_TARGET, voxel_ct=np.zeros((3, 3)))


def ball(middle_ct: Floats, radius_mm: float) -> TriangleMesh:
    """The surface of a ball about a point (3,), mm, to a hundredth of its radius."""
    cell = 2.0 * radius_mm / CELLS
    offset = (np.arange(CELLS + 3) - (CELLS + 2) / 2) * cell
    x, y, z = np.meshgrid(offset, offset, offset, indexing="ij")
    field = radius_mm - np.sqrt(x**2 + y**2 + z**2)
    field[field == 0.0] = -np.finfo(np.float32).eps
    T_ct_index = pose(np.eye(3) * cell, middle_ct + offset[0])
    framed, within = frame(field.shape)
    within[:] = field / radius_mm
    return framed_surface(framed, T_ct_index, where=OWN_TARGET)
