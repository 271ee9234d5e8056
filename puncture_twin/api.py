"""The public API: what `puncture_twin` hands on. Lengths are mm; angles are degrees where a name ends in ``_deg``.

Each function composes rooms of `planning` and `twin`; the rooms may be used by themselves for more.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike

from puncture_twin.planning.base.errors import InputError

if TYPE_CHECKING:
    from puncture_twin.planning.case.case import Case
    from puncture_twin.planning.certify.certificate import Certificate
    from puncture_twin.planning.certify.checker import Verification
    from puncture_twin.planning.formats.points import NamedPoints
    from puncture_twin.planning.formats.volumes.volume_files import Volume
    from puncture_twin.planning.geometry.mesh import TriangleMesh
    from puncture_twin.planning.plan.plan import Plan
    from puncture_twin.planning.registration.registration import Registration
    from puncture_twin.planning.search.candidates import Candidates
    from puncture_twin.planning.search.context import CaseContext
    from puncture_twin.planning.search.explain import Explanation
    from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import Calibration
    from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording
    from puncture_twin.twin.rehearsal.result import Rehearsal

    Points = NamedPoints | Mapping[str, ArrayLike]
    """Named points: read from a file, or name to (x, y, z) in mm."""


def load_case(path: Path | str) -> Case:
    """A validated case, without what its files hold. `prepare` reads those too.

    Args:
        path: Case file, or the folder that holds ``case.toml``.

    Raises:
        InputError: One line: what is wrong, where, and what is allowed.
    """
    from puncture_twin.planning.case.read_case import load_case

    return load_case(path)


def prepare(case: Path | str, *, arm: bool | None = None, engine: str = "fast") -> CaseContext:
    """Read a case and all that it names: structures, registration, arm.

    Args:
        case: Case file, or the folder that holds ``case.toml``.
        arm: Whether a candidate must be reachable too; None asks it where the case says where the robot's base is.
        engine: ``fast``, or ``fcl``, the plain reference.

    Raises:
        InputError: Anything in the case that cannot be used.
    """
    from puncture_twin.planning.search.context import prepare

    return prepare(case, arm=arm, engine=engine)


def search(context: CaseContext) -> Candidates:
    """Every direction of the case's grid with its verdict, ranked."""
    return context.search()


def check(context: CaseContext, theta_deg: float, beta_deg: float) -> Explanation:
    """One direction, explained: every constraint with its number and its limit.

    Args:
        context: From `prepare`.
        theta_deg: Puncture angle θ, 0..180.
        beta_deg: Azimuth β, 0..360.

    Raises:
        InputError: An angle outside of its range.
    """
    if not (0.0 <= theta_deg <= 180.0 and 0.0 <= beta_deg <= 360.0):
        what = f"theta {theta_deg}, beta {beta_deg}"
        raise InputError(what, where="check", allowed="theta_deg 0 to 180, beta_deg 0 to 360", code="out_of_range")
    return context.explain(float(np.radians(theta_deg)), float(np.radians(beta_deg)))


def rerank(candidates: Candidates, cost: ArrayLike) -> Candidates:
    """The candidates ranked by a cost of one's own. Which are safe stays as it is.

    Args:
        candidates: From `search`.
        cost: Shape (n,), smaller is better; what it says of rejected candidates does not matter.

    Raises:
        InputError: Another shape, or a safe candidate without a finite cost.
    """
    from puncture_twin.planning.search.ranking import ranked_by

    return ranked_by(candidates, np.asarray(cost))


def register(
    markers_ct: Points,
    markers_base: Points,
    *,
    target_ct: ArrayLike,
    method: Literal["triad", "rigid"] = "rigid",
    fle_mm: float | None = None,
) -> Registration:
    """CT to robot base from markers alone, with residuals and the error to expect at the target.

    Args:
        markers_ct: In the CT frame (LPS, mm).
        markers_base: The same names as the robot touched them (mm).
        target_ct: Shape (3,), where the error matters.
        method: ``rigid`` (least squares) or ``triad`` (Chen 2019, Eq. 1-9, three markers).
        fle_mm: Known localisation error (rms, both sides together); None estimates it from the residuals.

    Raises:
        InputError: Names that do not match, collinear or mirrored markers, residuals that the noise does not explain.
    """
    from puncture_twin.planning.registration import marker_pairs, registration

    pairs = marker_pairs.match(_named(markers_ct, "register"), _named(markers_base, "register"), use=None)
    target = _named({"target": target_ct}, "register: target_ct").points[0]
    return registration.register(pairs, method=method, target_ct=target, fle_mm=fle_mm)


def certify(context: CaseContext, *, size_deg: float = 0.25) -> Certificate:
    """The map between the grid points: cells of directions that are proven safe for the organs, or rejected.

    Args:
        context: From `prepare`.
        size_deg: Cells are halved down to this size.
    """
    from puncture_twin.planning.certify.subdivision import certify

    return certify(context.case, context.anatomy, size=float(np.radians(size_deg)))


def verify(certificate: Certificate, context: CaseContext) -> Verification:
    """Prove every cell of a certificate again, by a plain checker that shares none of the fast code.

    Raises:
        InputError: A certificate of another case, or a cell whose verdict does not follow.
    """
    from puncture_twin.planning.certify.checker import verify

    return verify(certificate, context.case, context.anatomy)


def make_plan(context: CaseContext, candidates: Candidates, *, seed: int | None = None) -> Plan:
    """The best candidate that the arm can come to, with its approach and insertion.

    Args:
        context: From `prepare`, with the arm.
        candidates: From `search`, or ranked anew by `rerank`.
        seed: Of the approach's planner; the case's by default.

    Raises:
        InputError: The case does not say where the robot's base is.
        NoAnswerError: No candidate is safe, or none of the best has a free approach.
    """
    from puncture_twin.planning.plan.planner import make_plan

    return make_plan(context, candidates, seed=context.case.rehearsal.seed if seed is None else seed).plan


def read_plan(path: Path | str, context: CaseContext) -> Plan:
    """A plan from its file, checked against its case again: same inputs, still safe, a motion that touches nothing.

    Raises:
        InputError: It cannot be read, or it does not hold any more.
    """
    from puncture_twin.planning.plan.plan_check import with_case_arm
    from puncture_twin.planning.plan.plan_document import read_plan
    from puncture_twin.planning.plan.recheck import check_plan

    plan = read_plan(Path(path))
    check_plan(plan, context, Path(path))
    return with_case_arm(plan, context.case)


def read_certificate(path: Path | str) -> Certificate:
    """A certificate from its file; `verify` proves it.

    Raises:
        InputError: Not a certificate, another version, missing or contradicting parts.
    """
    from puncture_twin.planning.certify.certificate import read_certificate

    return read_certificate(Path(path))


def read_points(path: Path | str) -> NamedPoints:
    """Named points from CSV, Slicer markups (.mrk.json) or .fcsv: mm, and LPS where the file states a space.

    Raises:
        InputError: It cannot be read, or is not whole.
    """
    from puncture_twin.planning.formats.points import read_points

    return read_points(Path(path))


def write_points(points: Points, path: Path | str) -> None:
    """Write named points as CSV in mm, whole or not at all; the space is not written, a CSV speaks in its case's.

    Raises:
        InputError: A point that is not three finite numbers, or a place that cannot be written to.
    """
    from puncture_twin.planning.formats.points import write_points

    write_points(Path(path), _named(points, "write_points"))


def read_mesh(path: Path | str, *, unit: str = "mm", space: str = "LPS", up: str | None = None) -> TriangleMesh:
    """One surface from STL, OBJ, PLY, GLB or VTP, in mm and LPS (or its own frame), checked against its own promises.

    Args:
        path: The file; nothing about unit or space is taken from it.
        unit: ``mm``, ``cm`` or ``m``: of its coordinates.
        space: ``LPS``, ``RAS`` or ``local``: of its coordinates.
        up: ``y`` or ``z``, its axis that is up; of GLB it must be stated.

    Raises:
        InputError: It is cut, contradicts itself, is empty, or has coordinates that are no finite numbers.
    """
    from puncture_twin.planning.formats.meshes.mesh_files import read_mesh
    from puncture_twin.planning.geometry.spaces import Space, Unit, Up

    try:
        known, axis = (Unit(unit), Space(space)), None if up is None else Up(up)
    except ValueError as error:
        allowed = "mm, cm or m; LPS, RAS or local; y or z"
        raise InputError(
            f"unit {unit!r}, space {space!r}, up {up!r}", where=str(path), allowed=allowed, code="unknown_choice"
        ) from error
    return read_mesh(Path(path), unit=known[0], space=known[1], up=axis)


def read_volume(path: Path | str) -> Volume:
    """A CT or label map from NIfTI or NRRD, or a CT from a DICOM series: its voxels, and where they lie in LPS mm.

    A series is named by its folder, or by any of its files where the folder holds several.

    Raises:
        InputError: It is cut, contradicts itself, or holds a voxel that is no finite number.
    """
    from puncture_twin.planning.formats.dicom.ct_series import read_series
    from puncture_twin.planning.formats.dicom.storage import is_series
    from puncture_twin.planning.formats.volumes.volume_files import read_volume

    path = Path(path)
    return read_series(path) if is_series(path) else read_volume(path)


def read_recording(path: Path | str) -> Recording:
    """What two arms and a probe's image said, pose by pose, from ``recording.csv`` or its folder; see `calibrate`.

    Raises:
        InputError: It cannot be read, or a row is no pair of rigid motions with a point.
    """
    from puncture_twin.twin.guidance.ultrasound.recording_file import read_recording

    return read_recording(Path(path))


def calibrate(recording: Recording, *, needle_length_mm: float | None = None) -> Calibration:
    """Probe, needle and both arms to each other (A X P = Y B Q), from a recording of the needle in the image.

    Args:
        recording: At least 16 poses, from `read_recording`.
        needle_length_mm: Flange to tip along the shaft, which holds what the image cannot show; None leaves it open.

    Raises:
        InputError: Too few poses, poses that cannot show every unknown, or more than half of them disagree.
    """
    from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibrate import calibrate

    return calibrate(recording, needle_length_mm=needle_length_mm)


def check_folder(folder: Path | str) -> tuple[str, ...]:
    """What keeps an output folder from being one whole set, a sentence each; empty if nothing does.

    Raises:
        InputError: Its ``manifest.json`` cannot be read, or is another program's.
    """
    from puncture_twin.planning.base.output.manifest import problems

    return problems(Path(folder))


def write_plan(plan: Plan, path: Path | str) -> None:
    """Write a plan as JSON, whole or not at all."""
    from puncture_twin.planning.plan.plan_document import write_plan

    write_plan(plan, Path(path))


def rehearse(context: CaseContext, plan: Plan, *, seed: int | None = None) -> Rehearsal:
    """Execute a plan in the twin, where the ground truth differs from the belief.

    Args:
        context: The plan's case.
        plan: From `make_plan` or `read_plan`.
        seed: What the ground truth is drawn from; the case's by default.

    Raises:
        InputError: The extra ``twin`` is not installed.
    """
    from puncture_twin.planning.base.errors import require_extra

    require_extra("twin", "rehearse")
    from puncture_twin.twin.rehearsal.plan_truth import plan_truth
    from puncture_twin.twin.rehearsal.rehearsal import rehearse

    return rehearse(plan, context.case, context.anatomy, plan_truth(context, plan, seed))


def _named(points: Points, where: str) -> NamedPoints:
    """Named points, from whichever form.

    Raises:
        InputError: A point that is not three finite numbers.
    """
    from puncture_twin.planning.formats.guard import guard_points
    from puncture_twin.planning.formats.points import NamedPoints

    if isinstance(points, NamedPoints):
        return points
    allowed = "name to three finite numbers, mm"
    try:
        values = np.array([np.asarray(point, dtype=np.float64) for point in points.values()])
    except (TypeError, ValueError) as error:
        raise InputError(
            f"a point is no three numbers ({error})", where=where, allowed=allowed, code="not_a_number"
        ) from error
    if values.ndim != 2 or values.shape[1] != 3:
        raise InputError(f"points of shape {values.shape}", where=where, allowed=allowed, code="wrong_shape")
    return NamedPoints(tuple(points), guard_points(values, tuple(points), where=where), None)
