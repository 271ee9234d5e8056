"""Do the structures belong to the image? The edge test for every file or folder that structures come from.

Each source (a label map, a folder of masks, a DICOM object, all meshes together) is tested by itself, with the skin
where that does not come from the CT. What is said:

- another place lies better on the CT's edges beyond chance (z >= `REFUSING_Z`): refused, and named where it is a peak;
- it may lie better (z >= `WARNING_Z`): a warning;
- the place as it is lies better than every other one: nothing but a note with the numbers;
- else the edges cannot tell, which is said with what they cannot exclude;
- one structure lies better shifted by itself, on stronger edges, and what is within it is more even there: a warning;
- it may: a note names those whose outline the CT does not confirm.

An organ is even within. So the second evidence is how much the Hounsfield units just below a surface differ: a better
edge that another organ has, around what is not even, is no other place.

A refused case may state ``[search] trust_labels = true``: its owner has looked, and the finding is a warning.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.scan import Scan
from puncture_twin.planning.anatomy.structure import label_grids
from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.base.cache.entry_file import Arrays
from puncture_twin.planning.base.errors import Finding, Severity
from puncture_twin.planning.base.text import first_few
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.evidence import edges
from puncture_twin.planning.geometry.mesh import TriangleMesh, box_of
from puncture_twin.planning.geometry.rigid import apply, log_rotation
from puncture_twin.planning.geometry.spaces import Space

REFUSING_Z, WARNING_Z = 6.0, 3.0
"""z of true placements stays below the first, also of one structure alone, and of six and more below the second: the
table of `python -m benchmarks.placements`."""
LEAST_SLIP = {"shift": 0.9, "turn": 0.9, "axes": 0.9, "grid": 0.9, "unit": 0.9, "scale": 1.25}
"""In shifts of the least that counts, by kind of placement: what moves the surfaces by less is never refused. A rib
cage by itself lies better on the edge of the lungs, 4 % smaller: .96."""
LEAST_SCALE_RATIO = 1.3
"""Edges so many times as strong refuse a scale: 5 % off has 1.5 to 2. What ends at one depth below the skin lies better
on the skin, scaled, by 1.22, however well it lies on weaker edges of its own."""
STRUCTURES = ((2.5, 1.2, 1.0), (1.5, 1.2, 0.5))
AGREEING = (4.0, 1.5, 1.0)
"""z, ratio of edges and of unevenness: one structure of a source that fits is named where it lies so much better
elsewhere by itself (either), and several are refused that do so at one place. Of 512 true ones, in noise, cropped, on
thick slices and blurred, none does; of those that are 15 mm off half do."""
UNCONFIRMED = ((0.5, 0.0, 1.3), (1.4, 0.0, 3.5))
"""Of a structure that does so by no more than this (either) the CT does not confirm where it lies: 95 of 100 that are
15 mm off, and 1 in 5 of true ones."""
INSIDE_MM, LEAST_HU = 3.0, 3.0
"""So deep below a surface lies what must be even within it; what deviates less than noise alone is even."""
UNITS, LEAST_EXTENT_MM = (0.001, 0.1, 10.0, 1000.0), 50.0
"""Meshes in m or cm taken for mm, and the other way round; what becomes smaller than this lies on any one edge."""
LEAST_SCALE, LEAST_TURN = 0.015, np.radians(1.5)
"""What a refined place may be off is not said."""

KINDS = {
    "shift": "a shift",
    "turn": "a rotation",
    "scale": "another scale",
    "axes": "a mirror image or a rotation of it",
    "unit": "another unit",
    "grid": "the CT's own grid",
}

AS_IT_IS = edges.Placement("shift", np.eye(4))
OTHER_SPACE = np.diag([-1.0, -1.0, 1.0, 1.0])
"""LPS as RAS."""
CODE = "labels_beside_image"
ALLOWED = (
    "structures where the CT shows them; or init --trust-labels, or [search] trust_labels = true, if you compared "
    "both and they agree"
)


@dataclass(frozen=True, eq=False)
class Source:
    """Structures that were written together, and lie right or wrong together."""

    name: str
    meshes: dict[str, TriangleMesh]
    axes: Floats  # shape (3, 3), unit columns: of its grid, or of the patient
    middles: tuple[Floats, Floats]
    """Places (3,) about which it may be mirrored or turned: of its grid or the image the middle; the origin."""
    first: Floats  # shape (3,), the first voxel of its grid, about which it may be scaled too
    voxel_mm: Floats  # shape (3,), of the coarser of its voxels and the image's along each of its axes
    in_units: bool = False
    grid_slip: Floats | None = None
    """Where the CT has its matrix on another grid: the map (4, 4) to that; else None."""

    def placements(self) -> list[edges.Placement]:
        """Every other place that is tried."""
        middles = self.middles[: 1 if np.allclose(*self.middles, atol=edges.LEAST_SHIFT_MM) else 2]
        low, high = box_of(np.concatenate([mesh.bounds for mesh in self.meshes.values()]))
        across = np.abs(self.axes.T) @ (high - low)
        placements = [
            *edges.shifts(self.axes, self.voxel_mm, across / 3.0),
            *edges.turns((low + high) / 2.0, self.axes),
            *edges.scalings([middles[0], self.first]),
            *edges.axis_slips(middles, self.axes),
        ]
        if self.in_units:
            units = edges.scalings([np.zeros(3)], UNITS, "unit")
            placements += [one for one in units if one.T[0, 0] * across.max() > LEAST_EXTENT_MM]
        if self.grid_slip is not None:
            placements.append(edges.Placement("grid", self.grid_slip))
        return placements


class Assessed(NamedTuple):
    """Result of the edge test for one source."""

    z: float
    """The largest over all placements that were tried; -inf where the image shows none of the surfaces."""
    ratio: float  # of the edge strength there to that as it is
    kind: str
    slip: float  # how far it is, rms over the surfaces, in shifts of the least that counts
    T: Floats | None  # shape (4, 4), LPS mm: the refined place where one is named, else None
    middle_ct: Floats  # shape (3,), of the surfaces as they are
    open: tuple[str, ...]  # the kinds of placements that are not excluded
    odd: tuple[str, ...]  # structures that lie better shifted by themselves
    agreeing: tuple[str, ...]
    """Structures of which two or more lie better at one place, whatever it is."""
    unconfirmed: tuple[str, ...]  # structures that may lie better shifted by themselves
    unseen: tuple[str, ...]  # structures of which the image shows less than half
    uneven: float
    """Of the best placement to as it is, over all structures: what is above 1 is no place of organs."""

    @property
    def doubtful(self) -> bool:
        """Whether they may lie elsewhere."""
        return self.refuses or (self.z >= WARNING_Z and not self.uneven > 1.0)

    @property
    def refuses(self) -> bool:
        """Whether they lie elsewhere beyond doubt, and far: sooner on the CT's own grid, whose matrix they have."""
        sure = self.z >= (WARNING_Z if self.kind == "grid" else REFUSING_Z)
        strong = self.kind != "scale" or self.ratio >= LEAST_SCALE_RATIO
        return sure and strong and self.slip >= LEAST_SLIP[self.kind]


def assess(image: edges.EdgeImage, source: Source) -> Assessed:
    """Hold the surfaces of one source against the edges of the CT.

    What elsewhere has to beat is the best place so near that it is no slip: half a voxel by which labels are off, or a
    smoothed surface, must not let the mirror image of a symmetric body win.
    """
    sample = edges.sample_surfaces(list(source.meshes.values()))
    compared = edges.compare(image, sample, source.placements())
    ahead = compared.best
    if ahead.z > -WARNING_Z:  # a row of single steps may leave out what lies between them
        ahead = _ahead(image, sample, source, compared.best)
    named = ahead.z >= WARNING_Z and ahead.placement.kind == "grid"
    if not named and ahead.z >= REFUSING_Z:  # a place can be named where it is a peak: every shift from there is worse
        shifts = list(edges.shifts(source.axes, source.voxel_mm))
        named = edges.compare(image, sample.moved(ahead.placement.T), shifts).best.z <= -WARNING_Z
    outward = np.copysign(1.0, [mesh.volume for mesh in source.meshes.values()])
    inner = sample.points_ct - INSIDE_MM * sample.normals_ct * outward[sample.structure, None]
    as_is = _unevenness(image, inner, sample.structure, np.eye(4))
    alone = Alone(tuple(source.meshes), compared, _alone(image, inner, sample.structure, compared.fits, as_is))
    seen = np.bincount(sample.structure, np.isfinite(image.hu_at(sample.points_ct))) / np.bincount(sample.structure)
    ahead_uneven = _unevenness(image, inner, sample.structure, ahead.placement.T)
    both = np.isfinite(ahead_uneven + as_is)
    left = [ahead.placement.kind] if ahead.z >= WARNING_Z else []
    left += [fit.placement.kind for fit in compared.fits if not _excluded(fit)]
    return Assessed(
        z=ahead.z,
        ratio=ahead.ratio,
        kind=ahead.placement.kind,
        slip=_slip(sample, ahead.placement.T, source),
        T=ahead.placement.T if named else None,
        middle_ct=sample.middle_ct,
        open=tuple(dict.fromkeys(left)),
        odd=alone.anywhere(STRUCTURES),
        agreeing=alone.agreeing,
        unconfirmed=alone.anywhere(UNCONFIRMED),
        unseen=alone.names_of(seen < edges.LEAST_SEEN),
        uneven=float(ahead_uneven[both].sum() / as_is[both].sum()) if both.any() else 1.0,
    )


def _ahead(image: edges.EdgeImage, sample: edges.Sample, source: Source, best: edges.Fit) -> edges.Fit:
    """The place at which the surfaces lie best, near a better one or near where they are, against what is no slip."""
    near = edges.refined(image, sample, AS_IT_IS, most_mm=edges.LEAST_SHIFT_MM / 2.0).T
    as_is, fits = edges.settled(image, sample.moved(near)), [best]
    if best.z >= WARNING_Z:
        place = best.placement if best.placement.kind == "grid" else edges.refined(image, sample, best.placement)
        fits = [edges.fit_of(place, sample, as_is, edges.settled(image, sample.moved(place.T)))]
        if place.kind == "grid" and fits[0].z >= WARNING_Z:
            return fits[0]
    place = edges.refined(image, sample, AS_IT_IS)
    if _slip(sample, place.T, source) >= LEAST_SLIP[place.kind]:
        fits.append(edges.fit_of(place, sample, as_is, edges.settled(image, sample.moved(place.T))))
    return max(fits, key=lambda fit: fit.z)


def _slip(sample: edges.Sample, T: Floats, source: Source) -> float:
    """How far a map (4, 4) moves the surfaces, rms, each axis in its least shift that counts."""
    moved = (apply(T, sample.points_ct) - sample.points_ct) @ source.axes / edges.least_shift_mm(source.voxel_mm)
    return float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))


def _excluded(fit: edges.Fit) -> bool:
    """Whether the surfaces do not belong there. Out of the image nothing belongs, but a shift may be the image's."""
    return fit.z <= -WARNING_Z and (fit.z > -np.inf or fit.placement.kind != "shift")


class Alone(NamedTuple):
    """How each structure by itself takes other places.

    ``uneven`` there to that as it is: shape (placements, structures), NaN where nobody asks, or sees it.
    """

    names: tuple[str, ...]
    compared: edges.Compared
    uneven: Floats

    def better(self, z: float, ratio: float, uneven: float) -> Bools:
        """Which structures lie so much better at which place by themselves, shape (placements, structures)."""
        on_edges = (self.compared.own_z >= z) & (self.compared.own_ratio >= ratio)
        return np.asarray(on_edges & (self.uneven < uneven))

    def names_of(self, rows: Bools) -> tuple[str, ...]:
        """Names of some structures, by a mask (n,)."""
        return tuple(name for name, one in zip(self.names, rows, strict=True) if one)

    def anywhere(self, limits: Sequence[tuple[float, float, float]]) -> tuple[str, ...]:
        """Structures that lie so much better somewhere by themselves, by any of the limits."""
        return self.names_of(np.any([self.better(*least).any(axis=0) for least in limits], axis=0))

    @property
    def agreeing(self) -> tuple[str, ...]:
        """The structures that lie better at the place that most of them prefer; empty where no two agree."""
        better = self.better(*AGREEING)
        most = better[better.sum(axis=1).argmax()]
        return self.names_of(most) if most.sum() >= 2 else ()


def _alone(
    image: edges.EdgeImage, inner_ct: Floats, structure: NDArray[np.intp], fits: Sequence[edges.Fit], as_is: Floats
) -> Floats:
    """Unevenness at each place to that as it is, shape (placements, structures).

    Only shifted or in the other space: of all mirror images and turns some has stronger edges than an organ that is as
    dense as what is around it, or than a lung that is full.
    """
    elsewhere = np.full((len(fits), len(as_is)), np.nan)
    for row, (kind, T) in enumerate(fit.placement for fit in fits):
        if kind == "shift" or (T == OTHER_SPACE).all():
            elsewhere[row] = _unevenness(image, inner_ct, structure, T)
    return elsewhere / as_is


def _unevenness(image: edges.EdgeImage, inner_ct: Floats, structure: NDArray[np.intp], T: Floats) -> Floats:
    """Of each structure, placed by T (4, 4): the mean deviation of HU at its inner points (n, 3); NaN where unseen."""
    deviations = []
    for one in np.split(image.hu_at(apply(T, inner_ct)), np.flatnonzero(np.diff(structure)) + 1):
        hu = one[np.isfinite(one)]
        deviations.append(np.abs(hu - np.median(hu)).mean() if len(hu) > edges.LEAST_SEEN * len(one) else np.nan)
    return np.maximum(deviations, LEAST_HU)


def label_placement(case: Case, anatomy: Anatomy) -> Iterator[Finding]:
    """Whether the structures of each source, and the skin, lie on the edges of the case's CT."""
    scan = anatomy.scan
    if scan is None or case.space is Space.LOCAL:
        return
    image = cache(lambda: edges.edge_image(*scan.voxels))
    for source in sources(case, anatomy, scan):
        given = (source.axes, *source.middles, source.first, source.voxel_mm, source.in_units, source.grid_slip)
        made_from = {
            "what": "edges",
            "meshes": [f"{name} {mesh.digest}" for name, mesh in source.meshes.items()],
            "placed_by": [np.asarray(one).tolist() for one in given],
        }

        def make(source: Source = source) -> Arrays:
            assessed = assess(image(), source)
            T, middle = None if assessed.T is None else assessed.T.tolist(), assessed.middle_ct.tolist()
            return {"json": np.array(json.dumps(assessed._asdict() | {"T": T, "middle_ct": middle}))}

        yield from _findings(case, scan, source, scan.source.kept(made_from, make, _read, by=__name__))


def sources(case: Case, anatomy: Anatomy, scan: Scan) -> Iterator[Source]:
    """The structures of a case by what they were written in; none that the CT itself or the case adds."""
    ct = scan.source.surfaces.source.grid
    middle, origin = apply(ct.T_ct_index, (np.array(ct.shape)[None] - 1) / 2)[0], np.zeros(3)
    rest = [(one.name, one.mesh, one.source.rpartition(":")[0] or one.source) for one in anatomy.structures]
    if scan.skin is not None:
        rest.append(("skin", scan.skin.mesh, str(case.skin_section.mesh or case.skin_section.labelmap)))
    for grid in label_grids(case):
        own = {name: mesh for name, mesh, file in rest if file in grid.files}
        if not own:
            continue
        T, shape = grid.voxels.T_ct_index, np.array(grid.voxels.shape)
        axes = T[:3, :3] / np.linalg.norm(T[:3, :3], axis=0)
        voxel = np.maximum(grid.voxels.spacing_mm, _along(axes, ct.T_ct_index))
        middles = (apply(T, (shape[None] - 1) / 2)[0], origin)
        slip = ct.T_ct_index @ np.linalg.inv(T)
        lost = tuple(shape) == tuple(ct.shape) and not np.allclose(slip, np.eye(4), atol=1e-3)
        yield Source(grid.name, own, axes, middles, T[:3, 3], voxel, grid_slip=slip if lost else None)
    files = {section.mesh for section in case.structure if section.mesh is not None}
    meshes = {name: mesh for name, mesh, file in rest if file in files}
    if meshes:
        voxel = _along(np.eye(3), ct.T_ct_index)
        yield Source("the meshes", meshes, np.eye(3), (middle, origin), origin, voxel, in_units=True)


def _along(axes: Floats, T_ct_index: Floats) -> Floats:
    """The size of a grid's voxel along each of some axes (unit columns), mm, shape (3,)."""
    return np.asarray(np.abs(axes.T @ T_ct_index[:3, :3]).max(axis=1))


def _findings(case: Case, scan: Scan, source: Source, assessed: Assessed) -> Iterator[Finding]:
    count = len(source.meshes)
    numbers: dict[str, Any] = {"source": source.name, "structures": float(count)}
    numbers |= {"z": round(assessed.z, 2)} if np.isfinite(assessed.z) else {}
    source_text = (
        f"{source.name} ({count} structures)" if count > 1 else f"{source.name} ('{next(iter(source.meshes))}')"
    )
    if assessed.doubtful:
        slip = None if assessed.T is None else slip_of(assessed.T, assessed.middle_ct)
        place = "elsewhere" if slip is None else slip.text(own_grid=assessed.kind == "grid")
        sure = "is not" if assessed.refuses else "may not be"
        said = (
            f"{source_text} {sure} where {scan.name} shows it: it fits the edges better {place} (z {assessed.z:.1f}, "
            f"edges {assessed.ratio:.2f} times as strong)"
        )
        severity = Severity.REFUSAL if assessed.refuses and not case.ct.trust_labels else Severity.WARNING
        yield Finding(CODE, severity, said, numbers | ({} if slip is None else slip.numbers()), ALLOWED)
    odd = assessed.agreeing or assessed.odd
    if odd and not assessed.refuses:
        names, alike = ", ".join(odd), "at one and the same other place" if assessed.agreeing else "elsewhere"
        said = f"{source.name}: {names} would fit the edges of {scan.name} better {alike}: are they in the right place?"
        severity = Severity.REFUSAL if assessed.agreeing and not case.ct.trust_labels else Severity.WARNING
        yield Finding("structure_beside_image", severity, said, numbers | {"names": names}, ALLOWED)
    faint = [name for name in assessed.unconfirmed if name not in {*assessed.odd, *assessed.agreeing, *assessed.unseen}]
    unsure = [*faint, *assessed.unseen]
    if count > 1 and not assessed.refuses and unsure:  # of which the image does not show where they lie
        parts = {"no clear edge": faint, "not in the image": [*assessed.unseen]}
        why = "".join(f"; {what}: {first_few(some)}" for what, some in parts.items() if some)
        said = f"{source.name}: {scan.name} does not confirm the outline of {len(unsure)} of {count} structures"
        yield Finding("outline_unconfirmed", Severity.NOTE, said + why, numbers | {"names": ", ".join(unsure)})
    if assessed.doubtful:
        return
    if assessed.open:
        said = (
            f"{source_text}: the edges of {scan.name} cannot distinguish its place from "
            f"{', '.join(KINDS[one] for one in assessed.open)}"
        )
        severity = Severity.WARNING if "shift" in assessed.open else Severity.NOTE
        yield Finding("edges_cannot_tell", severity, said, numbers)
    else:
        said = f"{source_text} as a whole fits the edges of {scan.name}, and fits worse at every other place tried"
        yield Finding("labels_on_edges", Severity.NOTE, said, numbers)


class Slip(NamedTuple):
    """A placement in words and numbers.

    The shift (3,) of the surfaces' middle, LPS, the scale, axes that are exchanged or negated, in words, and by how
    much it is turned besides, rad.
    """

    shift_mm: Floats  # shape (3,), LPS: of the middle of the surfaces
    scale: float
    axes: str
    turn: float

    def text(self, *, own_grid: bool) -> str:
        """After "it lies better"."""
        parts = [self.axes] if self.axes else []
        parts += [f"scaled by {self.scale:.3g}"] if abs(self.scale - 1) > LEAST_SCALE else []
        parts += [f"rotated by {np.degrees(self.turn):.0f} degrees"] if self.turn > LEAST_TURN else []
        parts.append(f"moved by ({', '.join(f'{one:.1f}' for one in self.shift_mm)}) mm LPS")
        return ("on the CT's own grid, whose matrix it has: " if own_grid else "") + " and ".join(parts)

    def numbers(self) -> dict[str, Any]:
        """For a program."""
        shift = [round(float(one), 2) for one in self.shift_mm]
        return {"shift_mm": shift, "scale": round(self.scale, 4), "turn_deg": round(float(np.degrees(self.turn)), 2)}


def slip_of(T: Floats, middle_ct: Floats) -> Slip:
    """Shift, rotation and scale of a placement (4, 4) about a point (3,), LPS mm."""
    linear, exchanged = T[:3, :3], np.zeros((3, 3))
    scale = float(np.cbrt(abs(np.linalg.det(linear))))
    order = np.abs(linear).argmax(axis=0)
    exchanged[order, range(3)] = signs = np.sign(linear[order, range(3)])
    axes = edges.axes_text(order.tolist(), signs.tolist())
    turn = float(np.linalg.norm(log_rotation(linear / scale @ exchanged.T)))
    return Slip(apply(T, middle_ct[None])[0] - middle_ct, scale, axes, turn)


TUPLES = ("open", "odd", "agreeing", "unconfirmed", "unseen")


def _read(stored: Arrays) -> Assessed:
    plain = json.loads(str(stored["json"]))
    arrays = {name: None if plain[name] is None else np.array(plain[name], np.float64) for name in ("T", "middle_ct")}
    return Assessed(**plain | arrays | {name: tuple(plain[name]) for name in TUPLES})
