"""Why the arm does not reach along a direction, of which every motion that kinematics allows is blocked."""

from __future__ import annotations

from puncture_twin.planning.arm.insertion import first_stop
from puncture_twin.planning.arm.singularity import away_from_singularities
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.planning.reach.answer import ReachAnswer
from puncture_twin.planning.reach.branch_paths import every_branch
from puncture_twin.planning.reach.survey import Surveyed
from puncture_twin.planning.reach.trial import Blocked
from puncture_twin.planning.reach.unreachable import why_unreachable


def refusal(model: UrModel, found: Surveyed, deepest: Blocked | None) -> ReachAnswer:
    """Of a request without a clear motion: what came farthest.

    Args:
        model: The arm.
        found: What kinematics says of the request.
        deepest: What blocked the motion that came farthest of those that it allows; None if it allows none.
    """
    if deepest is None:
        return _refusal_of_kinematics(model, found)
    if deepest.at_standoff:
        return ReachAnswer.refused(Reason.ARM_COLLISION, None, deepest.detail, deepest.contact)
    return ReachAnswer.refused(Reason.INSERTION_BLOCKED, deepest.depth_mm, deepest.detail, deepest.contact)


def _refusal_of_kinematics(model: UrModel, found: Surveyed) -> ReachAnswer:
    """The refusal of a direction along which kinematics allows no motion."""
    if (found.stop_at < 0).any():
        return ReachAnswer.refused(Reason.UNREACHABLE, None, "every roll and branch leaves the joint limits")
    reached = away_from_singularities(model, found.starts)
    if not reached.any():
        R, target, outward = found.line
        T_base_flange = pose(R, target + found.distances[0] * outward)
        return ReachAnswer.refused(Reason.UNREACHABLE, None, why_unreachable(model, T_base_flange))
    paths = every_branch(model, found.line, found.distances)
    stops = [first_stop(model, path, found.depths) for path in paths[reached]]
    deepest = max((stop for stop in stops if stop), key=lambda stop: stop.depth_mm)
    return ReachAnswer.refused(Reason.INSERTION_BLOCKED, deepest.depth_mm, deepest.detail)
