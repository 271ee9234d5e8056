"""Markers paired by name: the same ones in the CT and at the robot."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.text import did_you_mean, plural
from puncture_twin.planning.formats.points import NamedPoints

MIN_MARKERS = 3
"""Two points leave a rotation free."""
COLLINEAR = 0.01
"""Second over first singular value of the centred markers below which they count as one line."""
LEAST_SPAN_MM = 5.0
"""A needle's tip tells no two places of the skin apart that are nearer: markers in metres or cm, read as mm."""
UNIT_SLIP = 5.0
"""Ratio of the two marker sets' spreads from which on a unit (mm, cm, m) is wrong, not a measurement."""


@dataclass(frozen=True, eq=False)
class MarkerPairs:
    """The same markers in both frames, matched by name."""

    names: tuple[str, ...]
    points_ct: Floats  # shape (n, 3), mm
    points_base: Floats  # shape (n, 3), mm
    joints: Floats | None = None  # shape (n, 6), rad: the arm at each touch, where the file has it

    def __len__(self) -> int:
        return len(self.names)


def match(
    markers_ct: NamedPoints,
    markers_base: NamedPoints,
    *,
    use: tuple[str, ...] | None,
    where: str | Path = "registration",
) -> MarkerPairs:
    """Pair markers by name: those of ``use``, in this order; None demands the same names on both sides.

    Raises InputError: A name that one side lacks, or that is used twice.
    """
    names = markers_ct.names if use is None else use
    for side, points, other in (("CT", markers_ct, markers_base), ("base", markers_base, markers_ct)):
        wanted = set(names) if use is not None else set(other.names)
        missing = sorted(wanted - set(points.names))
        if missing:
            near = "".join(did_you_mean(name, set(points.names) - set(other.names)) for name in missing[:1])
            allowed = "the same names on both sides, or a case with registration.use = [names]"
            refuse(f"{', '.join(missing)} missing on the {side} side{near}", where, allowed, "markers_missing")
    if len(set(names)) < len(names):
        refuse(f"names repeat: {', '.join(names)}", where, "unique names", "duplicate_name")
    rows_ct = [markers_ct.names.index(name) for name in names]
    rows_base = [markers_base.names.index(name) for name in names]
    joints = None if markers_base.joints is None else markers_base.joints[rows_base]
    return MarkerPairs(tuple(names), markers_ct.points[rows_ct], markers_base.points[rows_base], joints)


def check_pairs(markers: MarkerPairs, where: str | Path) -> None:
    """Whether markers can be fitted at all.

    Raises InputError: Fewer than three, not finite, on a line, of two sizes, or all at one place.
    """
    if len(markers) < MIN_MARKERS:
        refuse(plural(len(markers), "marker"), where, "3 or more, by the same names", "too_few_markers")
    both = np.concatenate([markers.points_ct, markers.points_base])
    if not np.isfinite(both).all():
        bad = [n for n, a, b in zip(markers.names, markers.points_ct, markers.points_base, strict=True)
               if not np.isfinite([a, b]).all()]  # fmt: skip
        refuse(f"marker {', '.join(bad)} is not finite", where, "finite mm", "not_finite")
    sides = markers.points_ct, markers.points_base
    spreads = [np.linalg.svd(points - points.mean(axis=0), compute_uv=False) for points in sides]
    for side, values in zip(("CT", "base"), spreads, strict=True):
        if values[0] == 0 or values[1] / values[0] < COLLINEAR:
            what = f"markers {', '.join(markers.names)} are collinear on the {side} side"
            refuse(what, where, "three markers that span a triangle", "markers_collinear")
    ratio = float(np.linalg.norm(spreads[1]) / np.linalg.norm(spreads[0]))
    if not 1 / UNIT_SLIP < ratio < UNIT_SLIP:
        what = f"base markers spread {ratio:.3g} times as wide as the CT's: probably a wrong unit (mm/cm/m)"
        refuse(what, where, "both sides in mm", "wrong_unit")
    span = max(float(np.linalg.norm(points[:, None] - points, axis=2).max()) for points in sides)
    if span < LEAST_SPAN_MM:
        what = (
            f"markers {', '.join(markers.names)} span {span:.2g} mm, too little for a needle to distinguish: "
            "probably a wrong unit (m or cm as mm) on both sides"
        )
        refuse(what, where, f"both sides in mm, markers that span {LEAST_SPAN_MM:g} mm at least", "wrong_unit")
