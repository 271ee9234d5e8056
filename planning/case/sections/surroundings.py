"""What a case states to be located beside the patient: boxes, and a gantry with a round bore."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from puncture_twin.planning.base.arrays import read_only
from puncture_twin.planning.case.mount import axes_frame
from puncture_twin.planning.case.settings import Gantry, Obstacle
from puncture_twin.planning.case.tables.surroundings_section import GantrySection, ObstacleSection
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.planning.geometry.spaces import Space, to_lps


def obstacle_of(section: ObstacleSection, space: Space) -> Obstacle:
    """A box; its centre is in the case's space where its frame is the CT's."""
    center = np.asarray(section.center_mm)
    center = center if section.frame == "base" else to_lps(center[None], space)[0]
    return Obstacle(section.name, section.frame, center, np.asarray(section.size_mm))


def gantry_of(gantry: GantrySection, space: Space, path: Path) -> Gantry:
    """The bore's pose: z along the axis, x to the top, and turned so that a positive tilt leans the top against z."""
    axes = axes_frame(gantry.axis or "head", gantry.up or "anterior", space, path, "gantry: axis and up")
    T = pose(axes, to_lps(np.asarray([gantry.center_mm]), space)[0])
    c, s = np.cos(np.radians(gantry.tilt_deg)), np.sin(np.radians(gantry.tilt_deg))
    tilt = pose([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]], np.zeros(3))
    return Gantry(read_only(T @ tilt), gantry.bore_diameter_mm, gantry.wall_mm, gantry.thickness_mm)
