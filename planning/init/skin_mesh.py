"""Without a CT a mesh is the skin: the largest of those that are named like the body, if it holds the others."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.anatomy.skin import Skin, flat_ends, skin_from_mesh
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.init.mesh_folder import MeshFolder
from puncture_twin.planning.init.outlines import named_like_body
from puncture_twin.planning.init.segmentation import Segmentation

LEAST_HELD = 0.9
"""Of the other meshes, which the skin holds: a line or a bed may have been drawn too, and lies outside."""

SLACK_MM = 2.0
"""So far a mesh may reach out of the skin's box: both were drawn."""


class SkinMesh(NamedTuple):
    """A mesh that may be the skin."""

    folder: MeshFolder
    label: int

    @property
    def name(self) -> str:
        """Of the structure."""
        return self.folder.names[self.label]

    @property
    def mesh(self) -> TriangleMesh:
        """LPS mm."""
        return self.folder.surface(self.label)

    def skin(self) -> Skin:
        """The skin that it is, with flat ends as cuts."""
        return skin_from_mesh(self.mesh, flat_ends(self.mesh))


def skin_mesh(segmentations: Sequence[Segmentation]) -> SkinMesh | None:
    """The largest mesh that is named like the body, or None."""
    folders = [one for one in segmentations if isinstance(one, MeshFolder)]
    named = [SkinMesh(one, label) for one in folders for label, name in one.names.items() if named_like_body(name)]
    return max(named, key=lambda one: float(np.ptp(one.mesh.bounds, axis=0).prod()), default=None)


def skin_problems(found: SkinMesh, segmentations: Sequence[Segmentation]) -> Iterator[str]:
    """Why it cannot be the skin: what lies outside of a skin counts as air beside the patient."""
    folders = [one for one in segmentations if isinstance(one, MeshFolder)]
    others = [one.surface(label) for one in folders for label in one.names if SkinMesh(one, label) != found]
    low, high = found.mesh.bounds
    held = [bool(np.all((one.bounds[0] >= low - SLACK_MM) & (one.bounds[1] <= high + SLACK_MM))) for one in others]
    if sum(held) < LEAST_HELD * len(held):
        yield f"'{found.name}' is named like the skin, but holds {sum(held)} of the {len(held)} other meshes"
