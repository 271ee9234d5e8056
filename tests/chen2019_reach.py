"""What a UR3 reaches in Chen 2019's setup and about a target: the specification's numbers, and ours beside them."""

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.insertion import flange_poses
from puncture_twin.planning.arm.kinematics import MIN_SINGULARITY
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.case.entry import outward
from puncture_twin.planning.place.estimate import insertion_branches
from puncture_twin.planning.place.mounts import Region, Site

UR3 = ur_model("ur3")
LENGTH_MM, STANDOFF_MM = 401.0, 150.0
"""Needle and standoff of the paper."""
WINDOWS = {
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
"""First and last β, deg, that a UR3 reaches at each θ, deg, in setup 1 with markers A-B-C and lesion M.

Specification 1, section 2: inverse kinematics alone, 1-degree steps."""


class PublishedShare(NamedTuple):
    """Share of a cap of 60 deg, in equal-area directions, for which a UR3 has a solution with |sin q5| > .05.

    Attributes:
        distance_mm: Target to flange, r + l.
        rho_mm: Target to the base's axis; `z_mm`, above the base.
        cap_axis_base: Middle of the cap, base frame.
    """

    distance_mm: float
    rho_mm: float
    z_mm: float
    cap_axis_base: tuple[float, float, float]
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


def cap(axis, count=4000):
    """Equal-area directions within 60 deg of an axis, shape (count, 3): equal steps in height, golden turns."""
    k = np.arange(count) + 0.5
    height = 1.0 - 0.5 * k / count  # cos 60 deg = 0.5; equal area is equal height
    turn, side = np.pi * (1.0 + np.sqrt(5.0)) * k, np.sqrt(1.0 - height**2)
    R = flange_poses(np.zeros(3), -np.asarray(axis, dtype=float), 0.0)[0, :3, :3]  # z along the axis
    return np.stack([side * np.cos(turn), side * np.sin(turn), height], axis=1) @ R.T


def our_share(row):
    """Our number for a published one, as `place` counts it, no collisions asked: an arm from the ceiling, beside it."""
    region = Region("ceiling", "", (0, 0, -1), (0.0,) * 3, (0.0,) * 3)
    T_base_bed = np.linalg.inv(Site(region, (row.rho_mm, 0.0, row.z_mm)).T_bed_base())
    # In the bed frame the base's axis points down and the target lies rho to the side of it: base -z is bed +z.
    middle_bed = np.array([0.0, 0.0, 1.0]) if row.cap_axis_base == AGAINST_Z else np.array([1.0, 0.0, 0.0])
    outward_base = cap(middle_bed) @ T_base_bed[:3, :3].T
    distances = np.full((len(outward_base), 1), row.distance_mm)
    found = insertion_branches(UR3, T_base_bed[:3, 3], outward_base, distances, MIN_SINGULARITY)
    return float((found.margin.max(axis=1) != 0).mean())


def our_windows(T_base_ct, target_ct, theta_deg):
    """First and last β, deg, of each run of 1-degree steps that `place` counts as within reach at standoff."""
    u = outward(np.radians(theta_deg), np.radians(np.arange(360.0))) @ T_base_ct[:3, :3].T
    target = T_base_ct[:3, :3] @ target_ct + T_base_ct[:3, 3]
    found = insertion_branches(UR3, target, u, np.full((360, 1), LENGTH_MM + STANDOFF_MM))
    return runs(found.margin.max(axis=1) > 0.0)


def runs(flags):
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    return tuple((int(a), int(b) - 1) for a, b in edges.reshape(-1, 2))
