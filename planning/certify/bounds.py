"""Where the needles of a cone of directions leave the field of view, and how far every bound keeps from its limit.

A needle matters up to its flange while the tip waits at its standoff; docs/concepts/certificate.md, lemmas 5 and 9.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.anatomy.body.field_of_view import FieldOfView
from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.case.settings import Needle
from puncture_twin.planning.certify.question import Question
from puncture_twin.planning.certify.skin_cones import SkinBounds
from puncture_twin.planning.reach.standoff import waiting_flange

CLEARANCE_PAD_MM = 2e-4
"""Kept from every margin: within 1e-4 mm of one the search leaves the verdict to FCL's capsule."""

DEPTH_PAD_MM = 1e-4
"""Kept from every limit on a depth; the search calls faces of the field of view within 1e-6 mm equal."""

ANGLE_PAD_RAD = 1e-7
"""Kept from the largest skin angle: arccos near 0 rounds to 1e-8."""


@dataclass(frozen=True, eq=False)
class FlangeBounds:
    """How far from the target the flange is while the tip waits, over n cones; mm.

    They hold for every direction whose path and skin angle the case allows; along others no tip ever waits.

    Attributes:
        least: Shape (n,) or a number, never nearer.
        most: The same, never farther.
    """

    least: Floats | float
    most: Floats | float


def any_flange(needle: Needle, question: Question) -> FlangeBounds:
    """Bounds for every path and angle that the case allows, whatever the skin."""
    return FlangeBounds(float(waiting_flange(needle, 0.0, 0.0)), question.farthest)


def flange_bounds(needle: Needle, question: Question, skin: SkinBounds) -> FlangeBounds:
    """Bounds from those of the skin: the flange is the farther, the longer the path and the larger the angle."""
    longest, largest = question.longest, question.max_skin_angle
    low = np.clip(skin.least_angle - ANGLE_PAD_RAD, 0.0, largest)
    high = np.clip(skin.largest_angle + ANGLE_PAD_RAD, 0.0, largest)
    return FlangeBounds(
        waiting_flange(needle, np.minimum(skin.least_skin, longest), low),
        waiting_flange(needle, np.minimum(skin.farthest, longest), high),
    )


@dataclass(frozen=True, eq=False)
class ViewBounds:
    """The field of view over n cones, for directions along which a tip may wait.

    Attributes:
        kept: Shape (n,), no needle leaves it through a face that cuts the body before its flange.
        left: Shape (n,), every needle leaves it through such a face before its flange.
        depth: Shape (n,), no deeper, mm.
    """

    kept: Bools
    left: Bools
    depth: Floats


def view_bounds(
    view: FieldOfView | None, target_ct: Floats, centres: Floats, radius: Floats, flange: FlangeBounds
) -> ViewBounds:
    """Bound where needles leave the field of view.

    Args:
        view: The imaged box; None says nothing, and nothing leaves it.
        target_ct: Shape (3,), inside the box.
        centres: Shape (n, 3), unit, CT frame.
        radius: Shape (n,), rad.
        flange: How far the needles go.
    """
    count = len(centres)
    if view is None:
        return ViewBounds(np.ones(count, bool), np.zeros(count, bool), np.full(count, np.inf))
    view.exit(target_ct, centres[:1])  # refuses a target outside the box
    along = centres @ view.T_ct_box[:3, :3]
    start = view.to_box(target_ct[None])[0]
    toward = np.concatenate([-along, along], axis=1)  # low faces, high faces
    height = np.maximum(np.concatenate([start, view.size_mm - start]), 0.0)
    cut = np.concatenate([view.cut[:, 0], view.cut[:, 1]])
    angle = np.arccos(np.clip(toward, -1, 1))
    steepest = np.cos(np.maximum(angle - radius[:, None] - ANGLE_PAD_RAD, 0.0))
    flattest = np.cos(np.minimum(angle + radius[:, None] + ANGLE_PAD_RAD, np.pi))
    with np.errstate(divide="ignore", invalid="ignore"):  # a ray along a face never reaches it
        soonest = np.where(steepest > 0, height / np.where(steepest > 0, steepest, 1.0), np.inf)
        latest = np.where(flattest > 0, height / np.where(flattest > 0, flattest, 1.0), np.inf)
    first_cut = np.where(cut, latest, np.inf).min(axis=1)
    other = np.where(cut, np.inf, soonest).min(axis=1)
    left = (first_cut < flange.least - DEPTH_PAD_MM) & (other > first_cut + DEPTH_PAD_MM)
    needed = np.minimum(flange.most, latest.min(axis=1))
    harmless = ~cut | (soonest > needed[:, None] + DEPTH_PAD_MM)
    return ViewBounds(harmless.all(axis=1), left, first_cut)
