"""The numbers that decide every enclosure, for the cache."""

from __future__ import annotations

from puncture_twin.planning.collision.enclosures.coarse_hull import COARSE_DIRECTIONS
from puncture_twin.planning.collision.enclosures.prism import PRISM_SIDES
from puncture_twin.planning.collision.enclosures.sphere import CENTRE_STEPS, SLACK_MM
from puncture_twin.planning.collision.enclosures.sphere_tree import LEAF_RADIUS_MM


def settings() -> dict[str, float]:
    """The numbers of this folder that decide what it makes."""
    return {
        "leaf": LEAF_RADIUS_MM,
        "slack": SLACK_MM,
        "steps": CENTRE_STEPS,
        "sides": PRISM_SIDES,
        "few": COARSE_DIRECTIONS,
    }
