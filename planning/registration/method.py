"""The methods of registration, and whether one can weigh the declared noise.

Would a slip in the markers' names pass unnoticed? Permutations of the names that fit as well within the noise.

A permutation p pairs CT marker i with the touch of marker p(i). Least squares leaves
RSS = Sx + Sy - 2 (s1 + s2 +- s3), with Sx, Sy the squared spreads and s the singular values of
H = sum (y_p(i) - cy)(x_i - cx)'. For two markers (d_ij - d'_p(i)p(j))^2 <= (|r_i| + |r_j|)^2 <= 2 (r_i^2 + r_j^2), so
among any k of them the squared differences of their distances sum up to 2 (k - 1) RSS at most: a permutation that
breaks this with its first k names is dropped with all that begin alike, and what is left is complete.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import numpy as np

from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.fits import ReadingNoise, fit_joint, fit_rigid, fit_triad, fit_weighted, rms
from puncture_twin.planning.registration.marker_pairs import MarkerPairs
from puncture_twin.planning.registration.residuals import MAX_FRE_MM

Method = Literal["triad", "rigid", "weighted", "joint", "affine"]

Fit = Callable[[Floats, Floats], Floats]
"""From points (..., n, 3) in both frames, mm, to T_base_ct."""


LEAST_FOUND_MM = 0.01
"""FRE from which on the markers can say how large the errors are: no arm repeats so well, so one side was computed."""
SINGULAR = 1e-12
"""Least over greatest variance of the readings below which some of them count as free of error."""


def checked_fit(
    markers: MarkerPairs, method: Method, noise: ReadingNoise | None, found_in_mm: float | None, *, where: str | Path
) -> Fit:
    """The fit of a method, which the declared noise has passed; the FRE is given where its size is to be found in it.

    Raises InputError: ``affine``, ``weighted`` or ``joint`` without noise, or noise that cannot be weighed.
    """
    if method == "affine":
        allowed = "triad, rigid or weighted; affine only reproduces the paper's Table 6"
        refuse("method 'affine' bends the patient", where, allowed, "method_bends")
    if method not in get_args(Method):
        refuse(f"method {method!r}", where, ", ".join(get_args(Method)), "unknown_method")
    weighing = method in {"weighted", "joint"}
    if noise is None:
        if weighing:
            what = f"method '{method}' needs declared errors as weights"
            refuse(what, where, "[errors], or method rigid", "method_without_errors")
        return fit_triad if method == "triad" else fit_rigid
    covariance = noise.covariance(fit_rigid(markers.points_ct, markers.points_base)[:3, :3])
    values = np.linalg.eigvalsh(covariance.independent if weighing else covariance.whole)
    if not values[0] > SINGULAR * values[-1]:
        allowed = "ct_in_plane_mm, ct_slice_mm or touch_mm above 0"
        refuse("the declared errors leave some marker readings without error", where, allowed, "no_marker_noise")
    if found_in_mm is not None and found_in_mm < LEAST_FOUND_MM:
        message = f"marker_noise = 'found', but the residuals ({found_in_mm:.2g} mm) show none"
        refuse(message, where, "markers measured on both sides, or marker_noise = 'declared'", "no_marker_noise")
    if weighing:
        weighted = fit_weighted if method == "weighted" else fit_joint
        return lambda ct, base: weighted(ct, base, noise, fit_rigid(ct, base))
    return fit_triad if method == "triad" else fit_rigid


MAX_RESIDUAL_MM = 15.0
"""A marker that misses by more was swapped, moved or typed wrongly: the paper's worst set misses by 7 mm."""
MIRROR_GAIN = 2.0
"""Factor (and 1 mm) by which a mirrored fit must be better than the proper one: then one list is mirrored."""


def check_residuals(markers: MarkerPairs, residuals: Floats, target_ct: Floats, where: str | Path) -> None:
    """Refuse a fit that is far better mirrored, or that a marker misses by far; residuals (n, 3), mm.

    Raises InputError: Naming the markers, and the permutations of their names that would fit.
    """
    T_mirrored = fit_rigid(markers.points_ct, markers.points_base, mirrored=True)
    given, mirrored = rms(residuals), rms(apply(T_mirrored, markers.points_ct) - markers.points_base)
    if given > MIRROR_GAIN * mirrored + 1.0:
        what = (
            f"markers {', '.join(markers.names)} match only mirrored (rms {mirrored:.2f} mm against "
            f"{given:.2f} mm){better_names(markers, target_ct, given)}"
        )
        refuse(what, where, "both sides right-handed: check LPS/RAS and the marker names", "markers_mirrored")
    lengths = np.linalg.norm(residuals, axis=1)
    worst = int(np.argmax(lengths))
    if lengths[worst] > MAX_RESIDUAL_MM:
        what = (
            f"marker {markers.names[worst]} misses by {lengths[worst]:.1f} mm: swapped, moved or mistyped"
            f"{better_names(markers, target_ct, given)}"
        )
        refuse(what, where, f"residuals up to {MAX_RESIDUAL_MM:g} mm", "marker_misses")


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
    found = [_renaming(markers, order, T_given, target_ct) for order in fitting if np.any(order != np.arange(len(x)))]
    harmful = [renaming for renaming, moved_mm in found if moved_mm > moving_mm]
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
    found = renamings(markers, target_ct, min(fre_mm / BETTER, MAX_FRE_MM), moving_mm=0.0).found
    if not found:
        return ""
    best = sorted(found, key=lambda one: one.fre_mm)
    more = f" (and {len(best) - SHOWN} more)" if len(best) > SHOWN else ""
    fitting = [f"with {one.slip} they would fit (FRE {one.fre_mm:.2f} mm)" for one in best[:SHOWN]]
    return f"; {', or '.join(fitting)}{more}"
