"""The headers of the volumes that the structures come from."""

from __future__ import annotations

from collections.abc import Mapping

from puncture_twin.planning.anatomy.label_grids import label_grids
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid

Headers = Mapping[str, VolumeGrid]


def volume_headers(case: Case) -> dict[str, VolumeGrid]:
    """The headers of the CT and the label maps that the case's structures come from, by file name.

    Raises:
        InputError: A header that cannot be trusted.
    """
    named = {section.ct for section in case.structure if section.ct is not None}
    files = sorted(named.union(*(grid.files for grid in label_grids(case))))
    return {name: case.volumes.source(name).grid for name in files}
