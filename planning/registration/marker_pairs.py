"""Markers paired by name, and the permutations of their names that fit as well within the noise.

A permutation p pairs CT marker i with the touch of marker p(i). Least squares leaves
RSS = Sx + Sy - 2 (s1 + s2 +- s3), with Sx, Sy the squared spreads and s the singular values of
H = sum (y_p(i) - cy)(x_i - cx)'. For two markers (d_ij - d'_p(i)p(j))^2 <= (|r_i| + |r_j|)^2 <= 2 (r_i^2 + r_j^2), so
among any k of them the squared differences of their distances sum up to 2 (k - 1) RSS at most: a permutation that
breaks this with its first k names is dropped with all that begin alike, and what is left is complete.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.text import did_you_mean, plural
from puncture_twin.planning.formats.points import NamedPoints
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.fits import fit_rigid, rms

MAX_FRE_MM = 5.0
"""Without a declared noise: markers that miss by more (rms) are not the same markers, or have moved."""


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


MAX_NUMBERS = 20_000_000
"""Of one table of beginnings (160 MB): sets that are more alike than that are tested for swaps of two names only."""
HARMLESS_MM = 1.0
"""A permutation that moves target and markers by less changes nothing: two markers that all but coincide."""


@dataclass(frozen=True, eq=False)
class Renaming:
    """Names permuted, and what follows."""

    names: tuple[str, ...]  # the CT markers that are paired with another's touch
    touched_as: tuple[str, ...]  # the touches that they are paired with, in the same order
    fre_mm: float  # root mean square residual of the permuted pairs
    T_base_ct: Floats  # their rigid fit, shape (4, 4), mm
    target_mm: float  # how far from the believed target the true one would be
    turn: float  # by how much the patient would be turned against the belief, rad

    @property
    def slip(self) -> str:
        """Which names, in words."""
        if len(self.names) == 2:
            return f"{self.names[0]} and {self.names[1]} swapped"
        return f"{', '.join(self.names)} touched as {', '.join(self.touched_as)}"

    def text(self) -> str:
        """Which names, how well they fit, and what would follow."""
        return (
            f"{self.slip} fit with FRE {self.fre_mm:.2f} mm and put the target {self.target_mm:.1f} mm away, the "
            f"patient rotated by {np.degrees(self.turn):.0f} deg"
        )


class Renamings(NamedTuple):
    """The permutations that fit as well."""

    found: tuple[Renaming, ...]
    """The one that moves the target most first; without those that move neither target nor markers."""
    complete: bool  # whether all permutations were tested, or only swaps of two names


def renamings(markers: MarkerPairs, target_ct: Floats, alike_mm: float, *, moving_mm: float = HARMLESS_MM) -> Renamings:
    """Permutations of three names or more whose rigid fit has an FRE of at most ``alike_mm``.

    Those that move neither the target (3,), mm, nor a marker by more than ``moving_mm`` against the fit as named are
    left out.
    """
    x, y = (points - points.mean(axis=0) for points in (markers.points_ct, markers.points_base))
    bound = len(markers) * alike_mm**2
    orders = matching(x, y, bound)
    complete = orders is not None
    fitting = _fitting_swaps(x, y, bound) if orders is None else orders[rigid_rss(x, y[orders]) <= bound]
    T_given = fit_rigid(markers.points_ct, markers.points_base)
    moving = [_renaming(markers, order, T_given, target_ct) for order in fitting if np.any(order != np.arange(len(x)))]
    harmful = [renaming for renaming, moved_mm in moving if moved_mm > moving_mm]
    return Renamings(tuple(sorted(harmful, key=lambda one: (-one.target_mm, one.touched_as))), complete)


def rigid_rss(x: Floats, y: Floats) -> Floats:
    """Residual sums of squares of rigid fits of points (n, 3) to points (..., n, 3), all centred; shape (...), mm^2."""
    return _rss(np.swapaxes(y, -1, -2) @ x, float(np.sum(x**2)) + np.sum(y**2, axis=(-2, -1)))


def _rss(H: Floats, spreads: Floats | float) -> Floats:
    values = np.linalg.svd(H, compute_uv=False)
    values[..., 2] *= np.where(np.linalg.det(H) < 0, -1.0, 1.0)
    return np.asarray(np.maximum(spreads - 2 * values.sum(axis=-1), 0.0))


def matching(x: Floats, y: Floats, bound: float) -> Ints | None:
    """Every permutation that can have an RSS within the bound, shape (m, n); None where too many begin well."""
    count = len(x)
    in_ct, in_base = (np.linalg.norm(p[:, None] - p[None], axis=2) for p in (x, y))
    partial, cost = np.zeros((1, 0), dtype=np.intp), np.zeros(1)
    for size in range(count):
        if count * partial.shape[0] * max(size, 1) > MAX_NUMBERS:
            return None
        # shape (n, m, size): the next name's touch, the beginning, its names
        apart = in_base[:, partial] - in_ct[size, :size]
        costs = cost + np.sum(apart**2, axis=2)
        costs[partial.T, np.arange(len(partial))] = np.inf  # each touch once
        touch, beginning = np.nonzero(costs <= 2 * size * bound * (1 + 1e-9) + 1e-9)
        partial, cost = np.column_stack([partial[beginning], touch]), costs[touch, beginning]
    return partial


def _fitting_swaps(x: Floats, y: Floats, bound: float) -> Ints:
    """The identity with two names exchanged, of every pair that keeps within the bound, shape (m, n)."""
    first, second = np.triu_indices(len(x), 1)
    exchanged = (y[first] - y[second])[:, :, None] * (x[first] - x[second])[:, None, :]
    fits = _rss(y.T @ x - exchanged, float(np.sum(x**2) + np.sum(y**2))) <= bound
    first, second = first[fits], second[fits]
    orders, rows = np.tile(np.arange(len(x)), (len(first), 1)), np.arange(len(first))
    orders[rows, first], orders[rows, second] = second, first
    return orders


def _renaming(markers: MarkerPairs, order: Ints, T_given: Floats, target_ct: Floats) -> tuple[Renaming, float]:
    """The permutation, and how far it moves what it moves most (target or marker), mm."""
    permuted = markers.points_base[order]
    T = fit_rigid(markers.points_ct, permuted)
    points = np.vstack([target_ct, markers.points_ct])
    moved = np.linalg.norm(apply(T, points) - apply(T_given, points), axis=1)
    turn = np.arccos(np.clip((np.trace(T[:3, :3] @ T_given[:3, :3].T) - 1) / 2, -1.0, 1.0))
    rows = np.flatnonzero(order != np.arange(len(order)))
    names, touched_as = (tuple(markers.names[row] for row in which) for which in (rows, order[rows]))
    fre = rms(apply(T, markers.points_ct) - permuted)
    return Renaming(names, touched_as, fre, T, float(moved[0]), float(turn)), float(moved.max())


BETTER = 3.0
"""So many times better than the given names a permutation must fit to be named."""
SHOWN = 3
"""Permutations that a message lists."""


def better_names(markers: MarkerPairs, target_ct: Floats, fre_mm: float) -> str:
    """Sentence on permutations of the names that fit where the given ones do not, the best first; empty for none."""
    permuted = renamings(markers, target_ct, min(fre_mm / BETTER, MAX_FRE_MM), moving_mm=0.0).found
    if not permuted:
        return ""
    best = sorted(permuted, key=lambda one: one.fre_mm)
    more = f" (and {len(best) - SHOWN} more)" if len(best) > SHOWN else ""
    fitting = [f"with {one.slip} they would fit (FRE {one.fre_mm:.2f} mm)" for one in best[:SHOWN]]
    return f"; {', or '.join(fitting)}{more}"
