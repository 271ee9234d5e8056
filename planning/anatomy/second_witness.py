"""The CT as a second witness of the segmentation: what it shows inside the body that no structure of the case names.

A rib that a segmentation lost, a stent, a calcified vessel: dense, and part of no structure. Gas outside of what may
hold gas: a loop of bowel or a piece of lung that nobody labelled. Both become structures of role ``unknown``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Bools
from puncture_twin.planning.formats.labels.label_surface import field_surface
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.voxelize import voxels_inside

GAS_HU = -300.0
"""Half way between fat (-100) and a voxel that is half gas, half tissue (-500)."""
MIN_COMPONENT_MM3 = 100.0
"""Smaller components are noise and edges of labels: half a voxel of a 6 mm grid."""
SKIN_VOXELS = 2
"""So deep below the body's surface voxels are partly air: no gas there."""
GAS_HOLDERS = (
    "lung", "trachea", "bronch", "airway", "pharyn", "laryn", "nasopharyn", "esophag", "oesophag", "stomach", "duoden",
    "bowel", "intestin", "jejun", "ileum", "colon", "sigmoid", "rectum", "caecum", "cecum", "appendix", "mastoid",
)  # fmt: skip
"""How words begin that name structures which hold gas in a healthy body."""
GAS_WORDS = ("sinus", "sinuses", "nasal", "nose", "oral", "mouth", "gas", "air", "cavity")
"""Whole words that do: "oral" is not to be found in "femoral"."""

FULL = np.ones((3, 3, 3), bool)


class Named(NamedTuple):
    """A structure of the case."""

    name: str
    mesh: TriangleMesh

    @property
    def may_contain_gas(self) -> bool:
        """Whether its name is that of lung, bowel or another hollow organ that air gets into."""
        words = re.findall("[a-z]+", self.name.lower())
        return any(word.startswith(GAS_HOLDERS) or word in GAS_WORDS for word in words)


@dataclass(frozen=True, eq=False)
class BodyImage:
    """A CT with its body.

    Attributes:
        hu: Shape (nx, ny, nz), Hounsfield units.
        body: Same shape.
        T_ct_index: Shape (4, 4), voxel index to LPS mm.
        spacing_mm: Shape (3,).
        slack_mm: So deep below the body's surface there may still be the ambient air, because the surface is from
            elsewhere and was widened.
    """

    hu: NDArray[np.float32]
    body: Bools
    T_ct_index: NDArray[np.float64]
    spacing_mm: NDArray[np.float64]
    slack_mm: float = 0.0


class Unnamed(NamedTuple):
    """What no structure names: closed surfaces in LPS mm, or None where there is nothing."""

    dense: TriangleMesh | None
    gas: TriangleMesh | None


def unnamed_surfaces(image: BodyImage, structures: Sequence[Named], *, dense_hu: float, where: str | Path) -> Unnamed:
    """Find dense components and gas inside the body outside of all structures grown by one voxel.

    Args:
        image: The CT and its body.
        structures: Every structure of the case but the skin.
        dense_hu: From here on a voxel is dense.
        where: The CT's file, for messages.
    """
    named = _grown_union(structures, image)
    dense = image.body & (image.hu >= dense_hu) & ~named
    gas = image.hu < GAS_HU
    if gas.any():
        gas &= _deep(image) & ~_grown_union([one for one in structures if one.may_contain_gas], image)
    return Unnamed(_surface(dense, image, where), _surface(gas, image, where))


def _deep(image: BodyImage) -> Bools:
    """Voxels so deep in the body that air in them is not the room's."""
    deep = scipy.ndimage.binary_erosion(image.body, FULL, iterations=SKIN_VOXELS, border_value=1)
    if image.slack_mm > 0.0 and not image.body.all():
        deep &= scipy.ndimage.distance_transform_edt(image.body, sampling=image.spacing_mm) > image.slack_mm
    return np.asarray(deep)


def _grown_union(structures: Sequence[Named], image: BodyImage) -> Bools:
    """Voxels of all structures, dilated by one voxel."""
    union = np.zeros(image.hu.shape, bool)
    for structure in structures:
        union |= voxels_inside(structure.mesh, image.T_ct_index, image.hu.shape)
    return np.asarray(scipy.ndimage.binary_dilation(union))


def _surface(mask: Bools, image: BodyImage, where: str | Path) -> TriangleMesh | None:
    """The surface of the components that are large enough."""
    kept = np.zeros_like(mask)
    least = MIN_COMPONENT_MM3 / float(np.prod(image.spacing_mm))
    for box, component in _components(mask):
        if np.count_nonzero(component) >= least:
            kept[box] |= component
    return field_surface(kept.astype(np.float32) - 0.5, image.T_ct_index, where=where) if kept.any() else None


def _components(mask: Bools) -> Iterator[tuple[tuple[slice, ...], Bools]]:
    labels, _ = scipy.ndimage.label(mask, FULL)
    for number, box in enumerate(scipy.ndimage.find_objects(labels), start=1):
        yield box, labels[box] == number
