"""The case's limits of the chances, and which structures they are about."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy, Structure
from puncture_twin.planning.base.arrays import Ints
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.near_names import did_you_mean
from puncture_twin.planning.case.case import Case


def demanding(structures: tuple[Structure, ...]) -> Ints:
    """Columns of the structures that must not be touched."""
    return np.flatnonzero([s.demands_margin for s in structures])


def check_limits(case: Case, anatomy: Anatomy, error_known: bool) -> None:
    """Refuse limits that no candidate can be tested against: every one would pass untested.

    Args:
        case: States the limits.
        anatomy: Its structures.
        error_known: Whether markers and arm give the error of the needle's pose.

    Raises:
        InputError: Limits without a pose error, or of a structure that has no chance to be touched.
    """
    settings = case.search
    limited = settings.min_hit is not None or settings.max_touch is not None or bool(settings.max_touch_of)
    if limited and not error_known:
        message = "search.min_hit and max_touch cannot be checked: only markers and the arm give the needle's error"
        allowed = "[registration] with markers, and a search with the arm; or no such limit"
        raise InputError(message, where=case.path, allowed=allowed)
    names = [anatomy.checked[column].name for column in demanding(anatomy.checked)]
    unknown = sorted(set(settings.max_touch_of) - set(names))
    if unknown:
        message = f"search.max_touch_of '{unknown[0]}' is no structure that must not be touched"
        message += did_you_mean(unknown[0], names)
        raise InputError(message, where=case.path, allowed=", ".join(names))


def touch_limit(case: Case, name: str) -> float:
    """The greatest chance to touch a structure that a case allows."""
    allowed = case.search.max_touch_of.get(name, case.search.max_touch)
    return np.inf if allowed is None else allowed
