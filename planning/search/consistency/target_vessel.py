"""A target in a vessel or the like, which no path should cross."""

from __future__ import annotations

from puncture_twin.planning.anatomy.default_roles import never_crossed
from puncture_twin.planning.case.case import Case


def target_warnings(case: Case) -> tuple[str, ...]:
    """That the target is a vessel or the like: its structure is not avoided, so paths that end in it are safe."""
    line = never_crossed(case.target_structure)
    if line is None or case.own_target:
        return ()
    return (
        f"the target lies in '{case.target_structure}', of '{line.group}' ({line.reason}): every safe path ends in it; "
        "is the target's place right?",
    )
