"""The target of a new case: a point that was typed, or the middle of a structure; and what holds it.

The roles that a new case gives its structures, and the region that they show.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import scipy

from puncture_twin.planning.anatomy.default_roles import (
    BODY,
    LESION,
    NOT_ANNOTATED,
    UNKNOWN_NAME,
    DefaultRole,
    default_role,
    named_as_crossed,
    named_as_lesion,
    never_crossed,
)
from puncture_twin.planning.anatomy.regions import USUAL, absent_organs
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.text import did_you_mean
from puncture_twin.planning.evidence.target import Likely, likely_target
from puncture_twin.planning.formats.labels.naming import DEMANDING
from puncture_twin.planning.formats.points import parse_triple
from puncture_twin.planning.geometry.containment import Side, side_of
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.parts import voxels_inside
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.planning.geometry.spaces import Space, point_text, to_lps
from puncture_twin.planning.geometry.triangle_distance import squared_distance
from puncture_twin.planning.init.segmentation import STATED, Assigned, Outlines, Segmentation, named_like_body

LEAST_SHOWN = 0.3
"""Of a region's usual organs; with fewer the region is found by nothing."""

LEAST_ORGANS = 3
"""So many are enough, however long a region's list is."""

OWN_ORGANS: Mapping[str, frozenset[str]] = MappingProxyType(
    {
        "spine": frozenset(("spine", "spinal cord")),
        "limb": frozenset(("bone",)),
        "brain": frozenset(("brain", "skull")),
        "head": frozenset(("brain", "skull", "eyes")),
    }
)
"""Of regions whose other organs are vessels or neighbours, which other regions have too: one of these is there."""


class Holding(NamedTuple):
    """The structures that hold the target.

    Attributes:
        target: The one that the case names, or None where none holds it.
        others: Those around it, which a path must cross.
    """

    target: str | None
    others: frozenset[str]


def assign(
    names: Mapping[int, str],
    region: str,
    holding: Holding,
    outlines: Collection[str] = (),
    stated: Mapping[str, str] = MappingProxyType({}),
) -> list[Assigned]:
    """What a case says of each structure, by label.

    Args:
        outlines: Of those that are named like the body the ones that are its outline.
        stated: Name to the kind that a person states: ``skin``, ``ignore`` or ``unknown``.
    """
    return [
        _assigned(label, names[label], region, holding, outlines)
        if names[label] not in stated
        else _stated(label, names[label], region, stated[names[label]])
        for label in sorted(names)
    ]


def _stated(label: int, name: str, region: str, kind: str) -> Assigned:
    line = default_role(name, region)
    line = line if line is not None and line.kind in DEMANDING else UNKNOWN_NAME
    return Assigned(label, name, kind, line.margin_mm, STATED)


def _assigned(label: int, name: str, region: str, holding: Holding, outlines: Collection[str]) -> Assigned:
    line = default_role(name, region) or UNKNOWN_NAME
    if line == BODY and name not in outlines:
        line = UNKNOWN_NAME
    if name == holding.target:
        return Assigned(label, name, "target", 0.0, line)
    if name in holding.others and line != BODY and never_crossed(name) is None:
        return _around_target(label, name, line)
    if line.kind == "traverse" and not named_as_crossed(name):
        line = UNKNOWN_NAME
    return Assigned(label, name, line.kind, line.margin_mm, line)


def _around_target(label: int, name: str, line: DefaultRole) -> Assigned:
    """Of a structure that holds the target too, and no vessel or the like: crossed only if its name tells it wholly."""
    if named_as_crossed(name):
        return Assigned(label, name, "traverse", 0.0, line)
    line = line if line.kind in DEMANDING else UNKNOWN_NAME
    return Assigned(label, name, "unknown", line.margin_mm, line)


def role_notes(rows: Sequence[Assigned], holding: Holding) -> Iterator[str]:
    """What a person should look at: names that the table does not know, and what is crossed because of the target."""
    unknown = [row.name for row in rows if row.line == UNKNOWN_NAME and row.kind == "avoid"]
    if unknown:
        yield f"not in the table of default roles, so avoided by {UNKNOWN_NAME.margin_mm:g} mm: {_list(unknown)}"
    if left_open := [row.name for row in rows if row.line == NOT_ANNOTATED and row.kind == "unknown"]:
        yield f"{NOT_ANNOTATED.group}, so paths through them are unknown_region: {_list(left_open)}"
    doubted = [row.name for row in rows if row.kind == "unknown" and row.line not in {NOT_ANNOTATED, STATED}]
    if doubted:
        yield (
            "they also contain the target, and are not known as organs that a needle may cross, so paths through "
            f"them are unknown_region unless the case makes them traverse: {_list(doubted)}"
        )
    crossed = [row.name for row in rows if row.name in holding.others and row.kind == "traverse"]
    if crossed:
        yield f"they also contain the target, so paths cross them (traverse): {_list(crossed)}"
    if left_out := [row.name for row in rows if row.kind == "ignore" and row.line == STATED]:
        yield f"left out as stated (ignore), so paths through them may be safe: {_list(left_out)}"
    outlines = [row.name for row in rows if row.kind == "ignore" and row.line != STATED]
    if outlines:
        yield f"treated as the outline of the body, so not checked (ignore): {_list(outlines)}"


def _list(names: Sequence[str]) -> str:
    return ", ".join(names)


def chosen_target(names: Collection[str]) -> str:
    """Of the structures that hold the target the one that it is; never the body's outline.

    What is named as a lesion by all of its words, else one with such a word in it, else what the table knows for
    certain (an organ that a needle crosses, or a vessel that none does), else the first: beside a pancreas that holds
    the target too, an ``SMA`` is not taken for the target, nor a ``Tumorvene`` beside a tumour.
    """
    sure = [name for name in names if named_as_lesion(name)]
    lesions = [name for name in names if default_role(name, "other") == LESION]
    certain = [name for name in names if named_as_crossed(name) or never_crossed(name) is not None]
    return next(iter([*sure, *lesions, *certain, *names]))


def likely_region(names: Collection[str], target: str | None) -> str:
    """The region of which most usual organs are there, the target's own among them; ``other`` where few are.

    Not a region whose own organs are missing, such as a spine without vertebrae and cord, and not one whose organs are
    all another's that has more of those which are there: liver, aorta and kidneys are no spine.
    """
    own = [] if target is None else [target]
    told = {region: _explained(region, names) for region, organs in USUAL.items() if organs and _has_own(region, names)}
    whole = [region for region, some in told.items() if not any(some < others for others in told.values())]
    if not whole:
        return "other"
    region = max(whole, key=lambda one: len(_shown(one, names)) / len(USUAL[one]) + _owns(one, own))
    shown = len(_shown(region, names))
    return region if shown >= min(LEAST_SHOWN * len(USUAL[region]), LEAST_ORGANS) else "other"


def _has_own(region: str, names: Collection[str]) -> bool:
    own = OWN_ORGANS.get(region)
    return own is None or not own.isdisjoint(_shown(region, names))


def _explained(region: str, names: Collection[str]) -> frozenset[str]:
    """The names that are those of a region's usual organs."""
    return frozenset(name for name in names if _shown(region, [name]))


def _shown(region: str, names: Collection[str]) -> list[str]:
    """The usual organs of a region that some name is like; of a pair one is enough."""
    absent = absent_organs(region, names)
    return [organ.name for organ in USUAL[region] if organ.name not in absent]


def _owns(region: str, target: Collection[str]) -> float:
    """A tenth for a region among whose usual organs the target is, if it is any."""
    return 0.1 if _shown(region, target) else 0.0


CELLS = 64
"""Along the longest edge of a structure's box, to find its deepest point."""

USUAL_HIT_MM = 5.0
"""Radius of the ball that is hit where the target lies in no structure and nobody states it."""


@dataclass(frozen=True, eq=False)
class Target:
    """A point to reach.

    Attributes:
        point_ct: Shape (3,), LPS mm.
        hit_radius_mm: Of the ball that is hit where the target has no structure.
    """

    point_ct: Floats
    holding: Holding
    notes: tuple[str, ...]
    hit_radius_mm: float = USUAL_HIT_MM


def parse_point(text: str, space: Space) -> Floats:
    """A point as it is typed, ``X,Y,Z`` in mm, in LPS; shape (3,).

    Raises:
        InputError: Not three numbers.
    """
    return np.asarray(to_lps(np.array([parse_triple(text, "--target")]), space)[0])


def typed_target(
    point_ct: Floats, outlines: Outlines, space: Space, *, space_stated: bool, hit_radius_mm: float | None = None
) -> Target:
    """A point that was typed, with the structures that hold it.

    Args:
        point_ct: Shape (3,), LPS mm.
        outlines: The body's, with all segmentations that may hold the point.
        space_stated: Whether the user said so.
        hit_radius_mm: Stated where the target is a ball of its own, whatever holds it; else None.

    Raises:
        InputError: It would lie in a structure, or a likelier one, if it was meant in the other space, and nobody said
            which; it lies in no structure, but in a lesion in the space that was not stated, and nobody said that no
            structure is meant; or it lies in a vessel or another structure that no path may cross, which a slip of
            numbers does.
    """
    holders = _holders(point_ct, outlines)
    names = [name for name in holders if default_role(name, "other") not in {BODY, NOT_ANNOTATED}]
    if not space_stated:
        _refuse_likelier(point_ct, outlines, space, names)
    if hit_radius_mm is not None:
        return _own_target(point_ct, outlines, holders, hit_radius_mm)
    if not names:
        _refuse_lesion_elsewhere(point_ct, outlines, space)
        return _own_target(point_ct, outlines, holders, USUAL_HIT_MM)
    chosen = chosen_target(names)
    _refuse_in_danger(point_ct, chosen, space, _other_reading(point_ct, outlines, space, names))
    holding = Holding(chosen, frozenset(holders) - {chosen})
    return Target(point_ct, holding, (f"the target lies in '{chosen}', the structure of the target",))


def _refuse_likelier(point_ct: Floats, outlines: Outlines, space: Space, names: Sequence[str]) -> None:
    """A point that is a likelier target in the other space, where nobody said in which it was typed."""
    if other := _other_reading(point_ct, outlines, space, names):
        place = f"in '{chosen_target(names)}'" if names else "in no structure"
        what = f"target ({point_text(point_ct, space)}) lies {place}{other}"
        refuse(what, "--target", "the intended one of --space LPS and --space RAS", "target_in_other_space")


def _refuse_lesion_elsewhere(point_ct: Floats, outlines: Outlines, space: Space) -> None:
    """A point in no structure is a slip, whatever space was stated, where the other space puts it into a lesion."""
    holders = _other_holders(point_ct, outlines)
    if space is not Space.LOCAL and likely_target(holders) is Likely.LESION:
        what = (
            f"target ({point_text(point_ct, space)}) lies in no structure"
            f"{_other_reading(point_ct, outlines, space, ())}"
        )
        allowed = "the other --space; or --hit-radius MM for a target in no structure"
        refuse(what, "--target", allowed, "target_in_no_structure")


def _own_target(point_ct: Floats, outlines: Outlines, holders: Sequence[str], radius_mm: float) -> Target:
    """A ball about the point as the target's own structure."""
    note = _in_nothing(point_ct, outlines.segmentations, holders, radius_mm)
    return Target(point_ct, Holding(None, frozenset(holders)), (note,), radius_mm)


def _refuse_in_danger(point_ct: Floats, chosen: str, space: Space, other: str) -> None:
    """A point in the aorta is a slip of numbers: as the target's structure nothing would keep the needle out of it."""
    line = never_crossed(chosen)
    if line is not None:
        what = f"target ({point_text(point_ct, space)}) lies in '{chosen}'{other}: {_danger(line)}"
        allowed = f"a point outside it, or --target-label '{chosen}' if it is the target itself"
        refuse(what, "--target", allowed, "target_in_danger")


def _danger(line: DefaultRole) -> str:
    return f"of '{line.group}' ({line.reason}): as the target's structure, it would not be avoided"


def label_target(name: str, outlines: Outlines, space: Space) -> Target:
    """The deepest point of the largest part of a structure.

    Raises:
        InputError: No structure has this name.
    """
    segmentations = outlines.segmentations
    known = {one: (seg, label) for seg in segmentations for label, one in seg.names.items()}
    if name not in known:
        what = f"no structure is named '{name}'{did_you_mean(name, known)}"
        refuse(what, "--target-label", ", ".join(sorted(known)) or "there are none", "unknown_structure")
    segmentation, label = known[name]
    point, parts = deepest_point(segmentation.surface(label))
    notes = [f"the target is the deepest point of '{name}': {point_text(point, space)}"]
    if parts > 1:
        notes.append(f"'{name}' has {parts} parts; the largest was used")
    others = frozenset(_holders(point, outlines)) - {name}
    return Target(point, Holding(name, others), tuple(notes))


def _holders(point_ct: Floats, outlines: Outlines) -> list[str]:
    """The names of the structures that hold a point, the smallest first; none that is the body's outline."""
    found: list[tuple[float, str]] = []
    left_out = outlines.at(point_ct)
    for segmentation in outlines.segmentations:
        for label in segmentation.near(point_ct):
            name = segmentation.names[label]
            if name in left_out:
                continue
            mesh = segmentation.surface(label)
            if side_of(mesh, point_ct) is Side.INSIDE:
                found.append((float(np.prod(np.ptp(mesh.bounds, axis=0))), name))
    return [name for _, name in sorted(found)]


def _other_reading(point_ct: Floats, outlines: Outlines, space: Space, here: Sequence[str]) -> str:
    """What the same numbers mean in the other space, where that is a likelier target than what holds them here."""
    if space is Space.LOCAL:
        return ""
    other = Space.RAS if space is Space.LPS else Space.LPS
    names = _other_holders(point_ct, outlines)
    if likely_target(names) <= likely_target(here):
        return ""
    return f" (read in {other} it lies in '{chosen_target(names)}': --space {other})"


def _other_holders(point_ct: Floats, outlines: Outlines) -> list[str]:
    """What would hold a point if its numbers were meant in the other space; without outlines of the body."""
    return [name for name in _holders(to_lps(point_ct[None], Space.RAS)[0], outlines) if not named_like_body(name)]


def _in_nothing(
    point_ct: Floats, segmentations: Sequence[Segmentation], holders: Sequence[str], radius_mm: float
) -> str:
    near = "" if holders else f"; the nearest is {_nearest(point_ct, segmentations)}"
    but = f" but {', '.join(holders)}" if holders else ""
    return f"the target lies in no structure{but}{near}; the target is a ball of {radius_mm:g} mm about it"


def _nearest(point_ct: Floats, segmentations: Sequence[Segmentation]) -> str:
    meshes = [(name, seg.surface(label)) for seg in segmentations for label, name in seg.names.items()]
    gaps = [(float(np.sqrt(squared_distance(point_ct, mesh.triangles).min())), name) for name, mesh in meshes]
    gap, name = min(gaps, default=(np.inf, ""))
    return f"'{name}', {gap:.1f} mm away"


def deepest_point(mesh: TriangleMesh) -> tuple[Floats, int]:
    """The point of a closed surface's largest part that lies farthest inside, shape (3,), and how many parts it has.

    Found on a grid of `CELLS` cells along the longest edge.
    """
    low, high = mesh.bounds
    cell = float((high - low).max()) / CELLS
    shape = np.ceil((high - low) / cell).astype(int) + 2
    T_ct_index = pose(np.eye(3) * cell, low - cell / 2)
    inside = voxels_inside(mesh, T_ct_index, tuple(shape))
    parts, count = scipy.ndimage.label(inside)
    largest = parts == np.argmax(np.bincount(parts.ravel())[1:]) + 1 if count > 1 else inside
    depth = scipy.ndimage.distance_transform_edt(largest)
    index = np.array(np.unravel_index(np.argmax(depth), depth.shape))
    return np.round(low - cell / 2 + cell * index, 1), count
