"""Structures of one file, which may overlap: a mask each, made one at a time on the grid that all share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.formats.volumes.volume_files import Volume
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid

if TYPE_CHECKING:  # Slicer's segmentations need no DICOM library
    from puncture_twin.planning.formats.dicom.ct_series import CtSeries

Mask = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class MaskVolume:
    """One structure as a volume of 0 and 1, whose voxels are made at each call."""

    path: Path
    # every file that decides it, by its key in ``content``: also the CT's, where it lies on its grid
    files: tuple[str, ...]
    part: tuple[str, ...]
    grid: VolumeGrid  # where the voxels lie, LPS mm; sheared where the CT's gantry was tilted
    make: Callable[[], Mask]
    notes: tuple[str, ...] = ()

    def volume(self) -> Volume:
        """The mask with its voxels."""
        return Volume(self.make(), self.grid.T_ct_index, self.path)


@dataclass(frozen=True, eq=False)
class NamedMasks:
    """Named structures of one file as masks."""

    masks: dict[str, MaskVolume]
    notes: tuple[str, ...]


def unique_names(names: Sequence[str], where: Path) -> None:
    """Whether each structure has a name of its own. Raises InputError: one has none, or two share one."""
    if not names:
        refuse("has no structure", where, "a file with structures", "no_structure")
    for name in names:
        if not name or names.count(name) > 1:
            what = f"{names.count(name)} structures have the name {name!r}" if name else "a structure has no name"
            refuse(what, where, "a name of its own for each structure", "duplicate_name" if name else "bad_name")


def check_frame_of_reference(stated: str, ct: CtSeries, where: Path) -> None:
    """Whether structures and CT lie in the same coordinates. Raises InputError: they state two, or one states none."""
    if stated != ct.frame_of_reference or not stated:
        what = f"lies in the frame of reference {stated or 'not stated'}, the CT {ct.path.name} in "
        allowed = "structures drawn on this CT, or on one registered to it"
        refuse(f"{what}{ct.frame_of_reference or 'one that is not stated'}", where, allowed, "other_frame_of_reference")
