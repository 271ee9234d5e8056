"""Clearances are printed with the digits that the data carries; JSON keeps all."""

from dataclasses import replace

import numpy as np
import pytest

from puncture_twin.meshes import folder
from puncture_twin.planning.search.context import prepare


@pytest.mark.parametrize(("voxel_mm", "shown"), [(0.0, "5.00"), (0.7, "5.00"), (1.0, "5.0"), (3.0, "5.0")])
def test_coarse_voxels_carry_no_hundredths(voxel_mm, shown):
    """Of a mesh and of fine voxels two decimals, of voxels of 1 mm or more one."""
    found = prepare(folder() / "carton" / "case_m.toml", arm=False).explain(0.0, 0.0)
    structures = tuple(
        replace(one, voxel_ct=voxel_mm * np.eye(3) if voxel_mm else None) for one in found.anatomy.structures
    )
    coarse = replace(found, anatomy=replace(found.anatomy, structures=structures))
    line = next(line for line in coarse.text().splitlines() if line.split()[:1] == ["bolt_h"])
    assert line.split()[2] == shown
    assert coarse.summary()["clearance_mm"] == found.summary()["clearance_mm"]
