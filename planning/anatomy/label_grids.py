"""The grids on which a case's labels lie: of each label map, and one of each folder or DICOM file of masks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from puncture_twin.planning.anatomy.structure import Structure
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid


@dataclass(frozen=True, eq=False)
class LabelGrid:
    """The voxels of a label map, or of all masks of a folder.

    Attributes:
        name: The file or folder, as the case writes it.
        files: The map, or the masks.
        voxels: Where they lie.
    """

    name: str
    files: frozenset[str]
    voxels: VolumeGrid

    def own(self, structures: Sequence[Structure]) -> list[Structure]:
        """The structures that come from it."""
        return [one for one in structures if one.source.rpartition(":")[0] in self.files]


def label_grids(case: Case) -> tuple[LabelGrid, ...]:
    """Every grid of a case, by name.

    Raises:
        InputError: A header that cannot be trusted.
    """
    return tuple(sorted(_grids(case), key=lambda grid: grid.name))


def _grids(case: Case) -> Iterator[LabelGrid]:
    maps = {one.labelmap for one in case.structure} | {many.labelmap for many in case.structures}
    sources = {name: [name] for name in maps if name is not None}
    sets = [one.mask_set for one in case.structures if one.mask_set is not None]
    sources |= {one: list(case.masks(one).values()) for one in sets}
    for name, files in sources.items():
        yield LabelGrid(name, frozenset(files), case.volumes.source(files[0]).grid)
