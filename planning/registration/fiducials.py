"""Markers on the skin of a CT, found without being told where: dense, small, round, and at the body's surface.

What holds together at one of some levels of density, is no larger than a marker and lies at the skin is a candidate.
It is read as a marker (`puncture_twin.planning.registration.fiducial_reading`), and passed over where its image is not
that of a ball, disc or ring: bone, wires, clips, needles, parts of a table. Contrast counts on the skin alone: a
calcification beneath it looks the same; metal may lie a few mm under it. The markers of a patient are of one size:
where several sizes are seen the answer is what was seen, not a guess.

It is in `planning` because `init` proposes a registration by it; what the twin finds by expected places
(`twin.guidance.ct.markers`) is read in the same way.
"""

import itertools
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from puncture_twin.planning.anatomy.metal import METAL_HU, spacing_mm
from puncture_twin.planning.anatomy.skin import Skin
from puncture_twin.planning.base.arrays import Floats, Ints, read_only
from puncture_twin.planning.base.errors import NoAnswerError, refuse
from puncture_twin.planning.base.text import first_few, plural
from puncture_twin.planning.formats.points import NamedPoints
from puncture_twin.planning.formats.volumes.volume_files import Volume
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.geometry.spaces import Space, point_text
from puncture_twin.planning.geometry.triangle_distance import squared_distance
from puncture_twin.planning.registration.fiducial_reading import (
    CLIPPED,
    LARGEST_MM,
    LEAST_MM,
    TISSUE_HU,
    Box,
    Kind,
    Middle,
    Reading,
    find_middle,
    read_marker,
)
from puncture_twin.planning.registration.marker_pairs import BETTER, MIN_MARKERS, matching, rigid_rss

LEVELS_HU = (150.0, 350.0, 700.0, METAL_HU, 2500.0)
"""Tried one after the other: where a marker holds together with bone at one, it is alone at a higher one."""
AROUND_MM = 4.0
"""About a candidate, so much is looked at."""
MOST_VERTICES = 100_000
"""Of the skin, by which candidates are near it; on a trunk they are 3 mm apart."""
LEAST_VOXELS = 3
"""Fewer may be noise where it reaches so far."""
LEAST_CLIPPED = 4
"""Voxels of one greatest value: dense things have noise where they are not clipped."""
LEAST_CONTRAST_HU, LEAST_CONTRAST_SD = 150.0, 6.0
"""Of a marker above soft tissue, and over the image's noise; 200 HU less what small ones lose by blur."""
MOST_MISFIT = 0.28
"""Of an image from the drawing of a marker: balls, discs and rings have up to .25, an L or a bone's end more."""
LEAST_ROUND = 0.42
"""Of two axes: a piece of wire has a tenth."""
NEARLY = 0.7
"""What has so much of what a marker has is doubtful."""
OFF_SKIN_MM, UNDER_SKIN_MM, IN_SKIN_MM = 5.0, 4.0, 1.0
"""How far beyond its own size a marker may lie off the skin, of metal under it, and of other contrast under it."""
AS_WIDE, AS_DENSE = (0.25, 1.5), 2.0
"""Times: what is no marker, but about as wide (two that touch, a part of a ring) and as dense as the markers, is
doubtful; a wire is thinner."""
ABOUT_MM = 20.0
"""So far about a marker the skin's direction is taken."""
FRONT = read_only([0.0, -1.0, 0.0])
"""LPS."""
ROW_MM = 10.0
"""Markers less far apart along the body lie in one row."""
LAYOUT_MM = 2.0
"""Root mean square by which a layout may be off: skin gives way."""
LEAST_OF_LAYOUT = 4
"""Three of a layout fit many places by chance; so many are needed where some of it are not seen. A layout of three must
fit twice as well where more than three are seen."""


@dataclass(frozen=True)
class Stated:
    """What a person says of the markers; None for what is not known."""

    kind: str | None = None
    diameter_mm: float | None = None
    count: int | None = None

    def __post_init__(self) -> None:
        if self.kind is not None and self.kind not in get_args(Kind):
            refuse(f"kind '{self.kind[:40]}' is not known", "--kind", ", ".join(get_args(Kind)), "unknown_choice")
        if self.diameter_mm is not None and not LEAST_MM <= self.diameter_mm <= LARGEST_MM:
            allowed = f"mm, from {LEAST_MM:g} to {LARGEST_MM:g}"
            refuse(f"{self.diameter_mm:g} mm", "--diameter", allowed, "out_of_range")
        if self.count is not None and self.count < MIN_MARKERS:
            refuse(plural(self.count, "marker"), "--count", f"{MIN_MARKERS} or more", "out_of_range")


NOTHING_STATED = Stated()


@dataclass(frozen=True, eq=False)
class Fiducial:
    """A marker that was found."""

    name: str
    reading: Reading
    gap_mm: float  # of its centre from the skin, negative inside of the body

    @property
    def position_ct(self) -> Floats:
        """Shape (3,), LPS mm."""
        return self.reading.centre_ct

    @property
    def sd_mm(self) -> Floats:
        """Standard deviations along the patient's axes, shape (3,)."""
        return np.sqrt(np.diag(self.reading.cov_ct))


class Passed(NamedTuple):
    """A dense thing that is not taken for a marker."""

    point_ct: Floats  # shape (3,), LPS mm
    why: str
    nearly: bool  # whether it lacks little: a person should look at it
    middle: Middle | None = None  # how wide and dense it is, where it is on the skin and ends

    def resembles(self, group: Sequence[Fiducial]) -> bool:
        """Whether markers of a group may be in it, or be it in part."""
        if self.nearly or self.middle is None:
            return self.nearly
        of_one = self.middle.across_mm / np.median([one.reading.shape.diameter_mm for one in group])
        dense = (self.middle.peak_hu - TISSUE_HU) / np.median([one.reading.contrast_hu for one in group])
        return bool(AS_WIDE[0] <= of_one <= AS_WIDE[1] and 1 / AS_DENSE <= dense <= AS_DENSE)


class Seen(NamedTuple):
    """What looks like a marker, and the dense things near the skin that do not."""

    fiducials: tuple[Fiducial, ...]
    passed: tuple[Passed, ...]

    @property
    def doubtful(self) -> list[Passed]:
        """What may be a marker that was missed."""
        return [one for one in self.passed if one.nearly]


def look_for_fiducials(volume: Volume, skin: Skin, stated: Stated = NOTHING_STATED) -> Seen:
    """Everything on the skin of a CT (HU, axes to the left, back, head) that looks like a marker, from head to feet."""
    kinds = tuple(one for one in get_args(Kind) if stated.kind in (None, one))
    noise, ceiling = noise_hu(volume.values), clipped_at(volume.values)
    found, passed, voxel = list[Fiducial](), list[Passed](), float(spacing_mm(volume).max())
    for box in _candidates(volume, skin, ceiling, noise):
        middle = find_middle(box)
        if middle is not None and _among(middle.centre_ct, found, voxel):
            continue
        one = _looked_at(box, middle, skin, kinds, stated.diameter_mm)
        if isinstance(one, Passed):
            passed.append(one)
        elif not _among(one.position_ct, found, voxel):
            found.append(one)
    rows = order_along_body(np.array([one.position_ct for one in found]).reshape(-1, 3))
    others = tuple(one for one in passed if not _among(one.point_ct, found, voxel))
    return Seen(_numbered([found[row] for row in rows]), others)


def _among(point_ct: Floats, found: Sequence[Fiducial], voxel_mm: float) -> bool:
    return any(
        np.linalg.norm(point_ct - one.position_ct) < max(one.reading.shape.diameter_mm, voxel_mm) / 2 for one in found
    )


def _looked_at(
    box: Box, middle: Middle | None, skin: Skin, kinds: tuple[Kind, ...], diameter_mm: float | None
) -> Fiducial | Passed:
    peak_hu, point = float(box.volume.values[tuple(box.peak)]), apply(box.volume.T_ct_index, box.peak.astype(float))
    if middle is None:
        nearly = (box.cut or peak_hu >= METAL_HU) and -UNDER_SKIN_MM <= _at_skin(point, skin)[0] <= LARGEST_MM
        return Passed(point, "cut by the image" if box.cut else "part of something larger", nearly)
    point, contrast = middle.centre_ct, middle.peak_hu - TISSUE_HU
    least = max(LEAST_CONTRAST_HU, LEAST_CONTRAST_SD * box.noise_hu)
    gap, normal = _at_skin(point, skin)
    if not _on_skin(box, middle.peak_hu, middle.wide_mm / 2, gap):
        return Passed(point, "not on the skin", nearly=False)
    if contrast < least:
        return Passed(point, "too faint", contrast > NEARLY * least, middle)
    if middle.roundness < LEAST_ROUND:
        return Passed(point, "long, as wires and clips are", middle.roundness > NEARLY * LEAST_ROUND, middle)
    reading = read_marker(middle, normal, kinds, diameter_mm)
    if not LEAST_MM / 1.5 <= reading.shape.diameter_mm <= LARGEST_MM * 1.15:
        return Passed(point, "too small or too large", nearly=True)
    if reading.misfit > MOST_MISFIT:
        return Passed(point, "no ball, disc or ring", reading.misfit < MOST_MISFIT / NEARLY, middle)
    if not _on_skin(box, middle.peak_hu, reading.shape.half_mm(normal), gap):
        return Passed(point, "under the skin or off it", nearly=True)
    return Fiducial("", reading, gap)


def noise_hu(values: NDArray[Any]) -> float:
    """Standard deviation of a voxel in soft tissue, by neighbours two voxels apart (MAD); 0 where there is none."""
    some = values[:, :, :: max(1, values.shape[2] // 16)]
    left, right = some[:-2].astype(np.float32), some[2:].astype(np.float32)
    both = (np.abs(left) < 200) & (np.abs(right) < 200)
    return float(1.4826 * np.median(np.abs(left[both] - right[both])) / np.sqrt(2)) if both.any() else 0.0


def clipped_at(values: NDArray[Any]) -> float:
    """The value at which an image is clipped, as several voxels have it; infinite where nothing says so."""
    most = values.max()
    clips = most > METAL_HU and np.count_nonzero(values == most) >= LEAST_CLIPPED
    return float(most) if clips else np.inf


def _candidates(volume: Volume, skin: Skin, ceiling_hu: float, noise: float) -> Iterator[Box]:
    """What is dense, small and near the skin, each once, at the lowest level at which it is alone."""
    spacing = spacing_mm(volume)
    uncut = np.zeros(len(skin.mesh.vertices), np.bool_)
    uncut[skin.mesh.faces[~skin.cut_faces]] = True
    tree = cKDTree(skin.mesh.vertices[uncut][:: max(1, np.count_nonzero(uncut) // MOST_VERTICES)])
    first, values = _about_body(volume, skin)
    seen: set[tuple[int, ...]] = set()
    for level in LEVELS_HU:
        mask = values > level
        if not mask.any():
            break
        labels, _ = ndimage.label(mask, structure=np.ones((3, 3, 3)))
        sizes = np.bincount(labels.ravel())
        pieces = [(number, box) for number, box in enumerate(ndimage.find_objects(labels), start=1)]
        ends = np.array([[(one.start, one.stop) for one in box] for _, box in pieces])
        sides = np.ptp(ends, axis=2)
        small = np.all((sides - 1) * spacing <= 2 * LARGEST_MM + 2.0, axis=1)
        small &= (sizes[1:] >= LEAST_VOXELS) | (level >= TISSUE_HU + LEAST_CONTRAST_SD * noise)
        rows = np.flatnonzero(small)
        middles = apply(volume.T_ct_index, (ends[rows].sum(axis=2) - 1) / 2 + first)
        near, _ = tree.query(middles, distance_upper_bound=LARGEST_MM + OFF_SKIN_MM)
        for row in rows[np.isfinite(near)].tolist():
            number, box = pieces[row]
            inside = np.where(labels[box] == number, values[box], -np.inf)
            at = np.array(np.unravel_index(int(np.argmax(inside)), inside.shape))
            peak = at + ends[row, :, 0] + first
            if tuple(peak) not in seen:
                seen.add(tuple(peak))
                yield box_about(volume, ends[row] + first[:, None], peak, ceiling_hu, noise)


def _about_body(volume: Volume, skin: Skin) -> tuple[Ints, NDArray[Any]]:
    """The part of the image that holds the body and what may lie on it: its first voxel, and the values."""
    corners = apply(np.linalg.inv(volume.T_ct_index), np.array([*itertools.product(*skin.mesh.bounds.T)]))
    reach = (LARGEST_MM + OFF_SKIN_MM) / spacing_mm(volume)
    low = np.maximum(np.floor(corners.min(axis=0) - reach), 0).astype(int)
    high = np.ceil(corners.max(axis=0) + reach).astype(int) + 1
    return low, volume.values[tuple(slice(a, max(a, b)) for a, b in zip(low, high, strict=True))]


def box_about(volume: Volume, ends: Ints, peak: Ints, ceiling_hu: float, noise: float) -> Box:
    """What surrounds a thing whose voxels lie between ends, shape (3, 2), with its densest one at ``peak``."""
    around = np.maximum(np.ceil(AROUND_MM / spacing_mm(volume)), 2).astype(int)
    low, high = np.maximum(ends[:, 0] - around, 0), np.minimum(ends[:, 1] + around, volume.values.shape)
    part = volume.values[tuple(map(slice, low, high))].astype(np.float64)
    T = np.array(volume.T_ct_index)
    T[:3, 3] = apply(volume.T_ct_index, low.astype(float))
    cut = bool(np.any((ends[:, 0] <= 0) | (ends[:, 1] >= volume.values.shape)))
    return Box(Volume(part, T, volume.path), peak - low, ceiling_hu, noise, cut)


def _on_skin(box: Box, peak_hu: float, half_mm: float, gap_mm: float) -> bool:
    """Whether a thing lies on the skin, or of metal just under it; the skin may pass behind or over it."""
    metal = peak_hu >= min(METAL_HU, CLIPPED * box.ceiling_hu)
    under = UNDER_SKIN_MM if metal else IN_SKIN_MM + float(np.min(spacing_mm(box.volume))) / 2
    return -half_mm - under <= gap_mm <= half_mm + OFF_SKIN_MM


def _at_skin(point_ct: Floats, skin: Skin) -> tuple[float, Floats]:
    """How far a point (3,) is from the skin, negative inside, and the skin's mean outward normal about it.

    The skin goes over a marker where that counts as body: its mean direction is less of a bump.
    """
    mesh = skin.mesh
    near = np.all(np.abs(mesh.vertices - point_ct) < ABOUT_MM, axis=1)
    rows = np.flatnonzero(near[mesh.faces[:, 0]] & ~skin.cut_faces)
    if not len(rows):
        return np.inf, FRONT
    corners = mesh.vertices[mesh.faces[rows]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    squares, mean = squared_distance(point_ct, corners), normals.sum(axis=0)
    nearest, length = squares <= squares.min() + 0.01, float(np.linalg.norm(mean))
    if not length > 0.0:
        return np.inf, FRONT
    side = float((point_ct - corners[nearest].mean(axis=(0, 1))) @ normals[nearest].sum(axis=0))
    return float(np.copysign(np.sqrt(squares.min()), side)), mean / length


def order_along_body(points_ct: Floats) -> list[int]:
    """Rows of points (n, 3), LPS mm, from head to feet, and in a row across the body from right to left."""
    down = sorted(range(len(points_ct)), key=lambda row: -points_ct[row, 2])
    rows: list[list[int]] = []
    for one in down:
        if rows and points_ct[rows[-1][0], 2] - points_ct[one, 2] < ROW_MM:
            rows[-1].append(one)
        else:
            rows.append([one])
    return [one for row in rows for one in sorted(row, key=lambda one: points_ct[one, 0])]


def find_fiducials(
    volume: Volume, skin: Skin, stated: Stated, layout: NamedPoints | None = None, *, where: str | Path
) -> Seen:
    """The markers of a CT (HU, axes to the left, back, head), named by a layout (any frame, mm) or from head to feet.

    Raises NoAnswerError: None, too few, too many, several sizes, or none that a layout tells; it says what was seen.
    Raises InputError: A layout that is mirrored.
    """
    return choose_fiducials(look_for_fiducials(volume, skin, stated), stated, layout, where=where)


def choose_fiducials(seen: Seen, stated: Stated, layout: NamedPoints | None = None, *, where: str | Path) -> Seen:
    """Of what looks like markers those that are meant, as `find_fiducials` does."""
    size = stated.diameter_mm
    alike = [one for one in seen.fiducials if size is None or one.reading.of_size(size)]
    if layout is not None:
        chosen, why = named_by_layout(alike, layout, where), "no part of the layout"
    else:
        chosen, why = _numbered(_one_kind(alike, stated, seen)), "of another size or kind"
    taken = {one.reading for one in chosen}
    others = [Passed(one.position_ct, why, nearly=True) for one in seen.fiducials if one.reading not in taken]
    passed = [one._replace(nearly=one.resembles(chosen)) for one in seen.passed]
    return Seen(chosen, (*passed, *others))


def _numbered(fiducials: Sequence[Fiducial]) -> tuple[Fiducial, ...]:
    return tuple(replace(one, name=f"M{number}") for number, one in enumerate(fiducials, start=1))


def _one_kind(alike: Sequence[Fiducial], stated: Stated, seen: Seen) -> Sequence[Fiducial]:
    if not alike:
        counted = Counter(one.why for one in seen.passed)
        others = ", ".join(f"{count} {why}" for why, count in counted.most_common(3))
        what = "no marker on the skin" + (f"; dense things at the skin: {others}" if others else "")
        if seen.fiducials:
            what = f"no marker as stated; seen: {seen_text(seen.fiducials)}"
        raise NoAnswerError(what, code="no_markers")
    # things that may be alike together, also by others between them, in the order given
    count, labels = connected_components(np.array([[a.reading.alike(b.reading) for b in alike] for a in alike]))
    groups = [[one for one, label in zip(alike, labels, strict=True) if label == k] for k in range(count)]
    if stated.count is not None:
        # a group may lack what is doubtful: each may be two that touch
        most = [len(group) + 2 * sum(one.resembles(group) for one in seen.passed) for group in groups]
        fits = [len(group) <= stated.count <= count for group, count in zip(groups, most, strict=True)]
        groups = [group for group, fit in zip(groups, fits, strict=True) if fit] or groups
    if len(groups) > 1 or not all(one.reading.alike(other.reading) for one in groups[0] for other in groups[0]):
        what = f"things of {max(len(groups), 2)} kinds may be markers: {seen_text(alike)}"
        raise NoAnswerError(f"{what}; --diameter, --kind, --count or --layout tells them apart", code="markers_unclear")
    (group,) = groups
    wanted = stated.count or len(group)
    if len(group) < max(wanted, MIN_MARKERS):
        what = f"{plural(len(group), 'marker')}, {max(wanted, MIN_MARKERS)} are needed: {seen_text(group)}"
        raise NoAnswerError(what, code="too_few_markers")
    if len(group) > wanted:
        what = f"{len(group)} markers instead of {wanted}: {seen_text(group)}; --layout tells them apart"
        raise NoAnswerError(what, code="too_many_markers")
    return group


def seen_text(fiducials: Sequence[Fiducial]) -> str:
    """Places and sizes, for a line."""
    return first_few(
        [f"({point_text(one.position_ct, Space.LPS)}) {one.reading.shape.diameter_mm:.1f} mm" for one in fiducials]
    )


def named_by_layout(alike: Sequence[Fiducial], layout: NamedPoints, where: str | Path) -> tuple[Fiducial, ...]:
    """The markers by the names of a layout, in its order."""
    names, points = layout.names, layout.points
    if len(names) < MIN_MARKERS:
        refuse(plural(len(names), "marker"), where, f"a layout of {MIN_MARKERS} or more", "too_few_markers")
    seen = np.array([one.position_ct for one in alike]).reshape(-1, 3)
    mirrored = False
    for count in range(min(len(names), len(alike)), MIN_MARKERS - 1, -1):
        if count < len(names) and count < LEAST_OF_LAYOUT:
            break
        fits = _fits(points, seen, count, where)
        chance = count == MIN_MARKERS < len(alike)
        near = [one for one in fits if one.rms_mm <= (LAYOUT_MM / 2 if chance else LAYOUT_MM)]
        mirrored |= bool(near) and near[0].mirrored
        proper = [one for one in fits if not one.mirrored]
        if mirrored or not near:
            continue
        likely = [one for one in proper if one.rms_mm < BETTER * max(proper[0].rms_mm, LAYOUT_MM / BETTER**2)]
        if len(likely) > 1:
            rms = f"rms {likely[0].rms_mm:.2f} and {likely[1].rms_mm:.2f} mm"
            what = f"the layout fits in {len(likely)} ways ({rms}): {seen_text(alike)}"
            raise NoAnswerError(what, code="markers_ambiguous")
        return tuple(
            replace(alike[column], name=names[row])
            for row, column in zip(proper[0].rows, proper[0].columns, strict=True)
        )
    if mirrored:
        refuse("the layout fits mirrored alone", where, "a layout in right-handed axes", "markers_mirrored")
    what = f"the layout of {len(names)} does not fit what is seen to {LAYOUT_MM:g} mm"
    raise NoAnswerError(f"{what}: {seen_text(alike) or 'no marker'}", code="layout_not_seen")


class _Fit(NamedTuple):
    """Rows of a layout on markers that are seen; mirrored where that fits far better than a rotation."""

    rms_mm: float
    rows: tuple[int, ...]
    columns: tuple[int, ...]
    mirrored: bool


def _fits(points: Floats, seen: Floats, count: int, where: str | Path) -> list[_Fit]:
    """Every way to put so many points of a layout on markers that a fit within `LAYOUT_MM` may be mistaken for."""
    bound, found = count * (BETTER * LAYOUT_MM) ** 2, []
    for rows in itertools.combinations(range(len(points)), count):
        x = points[list(rows)] - points[list(rows)].mean(axis=0)
        orders = matching(x, seen, bound)
        if orders is None:
            refuse("the layout fits in too many ways to list", where, "markers without symmetry", "markers_ambiguous")
        y = seen[orders] - seen[orders].mean(axis=1, keepdims=True)
        rss = np.stack([rigid_rss(x, y), rigid_rss(x * [1.0, 1.0, -1.0], y)])
        for order, (proper, mirror) in zip(orders.tolist(), rss.T.tolist(), strict=True):
            if min(proper, mirror) <= bound:
                flipped = proper > count * LAYOUT_MM**2 >= mirror or proper > BETTER**2 * (
                    mirror + count * LAYOUT_MM**2 / BETTER**2
                )
                rms = float(np.sqrt(min(proper, mirror if flipped else proper) / count))
                found.append(_Fit(rms, rows, tuple(order), flipped))
    return sorted(found)
