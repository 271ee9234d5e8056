"""A dense thing in a CT read as a marker: kind, size and centre by drawing it again, and how well they are known.

A marker is drawn as a scanner would show it: the part of each voxel that it fills, blurred in the plane, in what lies
about it, clipped where the image is. From the weighted middle (`puncture_twin.planning.anatomy.metal`) on, Gauss-Newton
moves it until its drawing is nearest to the image; with p the shift, size, tilt, density and blur, J the drawing's
derivatives and P what is known beforehand of p,

    cov p = s^2 (J' J + s^2 P^-1)^-1,   s^2 the mean square of what the drawing lacks, at least the image's noise.

So thickness of slices, noise, blur and clipping all enter: a clipped voxel has no derivative, and what no drawing
explains makes the centre uncertain. The kind is that whose drawing is nearest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Literal, NamedTuple, get_args

import numpy as np
from scipy import ndimage
from scipy.spatial.distance import cdist

from puncture_twin.planning.anatomy.metal import (
    BLUR_MM,
    SOLID_HU,
    Metal,
    centroid,
    clear_of_metal,
    metal_parts,
    spacing_mm,
)
from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.formats.volumes.volume_files import Volume
from puncture_twin.planning.geometry.gauss_newton import System, gauss_newton
from puncture_twin.planning.geometry.rigid import exp_rotation, frame_about

Kind = Literal["ball", "disc", "ring"]

LEAST_MM, LARGEST_MM = 1.0, 15.0
"""Diameters of markers."""
TISSUE_HU = 50.0
"""Muscle, and about what skin and fat have at most: the level at which a marker ends lies between this and its own."""
AIR_HU = -1000.0
"""By the scale's definition."""
CLIPPED = 0.97
"""Of the image's greatest value: a voxel from here on may have been clipped."""
FINE_MM, MOST_FINE = 0.5, 8
"""Voxels are filled by cells so wide, and by so many along an axis at most."""
HOLE = 0.4
"""Diameter of a ring's hole over its own, assumed."""
GROWN = 0.3
"""Part of a marker's contrast at which it must still be alone: a wire goes on there, where noise had cut it."""
PLAIN = MappingProxyType({"ball": 1.0, "disc": 1.1, "ring": 1.2})
"""By which misfits are weighed: the simpler drawing has fewer freedoms."""
SURE = 0.1
"""A misfit below which no other kind is drawn."""
AS_NEAR = 1.4
"""Times the least misfit: such a kind may be the true one."""
UNRESOLVED = 2.5
"""Voxels: what is no wider in the image shows no kind."""
SKIN_EDGE_MM = 0.12
"""How far contrast is drawn along the skin's normal where the skin is no plane; metal is drawn less."""
TOUCHED = 1.01
"""Voxels from a marker: the next one may be filled in part."""
DEEP, ASIDE_MM = 0.4, 4.0
"""About a voxel that a marker hides others tell of its background: as deep in the skin (voxels), and so far aside."""
MOST_OTHERS = 2000
"""Of these voxels, spread over all."""
ROUNDS = 7
"""Of Gauss-Newton; it settles after four or five."""
SHIFT, SIZE, THICK, DENSITY, TILT = 0.5, 0.35, 0.7, 0.7, 0.25
"""What is known beforehand (standard deviations): a shift in voxels; logarithms of size, thickness and density; rad."""
STEPS = np.array([0.05, 0.05, 0.05, 0.05, 0.02, 0.03, 0.05, 0.05, 0.05])
"""By which derivatives of a drawing are taken: shift, density, size, blur, thickness, tilts."""
SETTLED_MM = 0.002
STATED = 0.07
"""Of the logarithm of a diameter that a person states."""
THICK_MM = 2.5
BLUR_SIGMA_MM, BLUR_KNOWN = 0.45, 0.12
"""Of reconstruction and pixel together, in the plane, mm."""
MADE = np.diag([0.1, 0.02]) ** 2
"""Of density and diameter: how far markers of one product differ (logarithms)."""
ALIKE = 11.829
"""Square of a difference over its covariance: of one product in 3 standard deviations, chi-squared of two (99.7 %)."""
FLOOR_MM, LACKING = 0.01, 0.25
"""Standard deviation that no reading is below, and how far what a drawing lacks may move it, part of a voxel along each
axis: it is no noise, which a mean would lessen."""


class Shape(NamedTuple):
    """A marker's shape: thickness and normal (3,), unit, of a disc or ring; of a ball they say nothing."""

    kind: Kind
    diameter_mm: float
    thick_mm: float
    normal: Floats

    def half_mm(self, along: Floats) -> float:
        """How far it reaches from its centre in a direction (3,), unit."""
        if self.kind == "ball":
            return self.diameter_mm / 2
        cos = float(np.clip(abs(self.normal @ along), 0.0, 1.0))
        return self.thick_mm / 2 * cos + self.diameter_mm / 2 * float(np.sqrt(1 - cos**2))


@dataclass(frozen=True, eq=False)
class Reading:
    """One dense thing, read as a marker."""

    centre_ct: Floats  # shape (3,), LPS mm
    cov_ct: Floats  # shape (3, 3), mm²
    shape: Shape
    contrast_hu: float  # its greatest value above soft tissue's; of clipped metal at least so much
    clipped: bool  # whether the image's range clips it
    misfit: float
    """Root mean square of what its drawing lacks beyond noise, over that of its contrast."""
    make: Floats  # logarithms of density (HU) and diameter (mm), shape (2,)
    cov_make: Floats  # of these, shape (2, 2)
    others: tuple[Kind, ...] = ()  # kinds whose drawing is about as near

    def alike(self, other: Reading) -> bool:
        """Whether both may be of one product: of one kind, and as large and dense as their readings tell."""
        off, cov = self.make - other.make, self.cov_make + other.cov_make + 2 * MADE
        return bool({self.shape.kind, *self.others} & {other.shape.kind, *other.others}) and bool(
            off @ np.linalg.solve(cov, off) < ALIKE
        )

    def of_size(self, diameter_mm: float) -> bool:
        """Whether it may be as wide as a person states."""
        return bool((self.make[1] - np.log(diameter_mm)) ** 2 < ALIKE * (self.cov_make[1, 1] + STATED**2))


class Box(NamedTuple):
    """What surrounds one thing."""

    volume: Volume  # the voxels of the box, as an image of its own, float64
    peak: Ints  # shape (3,), index of its densest voxel
    ceiling_hu: float  # where the whole image clips; infinite where it does not
    noise_hu: float
    cut: bool  # whether the image ends at the thing


@dataclass(frozen=True, eq=False)
class Middle:
    """A thing's weighted middle."""

    box: Box
    voxels: Bools
    centre_ct: Floats  # shape (3,), LPS mm
    spread: Floats  # shape (3, 3), mm², second moment about it
    peak_hu: float
    solid_hu: float  # of what it is made
    clear: Bools  # of the box: which voxels it does not reach

    @property
    def near(self) -> Bools:
        """Of the box: the voxels that it fills or blurs into."""
        return np.asarray(ndimage.binary_dilation(self.voxels, np.ones((3, 3, 3)), iterations=2))

    def background(self, normal: Floats) -> Floats:
        """What the voxels near it would show without, shape (n,), HU, by others as deep in a skin of that normal."""
        A = self.box.volume.T_ct_index[:3, :3]
        along = DEEP * float(np.linalg.norm(A.T @ normal))
        metric = np.eye(3) / ASIDE_MM + (1 / along - 1 / ASIDE_MM) * np.outer(normal, normal)
        others = np.argwhere(self.clear)
        others = others[:: 1 + len(others) // MOST_OTHERS]
        squares = cdist(np.argwhere(self.near) @ A.T @ metric, others @ A.T @ metric, "sqeuclidean")
        weights = np.exp((squares.min(axis=1, keepdims=True) - squares) / 2)
        return np.asarray(weights @ self.box.volume.values[tuple(others.T)] / weights.sum(axis=1))

    @property
    def clipped(self) -> bool:
        """Whether the image's range clips it."""
        return self.peak_hu >= CLIPPED * self.box.ceiling_hu

    @property
    def roundness(self) -> float:
        """Middle over greatest variance of its axes, 0 to 1; what slices cannot resolve counts as round."""
        axes = np.linalg.eigvalsh(self.spread)
        slack = float(np.max(spacing_mm(self.box.volume))) ** 2 / 12
        return float((axes[1] + slack) / (axes[2] + slack))

    @property
    def outward(self) -> Floats:
        """The direction in which what it lies in falls off to air, shape (3,), unit; in air alone where it is thin."""
        points = np.argwhere(self.clear) @ self.box.volume.T_ct_index[:3, :3].T
        values = self.box.volume.values[self.clear]
        if np.ptp(values) < -AIR_HU / 2:
            return np.asarray(np.linalg.eigh(self.spread - _blur(self.box.volume))[1][:, 0])
        slope = np.linalg.lstsq(points - points.mean(axis=0), values.mean() - values)[0]
        return np.asarray(slope / np.linalg.norm(slope))

    @property
    def _variances(self) -> Floats:
        """Along its axes, least first, without blur, shape (3,), mm²."""
        return np.asarray(np.maximum(np.linalg.eigvalsh(self.spread - _blur(self.box.volume)), 0.0))

    @property
    def wide_mm(self) -> float:
        """About its diameter."""
        return float(np.clip(4 * np.sqrt(self._variances[1:].mean()), LEAST_MM, 1.3 * LARGEST_MM))

    @property
    def across_mm(self) -> float:
        """About how wide it is across its longest axis."""
        return 4 * float(np.sqrt(self._variances[1]))


def find_middle(box: Box) -> Middle | None:
    """The middle of what holds together with the densest voxel at half of its contrast; None of what goes on."""
    volume, spacing = box.volume, spacing_mm(box.volume)
    contrast = float(volume.values[tuple(box.peak)]) - TISSUE_HU
    level = TISSUE_HU + contrast / 2
    mask = _joined(volume.values > level, box.peak)
    wider = _joined(volume.values > TISSUE_HU + GROWN * contrast, box.peak)
    if mask is None or wider is None:
        return None
    sides, more = (np.ptp(np.argwhere(one), axis=0) + 1 for one in (mask, wider))
    if np.any((more - sides) * spacing > 2 * (BLUR_MM + spacing)):  # a wire, which noise has cut at the higher level
        return None
    peak = float(np.percentile(volume.values[mask], 90))
    solid = SOLID_HU if peak > CLIPPED * box.ceiling_hu or (sides * spacing).max() < 2 * spacing.max() else peak
    whole = (slice(0, mask.shape[0]), slice(0, mask.shape[1]), slice(0, mask.shape[2]))
    metal = Metal(whole, mask, np.zeros(3), float((sides * spacing).max()))
    full = min(1.0, box.ceiling_hu / solid)
    reach = np.maximum(BLUR_MM, TOUCHED * spacing)
    parts = np.minimum(metal_parts(volume, metal, level_hu=level, solid_hu=solid, reach_mm=reach), full)
    if not parts.any():
        return None
    centre = centroid(parts, whole, volume.T_ct_index)
    points = np.argwhere(parts > 0) @ volume.T_ct_index[:3, :3].T + volume.T_ct_index[:3, 3] - centre
    heavy = parts[parts > 0]
    spread = (points * heavy[:, None]).T @ points / heavy.sum()
    return Middle(box, mask, centre, spread, peak, solid, clear_of_metal(volume, metal, level, reach))


def _joined(mask: Bools, at: Ints) -> Bools | None:
    """The part of a mask that holds a voxel; None where it reaches the box's faces."""
    labels, _ = ndimage.label(mask, structure=np.ones((3, 3, 3)))
    mine = np.asarray(labels == labels[tuple(at)])
    inner = mine[1:-1, 1:-1, 1:-1]
    return mine if labels[tuple(at)] and np.count_nonzero(inner) == np.count_nonzero(mine) else None


def _blur(volume: Volume) -> Floats:
    """Covariance of what blurs an image, shape (3, 3), mm²."""
    spacing = spacing_mm(volume)
    axes = volume.T_ct_index[:3, :3] / spacing
    return np.asarray(axes @ np.diag(spacing**2 / 12 + [BLUR_SIGMA_MM**2, BLUR_SIGMA_MM**2, 0.0]) @ axes.T)


def read_marker(
    middle: Middle, normal: Floats, kinds: tuple[Kind, ...] = get_args(Kind), diameter_mm: float | None = None
) -> Reading:
    """Read a thing as a marker of the kind that is nearest to it; where others are as near, their centres count too.

    A disc or ring lies about as the skin does, whose normal (3,) is a unit vector; ``diameter_mm`` as a person states
    it.
    """
    unresolved = middle.wide_mm < UNRESOLVED * float(spacing_mm(middle.box.volume).min())
    every, background = list[tuple[float, Reading]](), middle.background(normal)
    for kind in kinds[:1] if unresolved else kinds:
        lacks, reading = _fitted(_Drawing.of(middle, kind, normal, diameter_mm, background))
        every.append((lacks * PLAIN[kind], reading))
        if lacks < SURE:
            break
    least, best = min(every, key=lambda one: one[0])
    near = [one for lacks, one in every if lacks < AS_NEAR * least]
    off = np.array([one.centre_ct - best.centre_ct for one in near])
    others = kinds if unresolved else tuple(one.shape.kind for one in near if one is not best)
    return replace(best, cov_ct=best.cov_ct + off.T @ off / len(off), others=others)


def _fitted(drawing: _Drawing) -> tuple[float, Reading]:
    """The marker of a kind whose drawing is nearest to the image, and what that lacks of it, noise too."""
    middle, start, known = drawing.middle, drawing.start, drawing.known
    noise = middle.box.noise_hu

    def linearised(p: Floats) -> System[Floats]:
        image = drawing.image(p)
        sd = max(noise, float(np.sqrt(np.mean((drawing.seen - image) ** 2))))
        slopes = [(drawing.image(p + step) - image) / step.sum() for step in np.diag(STEPS[: len(start)])]

        def residuals(q: Floats, image: Floats) -> Floats:
            return np.concatenate([(image - drawing.seen) / sd, (q - start) / known])

        def cost(q: Floats) -> float:
            return float(np.sum(residuals(q, drawing.image(q)) ** 2))

        return System(residuals(p, image), np.vstack([np.column_stack(slopes) / sd, np.diag(1 / known)]), cost)

    fit = gauss_newton(start, linearised, np.add, lambda _, step: bool(np.abs(step[:3]).max() < SETTLED_MM), ROUNDS)
    p = fit.estimate
    lacks, contrast = float(np.mean((drawing.seen - drawing.image(p)) ** 2)), drawing.contrast_hu
    misfit, shape = float(np.sqrt(max(lacks - noise**2, 0.0))) / contrast, drawing.shape(p)
    cov, edge = np.linalg.inv(fit.system.information), 2 * LACKING * misfit * min(spacing_mm(middle.box.volume))
    return np.sqrt(lacks) / contrast, Reading(
        middle.centre_ct + p[:3],
        cov[:3, :3] + drawing.unknown(p, misfit),
        shape,
        middle.peak_hu - TISSUE_HU,
        middle.clipped,
        misfit,
        p[3:5],
        cov[3:5, 3:5] + np.diag([misfit, edge / shape.diameter_mm]) ** 2,
    )


@dataclass(frozen=True, eq=False)
class _Drawing:
    """A marker drawn into what lies about it.

    Its unknowns are the shift (3), logarithms of density (HU) and size, the blur; of a disc or ring the logarithm of
    its thickness and two tilts too.
    """

    middle: Middle
    kind: Kind
    normal: Floats
    start: Floats  # shape (p,), of the unknowns
    known: Floats  # shape (p,), how well each is known beforehand, standard deviations
    near: Bools  # shape of the box: the voxels that are compared
    background: Floats  # of them, shape (n,), HU

    @classmethod
    def of(cls, middle: Middle, kind: Kind, normal: Floats, diameter_mm: float | None, background: Floats) -> _Drawing:
        size = diameter_mm or (np.sqrt(1.25) if kind == "ball" else 1.0) * middle.wide_mm
        start = np.concatenate([np.zeros(3), np.log([middle.solid_hu, size]), [BLUR_SIGMA_MM, np.log(THICK_MM), 0, 0]])
        of_size = SIZE if diameter_mm is None else STATED
        shift = SHIFT * spacing_mm(middle.box.volume)
        known = np.array([*shift, DENSITY, of_size, BLUR_KNOWN, THICK, TILT, TILT])
        count = 6 if kind == "ball" else 9
        return cls(middle, kind, normal, start[:count], known[:count], middle.near, background)

    @property
    def seen(self) -> Floats:
        """Of the image, HU, shape (n,)."""
        return self.middle.box.volume.values[self.near]

    @property
    def contrast_hu(self) -> float:
        """Root mean square of what is seen above what lies about it."""
        return float(np.sqrt(np.mean((self.seen - self.background).clip(0.0) ** 2)))

    def shape(self, p: Floats) -> Shape:
        """The marker of unknowns (p,)."""
        if self.kind == "ball":
            return Shape(self.kind, float(np.exp(p[4])), THICK_MM, self.normal)
        tilt = exp_rotation(frame_about(self.normal) @ np.array([p[7], p[8], 0.0]))
        return Shape(self.kind, float(np.exp(p[4])), float(np.exp(p[6])), tilt @ self.normal)

    def image(self, p: Floats) -> Floats:
        """As a scanner shows it, shape (n,), HU."""
        box = self.middle.box
        part = filled(box.volume, self.shape(p), self.middle.centre_ct + p[:3])
        sigma = abs(p[5]) / spacing_mm(box.volume)[:2]
        part = ndimage.gaussian_filter(part, [*sigma, 0.0], mode="nearest")[self.near]
        return np.minimum(self.background + part * (float(np.exp(p[3])) - self.background), box.ceiling_hu)

    def unknown(self, p: Floats, misfit: float) -> Floats:
        """What no drawing knows of a centre, shape (3, 3), mm²: in a voxel that is wider, and at the skin's edge."""
        spacing = spacing_mm(self.middle.box.volume)
        axes = self.middle.box.volume.T_ct_index[:3, :3] / spacing
        free = np.maximum(0.0, spacing**2 - self.shape(p).diameter_mm ** 2) / 12
        along = FLOOR_MM**2 + (LACKING * misfit * spacing) ** 2 + free
        edge = SKIN_EDGE_MM * min(1.0, 1000.0 / float(np.exp(p[3])))
        return np.asarray(axes @ np.diag(along) @ axes.T + edge**2 * np.outer(self.normal, self.normal))


def filled(volume: Volume, shape: Shape, centre_ct: Floats) -> Floats:
    """Part of each voxel that a marker fills; of a voxel that its surface may pass, by cells of `FINE_MM`."""
    spacing = spacing_mm(volume)
    counts = np.clip(np.ceil(spacing / FINE_MM), 2, MOST_FINE).astype(np.int64)
    T = np.array(volume.T_ct_index[:3])
    T[:, 3] -= centre_ct
    part = np.zeros(volume.values.shape)
    half = np.array([shape.diameter_mm, shape.thick_mm, HOLE * shape.diameter_mm]) / 2
    kind = {"ball": 0, "disc": 1, "ring": 2}[shape.kind]
    _fill(T, counts, float(np.linalg.norm(spacing)) / 2, kind, half, np.array(shape.normal), part)
    return part


@nb.njit(cache=True, error_model="numpy")
def _fill(T, counts, reach, kind, half, normal, part):  # type: ignore[no-untyped-def]  # numba infers
    """Set the part (ni, nj, nk) of each voxel: that of cells, each as a plane at the surface's distance would fill it.

    T (3, 4) maps an index to mm from the marker's centre; ``reach`` is half of a voxel's diagonal, mm; ``half`` (3,)
    are the half diameter, thickness and diameter of the hole, mm.
    """
    cell = 2.0 * reach / np.sqrt(float(counts[0] ** 2 + counts[1] ** 2 + counts[2] ** 2))
    for i in range(part.shape[0]):
        for j in range(part.shape[1]):
            for k in range(part.shape[2]):
                beyond = _beyond(T, float(i), float(j), float(k), kind, half, normal)
                if beyond >= reach + cell:
                    continue
                if beyond <= -reach - cell:
                    part[i, j, k] = 1.0
                    continue
                total = 0.0
                for a in range(counts[0]):
                    x = i + (a + 0.5) / counts[0] - 0.5
                    for b in range(counts[1]):
                        y = j + (b + 0.5) / counts[1] - 0.5
                        for c in range(counts[2]):
                            z = k + (c + 0.5) / counts[2] - 0.5
                            off = _beyond(T, x, y, z, kind, half, normal)
                            total += min(max(0.5 - off / cell, 0.0), 1.0)
                part[i, j, k] = total / (counts[0] * counts[1] * counts[2])


@nb.njit(cache=True, error_model="numpy")
def _beyond(T, i, j, k, kind, half, normal):  # type: ignore[no-untyped-def]
    """How far a place lies beyond a marker's surface, mm; negative inside."""
    square, along = 0.0, 0.0
    for axis in range(3):
        at = T[axis, 0] * i + T[axis, 1] * j + T[axis, 2] * k + T[axis, 3]
        square += at * at
        along += at * normal[axis]
    if kind == 0:
        return np.sqrt(square) - half[0]
    across = np.sqrt(max(square - along * along, 0.0))
    off = max(across - half[0], abs(along) - half[1])
    return max(off, half[2] - across) if kind == 2 else off
