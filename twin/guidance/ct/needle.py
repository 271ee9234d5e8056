"""Needles found in a CT: long, thin metal that comes from outside of the body and has the image of a needle."""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.optimize import minimize_scalar
from scipy.special import ndtr

from puncture_twin.planning.anatomy.metal import (
    AROUND_MM,
    BLUR_MM,
    METAL_HU,
    SOLID_HU,
    Metal,
    centroid,
    full_part,
    metal_parts,
    metal_pieces,
    metal_weights,
    spacing_mm,
    where_set,
    wide_metal,
)
from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.base.errors import Finding, InputError, Severity, refuse
from puncture_twin.planning.formats.volumes.volume_files import Volume
from puncture_twin.planning.geometry.rigid import apply, frame_about
from puncture_twin.twin.guidance.ct.needle_fit import (
    FITTED_MM,
    UNKNOWN,
    WIDE_MM,
    WIDEST_SLICE,
    FoundNeedle,
    Line,
    beside,
    fit_needle,
    toward,
    unclear,
)
from puncture_twin.twin.guidance.ct.needle_image import BLUR_SIGMA_MM

SHORTEST_MM = 20.0
"""A shorter piece of metal is no needle."""
SHAFT_MM = 12.0
"""Behind the foremost voxel of metal, and beyond it, so far the needle is looked at."""
SLENDER = 8.0
"""Length over width: a rib is bent, and so wider."""
LEVELS_HU = (METAL_HU, 1000.0, 600.0, 400.0)
"""From what on voxels are taken for metal: thick slices dilute it."""
GROWTHS, GROWN_MM = 8, 10.0
"""The first line through a short piece is not yet the needle's; a bend is followed so far beyond it at a time."""
SEEN_MM = 3.0
"""So far before and beyond a tip the needle's axis is clear of other metal: else the tip is not seen."""
LARGEST_GAP_MM = 6.0
"""Along a needle, between voxels that show it."""
SKIN_MM = 5.0
"""A needle that ends so near below the skin comes from outside: thick slices of it show no metal in air."""
EDGE_VOXELS = 1.5
"""A needle that ends so near to the image's border leaves the image there."""
SAME_MM = 4.0
"""Two pieces of one needle: so near to its axis; in thin slices nearer, as far as its own image reaches."""
OF_PLAN_MM, OF_PLAN_DEG = 15.0, 15.0
"""Of two needles the plan's is the only one whose axis is so near to the planned tip, and so parallel to its line."""
MARKER_MM = 6.0
"""So far about a marker's middle its metal shows."""
UNSURE_MM = 1.5
"""A tip known worse than this is not read: streaks, other metal or thick slices hide where it ends."""
MOST_PARTS, LINES = 4, 300
"""Straight pieces of metal that touch; and lines that are tried for each."""
THICK_MM, BESIDE_MM = 3.0, 10.0
"""In thicker slices a needle so near beside another, and nearly along it, may show as one with it."""
Inside = Callable[[Floats], Bools]
"""Which of points (n, 3), LPS mm, lie in the body."""


def find_needle(volume: Volume, target_ct: Floats, diameter_mm: float | None = None) -> FoundNeedle:
    """Find the needle, or without a diameter the rod, whose metal is nearest to a target (3,), LPS mm.

    Metal that is wider than the needle (bolts, plates) is not looked at, nor what it blurs into; a tip there is
    refused.
    """
    if diameter_mm is not None:
        needles = [one for one in _needles(volume, target_ct, diameter_mm, None) if not one[0].unclear]
        if not needles:
            _refuse_none(volume, _dilution(volume, diameter_mm))
        nearest = min(needles, key=lambda one: float(np.linalg.norm(one[0].path_ct - target_ct, axis=1).min()))
        _check_tip(volume, *nearest, target_ct)
        return nearest[0]
    rods = [piece for piece in metal_pieces(volume) if piece.size_mm >= SHORTEST_MM]
    if not rods:
        _refuse_none(volume, "")
    metal = min(rods, key=lambda piece: float(np.linalg.norm(_places(volume, piece) - target_ct, axis=1).min()))
    line = toward(_axis(volume, metal), target_ct)
    end = _tip(volume, metal, line)
    return FoundNeedle(end, line.forward, line.width_mm, np.stack([end, line.middle]), UNKNOWN)


def read_needle(
    volume: Volume,
    target_ct: Floats,
    diameter_mm: float,
    inside: Inside,
    planned: tuple[Floats, Floats] | None = None,
    markers: Floats | None = None,
) -> tuple[FoundNeedle, tuple[Finding, ...]]:
    """Read the one needle that enters a body; another is reported, and none is guessed.

    The target (3,), LPS mm, is for what is said of a tip that is not seen. Tip and unit direction (3,) of the plan may
    tell one needle from another; what is seen at markers (n, 3) is no needle.

    Raises:
        InputError: No needle, two of which none is plainly the plan's, a tip outside of the image, at other metal, or
            lost in streaks.
    """
    needles = list(_needles(volume, target_ct, diameter_mm, inside, markers))
    if not needles:
        _refuse_none(volume, f", that enters the body{_dilution(volume, diameter_mm)}")
    findings: list[Finding] = []
    needle, hidden = needles[0]
    if len(needles) > 1:
        (needle, hidden), findings = _chosen(volume, needles, planned)
    elif not _of_plan(needle, *(planned or (target_ct, needle.forward_ct))):
        warning = f"the needle lies more than {OF_PLAN_MM:g} mm or {OF_PLAN_DEG:g} degrees off the planned line"
        warning = f"the needle's line passes the target by more than {OF_PLAN_MM:g} mm" if planned is None else warning
        findings = [Finding("far_from_plan", Severity.WARNING, f"{warning}: is it the needle?")]
    if not needle.unclear and not _enters(volume, needle, inside):
        warning = "the needle is in the body as far as it is seen: that it comes through the skin is not; is it a lead?"
        findings.append(Finding("entry_not_seen", Severity.WARNING, warning))
    if needle.leaves:
        what = "the needle leaves the image; its tip is outside"
        refuse(what, volume.path, "a scan with its tip", "tip_outside_image")
    if needle.unclear:
        at = "({:.0f}, {:.0f}, {:.0f}) mm".format(*needle.tip_ct)
        of_none = f"has not the image of a needle of {diameter_mm:g} mm"
        what = f"long metal ends in the body at {at} in the scan, but {of_none}"
        allowed = f"one needle of the case's diameter, apart from other metal{_dilution(volume, diameter_mm)}"
        refuse(what, volume.path, allowed, "needle_unclear")
    _check_tip(volume, needle, hidden, target_ct)
    if needle.tip_sd_mm > UNSURE_MM:
        known = f"it is known to {needle.tip_sd_mm:.1f} mm (standard deviation) only"
        what = f"streaks or thick slices hide the needle's tip: {known}"
        allowed = f"a tip known to {UNSURE_MM:g} mm: thinner slices, or another gantry tilt"
        refuse(what, volume.path, allowed, "tip_hidden")
    thick = float(spacing_mm(volume)[2])
    if thick > THICK_MM + 0.01:
        near = f"within {BESIDE_MM:g} mm of this one"
        warning = f"slices of {thick:g} mm: a second needle {near} may not be seen; look for it"
        findings.append(Finding("thick_slices", Severity.WARNING, warning, {"slice_mm": thick}))
    return needle, tuple(findings)


def _refuse_none(volume: Volume, how: str) -> None:
    allowed = f"a straight or slightly bent piece of metal of {SHORTEST_MM:g} mm or more{how}"
    raise InputError("no needle in the image", where=volume.path, allowed=allowed, code="needle_not_seen")


def _dilution(volume: Volume, diameter_mm: float) -> str:
    """That slices are too thick for so thin a needle, if one within a slice may be darker than bone."""
    thick_mm = float(spacing_mm(volume)[2])
    shown_hu = SOLID_HU * np.pi * diameter_mm**2 / 4 / (thick_mm * np.sqrt(2 * np.pi) * BLUR_SIGMA_MM)
    if shown_hu > METAL_HU:
        return ""
    return f"; thinner slices: of {thick_mm:g} mm they may show one of {diameter_mm:g} mm as {shown_hu:.0f} HU"


def _chosen(
    volume: Volume, needles: Sequence[tuple[FoundNeedle, Bools]], planned: tuple[Floats, Floats] | None
) -> tuple[tuple[FoundNeedle, Bools], list[Finding]]:
    alike = [] if planned is None else [one for one in needles if _of_plan(one[0], *planned)]
    tips = "; ".join("({:.0f}, {:.0f}, {:.0f})".format(*one[0].tip_ct) for one in needles)
    text = f"{len(needles)} needles enter the body, with tips at {tips} mm in the scan"
    if len(alike) != 1:
        refuse(text, volume.path, "one needle, or --plan whose line is near to only one", "two_needles")
    text += "; the one near the planned line is read: ({:.0f}, {:.0f}, {:.0f})".format(*alike[0][0].tip_ct)
    return alike[0], [Finding("two_needles", Severity.WARNING, text, {"needles": len(needles)})]


def _of_plan(needle: FoundNeedle, tip_ct: Floats, forward_ct: Floats) -> bool:
    aside = needle_error(needle.tip_ct, needle.forward_ct, tip_ct).lateral_mm
    return aside < OF_PLAN_MM and float(needle.forward_ct @ forward_ct) > np.cos(np.radians(OF_PLAN_DEG))


def _needles(
    volume: Volume, target_ct: Floats, diameter_mm: float, inside: Inside | None, markers: Floats | None = None
) -> Iterator[tuple[FoundNeedle, Bools]]:
    hidden, spacing = wide_metal(volume, diameter_mm), spacing_mm(volume)
    for marker in np.zeros((0, 3)) if markers is None else markers:
        at, reach = apply(np.linalg.inv(volume.T_ct_index), marker), MARKER_MM / spacing
        low, high = np.maximum(np.ceil(at - reach), 0).astype(int), np.floor(at + reach).astype(int) + 1
        box = tuple(slice(a, max(a, b)) for a, b in zip(low, np.minimum(high, hidden.shape), strict=True))
        index = np.moveaxis(np.indices(hidden[box].shape), 0, -1) + low
        hidden[box] |= np.linalg.norm((index - at) * spacing, axis=-1) <= MARKER_MM
    known: list[FoundNeedle] = []
    for level in LEVELS_HU:
        for metal in metal_pieces(volume, level, hidden | _taken(volume, known)):
            short = _length(volume, metal, level, hidden, diameter_mm) < SHORTEST_MM  # as hundreds of specks are
            if short or any(_same(volume, one, _places(volume, metal)) for one in known):
                continue
            for part, beside_it in _parts(volume, metal, level, hidden, diameter_mm):
                needle = _needle(volume, part, level, target_ct, inside, beside_it, diameter_mm)
                if needle is not None and not any(_same(volume, one, needle.path_ct) for one in known):
                    known.append(needle)
                    yield needle, beside_it


def _length(volume: Volume, metal: Metal, level: float, hidden: Bools, diameter_mm: float) -> float:
    """Of a piece, mm; of a thin one with what lies beyond a gap, where another needle or a slice's border cuts it."""
    part = LEVELS_HU[-1] < level and SHORTEST_MM / 2 <= metal.size_mm < SHORTEST_MM
    if not (part and _thin(volume, metal, diameter_mm)):
        return metal.size_mm
    return _whole(volume, metal, _axis(volume, metal), hidden)[0].size_mm


def _enters(volume: Volume, needle: FoundNeedle, inside: Inside) -> bool:
    """Whether a needle's line, from where it is seen last, comes out of the body within the image."""
    end, steps = needle.path_ct[-1], np.arange(0.0, FITTED_MM, 1.0)[:, None]
    line = end - steps * (needle.tip_ct - end) / np.linalg.norm(needle.tip_ct - end)
    return not inside(line[_in_image(volume, line)]).all()


def _in_image(volume: Volume, points: Floats) -> Bools:
    at = apply(np.linalg.inv(volume.T_ct_index), points)
    return np.asarray(((at >= 0) & (at <= np.array(volume.values.shape) - 1)).all(axis=1))


def _needle(
    volume: Volume, part: Metal, level: float, target_ct: Floats, inside: Inside | None, hidden: Bools,
    diameter_mm: float,
) -> FoundNeedle | None:  # fmt: skip
    """The needle that a long piece of metal is, clear or unclear; None where it does not enter the body."""
    line, thin = _axis(volume, part), _thin(volume, part, diameter_mm)
    if thin:
        part, line = _whole(volume, part, line, hidden)
    ends = _tip_end(volume, part, line, target_ct, inside, hidden)
    if ends is None:
        return None
    needle = fit_needle(volume, part, toward(line, ends[0]), diameter_mm, hidden) if thin else None
    if needle is None and level == METAL_HU:  # never passed over in silence
        needle = unclear(line, ends[0])
    if needle is None or not ends[1]:
        return needle
    # one at the border may end between the voxels, however its reading errs along it
    sd = float(np.sqrt(needle.forward_ct @ needle.cov_ct[:3, :3] @ needle.forward_ct))
    farthest = needle.tip_ct + 3.0 * sd * needle.forward_ct
    return needle._replace(leaves=not _in_image(volume, farthest[None])[0])


def _thin(volume: Volume, metal: Metal, diameter_mm: float) -> bool:
    widest = diameter_mm / 2 + 0.5 * float(spacing_mm(volume).max()) + BLUR_SIGMA_MM
    return _width(_places(volume, metal)) < min(widest, metal.size_mm / SLENDER)


def _parts(
    volume: Volume, metal: Metal, level: float, hidden: Bools, diameter_mm: float
) -> Iterator[tuple[Metal, Bools]]:
    """A thin piece, or the straight ones that touch in a wide one, each with the voxels that others hide from it."""
    if _thin(volume, metal, diameter_mm):
        yield metal, hidden
    elif level == METAL_HU:  # a needle at a wire, or at another; a wide piece at lower levels is bone
        straight = list(_straight(volume, metal))
        for part in straight:
            others, all_hidden = hidden.copy(), hidden.copy()
            others[tuple(_index(metal).T)] = True
            others[tuple(_index(part).T)] = False
            others &= ~hidden
            if others.any():  # with what they blur into
                away = distance_transform_edt(~others[metal.box], spacing_mm(volume))
                all_hidden[metal.box] |= away <= BLUR_MM
            yield part, all_hidden
        if not straight:
            yield metal, hidden


def _index(metal: Metal) -> NDArray[np.int64]:
    return np.argwhere(metal.voxels) + [axis.start for axis in metal.box]


def _straight(volume: Volume, metal: Metal) -> Iterator[Metal]:
    """The straight parts of a wide piece: of lines through two of its voxels the one with most on it, then the next.

    What lies around a line counts against it: lines through a block of metal have more around than on them.
    """
    rng, at = np.random.default_rng(0), _index(metal)
    places, left = apply(volume.T_ct_index, at.astype(float)), np.ones(len(at), np.bool_)
    for _ in range(MOST_PARTS):
        best = max(_lines(volume, places, left, rng), key=lambda one: one[0], default=None)
        if best is None or best[0] <= 0:
            return
        _, on, along = best
        order = np.flatnonzero(on)[np.argsort(along[on])]  # with what other parts have of it: they cross it
        runs = np.split(order, np.flatnonzero(np.diff(along[order]) > LARGEST_GAP_MM) + 1)
        run = max(runs, key=lambda one: float(np.ptp(along[one])))
        if np.ptp(along[run]) < SHORTEST_MM:
            return
        yield _piece(volume, at[run])
        left &= ~on


def _lines(
    volume: Volume, places: Floats, left: Bools, rng: np.random.Generator
) -> Iterator[tuple[int, Bools, Floats]]:
    """Lines through two of those left of places (n, 3): each line's score, which of all places are on it, and where.

    The score counts those left that are on it, less those around it.
    """
    some = places[left]
    for a, b in some[rng.integers(len(some), size=(LINES, 2))] if len(some) else ():
        length = float(np.linalg.norm(b - a))
        if length < SHORTEST_MM / 2:
            continue
        axes = frame_about((b - a) / length).T
        local = (places - a) @ axes.T
        aside = beside(local[:, :2], axes[:2] @ volume.T_ct_index[:3, 2])
        on = aside <= WIDE_MM
        yield int(2 * on[left].sum() - (aside[left] <= 2 * WIDE_MM).sum()), on, local[:, 2]


def _taken(volume: Volume, known: Sequence[FoundNeedle]) -> Bools:
    """The voxels that needles explain: a lower level would join them to what lies beside."""
    taken = np.zeros(volume.values.shape, np.bool_)
    at = where_set(volume.values > LEVELS_HU[-1])
    places, reach = apply(volume.T_ct_index, at.astype(float)), WIDE_MM + WIDEST_SLICE * float(spacing_mm(volume)[2])
    for path in (one.path_ct for one in known if not one.unclear):
        start, steps = path[:-1, None], np.diff(path, axis=0)[:, None]
        share = np.clip(((places - start) * steps).sum(axis=2) / (steps**2).sum(axis=2), 0.0, 1.0)[..., None]
        near = np.linalg.norm(places - start - share * steps, axis=2).min(axis=0) <= reach
        taken[tuple(at[near].T)] = True
    return taken


def _same(volume: Volume, needle: FoundNeedle, places: Floats) -> bool:
    away = places - needle.tip_ct
    aside = np.linalg.norm(away - np.outer(away @ needle.forward_ct, needle.forward_ct), axis=1)
    near = min(SAME_MM, WIDE_MM + WIDEST_SLICE * float(spacing_mm(volume)[2]))
    return bool(np.median(aside) < near + needle.sagitta_mm)


def _places(volume: Volume, metal: Metal) -> Floats:
    return apply(volume.T_ct_index, _index(metal).astype(float))


def _width(places: Floats) -> float:
    """Root mean square distance of points (n, 3) from the smooth curve through them, mm."""
    away = places - places.mean(axis=0)
    _, axes = np.linalg.eigh(away.T @ away)  # ascending: the last is along it
    along = away @ axes[:, 2]
    terms = np.vander(along / max(float(np.abs(along).max()), 1.0), 4)
    aside = away @ axes[:, :2]
    return float(np.sqrt(np.mean(np.sum((aside - terms @ np.linalg.lstsq(terms, aside, rcond=None)[0]) ** 2, axis=1))))


def _tip_end(
    volume: Volume, metal: Metal, line: Line, target_ct: Floats, inside: Inside | None, hidden: Bools
) -> tuple[Floats, bool] | None:
    """The end of a piece that is the tip (3,), and whether the image ends there; None for what is no needle.

    A needle comes from outside: its tip is the end in the body, the other one is outside of it or of the image, or
    goes on behind a marker.
    """
    places = _places(volume, metal)
    along = (places - line.middle) @ line.forward
    ends = places[[int(along.argmin()), int(along.argmax())]]
    if inside is None:
        near = int(np.linalg.norm(ends - target_ct, axis=1).argmin())
        return ends[near], False
    step, shape = np.array([[-1.0], [1.0]]) * line.forward, np.array(volume.values.shape)
    at, beyond = (apply(np.linalg.inv(volume.T_ct_index), ends + far * step) for far in (0.0, SEEN_MM))
    border = np.asarray(((at < EDGE_VOXELS) | (at > shape - 1 - EDGE_VOXELS)).any(axis=1))
    within, beyond = inside(ends), np.clip(np.rint(beyond).astype(int), 0, shape - 1)
    out = border | ~inside(ends + SKIN_MM * step) | hidden[tuple(beyond.T)]
    deeper = (target_ct - line.middle) @ line.forward > 0
    for at_border, first in ((False, int(deeper)), (True, 0)):
        for one in (first, 1 - first):
            if within[one] and border[one] == at_border and out[1 - one]:
                return ends[one], at_border
    return None


def _check_tip(volume: Volume, needle: FoundNeedle, hidden: Bools, target_ct: Floats) -> None:
    beyond = needle.tip_ct + np.arange(-SEEN_MM, SEEN_MM + 0.1, 0.25)[:, None] * needle.forward_ct
    at = np.rint(apply(np.linalg.inv(volume.T_ct_index), beyond)).astype(int)
    inside = ((at >= 0) & (at < hidden.shape)).all(axis=1)
    if not hidden[tuple(at[inside].T)].any():
        return
    lateral = needle_error(needle.tip_ct, needle.forward_ct, target_ct).lateral_mm
    what = f"other metal hides the needle's tip; the needle's axis passes the target by {lateral:.1f} mm"
    refuse(what, volume.path, f"a tip at least {SEEN_MM:g} mm away from wider metal and its blur", "tip_hidden")


def _whole(volume: Volume, metal: Metal, line: Line, hidden: Bools) -> tuple[Metal, Line]:
    """The whole needle along its line or bend, where thick slices dilute it and show it only in pieces at first."""
    at = where_set((volume.values > LEVELS_HU[-1]) & ~hidden)
    places = apply(volume.T_ct_index, at.astype(float))
    for _ in range(GROWTHS):
        axes = frame_about(line.forward).T
        own, local = ((points - line.middle) @ axes.T for points in (_places(volume, metal), places))
        along, low, high, thick = local[:, 2], own[:, 2].min(), own[:, 2].max(), axes[:2] @ volume.T_ct_index[:3, 2]
        bend = np.linalg.lstsq(np.vander(own[:, 2] / high, 4), own[:, :2], rcond=None)[0]
        aside = local[:, :2] - np.vander(np.clip(along, low, high) / high, 4) @ bend
        bent = (beside(aside, thick) <= WIDE_MM) & (along > low - GROWN_MM) & (along < high + GROWN_MM)
        near = bent | (beside(local[:, :2], thick) <= WIDE_MM)
        kept, along = at[near], along[near]
        order = np.argsort(along)
        parts = np.concatenate([[0], np.cumsum(np.diff(along[order]) > LARGEST_GAP_MM)])
        grown = kept[order[parts == parts[np.argmin(np.abs(along[order]))]]]
        if len(grown) == metal.voxels.sum():
            break
        metal = _piece(volume, grown)
        line = _axis(volume, metal)
    return metal, line


def _piece(volume: Volume, at: NDArray[np.int64]) -> Metal:
    spacing = spacing_mm(volume)
    around = np.ceil(AROUND_MM / spacing).astype(int)
    low, high = at.min(axis=0), at.max(axis=0) + 1
    begin, end = np.maximum(low - around, 0), np.minimum(high + around, volume.values.shape)
    voxels = np.zeros(end - begin, dtype=np.bool_)
    voxels[tuple((at - begin).T)] = True
    box = (slice(begin[0], end[0]), slice(begin[1], end[1]), slice(begin[2], end[2]))
    middle = apply(volume.T_ct_index, at.mean(axis=0))
    return Metal(box, voxels, middle, float(((high - low) * spacing).max()))


def _axis(volume: Volume, metal: Metal) -> Line:
    """Middle and direction of the weighted line of least squares, and how far the metal lies from it."""
    weights = metal_weights(volume, metal)
    weights = weights if (weights > 0).sum() > 3 else metal.voxels.astype(np.float64)  # nothing of it is metal
    at = np.argwhere(weights > 0)
    heavy = weights[tuple(at.T)]
    points = apply(volume.T_ct_index, at + np.array([axis.start for axis in metal.box], dtype=float))
    middle = centroid(weights, metal.box, volume.T_ct_index)
    spread = (points - middle) * np.sqrt(heavy / heavy.sum())[:, None]  # weighted for the SVD
    _, sizes, axes = np.linalg.svd(spread, full_matrices=False)
    return Line(middle, axes[0], float(np.hypot(sizes[1], sizes[2])))


def _tip(volume: Volume, metal: Metal, line: Line) -> Floats:
    """The end of the wide rod whose blurred and clipped image is nearest to the voxels about the axis."""
    parts, full = metal_parts(volume, metal), full_part(volume)
    index = np.argwhere(np.ones(parts.shape, dtype=bool))
    points = apply(volume.T_ct_index, index + np.array([axis.start for axis in metal.box], dtype=float)) - line.middle
    along = points @ line.forward
    across = np.linalg.norm(points - along[:, None] * line.forward, axis=1)
    typical = float(np.quantile(parts[metal.voxels], 0.9))  # thick slices dilute it
    end = float(along[parts.ravel() > min(full, typical) / 2].max())
    wide = max(line.width_mm / 2, WIDEST_SLICE * float(spacing_mm(volume).max()))
    near = (across <= wide) & (np.abs(along - end) <= SHAFT_MM)
    seen = np.minimum(parts.ravel()[near], full)
    sigmas = np.array([BLUR_SIGMA_MM, BLUR_SIGMA_MM, spacing_mm(volume)[2] / np.sqrt(12.0)])
    direction = np.linalg.solve(volume.T_ct_index[:3, :3], line.forward) * spacing_mm(volume)
    blur = float(np.linalg.norm(sigmas * direction))

    def misfit(tip: float) -> float:
        return float(np.sum((np.minimum(ndtr((tip - along[near]) / blur), full) - seen) ** 2))

    minimum = minimize_scalar(misfit, bounds=(end - SHAFT_MM / 2, end + SHAFT_MM / 2), method="bounded")
    return line.middle + float(minimum.x) * line.forward


class NeedleError(NamedTuple):
    """A needle's error seen from the target, mm: total² = lateral² + depth², depth positive when too deep."""

    tip_to_target_mm: float
    lateral_mm: float
    depth_mm: float


def needle_error(tip_ct: Floats, forward_ct: Floats, target_ct: Floats) -> NeedleError:
    """Tip minus target (3,), mm, split along and across the needle's unit direction (3,)."""
    error = tip_ct - target_ct
    depth = float(error @ forward_ct)
    return NeedleError(float(np.linalg.norm(error)), float(np.linalg.norm(error - depth * forward_ct)), depth)
