"""A named surface, and what it means to a needle.

The grids on which a case's labels lie: of each label map, and one of each folder or DICOM file of masks.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid
from puncture_twin.planning.geometry.mesh import TriangleMesh


class Role(StrEnum):
    """What a structure means to a needle."""

    AVOID = "avoid"
    TRAVERSE = "traverse"
    TARGET = "target"
    SKIN = "skin"
    UNKNOWN = "unknown"


GAS_HOLDERS = (
    "lung", "trachea", "bronch", "airway", "pharyn", "laryn", "nasopharyn", "esophag", "oesophag", "stomach", "duoden",
    "bowel", "intestin", "jejun", "ileum", "colon", "sigmoid", "rectum", "caecum", "cecum", "appendix", "mastoid",
)  # fmt: skip
"""How words begin that name structures which hold gas in a healthy body."""
GAS_WORDS = ("sinus", "sinuses", "nasal", "nose", "oral", "mouth", "gas", "air", "cavity")
"""Whole words that do: "oral" is not to be found in "femoral"."""


@dataclass(frozen=True, eq=False)
class Structure:
    """A named surface with a role."""

    name: str
    role: Role
    margin_mm: float
    """The clearance that it demands, where its role demands one."""
    mesh: TriangleMesh
    """In the CT frame, mm."""
    source: str
    """The file it comes from, and the label in it."""
    outside: bool = False
    """Whether it is outside of the body: then it is checked up to where the flange waits at its standoff."""
    voxel_ct: Floats | None = None
    """Shape (3, 3), the edges of the voxels that it was made of as columns, mm; None for one that no volume shows, such
    as a mesh: nobody knows then how far its surface may lie off."""

    @property
    def voxel_mm(self) -> float:
        """The longest edge of its voxels, mm; 0 without any."""
        return 0.0 if self.voxel_ct is None else float(np.linalg.norm(self.voxel_ct, axis=0).max())

    @property
    def demands_margin(self) -> bool:
        """Whether a needle too close to it is rejected."""
        return self.role in {Role.AVOID, Role.UNKNOWN}

    @property
    def may_contain_gas(self) -> bool:
        """Whether its name is that of lung, bowel or another hollow organ that air gets into."""
        words = re.findall("[a-z]+", self.name.lower())
        return any(word.startswith(GAS_HOLDERS) or word in GAS_WORDS for word in words)


@dataclass(frozen=True, eq=False)
class LabelGrid:
    """The voxels of a label map, or of all masks of a folder, by its name as the case writes it."""

    name: str
    files: frozenset[str]
    voxels: VolumeGrid
    cut: tuple[str, ...] | None = None
    """The sides of the patient at which its labels were cut off before the grid's face, where the case states them."""

    def own(self, structures: Sequence[Structure]) -> list[Structure]:
        """The structures that come from it."""
        return [one for one in structures if one.source.rpartition(":")[0] in self.files]


def label_grids(case: Case) -> tuple[LabelGrid, ...]:
    """Every grid of a case, by name. Raises InputError: A header that cannot be trusted."""
    maps = {one.labelmap for one in case.structure} | {many.labelmap for many in case.structures}
    sources = {name: [name] for name in maps if name is not None}
    sets = [one.mask_set for one in case.structures if one.mask_set is not None]
    sources |= {one: list(case.masks(one).values()) for one in sets}
    stated = [(many.source, many.cut) for many in case.structures]
    stated += [(one.labelmap or "", one.cut) for one in case.structure if one.role != "skin"]
    cuts = {
        of: tuple({side for name, sides in stated if name == of for side in sides or ()})
        for of in {name for name, sides in stated if sides is not None}
    }
    return tuple(
        LabelGrid(name, frozenset(files), case.volumes.source(files[0]).grid, cuts.get(name))
        for name, files in sorted(sources.items())
    )
