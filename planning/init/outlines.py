"""Is what is named like the body its outline?

A path crosses the skin anyway, so an outline is left out; a ball in the body that somebody called ``External`` or
``patient`` is not.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy

from puncture_twin.planning.anatomy.default_roles import BODY, default_role
from puncture_twin.planning.anatomy.skin import Skin
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.containment import Side, side_of
from puncture_twin.planning.geometry.mesh import TriangleMesh, spread_on
from puncture_twin.planning.init.segmentation import Assigned, Segmentation

NEAR_MM, NEAR = 8.0, 0.02
"""An outline follows the skin to 8 mm: the coarsest voxels in use are 6 mm wide. In a small body, such as an animal's,
an organ is so near to it too: there to 2 % of the box's diagonal."""

MOST_OF_SKIN = 0.7
"""Of the skin, which a shell or the whole body covers; what covers it is crossed by every path."""

PART_OF_SKIN, MOST_OF_OUTLINE = 0.25, 0.6
"""A body that was cropped, or cut at its limbs, covers a part of the skin, and is bounded by it but for the cuts."""

POINTS, PLACES = 4_000, 200_000
"""Points that are asked about, and places of the other surface that they are compared with: on 2 square metres these
lie 3 mm apart, so that what is within 8 mm is found."""


LEAST_HELD = 0.9
"""Of the other structures, which the skin holds: a line or a bed may have been drawn too, and lies outside."""

SLACK_MM = 2.0
"""So far a structure may reach out of the skin's box: both were drawn."""


class SkinOf(NamedTuple):
    """A structure that is the skin."""

    segmentation: Segmentation
    label: int

    @property
    def name(self) -> str:
        """Of the structure."""
        return self.segmentation.names[self.label]

    def skin(self) -> Skin:
        """The skin that it is."""
        return self.segmentation.skin(self.label)


def skin_of(segmentations: Sequence[Segmentation], stated: str | None) -> SkinOf | None:
    """The structure that is stated to be the skin, else the largest that is named like the body; None for neither."""

    def extent(one: SkinOf) -> float:
        return float(np.ptp(one.segmentation.surface(one.label).bounds, axis=0).prod())

    every = (SkinOf(one, label) for one in segmentations for label in one.names)
    named = [one for one in every if (named_like_body(one.name) if stated is None else one.name == stated)]
    return max(named, key=extent, default=None)


def skin_problems(found: SkinOf, segmentations: Sequence[Segmentation]) -> Iterator[str]:
    """Why what is named like the skin cannot be it: what lies outside of a skin counts as air beside the patient."""
    every = [SkinOf(one, label) for one in segmentations for label in one.names]
    boxes = [one.segmentation.surface(one.label).bounds for one in every if one != found]
    low, high = found.segmentation.surface(found.label).bounds
    held = [bool(np.all((one[0] >= low - SLACK_MM) & (one[1] <= high + SLACK_MM))) for one in boxes]
    if sum(held) < LEAST_HELD * len(held):
        noun = "meshes" if found.segmentation.voxel_ct is None else "structures"
        yield f"'{found.name}' is named like the skin, but contains {sum(held)} of the {len(held)} other {noun}"


class Agreement(NamedTuple):
    """How far a structure is the body's outline."""

    skin_covered: float
    """Of the skin, the fraction that it is near to; faces where the scan cut the body do not count."""
    on_skin: float
    """Of its own surface, the fraction that is near to the skin."""


@dataclass(frozen=True, eq=False)
class Outlines:
    """The structures that are named like the body, held against its skin.

    Attributes:
        stated: The names of those that a person states to be the skin, or to be left out.
    """

    segmentations: Sequence[Segmentation]
    skin: Skin
    stated: frozenset[str] = frozenset()

    @cached_property
    def _named(self) -> dict[str, tuple[TriangleMesh, Agreement]]:
        meshes = {
            name: one.surface(label)
            for one in self.segmentations
            for label, name in one.names.items()
            if named_like_body(name)
        }
        return {name: (mesh, agreement(mesh, self.skin)) for name, mesh in meshes.items()}

    def at(self, point_ct: Floats) -> frozenset[str]:
        """The names of those that are outlines of the body about a point (3,), LPS mm."""
        found = [name for name, (mesh, found) in self._named.items() if _is_one(found, mesh, point_ct)]
        return self.stated.union(found)

    def notes(self, point_ct: Floats) -> Iterator[str]:
        """What a person should know of those that are none, one sentence each."""
        for name in sorted(self._named.keys() - self.at(point_ct)):
            _, found = self._named[name]
            yield (
                f"'{name}' is named like the outline of the body, but covers {found.skin_covered:.0%} of the skin, and "
                f"{found.on_skin:.0%} of it is there: treated as an ordinary structure (if it is the outline: ignore)"
            )


def named_like_body(name: str) -> bool:
    """Whether a structure is called as outlines of the body are."""
    return default_role(name, "other") == BODY


def _is_one(found: Agreement, mesh: TriangleMesh, point_ct: Floats) -> bool:
    """Whether a surface is the outline of the body, or of the part of it that holds a point (3,), LPS mm."""
    part = found.skin_covered >= PART_OF_SKIN and found.on_skin >= MOST_OF_OUTLINE
    return found.skin_covered >= MOST_OF_SKIN or (part and side_of(mesh, point_ct) is Side.INSIDE)


def agreement(mesh: TriangleMesh, skin: Skin) -> Agreement:
    """How far a surface and the skin are near to each other, by points of both."""
    within_mm = min(NEAR_MM, NEAR * float(np.linalg.norm(np.ptp(skin.mesh.bounds, axis=0))))
    open_skin = ~skin.cut_faces if not skin.cut_faces.all() else skin.cut_faces
    seen = TriangleMesh(skin.mesh.vertices, skin.mesh.faces[open_skin])
    return Agreement(
        fraction_near(spread_on(seen, POINTS).points, mesh, within_mm),
        fraction_near(spread_on(mesh, POINTS).points, skin.mesh, within_mm),
    )


def fraction_near(points: Floats, other: TriangleMesh, within_mm: float) -> float:
    """The fraction of points (n, 3) that lie so near to a surface, by points of that."""
    distance, _ = scipy.spatial.cKDTree(spread_on(other, PLACES).points).query(points, distance_upper_bound=within_mm)
    return float(np.isfinite(distance).mean())


BORDER_MM = 2.0
"""The surfaces of two labels that border on each other are this near: both lie between the same voxels."""

MOST_OF_BORDER, ALL_ROUND = 0.5, 0.9
"""Of the target's surface, which an organ about it borders on; one below the organ's surface has more. What goes all
round holds it: the target was carved out of it, and no path comes to it otherwise."""


def bordering(target: str | None, segmentations: Sequence[Segmentation]) -> dict[str, float]:
    """Of the target's surface the fraction that each structure borders on whose box may go round it.

    Args:
        target: The structure that the case names, or None.
    """
    every = [SkinOf(one, label) for one in segmentations for label in one.names]
    found = {}
    for own in (one for one in every if one.name == target):
        points = spread_on(own.segmentation.surface(own.label), POINTS).points
        for one in (one for one in every if one.name != target):
            mesh = one.segmentation.surface(one.label)
            low, high = mesh.bounds
            if np.all((points >= low - BORDER_MM) & (points <= high + BORDER_MM), axis=1).mean() >= MOST_OF_BORDER:
                found[one.name] = fraction_near(points, mesh, BORDER_MM)
    return found


def carved_notes(rows: Sequence[Assigned], target: str | None, border: Mapping[str, float]) -> Iterator[str]:
    """That an avoided structure goes round the target's, one sentence each.

    Args:
        target: The structure that the case names, or None.
    """
    for row in rows:
        if row.kind == "avoid" and border.get(row.name, 0.0) >= MOST_OF_BORDER:
            yield (
                f"'{row.name}' surrounds '{target}' without containing it, as if cut out around it, and is avoided "
                f"by {row.margin_mm:g} mm: no path through it is safe. If a path may cross it, make it traverse in "
                "the case"
            )
