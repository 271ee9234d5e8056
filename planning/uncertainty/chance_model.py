"""What the chances of a case are computed from, and the limits that a case puts on them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy, Structure
from puncture_twin.planning.base.arrays import Ints
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.uncertainty.chances import HitModel, hit_model
from puncture_twin.planning.uncertainty.pose_error import PoseError

TAKEN = frozenset({"any", "joint"})
"""Names whose column ``p_touch_<name>`` says something else than one structure's chance."""


@dataclass(frozen=True, eq=False)
class ChanceModel:
    """What the chances of a case's candidates are computed from.

    Attributes:
        error: Of the needle's pose.
        hit: When the tip hits.
    """

    error: PoseError
    hit: HitModel


def chance_model(case: Case, anatomy: Anatomy, error: PoseError | None) -> ChanceModel | None:
    """The model of a case; None where it declares no errors, or nothing ties its frames.

    Raises:
        InputError: Neither a radius nor a closed mesh says where the target is hit, or a structure has the name of
            another column.
    """
    if error is None:
        return None
    taken = [anatomy.checked[column].name for column in demanding(anatomy.checked)]
    if not TAKEN.isdisjoint(taken):
        message = f"structures {', '.join(sorted(TAKEN.intersection(taken)))}: p_touch_<name> is another column"
        raise InputError(message, where=case.path, allowed="other names than any and joint")
    mesh = anatomy.structure(case.target_structure).mesh
    if case.hit_radius_mm is None and not mesh.closed:
        message = f"the mesh of '{case.target_structure}' is open: what lies in it, and is hit, is not known"
        raise InputError(message, where=case.path, allowed="target.hit_radius_mm, or a closed mesh")
    return ChanceModel(error, hit_model(case.hit_radius_mm, mesh, case.target_ct))


def demanding(structures: tuple[Structure, ...]) -> Ints:
    """Columns of the structures that must not be touched."""
    return np.flatnonzero([s.demands_margin for s in structures])


def check_limits(case: Case, anatomy: Anatomy, model: ChanceModel | None) -> None:
    """Refuse limits that no candidate can be tested against: every one would pass untested.

    Raises:
        InputError: Limits without a pose error, or of a structure that has no chance to be touched.
    """
    settings = case.search
    limited = settings.min_hit is not None or settings.max_touch is not None or bool(settings.max_touch_of)
    if limited and model is None:
        message = "search.min_hit and max_touch cannot be checked: only markers and the arm give the needle's error"
        allowed = "[registration] with markers, and a search with the arm; or no such limit"
        raise InputError(message, where=case.path, allowed=allowed)
    names = [anatomy.checked[column].name for column in demanding(anatomy.checked)]
    unknown = sorted(set(settings.max_touch_of) - set(names))
    if unknown:
        message = f"search.max_touch_of '{unknown[0]}' is no structure that must not be touched"
        raise InputError(message, where=case.path, allowed=", ".join(names))


def touch_limit(case: Case, name: str) -> float:
    """The greatest chance to touch a structure that a case allows."""
    allowed = case.search.max_touch_of.get(name, case.search.max_touch)
    return np.inf if allowed is None else allowed
