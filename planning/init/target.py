"""The target of a new case and what holds it; the roles of all structures then, and the region that they show."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import scipy

from puncture_twin.planning.anatomy import default_roles
from puncture_twin.planning.anatomy.default_roles import BODY, NOT_ANNOTATED, UNKNOWN_NAME, default_role, never_crossed
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
from puncture_twin.planning.init.segmentation import STATED, Assigned, Outlines, named_like_body, structures_of

LEAST_SHOWN = 0.3
"""Least fraction of a region's usual organs by which it is inferred."""
LEAST_ORGANS = 3
"""Organs that are enough, however long a region's list is."""
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
    """The structures that hold the target."""

    target: str | None  # the one that the case names, or None where none holds it
    others: frozenset[str]  # those around it, which a path must cross


def assign(
    names: Mapping[int, str],
    region: str,
    holding: Holding,
    outlines: Collection[str] = (),
    stated: Mapping[str, str] = MappingProxyType({}),
) -> list[Assigned]:
    """The role of each structure in a case, by label.

    Args:
        outlines: Of those that are named like the body the ones that are its outline.
        stated: Name to the kind that a person states: ``skin``, ``ignore`` or ``unknown``.
    """
    rows = []
    for label, name in sorted(names.items()):
        line = default_role(name, region) or UNKNOWN_NAME
        demanding = line if line.kind in DEMANDING else UNKNOWN_NAME
        if name in stated:
            rows.append(Assigned(label, name, stated[name], demanding.margin_mm, STATED))
            continue
        outline = line == BODY and name in outlines
        line = UNKNOWN_NAME if line == BODY and not outline else line
        if name == holding.target:
            rows.append(Assigned(label, name, "target", 0.0, line))
        elif name in holding.others and not outline and never_crossed(name) is None:
            # About the target, and no vessel or the like: crossed only if its name tells it wholly.
            if default_roles.named_as_crossed(name):
                rows.append(Assigned(label, name, "traverse", 0.0, line))
            else:
                rows.append(Assigned(label, name, "unknown", demanding.margin_mm, demanding))
        else:
            line = UNKNOWN_NAME if line.kind == "traverse" and not default_roles.named_as_crossed(name) else line
            rows.append(Assigned(label, name, line.kind, line.margin_mm, line))
    return rows


def role_notes(rows: Sequence[Assigned], holding: Holding) -> list[str]:
    """Sentences about names that the table does not know, and about what is crossed because of the target."""
    open_lines = {NOT_ANNOTATED, STATED}
    groups = {
        f"not in the table of default roles, so avoided by {UNKNOWN_NAME.margin_mm:g} mm": [
            row.name for row in rows if row.line == UNKNOWN_NAME and row.kind == "avoid"
        ],
        f"{NOT_ANNOTATED.group}, so paths through them are unknown_region": [
            row.name for row in rows if row.line == NOT_ANNOTATED and row.kind == "unknown"
        ],
        "they also contain the target, and are not known as organs that a needle may cross, so paths through "
        "them are unknown_region unless the case makes them traverse": [
            row.name for row in rows if row.kind == "unknown" and row.line not in open_lines
        ],
        "they also contain the target, so paths cross them (traverse)": [
            row.name for row in rows if row.name in holding.others and row.kind == "traverse"
        ],
        "left out as stated (ignore), so paths through them may be safe": [
            row.name for row in rows if row.kind == "ignore" and row.line == STATED
        ],
        "treated as the outline of the body, so not checked (ignore)": [
            row.name for row in rows if row.kind == "ignore" and row.line != STATED
        ],
    }
    return [f"{said}: {', '.join(names)}" for said, names in groups.items() if names]


def chosen_target(names: Collection[str]) -> str:
    """The structure that is the target, of those that hold it; never the body's outline.

    What is named as a lesion by all of its words, else one with such a word in it, else what the table knows for
    certain (an organ that a needle crosses, or a vessel that none does), else the first: beside a pancreas that holds
    the target too, an ``SMA`` is not taken for the target, nor a ``Tumorvene`` beside a tumour.
    """
    sure = [name for name in names if default_roles.named_as_lesion(name)]
    lesions = [name for name in names if default_role(name, "other") == default_roles.LESION]
    certain = [name for name in names if default_roles.named_as_crossed(name) or never_crossed(name) is not None]
    return next(iter([*sure, *lesions, *certain, *names]))


def likely_region(names: Collection[str], target: str | None) -> str:
    """The region of which most usual organs are there, the target's own among them; ``other`` where few are.

    Not a region whose own organs are missing, such as a spine without vertebrae and cord, and not one whose organs are
    all another's that has more of those which are there: liver, aorta and kidneys are no spine.
    """

    def shown(region: str, among: Collection[str]) -> list[str]:
        """The usual organs of a region that some name is like; of a pair one is enough."""
        absent = absent_organs(region, among)
        return [organ.name for organ in USUAL[region] if organ.name not in absent]

    def score(region: str) -> float:
        own = target is not None and bool(shown(region, [target]))
        return len(shown(region, names)) / len(USUAL[region]) + (0.1 if own else 0.0)

    explained: dict[str, set[str]] = {}
    for region, organs in USUAL.items():
        own = OWN_ORGANS.get(region)
        if organs and (own is None or not own.isdisjoint(shown(region, names))):
            explained[region] = {name for name in names if shown(region, [name])}
    whole = [region for region, some in explained.items() if not any(some < others for others in explained.values())]
    if not whole:
        return "other"
    region = max(whole, key=score)
    least = min(LEAST_SHOWN * len(USUAL[region]), LEAST_ORGANS)
    return region if len(shown(region, names)) >= least else "other"


CELLS = 64
"""Cells along the longest edge of a structure's box, to find its deepest point."""
USUAL_HIT_MM = 5.0
"""Radius of the ball that is hit where the target lies in no structure and nobody states it."""


@dataclass(frozen=True, eq=False)
class Target:
    """The target of a new case: a point to reach, and what holds it."""

    point_ct: Floats  # shape (3,), LPS mm
    holding: Holding
    notes: tuple[str, ...]
    hit_radius_mm: float = USUAL_HIT_MM  # of the ball that is hit where the target has no structure


def parse_point(text: str, space: Space) -> Floats:
    """A point as it is typed, ``X,Y,Z`` in mm, in LPS; shape (3,). Raises InputError: not three numbers."""
    return np.asarray(to_lps(np.array([parse_triple(text, "--target")]), space)[0])


def typed_target(
    point_ct: Floats, outlines: Outlines, space: Space, *, space_stated: bool, hit_radius_mm: float | None = None
) -> Target:
    """A point (3,), LPS mm, that was typed, with the structures that hold it.

    Args:
        outlines: The body's, with all segmentations that may hold the point.
        hit_radius_mm: Stated where the target is a ball of its own, whatever holds it; else None.

    Raises:
        InputError: It is a likelier target in the other space, and nobody said which is meant; it lies in no structure,
            but there in a lesion, and nobody said that none is meant; or it lies in what no path may cross.
    """
    holders = _holders(point_ct, outlines)
    names = [name for name in holders if default_role(name, "other") not in {BODY, NOT_ANNOTATED}]
    place_text = f"target ({point_text(point_ct, space)}) lies"
    # What would hold the point if its numbers were meant in the other space, and what to say where that is likelier.
    elsewhere: list[str] = []
    reading = ""
    if space is not Space.LOCAL and (hit_radius_mm is None or not space_stated):  # else nobody asks
        elsewhere_holders = _holders(to_lps(point_ct[None], Space.RAS)[0], outlines)
        elsewhere = [name for name in elsewhere_holders if not named_like_body(name)]
        if likely_target(elsewhere) > likely_target(names):
            other = Space.RAS if space is Space.LPS else Space.LPS
            reading = f" (read in {other} it lies in '{chosen_target(elsewhere)}': --space {other})"
    if reading and not space_stated:
        place = f"in '{chosen_target(names)}'" if names else "in no structure"
        allowed = "the intended one of --space LPS and --space RAS"
        refuse(f"{place_text} {place}{reading}", "--target", allowed, "target_in_other_space")
    if not names and hit_radius_mm is None and likely_target(elsewhere) is Likely.LESION:
        allowed = "the other --space; or --hit-radius MM for a target in no structure"
        refuse(f"{place_text} in no structure{reading}", "--target", allowed, "target_in_no_structure")
    if not names or hit_radius_mm is not None:
        radius_mm = USUAL_HIT_MM if hit_radius_mm is None else hit_radius_mm
        neighbours = f" but {', '.join(holders)}" if holders else f"; the nearest is {_nearest(point_ct, outlines)}"
        note = f"the target lies in no structure{neighbours}; the target is a ball of {radius_mm:g} mm about it"
        return Target(point_ct, Holding(None, frozenset(holders)), (note,), radius_mm)
    chosen = chosen_target(names)
    if (line := never_crossed(chosen)) is not None:  # a slip of numbers: nothing would keep the needle out of an aorta
        danger = f"of '{line.group}' ({line.reason}): as the target's structure, it would not be avoided"
        allowed = f"a point outside it, or --target-label '{chosen}' if it is the target itself"
        refuse(f"{place_text} in '{chosen}'{reading}: {danger}", "--target", allowed, "target_in_danger")
    holding = Holding(chosen, frozenset(holders) - {chosen})
    return Target(point_ct, holding, (f"the target lies in '{chosen}', the structure of the target",))


def _nearest(point_ct: Floats, outlines: Outlines) -> str:
    every = structures_of(outlines.segmentations)
    gaps = [(float(np.sqrt(squared_distance(point_ct, one.surface.triangles).min())), one.name) for one in every]
    gap, name = min(gaps, default=(np.inf, ""))
    return f"'{name}', {gap:.1f} mm away"


def label_target(name: str, outlines: Outlines, space: Space) -> Target:
    """The deepest point of the largest part of a structure. Raises InputError: no structure has this name."""
    known = {one.name: one for one in structures_of(outlines.segmentations)}
    if name not in known:
        what = f"no structure is named '{name}'{did_you_mean(name, known)}"
        refuse(what, "--target-label", ", ".join(sorted(known)) or "there are none", "unknown_structure")
    point, parts = _deepest_point(known[name].surface)
    notes = [f"the target is the deepest point of '{name}': {point_text(point, space)}"]
    if parts > 1:
        notes.append(f"'{name}' has {parts} parts; the largest was used")
    return Target(point, Holding(name, frozenset(_holders(point, outlines)) - {name}), tuple(notes))


def _holders(point_ct: Floats, outlines: Outlines) -> list[str]:
    """The names of the structures that hold a point, the smallest first; none that is the body's outline."""
    by_size: list[tuple[float, str]] = []
    left_out = outlines.at(point_ct)
    for segmentation in outlines.segmentations:
        for label in segmentation.near(point_ct):
            name = segmentation.names[label]
            if name in left_out:
                continue
            mesh = segmentation.surface(label)
            if side_of(mesh, point_ct) is Side.INSIDE:
                by_size.append((float(np.prod(np.ptp(mesh.bounds, axis=0))), name))
    return [name for _, name in sorted(by_size)]


def _deepest_point(mesh: TriangleMesh) -> tuple[Floats, int]:
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
