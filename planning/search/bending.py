"""The needle that bends: which directions it makes unsafe, and what one insertion does to needle and arm.

The shaft is nowhere farther from its straight axis than the bound of its path's length (`DeflectionBound`), so a
clearance of margin and bound is enough whatever side the bevel points to: `with_bending` rejects what has less.
`insertion_along` follows one path through its tissues (`path_layers`), `stretches` through the CT.
"""

from dataclasses import replace
from itertools import groupby
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.structure import Structure
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.formats.labels.naming import REST
from puncture_twin.planning.geometry.containment import contains, crossings
from puncture_twin.planning.needle.deflection import (
    Bending,
    BevelPath,
    DeflectionBound,
    Layer,
    bevel_path,
    shortest_bend,
    step_for,
    stiffest_resolved,
)
from puncture_twin.planning.needle.insertion_force import InsertionForce, insertion_force
from puncture_twin.planning.search.candidates import Candidates, Verdict


def with_bending(anatomy: Anatomy, candidates: Candidates, bound: DeflectionBound) -> Candidates:
    """Reject candidates whose clearance is less than the margin and the largest deflection."""
    deflection = bound.at(candidates.path.length)
    verdict = bent_verdict(candidates.verdict, anatomy.checked, candidates.clearance.by_structure, deflection)
    return replace(candidates, verdict=verdict, deflection=deflection)


def bent_verdict(verdict: Verdict, structures: tuple[Structure, ...], clearance: Floats, deflection: Floats) -> Verdict:
    """A verdict with candidates rejected whose clearance (n, k) is less than margin + deflection (n,), mm."""
    demanding = np.flatnonzero([one.demands_margin for one in structures])
    if not len(demanding):
        return verdict
    excess = clearance[:, demanding] - np.array([structures[column].margin_mm for column in demanding])
    nearest = demanding[excess.argmin(axis=1)]
    rows = np.flatnonzero(verdict.safe & ~(excess.min(axis=1) >= deflection))
    broken = [structures[column] for column in nearest[rows]]
    details = [
        f"it may bend by {bend:.2f} mm; the margin is {one.margin_mm:g} mm"
        for bend, one in zip(deflection[rows], broken, strict=True)
    ]
    return verdict.with_rows(
        rows,
        reason=Reason.NEEDLE_BENDS.value,
        structure=np.array([one.name for one in broken], dtype=object),
        amount=clearance[rows, nearest[rows]],
        detail=np.array(details, dtype=object),
    )


class Insertion(NamedTuple):
    """The insertion along one path with a bevel that never rotates; N and mm."""

    path: BevelPath
    force: InsertionForce
    buckling_free_n: float
    buckling_pinned_n: float

    @property
    def tip_mm(self) -> float:
        """Deviation of the tip from a straight line, to the side to which the bevel points, mm."""
        return float(self.path.cut_mm[-1])

    def lines(self, greatest_mm: float) -> list[str]:
        """Lines of text for a person."""
        peak, free, pinned = self.force.peak_n, self.buckling_free_n, self.buckling_pinned_n
        added = f"{greatest_mm:.2f} mm are added to the margins"
        return [
            f"  needle bends   {self.tip_mm:8.2f} mm at the tip if the bevel is never rotated; {added}",
            f"  axial force    {peak:8.2f} N at most; the shaft buckles at {free:.1f} N, pinned at {pinned:.1f} N",
        ]


def insertion_along(
    bending: Bending, anatomy: Anatomy, end_ct: Floats, outward_ct: Floats, path_length: float
) -> Insertion:
    """Deflection, forces and buckling of the insertion along one direction (3,), unit, outward from the target.

    The path ends at ``end_ct`` (3,), mm, the target; its length is from there to the skin, mm.
    """
    layers = path_layers(bending, anatomy, end_ct, outward_ct, path_length)
    stiffest = max(layer.tissue.stiffness_n_mm2 for layer in layers)
    count = max(1, int(np.ceil(path_length / step_for(bending.shaft, stiffest))))
    middles = (np.arange(count) + 0.5) * path_length / count
    ends = np.array([layer.end_mm for layer in layers])
    at = np.minimum(np.searchsorted(ends, middles), len(layers) - 1)
    stiffness = np.array([layers[row].tissue.stiffness_n_mm2 for row in at])
    path = bevel_path(bending.shaft, stiffness, np.full(count, bending.alpha), path_length / count)
    shaft = bending.shaft
    return Insertion(path, insertion_force(layers), shaft.buckling_n(pinned=False), shaft.buckling_n(pinned=True))


STEP_MM = 0.5
"""Between two samples of a path."""


def check_tissues(case: Case, anatomy: Anatomy) -> None:
    """Refuse tissues that match no structure, contradict each other, or are too stiff for so thin a needle."""
    if case.bending is None:
        return
    tissues, most = case.bending.tissues, stiffest_resolved(case.bending.shaft)
    tissues.check([one.name for one in anatomy.structures], "tissue", case.path)
    for pattern, tissue in tissues.of_pattern.items():
        if tissue.stiffness_n_mm2 > most:
            bend = shortest_bend(case.bending.shaft)
            what = f"tissue.{pattern}: {tissue.stiffness_n_mm2:g} N/mm2 bends this shaft within {bend:.2g} mm"
            allowed = f"at most {most:.3g} N/mm2 for this shaft: above, no bound of its bending is known"
            refuse(what, case.path, allowed, "tissue_too_stiff")


def path_layers(
    bending: Bending, anatomy: Anatomy, target_ct: Floats, outward_ct: Floats, path_length: float
) -> tuple[Layer, ...]:
    """The tissue layers of a path, skin first; in nested structures the smallest box counts.

    A surface is a capsule where it is entered. That of the rest is the skin: coming out of an organ there is none.

    Args:
        anatomy: The case's structures; only closed ones have an inside.
        target_ct: Shape (3,), mm.
        outward_ct: Shape (3,), unit.
        path_length: Target to skin, mm.
    """
    count = max(1, round(path_length / STEP_MM))
    edges = np.linspace(0.0, path_length, count + 1)
    depths = path_length - 0.5 * (edges[1:] + edges[:-1])
    names = np.full(count, REST, dtype=object)
    closed = [one for one in anatomy.structures if one.mesh.closed]
    for one in sorted(closed, key=lambda one: float(np.prod(np.ptp(one.mesh.bounds, axis=0))), reverse=True):
        names[inside_at(one, target_ct, outward_ct, depths)] = one.name
    layers: list[Layer] = []
    for name, group in groupby(range(count), key=lambda at: names[at]):
        rows = list(group)
        tissue = bending.tissues.of(str(name)) or bending.tissues.of_pattern[REST]
        if layers and tissue == bending.tissues.of_pattern[REST]:
            tissue = replace(tissue, capsule_n=0.0, capsule_mm=0.0)
        layers.append(Layer(float(edges[rows[0]]), float(edges[rows[-1] + 1]), tissue))
    return tuple(layers)


PROFILE_STEP_MM = 1.0
"""Between two samples: finer than the voxels of nearly every CT."""
BEYOND_SKIN_MM = 30.0
"""How far outside of the skin the path is followed."""


class Stretch(NamedTuple):
    """A part of a path along which the same structures are."""

    start_mm: float
    end_mm: float
    structures: tuple[str, ...]
    hu_low: float
    hu_median: float
    hu_high: float


def stretches(anatomy: Anatomy, target_ct: Floats, outward_ct: Floats, path_length: float) -> tuple[Stretch, ...]:
    """Follow a path from the target (3,), LPS mm, to ``BEYOND_SKIN_MM`` outside of the skin; empty without a CT.

    ``outward_ct`` (3,) is a unit vector, and ``path_length``, mm, from target to skin; NaN without an entry: nothing is
    followed.
    """
    if anatomy.scan is None or not np.isfinite(path_length):
        return ()
    depths = np.arange(0.0, path_length + BEYOND_SKIN_MM, PROFILE_STEP_MM)
    hu = anatomy.scan.hu_at(target_ct + depths[:, None] * outward_ct)
    closed = [s for s in anatomy.checked if s.mesh.closed]
    around = np.array([inside_at(s, target_ct, outward_ct, depths) for s in closed])
    names = np.array([s.name for s in closed], dtype=object)
    keys = [(*names[around[:, row]], "" if depth <= path_length else "outside") for row, depth in enumerate(depths)]
    parts: list[Stretch] = []
    for key, group in groupby(range(len(keys)), key=keys.__getitem__):
        rows = list(group)
        end = depths[rows[-1]] + PROFILE_STEP_MM
        parts.append(Stretch(float(depths[rows[0]]), float(end), tuple(filter(None, key)), *_range(hu[rows])))
    return tuple(parts)


def inside_at(structure: Structure, target_ct: Floats, outward_ct: Floats, depths: Floats) -> NDArray[np.bool_]:
    """Which depths (n,), mm, of a path from a target (3,) along a unit vector (3,) are inside a closed structure.

    By the parity of the crossings before; depths are from the target outward.
    """
    points = target_ct + depths[:, None] * outward_ct
    low, high = structure.mesh.bounds
    if not np.any(np.all((low <= points) & (points <= high), axis=1)):
        return np.zeros(len(depths), bool)
    crossed = np.sort(crossings(structure.mesh, target_ct, outward_ct[None]).depth)
    inside = contains(structure.mesh, target_ct)
    return np.asarray((np.searchsorted(crossed, depths) % 2 == 1) != inside)


def _range(hu: Floats) -> tuple[float, float, float]:
    seen = hu[np.isfinite(hu)]
    if not len(seen):
        return float("nan"), float("nan"), float("nan")
    return float(seen.min()), float(np.median(seen)), float(seen.max())
