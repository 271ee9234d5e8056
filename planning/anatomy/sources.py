"""Reads what a case's structures come from: meshes, label maps, folders of masks, the CT."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from puncture_twin.planning.anatomy.body.tables import Shown
from puncture_twin.planning.anatomy.scan import Scan
from puncture_twin.planning.anatomy.skin import Skin, flat_ends
from puncture_twin.planning.anatomy.structure import Role, Structure
from puncture_twin.planning.anatomy.surfaces import Imaged, VolumeSurfaces, cached_skin
from puncture_twin.planning.base.cache.array_cache import Cache
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.progress import Names
from puncture_twin.planning.base.text import first_few, plural
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.tables import StructureSection, StructuresSection
from puncture_twin.planning.formats.labels.label_sources import check_one_grid
from puncture_twin.planning.formats.labels.naming import BUILT_IN, LabelRule, RuleKind, names_for, select
from puncture_twin.planning.formats.meshes.mesh_files import parse_mesh
from puncture_twin.planning.formats.volumes.volume_files import NRRD_ENDINGS
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid, refuse_lost_grid
from puncture_twin.planning.geometry.containment import contains
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.spaces import Space, Unit, Up, parse_space, parse_unit

EMPTY_MASKS = "{folder}: {empty}: {names}"


class StructureSources:
    """Reads the sources of one case, each volume at most once."""

    def __init__(self, case: Case, progress: Names, cache: Cache) -> None:
        self._case = case
        self._progress = progress
        self._cache = cache
        self._volumes: dict[str, VolumeSurfaces] = {}
        self._imaged: dict[tuple[str, int | None], Imaged] = {}
        self.warnings: list[str] = []
        self.ignored: list[str] = []

    def one(self, section: StructureSection) -> Structure:
        """One structure from a mesh or a label."""
        self._progress(section.name)
        if section.mesh is not None:
            mesh, source, voxel_ct = self._mesh(section), section.mesh, None
        else:
            mesh, source = self._label(section), f"{section.labelmap}:{section.label}"
            voxel_ct = self._labels(str(section.labelmap)).voxel_ct
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
        selection = select(
            names,
            present,
            avoid=section.avoid,
            unknown=section.unknown,
            traverse=section.traverse,
            ignore=section.ignore,
            target=section.target,
            all_named=section.naming in BUILT_IN,
            where=self._case.path,
        )
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
        if not seen.surfaces.source.grid.holds(self._case.target_ct):
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

    def _label(self, section: StructureSection) -> TriangleMesh:
        if section.labelmap is None or section.label is None:
            refuse(f"'{section.name}' has no source", self._case.path, "mesh or labelmap", "missing_source")
        return self._labels(section.labelmap).label(section.label)

    def _labels(self, name: str) -> VolumeSurfaces:
        self._refuse_local(name, "label map")
        known, volume = name in self._volumes, self._volume(name)
        if not known:
            self._check_grid(volume.source.grid, name)
            self.warnings.extend(volume.present().notes(volume.path))
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
