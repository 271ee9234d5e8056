"""Estimated fraction of directions an arm reaches from a placement: kinematics and bounding spheres."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.insertion import flange_poses
from puncture_twin.planning.arm.inverse_kinematics import N_BRANCHES, inverse
from puncture_twin.planning.arm.kinematics import MIN_SINGULARITY, link_poses, singularity
from puncture_twin.planning.arm.tool import Tool
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.place.arm_spheres import ArmSpheres, Surroundings, base_is_clear, clear_branches
from puncture_twin.planning.place.mounts import Site, WantedDirections

STATES = 3
"""States of an insertion, from standoff to target: enough to see most of what ends it."""


class Branches(NamedTuple):
    """The straight insertions along n directions on every branch, looked at in m states each."""

    q: Floats
    """Shape (n, 8, m, 6), rad, standoff first; NaN where a branch does not exist."""
    margin: Floats
    """Shape (n, 8): least distance from a singularity over the states, 0..1; 0 where the insertion is not possible."""


class ReachEstimate(NamedTuple):
    """Fractions of the directions, 0..1: each counts those that the one before left and that pass its own test."""

    reach: float
    """Kinematics allow the insertion."""
    fraction: float
    """Links and holder keep clear of the patient and of what is around, too; whether of one another is not tested."""
    margin: float
    """Mean distance of the reached directions from singularities, 0..1; 0 where none is reached."""


NOTHING = ReachEstimate(0.0, 0.0, 0.0)


def insertion_branches(
    model: UrModel, target_base: Floats, outward_base: Floats, distances_mm: Floats, at_least: float = MIN_SINGULARITY
) -> Branches:
    """Every branch of many insertions, by kinematics alone; joint limits are not tested.

    Args:
        model: The arm.
        target_base: Shape (3,), mm.
        outward_base: Shape (n, 3), unit.
        distances_mm: Shape (n, m): target to flange at each state.
        at_least: Each singularity must be farther than this.
    """
    count, states = distances_mm.shape
    poses = flange_poses(target_base, np.repeat(outward_base, states, axis=0), distances_mm.reshape(-1))
    q = inverse(model, poses).reshape(count, states, N_BRANCHES, 6)
    least = singularity(model, q).least().min(axis=1)  # NaN where a state does not exist
    return Branches(np.moveaxis(q, 2, 1), np.where(least > at_least, least, 0.0))


@dataclass(frozen=True, eq=False)
class Estimator:
    """Estimates placements of one arm about one target. Its values can be sent to another process.

    Attributes:
        model: The arm.
        tool: What its flange carries.
        surroundings: Patient and boxes around it.
        T_ct_bed: Shape (4, 4), mm, its origin the target.
        wanted: The directions.
    """

    model: UrModel
    tool: Tool
    surroundings: Surroundings
    T_ct_bed: Floats
    wanted: WantedDirections

    def estimate(self, site: Site) -> ReachEstimate:
        """The fractions at one site; ``NOTHING`` where the base would lie in something."""
        model, spheres = self.model, _spheres(self.model, self.tool)
        T_ct_base = self.T_ct_bed @ site.T_bed_base()
        if not base_is_clear(spheres, self.surroundings, T_ct_base):
            return NOTHING
        T_base_ct = np.linalg.inv(T_ct_base)
        target = T_base_ct[:3, :3] @ self.T_ct_bed[:3, 3] + T_base_ct[:3, 3]
        depths = np.linspace(0.0, 1.0, STATES)
        distances = self.tool.needle_length_mm + self.wanted.standoff_mm[:, None] * (1.0 - depths)
        found = insertion_branches(model, target, self.wanted.outward_ct @ T_base_ct[:3, :3].T, distances)
        best = self._open_margins(found, T_ct_base)
        fraction = self._fraction(best)
        margin = float(best @ self.wanted.weight) / fraction if fraction > 0.0 else 0.0
        return ReachEstimate(self._fraction(found.margin.max(axis=1)), fraction, margin)

    def _open_margins(self, branches_reached: Branches, T_ct_base: Floats) -> Floats:
        """The margin of each direction's best branch that keeps clear of the surroundings, shape (n,); 0 for none."""
        model, spheres = self.model, _spheres(self.model, self.tool)
        best = np.zeros(len(branches_reached.margin))
        order = np.argsort(-branches_reached.margin, axis=1, kind="stable")
        rows = np.arange(len(order))
        for place in range(N_BRANCHES):
            rows = rows[branches_reached.margin[rows, order[rows, place]] > 0.0]
            branches = order[rows, place]
            clear = clear_branches(
                spheres, self.surroundings, T_ct_base, link_poses(model, branches_reached.q[rows, branches])
            )
            best[rows[clear]] = branches_reached.margin[rows[clear], branches[clear]]
            rows = rows[~clear]
        return best

    def _fraction(self, margins: Floats) -> float:
        return float(self.wanted.weight[margins > 0.0].sum())


@cache
def _spheres(model: UrModel, tool: Tool) -> ArmSpheres:
    return ArmSpheres.of(model, tool)
