"""The grid of directions and the limits that a case states."""

from __future__ import annotations

from types import MappingProxyType

import numpy as np

from puncture_twin.planning.case.settings import SearchSettings
from puncture_twin.planning.case.tables.search_section import SearchSection


def search_of(section: SearchSection) -> SearchSettings:
    """The grid and the limits in radians."""
    return SearchSettings(
        theta=(np.radians(section.theta_deg[0]), np.radians(section.theta_deg[1])),
        beta=(np.radians(section.beta_deg[0]), np.radians(section.beta_deg[1])),
        step=np.radians(section.step_deg),
        max_skin_angle=np.radians(section.max_skin_angle_deg),
        min_hit=section.min_hit,
        max_touch=section.max_touch,
        max_touch_of=MappingProxyType(dict(section.max_touch_of)),
    )
