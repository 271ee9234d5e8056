"""Standoff: where tip and flange wait before the insertion, and how far out the needle's axis is checked.

Along a path, from the target outward, mm:

    standoff = path length + gap to the skin          (or what the case states)
    waiting flange = needle length + standoff
"""

from collections.abc import Sequence

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.skin import Skin, SkinPaths, skin_paths
from puncture_twin.planning.anatomy.structure import Structure
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.settings import Needle
from puncture_twin.planning.collision.workcell import ARM_PADDING_MM


def standoffs(needle: Needle, path_length: Floats | float, skin_angle: Floats | float) -> Floats:
    """Distance of the waiting tip from the target, mm: what the case states, or the skin's distance and `skin_gaps`.

    Of path lengths, mm, NaN without a skin entry, and as many skin angles, rad.
    """
    path_length = np.asarray(path_length, dtype=float)
    if needle.standoff_mm is None:
        return path_length + skin_gaps(needle, skin_angle)
    return np.full(path_length.shape, needle.standoff_mm)


def waiting_flange(needle: Needle, path_length: Floats | float, skin_angle: Floats | float) -> Floats:
    """Distance of the waiting flange from the target, mm; arguments as of `standoffs`."""
    return np.asarray(needle.length_mm + standoffs(needle, path_length, skin_angle))


def farthest_flange(needle: Needle, max_skin_angle: float) -> float:
    """Largest distance of a waiting flange from the target, mm: on the longest path at the largest skin angle, rad."""
    return float(waiting_flange(needle, needle.shaft_mm, max_skin_angle))


def case_paths(case: Case, skin: Skin, outward_ct: Floats, shift_ct: Floats | float = 0.0) -> SkinPaths:
    """Skin along n paths from the case's target, displaced by ``shift_ct``, mm; ``outward_ct`` (n, 3), unit vectors."""
    farthest = farthest_flange(case.needle, case.search.max_skin_angle)
    return skin_paths(skin, case.target_ct + shift_ct, outward_ct, farthest)


def axis_lengths(case: Case, structures: Sequence[Structure], path_length: Floats, skin_angle: Floats) -> Floats:
    """Lengths to which n needle axes are checked against k structures, shape (n, k), mm.

    Against structures of the body: the needle, inserted. Against what is outside of the body (table, gantry): up to the
    waiting flange, for the needle comes from there.
    """
    farthest = farthest_flange(case.needle, case.search.max_skin_angle)
    waiting = np.fmin(waiting_flange(case.needle, path_length, skin_angle), farthest)  # NaN without skin
    return np.where([s.outside for s in structures], waiting[:, None], case.needle.length_mm)


def case_axis_lengths(case: Case, anatomy: Anatomy, outward_ct: Floats) -> Floats:
    """`axis_lengths` of n paths to the case's target against everything that is checked; ``outward_ct`` (n, 3)."""
    paths = case_paths(case, anatomy.skin, outward_ct)
    return axis_lengths(case, anatomy.checked, paths.path_length, paths.skin_angle)


UNEVEN_SKIN_MM = 1.0
"""Added along the needle because skin is not flat and its triangles are coarser than it. On the embedded abdomen and
on two label maps of a real CT 0 and 0.1 mm leave the needle too near in up to 10 % of the organ-safe solid angle, 1 mm
in none of it."""
MAX_GAP_MM = 200.0
"""Largest gap, as large as a case may state: along a path that grazes the skin none would suffice."""


def skin_gaps(needle: Needle, skin_angle: Floats | float) -> Floats:
    """Least distance from the waiting tip to the skin, along the needle, at which the arm's checker sees no contact.

        gap(a) > p + (r + p) tan(a)

    The checker pads the needle (radius r) by p: a cylinder of radius r + p that begins p before the tip. At an angle a
    to the normal of flat skin, the rim of its end is (gap - p) cos(a) - (r + p) sin(a) above the skin.

    Args:
        needle: With ``skin_gap_mm``, the least gap.
        skin_angle: Any shape, rad, 0 straight in; NaN without a skin entry.

    Returns:
        Shape of ``skin_angle``, mm; NaN where that is.
    """
    slope = np.tan(np.asarray(skin_angle, dtype=float))
    clear = ARM_PADDING_MM + (needle.radius_mm + ARM_PADDING_MM) * slope + UNEVEN_SKIN_MM
    return np.asarray(np.clip(clear, needle.skin_gap_mm, max(MAX_GAP_MM, needle.skin_gap_mm)))
