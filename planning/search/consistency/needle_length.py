"""A needle that is shorter than the shortest path from the target to the skin."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.anatomy.skin import Skin
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.geometry.triangle_distance import squared_distance
from puncture_twin.planning.search.constraints import longest_path


def needle_warnings(case: Case, skin: Skin) -> tuple[str, ...]:
    """A needle that is shorter than the shortest path from the target to the skin."""
    triangles = skin.mesh.triangles[~skin.cut_faces]
    if len(triangles) == 0:
        return ()
    nearest = float(np.sqrt(squared_distance(case.target_ct, triangles).min()))
    longest = longest_path(case.needle)
    if longest >= nearest:
        return ()
    said = f"the needle's longest path is {longest:g} mm, and the skin is {nearest:.1f} mm away"
    return (f"{said}: every path is too long",)
