"""The question that a certificate answers: everything but the surfaces that a verdict depends on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.structure import Structure
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.provenance import Input
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.certify.cells import Cells
from puncture_twin.planning.reach.standoff import farthest_flange
from puncture_twin.planning.uncertainty.pose_error import PoseError, any_pose

MOST_TOUCH = 0.5
"""More than every other needle is no limit."""


@dataclass(frozen=True, eq=False)
class Question:
    """The question of a certificate: everything but the surfaces that a verdict depends on; mm and rad."""

    case_name: str
    inputs: tuple[Input, ...]
    target_ct: Floats
    """Shape (3,)."""
    R_ct_entry: Floats
    """Shape (3, 3)."""
    theta: tuple[float, float]
    """The cap's lowest and highest angle, as ``beta``."""
    beta: tuple[float, float]
    length: float
    standoff: float | None
    """Distance tip to target before the insertion where the case states one, else None."""
    skin_gap: float
    """The least distance from the waiting tip to the skin, along the needle."""
    farthest: float
    """The flange's greatest distance from the target while the tip waits: how far skin matters."""
    radius: float
    longest: float
    max_skin_angle: float
    structures: tuple[str, ...]
    """Names of the k structures that demand a margin."""
    margins: Floats
    """Shape (k,), their margins; with ``touch`` at least so wide that the chance is kept."""
    touch: float | None = None
    """The chance to touch each structure that no safe cell exceeds; None asks for none."""

    def cap(self) -> Cells:
        """The whole cap of directions as one cell."""
        return Cells(np.array([self.theta], float), np.array([self.beta], float))


def question_of(
    case: Case,
    anatomy: Anatomy,
    *,
    theta: tuple[float, float] | None = None,
    beta: tuple[float, float] | None = None,
    touch: float | None = None,
    error: PoseError | None = None,
) -> Question:
    """The question that a certificate of a case answers; see `certify`."""
    for table, declared, straight in (
        ("breathing", case.breathing, "a body that does not move"),
        ("tissue", case.bending, "a needle that does not bend"),
    ):
        if declared is not None:
            what = f"[{table}]: a certificate proves {straight}"
            refuse(what, case.path, f"a case without [{table}]; or a search, which includes it", "not_certifiable")
    theta, beta = theta or case.search.theta, beta or case.search.beta
    if not (0 <= theta[0] <= theta[1] <= np.pi + 1e-12 and beta[0] <= beta[1] <= beta[0] + 2 * np.pi + 1e-12):
        refuse("the cap is not a range of angles", "certify", "theta 0 to 180, beta 0 to 360", "out_of_range")
    demanding = [s for s in anatomy.checked if s.demands_margin]
    margins = np.array([s.margin_mm for s in demanding], dtype=np.float64)
    if touch is not None:  # where it is more than a margin, what keeps the chance in any configuration
        margins = np.maximum(margins, _kept(case, demanding, touch, error))
    return Question(
        case_name=case.name,
        inputs=case.inputs,
        target_ct=case.target_ct,
        R_ct_entry=case.T_ct_entry[:3, :3],
        theta=(float(theta[0]), float(theta[1])),
        beta=(float(beta[0]), float(beta[1])),
        length=case.needle.length_mm,
        standoff=case.needle.standoff_mm,
        skin_gap=case.needle.skin_gap_mm,
        farthest=farthest_flange(case.needle, case.search.max_skin_angle),
        radius=case.needle.radius_mm,
        longest=case.needle.longest_path_mm,
        max_skin_angle=float(case.search.max_skin_angle),
        structures=tuple(s.name for s in demanding),
        margins=margins,
        touch=touch,
    )


def _kept(case: Case, demanding: list[Structure], touch: float, error: PoseError | None) -> Floats:
    """Clearances, (k,), mm, at which structures are touched no more often than ``touch``."""
    if not 0.0 < touch <= MOST_TOUCH:
        refuse(f"chance to touch {touch:g}", "certify", f"above 0, at most {MOST_TOUCH:g}", "out_of_range")
    if error is None:
        message = "a chance to touch cannot be certified: the needle's error needs markers and [errors]"
        refuse(message, case.path, "[registration] with markers, and [errors]; or no such limit", "not_certifiable")
    farthest = np.array([np.linalg.norm(s.mesh.vertices - case.target_ct, axis=1).max() for s in demanding])
    waiting = farthest_flange(case.needle, case.search.max_skin_angle)
    lengths = np.array([waiting if s.outside else case.needle.length_mm for s in demanding])
    surface_mm = np.sqrt([np.linalg.eigvalsh(error.surface_cov_ct(s.voxel_ct))[-1] for s in demanding])
    return any_pose(error).margin(touch, error.freedom, farthest, lengths, case.needle.radius_mm, surface_mm)
