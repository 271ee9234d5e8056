"""The exact check of a placement: directions as the batch search checks them, and the expected error of the tip.

Whether the needle can wait before the insertion at all depends on the needle alone: no placement changes it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import fcl
import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.arm.insertion import flange_poses
from puncture_twin.planning.arm.tool import Box, Tool
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import user_cache
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.collision import workcell
from puncture_twin.planning.collision.bodies import Solid
from puncture_twin.planning.collision.fast_checker import FastChecker
from puncture_twin.planning.collision.patient import FclSkin
from puncture_twin.planning.collision.state_checker import PATIENT
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.place.mounts import WantedDirections, wanted_directions
from puncture_twin.planning.reach.reach import assess_reach_all
from puncture_twin.planning.reach.survey import ReachAnswer, ReachRequest
from puncture_twin.planning.registration.fit_uncertainty import reading_noise, touches
from puncture_twin.planning.registration.marker_pairs import MarkerPairs
from puncture_twin.planning.registration.placement import Placement, default_method
from puncture_twin.planning.registration.registration import Registration, register
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.uncertainty.pose_error import PoseError


def placement_check(case: Case, anatomy: Anatomy, candidates: Candidates) -> PlacementCheck:
    """The case's workcell, with what moves with the patient apart from what moves with the arm, and its directions."""
    carried = {obstacle.name for obstacle in case.obstacles if obstacle.frame == "base"}
    boxes = workcell.case_boxes(case, np.eye(4))  # with the two frames in one place each box stands in its own
    return PlacementCheck(
        model=case.robot.model,
        tool=workcell.case_tool(case),
        skin=anatomy.skin.mesh,
        outside=workcell.outside_surface(anatomy),
        fixed=tuple(box for box in boxes if box.name not in carried),
        carried=tuple(box for box in boxes if box.name in carried),
        padding_mm=workcell.ARM_PADDING_MM,
        target_ct=case.target_ct,
        wanted=wanted_directions(case, candidates),
        home=workcell.home_configuration(case),
    )


@dataclass(frozen=True, eq=False)
class Verdict:
    """Exact reach from one placement, in the directions that were checked."""

    fraction: float
    """Of the wanted solid angle, 0..1; where not all were checked, each counts for those nearest to it."""
    reached: int
    count: int
    margin: float
    """Mean reach margin of the reached ones, 0..1; 0 for none."""
    reasons: Mapping[str, int]
    home_contact: str
    """What the arm touches in its home configuration, or ""."""
    q_insertion: Floats
    """Shape (reached, 6), rad, the tip on the target."""
    answers: tuple[ReachAnswer, ...]
    """Of each checked direction; where all were checked, in the order of the candidates."""


class Checked(NamedTuple):
    """Directions checked from one placement: of each insertion the last state alone is kept."""

    answers: list[ReachAnswer]
    home_contact: str


@dataclass(frozen=True, eq=False)
class PlacementCheck:
    """Checks placements. Its values can be sent to another process."""

    model: UrModel
    tool: Tool
    skin: TriangleMesh
    outside: TriangleMesh | None
    """What the CT shows outside of the skin, or None; CT frame, as the skin."""
    fixed: tuple[Box, ...]
    """Boxes that stand with the patient; their ``T_base_box`` is in the CT frame."""
    carried: tuple[Box, ...]
    """Boxes that stand with the arm, base frame."""
    padding_mm: float
    target_ct: Floats  # shape (3,), mm
    wanted: WantedDirections
    home: Floats
    """Shape (6,), rad."""

    def checked(self, piece: tuple[Floats, NDArray[np.int64]]) -> Checked:
        """Check some directions from a pose ``T_base_ct`` (4, 4); a base in the patient or the unseen reaches none."""
        T_base_ct, rows = piece
        try:
            checker = FastChecker(
                self.model,
                self.tool,
                (*(Box(box.name, T_base_ct @ box.T_base_box, box.size_mm) for box in self.fixed), *self.carried),
                self.skin.transformed(T_base_ct),
                outside=None if self.outside is None else self.outside.transformed(T_base_ct),
                padding_mm=self.padding_mm,
                cache=user_cache(),
            )
        except InputError as error:
            if not error.code.startswith("base_in"):
                raise
            return Checked([ReachAnswer.refused(Reason.ARM_COLLISION, None, str(error))] * len(rows), str(error))
        target = T_base_ct[:3, :3] @ self.target_ct + T_base_ct[:3, 3]
        requests = [
            ReachRequest(target, T_base_ct[:3, :3] @ outward, self.tool.needle_length_mm, float(standoff))
            for outward, standoff in zip(self.wanted.outward_ct[rows], self.wanted.standoff_mm[rows], strict=True)
        ]
        home = checker.contact(self.home, needle_may_touch_patient=False)
        answers = assess_reach_all(checker, requests)
        touched = "" if home is None else f"{home.body} touches {home.other}"
        return Checked([replace(one, insertion_q=one.insertion_q[-1:]) for one in answers], touched)


def expected_tip_error_mm(case: Case, placement: Placement | None, T_base_ct: Floats, q: Floats) -> float | None:
    """Root mean square over insertions (n, 6) of sqrt(trace(Sigma_dd)); None without declared errors, markers or q.

    How the arm will touch the markers from there nobody has said, so that the arm's own errors do not cancel (2 J_f
    Sigma_eta J_f' stands for them); the residuals of the old touches say nothing of the new ones.

    Args:
        T_base_ct: Shape (4, 4), mm: where the arm is to stand.
        q: Joints (rad) with the tip on the target from there.
    """
    registration = None if placement is None else placement.registration
    if case.errors is None or registration is None or not len(q):
        return None
    covariance = pose_error_from(case, registration, T_base_ct).covariance(q)
    return float(np.sqrt(np.trace(covariance[:, :3, :3], axis1=1, axis2=2).mean()))


def pose_error_from(case: Case, registration: Registration, T_base_ct: Floats) -> PoseError:
    """The needle's pose error from another placement; arguments as above, the case with errors."""
    assert case.errors is not None  # the caller has looked
    errors, old = replace(case.errors, found=False), registration.markers
    markers = MarkerPairs(old.names, old.points_ct, apply(T_base_ct, old.points_ct))
    model, tip = case.robot.model, case.needle.length_mm
    noise = reading_noise(errors, model, tip, touches(case, markers), known=False)
    method = (None if case.registration is None else case.registration.method) or default_method(errors)
    fitted = register(markers, method=method, target_ct=case.target_ct, noise=noise)
    assert fitted.uncertainty is not None  # its markers have noise
    return PoseError(model, tip, apply(T_base_ct, case.target_ct), errors, fitted.uncertainty)


def needle_can_start(
    tool: Tool, skin: TriangleMesh, target_ct: Floats, wanted: WantedDirections, padding_mm: float
) -> NDArray[np.bool_]:
    """Whether the padded needle at standoff is clear of the skin: else no placement can reach the direction.

    Args:
        tool: With the needle.
        skin: CT frame.
        target_ct: Shape (3,), mm.
        wanted: n directions.
        padding_mm: What the arm's checker keeps from the patient.

    Returns:
        Shape (n,).
    """
    start, end = tool.needle_span_mm
    radius, length = tool.needle_diameter_mm / 2 + padding_mm, end - start + 2 * padding_mm
    needle, half = Solid(partial(fcl.Cylinder, radius, length)), np.array([radius, radius, length / 2])
    patient = FclSkin(skin, PATIENT)
    # From the tip, at the standoff from the target, the needle's middle is half its body farther out.
    poses = flange_poses(target_ct, wanted.outward_ct, wanted.standoff_mm + (end - start) / 2)
    clear = np.empty(len(wanted), np.bool_)
    for row, T in enumerate(poses):
        needle.place(fcl.Transform(T[:3, :3], T[:3, 3]))
        clear[row] = not patient.touches(needle, np.array([-half, half]))
    return clear
