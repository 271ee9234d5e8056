"""A cross-check of the segmentation by the CT: what it shows inside the body that no structure of the case names.

A rib that a segmentation lost, a stent, a calcified vessel: dense, and part of no structure. Gas outside of what may
hold gas: a loop of bowel or a piece of lung that nobody labelled. Both become structures of role ``unknown``.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy

from puncture_twin.planning.anatomy.body.body_mask import CtImage
from puncture_twin.planning.base.arrays import Bools, grown, widened
from puncture_twin.planning.formats.labels.labelmaps import box_in, mask_surface
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.parts import mark_inside, parts_of

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


class Named(NamedTuple):
    """A structure of the case."""

    name: str
    mesh: TriangleMesh

    @property
    def may_contain_gas(self) -> bool:
        """Whether its name is that of lung, bowel or another hollow organ that air gets into."""
        words = re.findall("[a-z]+", self.name.lower())
        return any(word.startswith(GAS_HOLDERS) or word in GAS_WORDS for word in words)


class Unnamed(NamedTuple):
    """Closed surfaces of what no structure names, LPS mm; None where there is nothing."""

    dense: TriangleMesh | None
    gas: TriangleMesh | None


def unnamed_surfaces(
    ct: CtImage, body: Bools, structures: Sequence[Named], *, dense_hu: float, slack_mm: float = 0.0
) -> Unnamed:
    """Find dense components and gas inside the body outside of all structures grown by one voxel.

    Args:
        body: The CT's body, shape (nx, ny, nz).
        dense_hu: From here on a voxel is dense.
        slack_mm: So deep below the body's surface there may still be the ambient air, because the surface is from
            elsewhere and was widened.
    """
    gas, named = ct.hu < GAS_HU, np.zeros(body.shape, bool)
    if gas.any():
        gas &= ~widened(~body, (SKIN_VOXELS,) * 3)  # beyond the border the body goes on
        if slack_mm > 0.0 and not body.all():
            gas &= scipy.ndimage.distance_transform_edt(body, sampling=ct.spacing_mm) > slack_mm
    for holders in (True, False):
        for one in structures:
            if one.may_contain_gas == holders:
                mark_inside(one.mesh, ct.T_ct_index, named)
        if holders and gas.any():
            gas &= ~grown(named)
    return Unnamed(_surface(body & (ct.hu >= dense_hu) & ~grown(named), ct), _surface(gas, ct))


def _surface(mask: Bools, ct: CtImage) -> TriangleMesh | None:
    if not mask.any():
        return None
    box = box_in(mask)
    found = parts_of(mask[box], corners=True)
    large = found.sizes >= MIN_COMPONENT_MM3 / float(np.prod(ct.spacing_mm))
    mask[box] = found.painted(large)
    return mask_surface(mask, ct.T_ct_index, where=ct.where) if large.any() else None
