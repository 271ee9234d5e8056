"""The structures of a case, with roles and margins, from meshes or label maps, and the skin."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.body.tables import support_warnings
from puncture_twin.planning.anatomy.scan import Outside, Scan
from puncture_twin.planning.anatomy.skin import Skin
from puncture_twin.planning.anatomy.sources import StructureSources
from puncture_twin.planning.anatomy.structure import Role as Role, Structure as Structure
from puncture_twin.planning.anatomy.unnamed import Named
from puncture_twin.planning.anatomy.unseen import beyond_images, beyond_labels
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import NO_CACHE, Cache
from puncture_twin.planning.base.errors import Finding, Severity, refuse
from puncture_twin.planning.base.progress import Names, unnamed
from puncture_twin.planning.base.text import did_you_mean
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.case_file import count_difference
from puncture_twin.planning.formats.labels.labelmaps import frame, framed_surface
from puncture_twin.planning.formats.meshes.mesh_files import cached_mesh_warnings
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.planning.geometry.triangle_distance import squared_distance

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
    """What a needle must be checked against, and what could not be known."""

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
    """The warnings again, and what is said besides, with code and numbers."""

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

    Raises:
        InputError: A file that cannot be trusted, or a label that no rule names.
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
    beyond, ending = beyond_labels(case, skin, structures, cache.memory)
    outside = (*outside, *unseen.structures)
    structures.extend(beyond)
    _check_names(case, [*structures, *outside])
    read = {one.name: one.mesh for one in structures if one.source != OWN_TARGET}  # the ball is ours
    of_meshes = cached_mesh_warnings(read, cache)
    warnings = (*loader.warnings, *ending, *left_out, *skin.warnings, *of_meshes)
    found = (*guesses, *unseen.findings)
    return Anatomy(tuple(structures), skin, warnings, outside, scan, tuple(loader.ignored), couch, found)


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
    voxel_ct = scan.source.surfaces.voxel_ct
    bones = [Named(one.name, one.mesh) for one in structures if one.source != OWN_TARGET]
    found = ((OUTSIDE_BODY, outside.mesh), (ATTACHED_LIMB, scan.attached_limbs(case.target_ct, bones)))
    return tuple(
        Structure(name, Role.UNKNOWN, case.ct.margin_mm, mesh, f"{scan.name}: {name}", True, voxel_ct)
        for name, mesh in found
        if mesh is not None
    )


def _unnamed(case: Case, scan: Scan, structures: Sequence[Structure]) -> Iterator[Structure]:
    """Surfaces of what the CT shows inside the body that no structure names, unless the case declares it free."""
    if case.ct.unnamed == "free":
        return
    written = [Named(one.name, one.mesh) for one in structures if one.source != OWN_TARGET]
    balls = [Named(one.name, one.mesh) for one in structures if one.source == OWN_TARGET]
    unnamed = scan.unnamed(written, case.ct.dense_hu)
    if any(scan.may_hold(unnamed, ball.mesh) for ball in balls):  # else it is the same for every target
        unnamed = scan.unnamed([*written, *balls], case.ct.dense_hu)
    for name, mesh in ((UNNAMED_DENSE, unnamed.dense), (UNNAMED_GAS, unnamed.gas)):
        if mesh is not None:
            source, voxel_ct = f"{scan.name}: {name}", scan.source.surfaces.voxel_ct
            yield Structure(name, Role.UNKNOWN, case.ct.margin_mm, mesh, source, voxel_ct=voxel_ct)


def load_skin(case: Case, cache: Cache = NO_CACHE) -> Skin:
    """The skin of a case alone. Raises InputError: A file that cannot be trusted."""
    return StructureSources(case, lambda _: None, cache).skin(case.skin_section)


def load_couch(case: Case, skin: Skin, cache: Cache = NO_CACHE) -> TriangleMesh | None:
    """Load the surfaces beyond what the body lies on in the case's CT, as `Anatomy.couch`.

    Raises:
        InputError: A CT that cannot be trusted, or does not show the target.
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
