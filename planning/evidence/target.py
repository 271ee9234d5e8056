"""What speaks against a target: a vessel's name, the other space, an open mesh around it, a needle too short."""

from collections.abc import Callable, Iterable, Iterator
from enum import IntEnum
from functools import partial

import numpy as np

from puncture_twin.planning.anatomy.anatomy import OWN_TARGET, Anatomy, surface_distance
from puncture_twin.planning.anatomy.default_roles import (
    LESION,
    NEVER_CROSSED,
    default_role,
    named_as_crossed,
    never_crossed,
)
from puncture_twin.planning.anatomy.structure import Role
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import Finding, Severity
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.geometry.containment import Side, contains, odd_fraction, side_of, winding_number
from puncture_twin.planning.geometry.spaces import Space, Unit, point_text, to_lps
from puncture_twin.planning.geometry.triangle_distance import squared_distance

MOST_AROUND = 0.5
"""An open mesh may go so far around the target: of the rays that cross it oddly, and of its winding number."""
ON_SURFACE_MM = 1e-3
"""A target this close to its structure's surface lies on it: meshes in single precision round to 1e-5 mm."""


class Likely(IntEnum):
    """How likely a structure is to be a target, the least first."""

    NOTHING = 0
    """No structure at all: fat, or what nobody drew."""
    DANGER = 1
    """A large vessel, a nerve, the heart: no usual target."""
    OTHER = 2
    """Anything else, such as a bone, a muscle, or a name that nobody knows."""
    ORGAN = 3
    """An organ that the table of default roles knows and that is avoided: a lesion may lie in it."""
    LESION = 4


def likely_target(names: Iterable[str]) -> Likely:
    """Of the structures that hold a point, the likeliest target: it tells the wrong one of two readings of a point."""
    likeliest = Likely.NOTHING
    for name in names:
        line = default_role(name, "other")
        if line == LESION:
            likely = Likely.LESION if never_crossed(name) is None else Likely.DANGER
        elif line is None or line.kind != "avoid":
            likely = Likely.OTHER
        else:
            likely = Likely.DANGER if line.group in NEVER_CROSSED else Likely.ORGAN
        likeliest = max(likeliest, likely)
    return likeliest


def target_place(case: Case, anatomy: Anatomy) -> Iterator[Finding]:
    """A target must lie inside the skin and its own structure, and inside nothing that is to be avoided."""
    if side_of(anatomy.skin.mesh, case.target_ct) is Side.OUTSIDE:
        hint = readings_inside(case.target_ct, case.space, partial(contains, anatomy.skin.mesh))
        yield _misplaced(case, f"outside the skin{hint}", "a point in the body, in mm, in the case's space")
    for structure in anatomy.structures:
        own = structure.name == case.target_structure
        low, high = structure.mesh.bounds
        if not own and not np.all((low <= case.target_ct) & (case.target_ct <= high)):
            continue
        side = side_of(structure.mesh, case.target_ct)
        if structure.role is Role.AVOID and side is Side.INSIDE:
            lies = f"inside '{structure.name}', which is to be avoided"
            yield _misplaced(case, lies, "a target outside every 'avoid' structure")
        elif own and structure.role is not Role.TARGET:
            said = f"target.structure '{structure.name}' has role '{structure.role}'"
            way_out = 'role "target" for the structure that contains the target'
            yield Finding("target_role", Severity.REFUSAL, said, way_out=way_out)
        elif own and side is Side.OUTSIDE:
            gap = surface_distance(structure.mesh, case.target_ct)
            if gap > ON_SURFACE_MM:
                hint = readings_inside(case.target_ct, case.space, partial(contains, structure.mesh), "inside")
                lies = f"{gap:.1f} mm outside its structure '{structure.name}'{hint}"
                yield _misplaced(case, lies, "a point inside target.structure")


def _misplaced(case: Case, lies: str, allowed: str) -> Finding:
    said = f"target ({point_text(case.target_ct, case.space)}) lies {lies}"
    return Finding("target_misplaced", Severity.REFUSAL, said, way_out=allowed)


def readings_inside(
    point_ct: Floats, space: Space, inside: Callable[[Floats], bool], place: str = "in the body"
) -> str:
    """The readings of a point (3,), mm, under which it would lie where it belongs, in brackets; else empty."""
    readings = [text for text, point in _readings(point_ct, space) if inside(point)]
    return f" (read {' or '.join(readings)} it lies {place})" if readings else ""


def _readings(point_ct: Floats, space: Space) -> Iterator[tuple[str, Floats]]:
    for unit in Unit:
        if unit is not Unit.MM:
            yield f"in {unit}", unit.mm * point_ct
        if space is not Space.LOCAL:
            other = Space.RAS if space is Space.LPS else Space.LPS
            mirrored = to_lps(point_ct[None], Space.RAS)[0]
            yield f"in {other}" if unit is Unit.MM else f"in {other} and {unit}", unit.mm * mirrored


def target_in_vessel(case: Case) -> Iterator[Finding]:
    """A warning where the target is a vessel or the like: it is then not avoided, so paths that end in it are safe.

    Or where its name is not wholly known: a ``Tumorvene`` is a vessel, a lesion's by a part of its name alone, and an
    ``AAA`` is an aneurysm. In a phantom any name is usual.
    """
    if case.own_target:
        return
    name = case.target_structure
    if (line := never_crossed(name)) is not None:
        said = f"of '{line.group}' ({line.reason}): every safe path ends in it; is the target's position right?"
        yield Finding("target_in_vessel", Severity.WARNING, f"the target lies in '{name}', {said}")
        return
    line = default_role(name, "other")
    part = line == LESION and not named_as_crossed(name)
    if part or (line is None and case.region != "phantom"):
        shortfall = "is like a lesion's only in part" if part else "is not in the table of default roles"
        said = f"a name that {shortfall}, and every safe path ends in it: is it no vessel?"
        yield Finding("target_name_unknown", Severity.WARNING, f"the target lies in '{name}', {said}")


def target_in_other_space(case: Case, anatomy: Anatomy) -> Iterator[Finding]:
    """A warning where the target, read in the other space, lies in a lesion or organ, and as stated in none.

    Nothing is refused: a lesion that nobody drew is a target as well, and its mirror image may lie in another one.
    """
    if case.space is Space.LOCAL:
        return
    holders = list(_holders(anatomy, case.target_ct))
    other_holders = list(_holders(anatomy, to_lps(case.target_ct[None], Space.RAS)[0]))
    is_, would_be = likely_target(holders), likely_target(other_holders)
    if is_ < would_be is Likely.LESION or (is_ is Likely.NOTHING and would_be >= Likely.ORGAN):
        name = max(other_holders, key=lambda one: likely_target([one]))
        space = Space.RAS if case.space is Space.LPS else Space.LPS
        place = "in no structure" if not holders else f"in {', '.join(holders)}"
        yield Finding(
            "target_in_other_space",
            Severity.WARNING,
            f"the target ({point_text(case.target_ct, case.space)}) lies {place}; read in {space}, the same numbers "
            f"lie in '{name}': is the space right?",
        )


def _holders(anatomy: Anatomy, point_ct: Floats) -> Iterator[str]:
    """The names of the structures that hold a point (3,), LPS mm; the target's own ball is none."""
    for structure in anatomy.structures:
        if structure.source != OWN_TARGET and contains(structure.mesh, point_ct):
            yield structure.name


def open_around_target(case: Case, anatomy: Anatomy) -> Iterator[Finding]:
    """Refusals of open surfaces that go more than half around the target: their inside is not known.

    Two numbers tell: rays from the target say it however the triangles are wound, and the winding number says it of
    shells in shells, which a ray leaves an even number of times. Neither is the inside, so none is claimed.
    """
    for structure in anatomy.structures:
        if not structure.demands_margin or structure.mesh.closed:
            continue
        odd, turns = odd_fraction(structure.mesh, case.target_ct), winding_number(structure.mesh, case.target_ct)
        if max(odd, abs(turns)) > MOST_AROUND:
            yield Finding(
                "open_around_target",
                Severity.REFUSAL,
                f"'{structure.name}' is an open mesh around the target: it is not known whether the target lies inside "
                f"({100 * odd:.0f} % of rays from it cross the mesh an odd number of times; winding number "
                f"{turns:.2f})",
                {"odd": odd, "winding": turns},
                "a closed mesh, or one that covers less than half of the directions from the target",
            )


def needle_too_short(case: Case, anatomy: Anatomy) -> Iterator[Finding]:
    """A needle that is shorter than the shortest path from the target to the skin."""
    mesh, shown, longest = anatomy.skin.mesh, ~anatomy.skin.cut_faces, case.needle.longest_path_mm
    for every in (100, 1):  # of a usual body some of the first are near
        corners = mesh.vertices[mesh.faces[::every, 0][shown[::every]]] - case.target_ct
        if np.einsum("ij,ij->i", corners, corners).min(initial=np.inf) <= longest**2:
            return  # no triangle is farther away than its corner
    if not shown.any():
        return
    nearest = float(np.sqrt(squared_distance(case.target_ct, mesh.triangles[shown]).min()))
    if longest < nearest:
        said = f"the needle's longest path is {longest:g} mm, and the skin is {nearest:.1f} mm away"
        numbers = {"longest_path_mm": longest, "skin_mm": nearest}
        yield Finding("needle_too_short", Severity.WARNING, f"{said}: every path is too long", numbers)
