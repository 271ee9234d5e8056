"""The roles that a new case gives its structures, and the region that they show."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

from puncture_twin.planning.anatomy.crossed_names import named_as_crossed, named_as_lesion
from puncture_twin.planning.anatomy.default_roles import (
    BODY,
    LESION,
    NOT_ANNOTATED,
    UNKNOWN_NAME,
    DefaultRole,
    default_role,
    never_crossed,
)
from puncture_twin.planning.anatomy.regions import USUAL, absent_organs
from puncture_twin.planning.formats.labels.naming import DEMANDING
from puncture_twin.planning.init.segmentation import STATED, Assigned

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
