"""The frame of a control scan tied to a case's: by the markers that both show, or by skin and bone.

A surface of the case lies in the scan where grey values change along its normal n by half of what they change in all.
With q_i = T p_i, c their middle and d_i the distance of that place along n_i:

    min sum w_i (n_i . (t + r x (q_i - c)) - d_i)^2      Gauss-Newton over shift t and rotation r, w by Tukey

The fit is held to the same surfaces mirrored: a body that lies better so is another patient's, or was turned over. The
needle's own metal, and the markers', show no surface. Organs move against skin and bone, with breath above all: by how
much all of them together is looked for, s, and what is known of the target gets s s' more covariance.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import linear_sum_assignment

from puncture_twin.planning.anatomy.metal import METAL_HU, centroid, metal_pieces, metal_weights
from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.base.errors import Finding, Severity, refuse
from puncture_twin.planning.evidence.edges import Placement, Sample, fit_of, sample_surfaces
from puncture_twin.planning.formats.points import NamedPoints
from puncture_twin.planning.formats.volumes.volume_files import Volume
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, pose, rotation_angle
from puncture_twin.planning.registration.fits import carried, design, fit_rigid, least_squares_map
from puncture_twin.twin.guidance.ct.markers import LARGEST_MM

SAMPLES, COARSE_SAMPLES = 1800, 500
"""Points of the surfaces in the image: of the fit, and of the search for where it starts."""
SPREAD = 12 * SAMPLES
"""Over the whole body, of which an image may show a small part."""
BORDER_MM = 5.0
"""Points so far beyond the image may come into it as they are fitted."""
WINDOWS_MM = (14.0, 14.0, 10.0, 10.0, 7.0, 7.0, 5.0, 5.0, 4.0, 4.0, 4.0, 4.0)
"""How far along its normal a surface is looked for, step by step."""
STEP_MM = 0.5
CONTRAST_HU = 100.0
"""Least change of grey values that counts as a surface."""
SHOWN_HU = (-1000.0, 500.0)
"""Values beyond say no more about where a surface is."""
NEAR_MM = 2.5
"""A surface is found where it lies so near to its fitted place."""
LEAST_FOUND, LEAST_SEEN = 0.6, 120
"""Least fraction of the surfaces in the image that are found, and least number of points of them."""
MIRRORED = 0.8
"""Misfit over that of the mirrored surfaces, above which nobody can tell which of them the scan shows."""
MOST_STRETCH = 0.05
"""Of a body that alone ties the frames: quiet breath changes it by less, and what changes more has moved its organs."""
UNSURE_MM = 3.0
"""A tie whose standard deviation at the target is larger is none."""
PATCH_SD = 0.7
"""By how much of the residuals a patch of the surface errs as a whole: contours are not independent point by point."""
LEAST_MM, LEAST_DEG = 0.4, 0.2
"""Standard deviations of a fit to surfaces that more points do not lessen: how two scans are segmented."""
INNER_MM, LEAST_OF_ORGAN, MOST_OF_ORGAN, OF_MARKER = 3.0, 40, 20.0, 20.0
"""Of the evidence that a symmetric body is not mirrored: how far from an organ's surface grey values are compared, on
how many points at least; and the most that an organ, and a marker, says."""
ORGAN_HU = 150.0
"""More contrast counts as so much: lungs alone do not say where all organs are."""
BREATH_MM, BREATH_STEP_MM = 30.0, 5.0
"""So far along the body organs are looked for, and in which steps first."""
FINER_MM = (5.0, 2.5, 1.25)
"""Steps along each axis from there."""
SURELY, LEAST_MOVED_MM = 5.0, 2.5
"""Deviations by which organs lie better elsewhere, and how far at least, to be said to have moved."""
SEARCH_MM, SEARCH_STEP_MM = 60.0, 12.0
"""Shifts that are tried where no frame is shared."""
MARKER_MM = 12.0
"""A marker lies no farther from where the body says."""
SIDES_MM = 4.0
"""Distances between markers agree so well, where they are recognised by them."""
MARKER_SD_VOXEL = 0.15
"""Of a marker's middle, in voxels along each axis."""
LOOSE, APART = 3.0, 4.0
"""Residuals of markers this many times what is declared, or deviations by which they and the body disagree about the
target: some have moved, on the skin or with it, and the body ties the frames instead."""


@dataclass(frozen=True, eq=False)
class Body:
    """A patient's surfaces that a scan shows again, LPS mm: points on skin and bones, and on other organs."""

    sample: Sample
    organs: Sample
    markers: NamedPoints | None
    marker_cov: Floats  # shape (3, 3), mm², of their reading in the case's CT
    target_ct: Floats  # shape (3,), where the tie must be known


def body_of(
    skin: TriangleMesh, bones: Sequence[TriangleMesh], organs: Sequence[TriangleMesh], target_ct: Floats,
    markers: NamedPoints | None, cov: Floats,
) -> Body:  # fmt: skip
    """The body of surfaces and markers; arguments as the attributes of `Body`."""
    return Body(sample_surfaces([skin, *bones], SPREAD), sample_surfaces(organs, SPREAD), markers, cov, target_ct)


@dataclass(frozen=True, eq=False)
class Tie:
    """Pose of the case's frame in a scan."""

    T_scan_ct: Floats  # shape (4, 4)
    cov_ct: Floats  # shape (6, 6), of its inverse at the target: shift (mm) and rotation (rad), axes of the case
    target_ct: Floats
    how: str
    residual_mm: float
    found: float  # fraction of the surfaces in the image that were found; the residual (rms) is theirs, or the markers'
    moved_mm: float  # how far the target lies from where one frame would have it; NaN where the scan has its own
    moved_deg: float
    findings: tuple[Finding, ...] = ()

    @property
    def sd_mm(self) -> float:
        """Standard deviation at the target in its worst direction."""
        return float(np.sqrt(np.linalg.eigvalsh(self.cov_ct[:3, :3])[-1]))

    def cov_at(self, point_ct: Floats) -> Floats:
        """Covariance of the inverse at another point (3,)."""
        X = carried(self.target_ct, point_ct)
        return np.asarray(X @ self.cov_ct @ X.T)


class _Fit(NamedTuple):
    """A fit of surfaces. `misfit_mm` counts each point in the image, at `NEAR_MM` at most; `cov` is at `center`."""

    T: Floats
    misfit_mm: float
    residual_mm: float
    found: float
    seen: int
    center: Floats
    cov: Floats


def tie_frames(volume: Volume, body: Body, *, same_frame: bool) -> Tie:
    """Tie a scan to a case; that it states the case's own frame of reference is a guess until the body agrees.

    Raises:
        InputError: Neither markers nor surfaces tie them, or the body lies mirrored as well.
    """
    picture = _Picture(volume)
    own = [np.eye(4)] if same_frame else []
    small = [piece for piece in metal_pieces(volume) if piece.size_mm <= LARGEST_MM and piece.voxels.sum() > 1]
    middles = [centroid(metal_weights(volume, piece), piece.box, volume.T_ct_index) for piece in small]
    pieces = np.array([one for one in middles if np.isfinite(one).all()]).reshape(-1, 3)  # which may be markers
    fits = [_fitted(picture, body.sample, start) for start in (*own, *_by_distances(body.markers, pieces))]
    best = min(fits, key=lambda fit: fit.misfit_mm, default=None)
    if best is None or not _believed(best):
        fits += [_fitted(picture, body.sample, start) for start in _searched(picture, body)]
        best = min(fits, key=lambda fit: fit.misfit_mm, default=None)
    allowed = "a scan of the same patient that shows skin and bone of the case, or three of its markers"
    if best is None or not _believed(best):
        of = "points of skin and bone lie where they should"
        shown = "" if best is None else f": {best.found:.0%} of {best.seen} {of}"
        refuse(f"the scan does not fit the case's body{shown}", volume.path, allowed, "frames_not_tied")
    flipped, T_flipped = _mirrored(picture, body.sample, best.T)
    shift = _organs_moved(picture, body.organs, best.T)
    if best.misfit_mm > MIRRORED * flipped.misfit_mm:  # as symmetric as that: organs and markers tell
        moved = _organs_moved(picture, body.organs, T_flipped)
        here = _evidence(picture, body, best.T, shift, pieces)
        there = _evidence(picture, body, T_flipped, moved, pieces)
        if MIRRORED * best.misfit_mm > flipped.misfit_mm or not here * MIRRORED > there:
            said = f"{best.misfit_mm:.2f} mm off, mirrored {flipped.misfit_mm:.2f} mm"
            refuse(f"the body fits the scan mirrored as well ({said})", volume.path, allowed, "mirrored")
    tie = _by_markers(volume, body, best, pieces, same_frame)
    if not tie.sd_mm <= UNSURE_MM:
        what = f"skin and bone in the scan tie it to the case at the target by {tie.sd_mm:.1f} mm (standard deviation)"
        refuse(what, volume.path, f"{UNSURE_MM:g} mm at most: {allowed}", "frames_not_tied")
    stretch = _stretch(picture, body.sample, best.T) if tie.how == "body" else np.zeros(3)
    if np.abs(stretch).max() > MOST_STRETCH:
        sizes = ", ".join(f"{100 * one:+.0f} %" for one in stretch)
        what = f"the scan's body has another size than the case's ({sizes} along LPS)"
        refuse(what, volume.path, allowed, "other_body")
    return _with_organs(tie, shift)


def _with_organs(tie: Tie, shift: Floats) -> Tie:
    """A tie that counts by how much organs (3,), mm, have moved against skin and bone: so far may the target have."""
    moved = float(np.linalg.norm(shift))
    if moved < LEAST_MOVED_MM:
        return tie
    cov = tie.cov_ct.copy()
    cov[:3, :3] += np.outer(shift, shift)
    way = ", ".join(f"{one:+.0f}" for one in shift)
    said = f"organs lie {moved:.0f} mm ({way} along LPS) from where skin and bone have them: another breath?"
    finding = Finding("organs_moved", Severity.WARNING, said, {"moved_mm": moved})
    return replace(tie, cov_ct=cov, findings=(*tie.findings, finding))


def _believed(fit: _Fit) -> bool:
    return fit.found >= LEAST_FOUND and fit.seen >= LEAST_SEEN


class _Picture:
    """A scan between its voxels; NaN at metal and outside."""

    def __init__(self, volume: Volume) -> None:
        self.values = volume.values
        self.T_index_ct = np.linalg.inv(volume.T_ct_index)
        corners = np.array(list(itertools.product(*((0, n - 1) for n in volume.values.shape))), dtype=float)
        bounds = apply(volume.T_ct_index, corners)
        self.low, self.high, self.middle = bounds.min(axis=0), bounds.max(axis=0), bounds.mean(axis=0)

    def holds(self, points: Floats, beyond_mm: float = 0.0) -> Bools:
        """Points (n, 3) that lie in the box about the image."""
        return np.asarray(((points > self.low - beyond_mm) & (points < self.high + beyond_mm)).all(axis=1))

    def shown(self, sample: Sample, T: Floats) -> Sample:
        """About `SAMPLES` of the points that a placement (4, 4) has in the image, or near its border."""
        rows = np.flatnonzero(self.holds(sample.placed(T)[0], BORDER_MM))
        return sample.rows(rows[:: max(1, len(rows) // SAMPLES)])

    def at(self, points: Floats) -> Floats:
        index = np.moveaxis(apply(self.T_index_ct, points.reshape(-1, 3)), 1, 0)
        near = np.clip(np.rint(index).astype(int), 0, np.array(self.values.shape)[:, None] - 1)
        outside = (np.abs(index - near) > 0.51).any(axis=0)
        values = ndimage.map_coordinates(self.values, index, np.float64, order=1, mode="nearest")
        values[outside | (values > METAL_HU)] = np.nan
        return np.asarray(np.clip(values, *SHOWN_HU).reshape(points.shape[:-1]))


def _edges(picture: _Picture, points: Floats, normals: Floats, window_mm: float) -> Floats:
    """Distance of the surface along each normal, shape (n,), mm: NaN where none is seen, infinite outside."""
    steps = np.arange(-window_mm, window_mm + STEP_MM / 2, STEP_MM)
    profile = picture.at(points[:, None] + steps[:, None] * normals[:, None])
    unseen = np.isnan(profile).any(axis=1)
    profile = np.nan_to_num(profile)
    half = len(steps) // 2
    high, low = profile[:, : half + 1].max(axis=1), profile[:, half:].min(axis=1)
    level = ((high + low) / 2)[:, None]
    falls = (profile[:, :-1] >= level) & (profile[:, 1:] < level)
    drop = np.maximum(profile[:, :-1] - profile[:, 1:], 1e-9)
    places = steps[:-1] + STEP_MM * np.clip((profile[:, :-1] - level) / drop, 0.0, 1.0)
    places = np.where(falls, places, np.inf)
    nearest = places[np.arange(len(places)), np.abs(places).argmin(axis=1)]
    edges = np.where((high - low >= CONTRAST_HU) & np.isfinite(nearest), nearest, np.nan)
    return np.where(unseen, np.inf, edges)


def _fitted(picture: _Picture, sample: Sample, start: Floats) -> _Fit:
    some, T, none = picture.shown(sample, start), start, (np.zeros(3), np.full((6, 6), np.inf))
    if len(some.points_ct) < LEAST_SEEN:
        return _Fit(T, np.inf, np.inf, 0.0, len(some.points_ct), *none)
    for window in WINDOWS_MM:
        points, normals = some.placed(T)
        off = _edges(picture, points, normals, window)
        good = np.isfinite(off)
        if good.sum() < LEAST_SEEN:
            break
        step, center, *_ = _step(points[good], normals[good], off[good], some.patch[good])
        turn = exp_rotation(step[3:])
        T = pose(turn @ T[:3, :3], turn @ (T[:3, 3] - center) + center + step[:3])
    points, normals = some.placed(T)
    off = _edges(picture, points, normals, WINDOWS_MM[-1])
    seen, good = ~np.isposinf(off), np.isfinite(off)
    if good.sum() < LEAST_SEEN or seen.sum() == 0:
        return _Fit(T, np.inf, np.inf, 0.0, int(seen.sum()), *none)
    capped = np.minimum(np.abs(np.where(good, off, np.inf)[seen]), NEAR_MM)
    inliers = good & (np.abs(off) < NEAR_MM)
    misfit, residual = (float(np.sqrt(np.mean(one**2))) for one in (capped, off[inliers]))
    _, center, cov = _step(points[good], normals[good], off[good], some.patch[good])
    return _Fit(T, misfit, residual, float(inliers.sum() / seen.sum()), int(seen.sum()), center, cov)


def _stretch(picture: _Picture, sample: Sample, T: Floats) -> Floats:
    """By what fraction the body in a scan is longer than the case's along each axis, shape (3,).

    A fit looks for each surface nearby, so another patient's may be found near enough; from farther off all of them
    agree on another size. Least squares as `_step`, with n_k (p - c)_k for each axis k.
    """
    points, normals = picture.shown(sample, T).placed(T)
    off = _edges(picture, points, normals, WINDOWS_MM[0])
    good = np.isfinite(off)
    points, normals, off = points[good], normals[good], off[good]
    lever = points - points.mean(axis=0)
    A, x = np.concatenate([normals, np.cross(lever, normals), normals * lever], axis=1), np.zeros(9)
    for _ in range(20):  # Tukey's weights settle
        left = off - A @ x
        scale = max(1.4826 * float(np.median(np.abs(left))), 0.3)
        weights = np.maximum(1 - (left / (4.685 * scale)) ** 2, 0.0) ** 2
        x = np.linalg.solve(A.T @ (weights[:, None] * A) + 1e-6 * np.eye(9), A.T @ (weights * off))
    return np.asarray(x[6:])


def _step(points: Floats, normals: Floats, off: Floats, patch: NDArray[np.intp]) -> tuple[Floats, Floats, Floats]:
    """The motion (6,) about a centre (3,) that brings surfaces to where they are seen, and its covariance."""
    center = points.mean(axis=0)
    A = np.concatenate([normals, np.cross(points - center, normals)], axis=1)
    scale = max(1.4826 * float(np.median(np.abs(off - np.median(off)))), 0.2)
    ratio = off / (4.685 * scale)
    weights = np.where(np.abs(ratio) < 1, (1 - ratio**2) ** 2, 0.0)
    normal = np.linalg.inv(A.T @ (weights[:, None] * A) + 1e-9 * np.eye(6))
    step = normal @ (A.T @ (weights * off))
    left = off - A @ step
    variance = float((weights * left**2).sum() / max(weights.sum() - 6, 1.0))
    sums = np.zeros((int(patch.max()) + 1, 6))
    np.add.at(sums, patch, weights[:, None] * A)
    shared = normal @ (sums.T @ sums) @ normal  # patches err as a whole
    cov = variance * (normal + PATCH_SD**2 * shared)
    cov += np.diag([LEAST_MM**2] * 3 + [np.radians(LEAST_DEG) ** 2] * 3)
    return step, center, cov


def _mirrored(picture: _Picture, sample: Sample, T: Floats) -> tuple[_Fit, Floats]:
    """The best fit of the surfaces mirrored about their middle, and where it puts the case, (4, 4)."""
    middle = sample.points_ct[picture.holds(sample.placed(T)[0])].mean(axis=0)
    fits = []
    for axis in range(3):
        flip = np.eye(4)
        flip[axis, axis], flip[axis, 3] = -1.0, 2 * middle[axis]
        fit = _fitted(picture, sample.moved(flip), T)
        fits.append((fit, fit.T @ flip))
    return min(fits, key=lambda one: one[0].misfit_mm)


def _fall(picture: _Picture, organs: Sample, T: Floats) -> Floats:
    """By how much grey values fall out of the organs, shape (n,), HU; of one that is darker, by how much they rise."""
    points, normals = organs.placed(T)
    fall = picture.at(points - INNER_MM * normals) - picture.at(points + INNER_MM * normals)
    fall = np.clip(fall, -ORGAN_HU, ORGAN_HU)
    total = np.bincount(organs.structure, np.nan_to_num(fall))
    return np.asarray(fall * np.sign(total)[organs.structure])


def _organs_moved(picture: _Picture, organs: Sample, T: Floats) -> Floats:
    """The shift (3,), mm in the case's axes, at which all organs together surely lie better; else 0."""
    here = _fall(picture, organs, T)

    def fall(shift: Floats) -> Floats:
        return _fall(picture, organs, T @ pose(np.eye(3), shift))

    def gain(shift: Floats) -> float:
        there = fall(shift)
        both = np.isfinite(here) & np.isfinite(there)
        return float((there - here)[both].sum())

    along = np.arange(-BREATH_MM, BREATH_MM + 1.0, BREATH_STEP_MM)
    best = max((np.array([0.0, 0.0, z]) for z in along), key=gain)
    for step in FINER_MM:
        for axis in np.eye(3):
            best = max((best + sign * step * axis for sign in (0.0, -1.0, 1.0)), key=gain)
    surely = fit_of(Placement("shift", pose(np.eye(3), best)), organs, here, fall(best)).z > SURELY
    return best if surely else np.zeros(3)


def _evidence(picture: _Picture, body: Body, T: Floats, shift: Floats, pieces: Floats) -> float:
    """Change of grey values at organs, in standard errors, and the markers that are where they should be."""
    total, step = 0.0, _fall(picture, body.organs, T @ pose(np.eye(3), shift))
    known = np.isfinite(step)
    for number in np.unique(body.organs.structure):
        own = step[known & (body.organs.structure == number)]
        if len(own) > LEAST_OF_ORGAN:
            total += min(float(own.mean()) / (float(own.std()) / np.sqrt(len(own)) + 1e-9), MOST_OF_ORGAN)
    if body.markers is not None and len(pieces):
        gaps = np.linalg.norm(apply(T, body.markers.points)[:, None] - pieces, axis=2).min(axis=1)
        total += OF_MARKER * float((gaps < MARKER_MM).sum())
    return total


def _searched(picture: _Picture, body: Body) -> Iterator[Floats]:
    """The shift from which skin and bone show most contrast: about the frame's own, and with the middles together."""
    sample = body.sample.thinned(4 * SAMPLES)
    points, normals = sample.points_ct, sample.normals_ct
    steps = np.arange(-SEARCH_MM, SEARCH_MM + 1.0, SEARCH_STEP_MM)
    tried = []
    for about in (np.zeros(3), picture.middle - body.target_ct):
        for shift in itertools.product(steps, repeat=3):
            move = about + shift
            rows = np.flatnonzero(((points > picture.low - move) & (points < picture.high - move)).all(axis=1))
            some = rows[:: max(1, len(rows) // COARSE_SAMPLES)]
            inner, outer = (picture.at(points[some] + move + side * 4.0 * normals[some]) for side in (-1.0, 1.0))
            fall = inner - outer
            fall = fall[np.isfinite(fall)]
            score = np.clip(fall, -600, 600).mean() * np.sqrt(len(rows)) if len(fall) > LEAST_SEEN / 2 else -np.inf
            tried.append((float(score), move))
    tried.sort(key=lambda one: -one[0])
    yield from (pose(np.eye(3), move) for _, move in tried[:3])


def _by_distances(markers: NamedPoints | None, pieces: Floats) -> Iterator[Floats]:
    """The placements that bring three markers or more to pieces of metal, by the distances between them."""
    if markers is None or not 3 <= len(pieces) <= 40:
        return
    points, gaps = markers.points, np.linalg.norm(pieces[:, None] - pieces, axis=2)
    peaks = []
    for rows in itertools.combinations(range(len(points)), 3):  # any of the others may be off, or outside
        corners = points[list(rows)]
        known = np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1)
        for i, j in zip(*np.nonzero(np.abs(gaps - known[0]) < SIDES_MM), strict=True):
            fits = (np.abs(gaps[j] - known[1]) < SIDES_MM) & (np.abs(gaps[i] - known[2]) < SIDES_MM)
            for k in np.flatnonzero(fits & (np.arange(len(pieces)) != i) & (np.arange(len(pieces)) != j)):
                T = fit_rigid(corners, pieces[[i, j, k]])
                left = np.linalg.norm(apply(T, points)[:, None] - pieces, axis=2).min(axis=1)
                peaks.append((float(np.minimum(left, SIDES_MM).sum()), T))
    yield from (T for _, T in sorted(peaks, key=lambda one: one[0])[:3])


def _by_markers(volume: Volume, body: Body, fit: _Fit, pieces: Floats, same_frame: bool) -> Tie:
    """The tie by three markers or more that the scan shows where the body has them; else by the body."""
    R = fit.T[:3, :3]
    X = carried(fit.center, apply(fit.T, body.target_ct))
    turn = np.kron(np.eye(2), R)
    cov_body = turn.T @ X @ fit.cov @ X.T @ turn
    by_body = partial(_tie, fit.T, cov_body, body, "body", fit.residual_mm, fit.found, same_frame)
    rows, columns = _paired(body.markers, pieces, fit.T)
    if body.markers is None or len(rows) < 3:
        return by_body([])
    known, seen = body.markers.points[rows], pieces[columns]
    if not np.linalg.norm(np.cross(known[1] - known[0], known[2] - known[0])) > 100.0:  # mm², on a line
        return by_body([])
    T = fit_rigid(known, seen)
    voxel = MARKER_SD_VOXEL * volume.T_ct_index[:3, :3]
    each = body.marker_cov + R.T @ voxel @ voxel.T @ R
    left = apply(np.linalg.inv(T), seen) - known
    expected_ms = float(np.trace(each)) * (1 - 2 / len(rows))
    size = float(np.mean((left**2).sum(axis=1))) / expected_ms
    center = known.mean(axis=0)
    L = carried(center, body.target_ct) @ least_squares_map(design(known, center))
    cov = max(size, 1.0) * L @ np.kron(np.eye(len(rows)), each) @ L.T
    off = R.T @ (apply(T, body.target_ct) - apply(fit.T, body.target_ct))
    apart = float(off @ np.linalg.solve(cov[:3, :3] + cov_body[:3, :3], off))
    if size < LOOSE**2 and apart < APART**2:
        residual = float(np.sqrt(np.mean((left**2).sum(axis=1))))
        return _tie(T, cov, body, "markers", residual, fit.found, same_frame, [])
    what = f"have the target {np.linalg.norm(off):.1f} mm from where skin and bone have it"
    if size >= LOOSE**2:
        what = f"lie {np.sqrt(size):.1f} times as far from their places as declared"
    numbers = {"times": float(np.sqrt(size)), "apart_mm": float(np.linalg.norm(off))}
    said = f"markers {what}: skin and bone tie the frames"
    return by_body([Finding("markers_moved", Severity.WARNING, said, numbers)])


def _paired(markers: NamedPoints | None, pieces: Floats, T: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows of markers and of the pieces of metal that lie where a placement (4, 4) has them."""
    points = np.zeros((0, 3)) if markers is None else apply(T, markers.points)
    distance = np.linalg.norm(points[:, None] - pieces, axis=2)
    rows, columns = linear_sum_assignment(np.minimum(distance, 10 * MARKER_MM))
    kept = distance[rows, columns] < MARKER_MM
    return rows[kept], columns[kept]


def _tie(
    T: Floats, cov: Floats, body: Body, how: str, residual: float, found: float, same_frame: bool, said: list[Finding]
) -> Tie:
    moved_mm = moved_deg = np.nan
    if same_frame:
        moved_mm = float(np.linalg.norm(apply(T, body.target_ct) - body.target_ct))
        moved_deg = float(np.degrees(rotation_angle(T[:3, :3])))
        if moved_mm > 2 * np.sqrt(np.linalg.eigvalsh(cov[:3, :3])[-1]) + 1.0:
            text = f"the patient has moved by {moved_mm:.1f} mm and {moved_deg:.1f} degrees since the case's CT"
            said = [*said, Finding("patient_moved", Severity.WARNING, text, {"moved_mm": moved_mm})]
    return Tie(T, np.asarray(cov), body.target_ct, how, residual, found, moved_mm, moved_deg, tuple(said))
