"""What a UR3 reaches in Chen 2019's setup and about a target: the specification's numbers, and ours beside them."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.arm.insertion import flange_poses
from puncture_twin.planning.arm.kinematics import MIN_SINGULARITY
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.case.entry import outward
from puncture_twin.planning.place.estimate import insertion_branches
from puncture_twin.planning.place.mounts import Region, Site

Floats = NDArray[np.float64]
Window = tuple[int, int]
MODEL = "ur3"
CAP_DIRECTIONS = 4000
LENGTH_MM, STANDOFF_MM = 401.0, 150.0
"""Needle and standoff of the paper."""

WINDOWS: Mapping[int, tuple[Window, ...]] = MappingProxyType(
    {
        **dict.fromkeys(range(9), ()),
        9: ((243, 285),),
        10: ((233, 295),),
        20: ((207, 322),),
        30: ((203, 325),),
        40: ((204, 325),),
        50: ((206, 322),),
        60: ((211, 255), (273, 317)),
        70: ((217, 253), (275, 311)),
        80: ((226, 253), (275, 303)),
        90: ((239, 253), (275, 289)),
    }
)
"""First and last β, deg, that a UR3 reaches at each θ, deg, in setup 1 with markers A-B-C and lesion M.

Specification 1, section 2: inverse kinematics alone, 1-degree steps."""


class PublishedShare(NamedTuple):
    """Share of a cap of 60 deg, in equal-area directions, for which a UR3 has a solution with |sin q5| > .05."""

    distance_mm: float
    """Target to flange, r + l."""
    rho_mm: float
    """Target to the base's axis."""
    z_mm: float
    """Target above the base."""
    cap_axis_base: tuple[float, float, float]
    """Middle of the cap, base frame."""
    share: float


AGAINST_Z, TOWARD_AXIS = (0.0, 0.0, -1.0), (-1.0, 0.0, 0.0)

SHARES = (
    PublishedShare(551.0, 250.0, 700.0, AGAINST_Z, 0.61),
    PublishedShare(551.0, 400.0, 250.0, TOWARD_AXIS, 0.68),
    PublishedShare(451.0, 250.0, 150.0, TOWARD_AXIS, 0.96),
    PublishedShare(401.0, 250.0, 150.0, TOWARD_AXIS, 0.93),
    PublishedShare(300.0, 250.0, 500.0, AGAINST_Z, 0.81),
    PublishedShare(300.0, 500.0, 200.0, TOWARD_AXIS, 1.00),
)
"""Specification 1, section 2."""


def cap(axis: Floats | tuple[float, float, float], count: int = CAP_DIRECTIONS) -> Floats:
    """Equal-area directions within 60 deg of an axis, shape (count, 3): equal steps in height, golden turns."""
    k = np.arange(count) + 0.5
    height = 1.0 - 0.5 * k / count  # cos 60 deg = 0.5; equal area is equal height
    turn, side = np.pi * (1.0 + np.sqrt(5.0)) * k, np.sqrt(1.0 - height**2)
    R = flange_poses(np.zeros(3), -np.asarray(axis, dtype=float), 0.0)[0, :3, :3]  # z along the axis
    return np.asarray(np.stack([side * np.cos(turn), side * np.sin(turn), height], axis=1) @ R.T)


def held_share(
    target_base: Floats, outward_base: Floats, distance_mm: float, at_least: float = MIN_SINGULARITY
) -> float:
    """The share of directions that `place` counts as within reach at one distance, no collisions asked."""
    distances = np.full((len(outward_base), 1), distance_mm)
    found = insertion_branches(ur_model(MODEL), target_base, outward_base, distances, at_least)
    return float((found.margin.max(axis=1) != 0).mean())


def our_share(row: PublishedShare) -> float:
    """Our number for a published one, through a site of `place`: an arm from the ceiling, the target beside."""
    region = Region("ceiling", "", (0, 0, -1), (0.0,) * 3, (0.0,) * 3)
    site = Site(region, (row.rho_mm, 0.0, row.z_mm))
    T_base_bed = np.asarray(np.linalg.inv(site.T_bed_base()), dtype=np.float64)
    # In the bed frame the base's axis points down and the target lies rho to the side of it: base -z is bed +z.
    middle_bed = np.array([0.0, 0.0, 1.0]) if row.cap_axis_base == AGAINST_Z else np.array([1.0, 0.0, 0.0])
    return held_share(T_base_bed[:3, 3], cap(middle_bed) @ T_base_bed[:3, :3].T, row.distance_mm)


def our_windows(T_base_ct: Floats, target_ct: Floats, theta_deg: int) -> tuple[Window, ...]:
    """First and last β, deg, of each run of 1-degree steps that `place` counts as within reach at standoff."""
    u = outward(np.radians(theta_deg), np.radians(np.arange(360.0))) @ T_base_ct[:3, :3].T
    target = T_base_ct[:3, :3] @ target_ct + T_base_ct[:3, 3]
    ways = insertion_branches(ur_model(MODEL), target, u, np.full((360, 1), LENGTH_MM + STANDOFF_MM))
    return runs(ways.margin.max(axis=1) > 0.0)


def runs(flags: NDArray[np.bool_]) -> tuple[Window, ...]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    return tuple((int(a), int(b) - 1) for a, b in edges.reshape(-1, 2))
