"""A target in a vessel or the like, which no path should cross, or in what may be one by its name."""

from __future__ import annotations

from puncture_twin.planning.anatomy.crossed_names import named_as_crossed
from puncture_twin.planning.anatomy.default_roles import LESION, default_role, never_crossed
from puncture_twin.planning.case.case import Case

UNNAMED = frozenset((None, "phantom"))
"""Regions in which structures have any name."""


def target_warnings(case: Case) -> tuple[str, ...]:
    """That the target is a vessel or the like: its structure is not avoided, so paths that end in it are safe.

    And that its name is not wholly known: a ``Tumorvene`` is a vessel, a lesion's by a part of its name alone, and an
    ``AAA`` is an aneurysm. In a phantom, and where a case of schema 1 states no region, any name is usual.
    """
    if case.own_target:
        return ()
    name = case.target_structure
    if (line := never_crossed(name)) is not None:
        return (
            f"the target lies in '{name}', of '{line.group}' ({line.reason}): every safe path ends in it; "
            "is the target's place right?",
        )
    line = default_role(name, "other")
    part = line == LESION and not named_as_crossed(name)
    if part or (line is None and case.region not in UNNAMED):
        of = "is a lesion's by a part of it alone" if part else "the table of default roles does not know"
        return (f"the target lies in '{name}', a name that {of}, and every safe path ends in it: is it no vessel?",)
    return ()
