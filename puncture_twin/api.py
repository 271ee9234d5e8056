"""The public API: what `puncture_twin` hands on. Lengths are mm, angles degrees, points in the CT frame (LPS).

Each function is what the command of its name does: values in, one value out. Nothing is written but where the name says
so (`export`, `report`, `batch`, ``.write``). Whatever cannot be used is refused by one `InputError`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from puncture_twin.planning.base.arguments import checked, checked_degrees, real_numbers, word_of
from puncture_twin.planning.base.errors import refuse

if TYPE_CHECKING:
    from puncture_twin.planning.case.case import Case
    from puncture_twin.planning.certify.certificate import Certificate
    from puncture_twin.planning.certify.checker import Verification
    from puncture_twin.planning.formats.points import NamedPoints
    from puncture_twin.planning.formats.volumes.volume_files import Volume
    from puncture_twin.planning.geometry.mesh import TriangleMesh
    from puncture_twin.planning.place.search import PlaceSearch
    from puncture_twin.planning.plan.plan import Plan
    from puncture_twin.planning.registration.fits import Method
    from puncture_twin.planning.registration.hand_eye import HandEye, PosePairs
    from puncture_twin.planning.registration.registration import Registration
    from puncture_twin.planning.search.candidates import Candidates, Pick
    from puncture_twin.planning.search.context import CaseContext, EngineChoice
    from puncture_twin.planning.search.explain import Explanation
    from puncture_twin.planning.search.safe_map import BestTarget, SafeMap
    from puncture_twin.planning.visibility.cameras import CameraView
    from puncture_twin.planning.visibility.probe import ProbeView
    from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import Calibration, ShotByShot
    from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording
    from puncture_twin.twin.jobs.batch.jobs import Merged
    from puncture_twin.twin.jobs.choosing.compare_job import Comparison
    from puncture_twin.twin.jobs.experiment.dynamics_job import Dynamics
    from puncture_twin.twin.jobs.experiment.touch_job import TouchRun
    from puncture_twin.twin.jobs.patient.confirm_job import Confirmed
    from puncture_twin.twin.jobs.patient.export_jobs import Written
    from puncture_twin.twin.jobs.patient.markers_job import MarkersRun
    from puncture_twin.twin.rehearsal.result import Rehearsal

    Points = NamedPoints | Mapping[str, ArrayLike]
    """Named points: read from a file, or name to (x, y, z) in mm."""


@checked
def init_case(
    folder: Path | str,
    target: ArrayLike | None = None,
    *,
    target_label: str | None = None,
    hit_radius_mm: float | None = None,
    region: str | None = None,
    space: str | None = None,
    naming: str | None = None,
    unit: str | None = None,
    up: str | None = None,
    ct: str | None = None,
    segmentation: str | None = None,
    skin: str | None = None,
    ignore: Sequence[str] = (),
    unknown: Sequence[str] = (),
    settings: Sequence[str] = (),
    force: bool = False,
) -> Case:
    """Write FOLDER/case.toml from what is in the folder, a CT and its segmentation, and return the case.

    Args:
        target: Shape (3,), mm, in `space`; or `target_label`, whose deepest point it is.
        hit_radius_mm: The target is a ball of its own, in no structure.
        region: What the CT shows; else inferred from the organs.
        space: ``LPS`` or ``RAS``: of the target, of the case, and of meshes; LPS by default.
        naming: Of labels: ``totalsegmentator-v1``, ``-v2``, or a table.
        unit: Of meshes: ``mm``, ``cm`` or ``m``; else inferred from their extent. `up` is their axis ``y`` or ``z``.
        ct: Which file, where the folder holds several; so `segmentation`.
        skin: Structure that is the skin; else the CT's body.
        ignore: Structures or files to be left out; no path may cross those of `unknown`.
        settings: Keys of the case, such as ``ct.arms=none`` or ``search.trust_labels=true``.
        force: Replace a case.toml that is there.

    Raises:
        InputError: Everything that keeps the case from being searched, in one line; nothing is written then.
    """
    from puncture_twin.planning.base.progress import Silent
    from puncture_twin.planning.formats.points import typed_point
    from puncture_twin.planning.geometry.spaces import Space, Unit, Up
    from puncture_twin.planning.init.finder import Wanted
    from puncture_twin.planning.init.overrides import overrides_of
    from puncture_twin.planning.init.start import Request
    from puncture_twin.twin.jobs.patient.init_job import init_case

    for name, texts in (("ignore", ignore), ("unknown", unknown), ("settings", settings)):
        if not all(isinstance(text, str) for text in texts):
            refuse(f"{name} holds what is no text", "init_case", "a list of texts", "wrong_type")
    words = word_of(Space, space), word_of(Unit, unit), word_of(Up, up)
    overrides = overrides_of(skin, list(ignore), list(unknown), list(settings))
    wanted = Wanted(words[0] or Space.LPS, naming, words[1], ct, segmentation, words[2], overrides)
    point = None if target is None else typed_point(target, "init_case: target")
    request = Request(Path(folder), point, target_label, region, wanted, space is not None, hit_radius_mm)
    return load_case(init_case(request, force=force, watcher=Silent()).path)


@checked
def load_case(path: Path | str) -> Case:
    """A validated case, without what its files hold. `prepare` reads those too.

    ``case.replace(target_ct=..., mount=..., needle=...)`` is what the case would be if its file had these values.

    Args:
        path: Case file, or the folder that holds ``case.toml``.
    """
    from puncture_twin.planning.case.case import load_case

    return load_case(path)


@checked
def prepare(case: Case | Path | str, *, arm: bool | None = None, engine: str | EngineChoice = "fast") -> CaseContext:
    """Read a case and all that it names: structures, registration, arm. It can be pickled, and used in threads.

    Args:
        case: A case, such as ``load_case(...).replace(...)``, its file, or the folder that holds ``case.toml``.
        arm: Whether a candidate must be reachable too; None: where the case states the robot's base.
        engine: Who measures clearance: ``fast``, ``fcl`` (the plain reference), or a class of your own that
            implements the protocol `puncture_twin.planning.clearance.engine.ClearanceEngine`. Its distances are
            compared with the fast engine's: where one is larger, the search ends with an error.
    """
    from puncture_twin.planning.search.context import prepare

    return prepare(case, arm=arm, engine=engine)


@checked
def search(context: CaseContext) -> Candidates:
    """Every direction of the case's grid with its verdict, ranked."""
    return context.search()


@checked
def check(
    context: CaseContext,
    theta_deg: float | None = None,
    beta_deg: float | None = None,
    *,
    candidate: Pick | None = None,
    window: int | None = None,
    entry: ArrayLike | None = None,
) -> Explanation:
    """One direction, explained: every constraint with its number and its limit. Without a choice it is the best one.

    Args:
        theta_deg: Puncture angle θ, 0 to 180, with `beta_deg`.
        beta_deg: Azimuth β, 0 to 360.
        candidate: Or one of a search, such as ``candidates.best`` or ``candidates.pick(row)``.
        window: Or the best of this window of the search; 1 holds the best of all.
        entry: Or where the needle enters the skin: shape (3,), mm, in the case's space; or a Slicer file of it.

    Raises:
        NoAnswerError: Nothing is safe, so that nothing is the best.
    """
    from puncture_twin.planning.budget.guidance import explained_ways
    from puncture_twin.planning.search.choice import explain_choice, stated_choice

    explained = explain_choice(context, stated_choice("check", context, theta_deg, beta_deg, candidate, window, entry))
    return explained_ways(context, explained)


@checked
def check_many(context: CaseContext, theta_deg: ArrayLike, beta_deg: ArrayLike) -> Candidates:
    """Many directions at once: a row each, ranked among themselves; without the windows and safe cones of a grid.

    Args:
        theta_deg: Shape (n,), puncture angles θ, 0 to 180.
        beta_deg: Shape (n,), azimuths β, 0 to 360.
    """
    theta = checked_degrees(theta_deg, 180.0, "check_many: theta_deg")
    beta = checked_degrees(beta_deg, 360.0, "check_many: beta_deg")
    if theta.shape != beta.shape:
        refuse(f"{len(theta)} theta and {len(beta)} beta", "check_many", "as many of both", "wrong_shape")
    return context.check(np.radians(theta), np.radians(beta))


@checked
def safe_map(context: CaseContext, target_ct: ArrayLike | None = None) -> SafeMap:
    """Which directions of the case's grid the margins of its structures block, at a target: a verdict, without mm.

    ``blocked`` and ``structure`` have a row a direction. Skin entry and angle, bending, breathing, arm and chances are
    not tested: `check` does that, of the context ``context.at(target_ct)``.

    Args:
        target_ct: Another target in the same structure, shape (3,), mm, LPS (or the case's local frame); None is the
            context's own.

    Raises:
        InputError: A target that the case could not have: outside its structure or the skin, in an organ to be avoided.
    """
    from puncture_twin.planning.search.safe_map import safe_map

    return safe_map(context if target_ct is None else context.at(target_ct))


@checked
def best_target(context: CaseContext, points: int | ArrayLike = 1000) -> BestTarget:
    """Of many points of the target's structure, which one has the widest window, by `safe_map` and the skin.

    ``context.at(found.target_ct)`` goes on from there; ``found.window_deg2`` has a row a point.

    Args:
        points: How many, evenly in the structure; or your own, shape (n, 3), mm, LPS (or the case's local frame).

    Raises:
        NoAnswerError: No point has an open direction.
    """
    from puncture_twin.planning.search.safe_map import best_target

    return best_target(context, points)


@checked
def rerank(candidates: Candidates, cost: ArrayLike) -> Candidates:
    """The candidates ranked by a cost of one's own. Which are safe stays as it is.

    Args:
        cost: Shape (n,), smaller is better; what it says of rejected candidates does not matter.
    """
    from puncture_twin.planning.search.ranking import ranked_by

    return ranked_by(candidates, real_numbers(cost, "rerank", f"{len(candidates)} numbers, shape (n,)"))


@checked
def register(
    markers_ct: Points,
    markers_base: Points,
    *,
    target_ct: ArrayLike,
    method: Method = "rigid",
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
    from puncture_twin.planning.formats.points import named_points
    from puncture_twin.planning.registration import marker_pairs, registration

    pairs = marker_pairs.match(named_points(markers_ct, "register"), named_points(markers_base, "register"), use=None)
    target = named_points({"target": target_ct}, "register: target_ct").points[0]
    return registration.register(pairs, method=method, target_ct=target, fle_mm=fle_mm)


@checked
def markers(
    source: Path | str,
    *,
    kind: str | None = None,
    diameter_mm: float | None = None,
    count: int | None = None,
    layout: Points | None = None,
) -> MarkersRun:
    """The markers on the skin of a CT; ``points`` go to `write_points` or `register`, ``doubtful`` may be more of them.

    Args:
        source: A folder or file with a CT, or a case with one.
        kind: ``ball``, ``disc`` or ``ring``, of all markers.
        diameter_mm: Of all markers, 1 to 15.
        count: How many there are.
        layout: Names them by their distances, in any frame, mm.

    Raises:
        NoAnswerError: No markers, too few or many, or several sizes; it says what was seen.
    """
    from puncture_twin.planning.base.progress import Silent
    from puncture_twin.planning.formats.points import named_points
    from puncture_twin.planning.registration.fiducials import Stated
    from puncture_twin.twin.jobs.patient.markers_job import look_for_markers

    named = None if layout is None else named_points(layout, "markers: layout")
    return look_for_markers(Path(source), Stated(kind, diameter_mm, count), named, "markers: layout", Silent())


@checked
def certify(context: CaseContext, *, size_deg: float = 0.25, touch: float | None = None) -> Certificate:
    """The map between the grid points: cells of directions that are proven safe for the organs, or rejected.

    Args:
        size_deg: Cells are halved down to this size.
        touch: No structure is touched more often than this, 0 to 1, in a safe cell; None proves margins alone.

    Raises:
        InputError: A chance without declared errors, or a case that cannot have a certificate.
    """
    from puncture_twin.planning.certify.subdivision import certify

    error = context.pose_error
    return certify(context.case, context.anatomy, size=float(np.radians(size_deg)), touch=touch, error=error)


@checked
def verify(certificate: Certificate, context: CaseContext) -> Verification:
    """Prove every cell of a certificate again, by a plain checker that shares none of the fast code.

    Raises:
        InputError: A certificate of another case, or a cell whose verdict does not follow.
    """
    from puncture_twin.planning.certify.checker import verify

    return verify(certificate, context.case, context.anatomy, error=context.pose_error)


@checked
def plan(
    context: CaseContext,
    candidates: Candidates | None = None,
    *,
    theta_deg: float | None = None,
    beta_deg: float | None = None,
    candidate: Pick | None = None,
    window: int | None = None,
    entry: ArrayLike | None = None,
    seed: int | None = None,
) -> Plan:
    """Plan a direction: approach and insertion of the arm. Without a choice it is the best that the arm can come to.

    Args:
        context: With the arm.
        candidates: From `search`, or ranked anew by `rerank`; None searches where the choice needs it.
        theta_deg: The choice, as in `check`: two angles, or one of `candidate`, `window` and `entry`.
        seed: Of the approach's planner; the case's by default.

    Raises:
        NoAnswerError: Nothing is safe, what was chosen is rejected, or the arm finds no free approach to it.
    """
    from puncture_twin.planning.budget.guidance import with_ways
    from puncture_twin.planning.plan.planner import make_plan
    from puncture_twin.planning.search.choice import stated_choice

    choice = stated_choice("plan", context, theta_deg, beta_deg, candidate, window, entry)
    return with_ways(context, make_plan(context, candidates, choice, seed=seed).plan)


@checked
def read_plan(path: Path | str, context: CaseContext) -> Plan:
    """A plan from its file, checked against its case again: same inputs, still safe, a motion that touches nothing."""
    from puncture_twin.planning.plan.plan_document import read_plan

    return _own_plan(context, read_plan(Path(path)), str(path))


@checked
def read_certificate(path: Path | str) -> Certificate:
    """A certificate from its file; `verify` proves it."""
    from puncture_twin.planning.certify.certificate import read_certificate

    return read_certificate(Path(path))


@checked
def read_points(path: Path | str) -> NamedPoints:
    """Named points from CSV, Slicer markups (.mrk.json) or .fcsv: mm, and LPS where the file states a space."""
    from puncture_twin.planning.formats.points import read_points

    return read_points(Path(path))


@checked
def write_points(points: Points, path: Path | str) -> None:
    """Write named points as CSV in mm, whole or not at all; the space is not written, a CSV speaks in its case's."""
    from puncture_twin.planning.formats.points import named_points, write_points

    write_points(Path(path), named_points(points, "write_points"))


@checked
def read_mesh(path: Path | str, *, unit: str = "mm", space: str = "LPS", up: str | None = None) -> TriangleMesh:
    """One surface from STL, OBJ, PLY, GLB or VTP, in mm and LPS (or its own frame), checked against its own promises.

    Args:
        unit: ``mm``, ``cm`` or ``m``, of its coordinates; nothing about unit or space is taken from the file.
        space: ``LPS``, ``RAS`` or ``local``.
        up: ``y`` or ``z``, its axis that is up; of GLB it must be stated.
    """
    from puncture_twin.planning.formats.meshes.mesh_files import read_mesh
    from puncture_twin.planning.geometry.spaces import Space, Unit, Up

    known = word_of(Unit, unit) or Unit.MM, word_of(Space, space) or Space.LPS
    return read_mesh(Path(path), unit=known[0], space=known[1], up=word_of(Up, up))


@checked
def read_volume(path: Path | str) -> Volume:
    """A CT or label map from NIfTI or NRRD, or a CT from a DICOM series: its voxels, and where they lie in LPS mm.

    A series is named by its folder, or by any of its files where the folder holds several.
    """
    from puncture_twin.planning.formats.dicom.ct_series import read_series
    from puncture_twin.planning.formats.dicom.storage import is_series
    from puncture_twin.planning.formats.volumes.volume_files import read_volume

    path = Path(path)
    return read_series(path) if is_series(path) else read_volume(path)


@checked
def read_recording(path: Path | str) -> Recording:
    """What two arms and a probe's pictures said, pose by pose: ``recording.csv`` or its folder; see `calibrate`."""
    from puncture_twin.twin.guidance.ultrasound.recording_file import read_recording

    return read_recording(Path(path))


@checked
def calibrate(recording: Recording, *, needle_length_mm: float | None = None) -> Calibration:
    """Probe, needle and both arms to each other (A X P = Y B Q), from a recording of the needle in the image.

    Args:
        recording: At least 16 poses, from `read_recording`.
        needle_length_mm: Flange to tip along the shaft, which holds what the image cannot show; None leaves it open.

    Raises:
        InputError: Too few poses, poses that cannot show every unknown, or more than half of them disagree.
    """
    from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import calibrate

    return calibrate(recording, needle_length_mm=needle_length_mm)


@checked
def read_pose_pairs(path: Path | str, *, motions: bool = False) -> PosePairs:
    """What an arm and the camera on its flange said, pose by pose, from a CSV; see `calibrate_hand_eye`.

    Args:
        path: Columns ``name``, ``A_r11 .. A_z_mm`` (T_base_flange) and ``B_r11 .. B_z_mm`` (T_board_camera).
        motions: Whether rows are motions from pose to pose.
    """
    from puncture_twin.planning.registration.hand_eye import read_pose_pairs

    return read_pose_pairs(Path(path), motions=motions)


@checked
def calibrate_hand_eye(
    pairs: PosePairs,
    *,
    robot_mm: float | None = None,
    robot_deg: float | None = None,
    camera_mm: float | None = None,
    camera_deg: float | None = None,
) -> HandEye:
    """Where a camera is on an arm's flange: A X = Z B of poses, A X = X B of motions.

    Args:
        pairs: At least three poses or two motions, from `read_pose_pairs`.
        robot_mm: Standard deviations of the flange's place, per axis, and of its rotation, and of the camera's; all
            four, or none to find the noise.

    Raises:
        InputError: Too few pairs, rotations about one axis alone, or poses that do not belong together.
    """
    from puncture_twin.planning.registration.hand_eye import calibrate_hand_eye, noise_of

    return calibrate_hand_eye(pairs, noise_of((robot_mm, robot_deg, camera_mm, camera_deg)))


@checked
def calibrate_dynamics(context: CaseContext, recording: Path | str) -> Dynamics:
    """The dynamics of a case's arm from joints and torques over time, and what their error costs at the tip.

    Args:
        recording: Columns ``time_s``, ``q1_deg .. q6_deg``, ``tau1_nm .. tau6_nm``, or RTDE's.

    Raises:
        InputError: It cannot be read, its motion shows too little, or its torques are of another motion.
    """
    from puncture_twin.twin.jobs.experiment.dynamics_job import calibrate_dynamics

    return calibrate_dynamics(context, Path(recording))


@checked
def shot_by_shot(calibration: Calibration) -> ShotByShot:
    """A calibration that further shots update, one pose at a time: ``after = before.with_shot(pose)``.

    ``after.shots[-1]`` says whether it fits, and ``after.calibration()`` is the calibration with it.

    Raises:
        InputError: The calibration holds a needle length; state it to ``calibration()`` instead.
    """
    from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import ShotByShot

    return ShotByShot.of(calibration)


@checked
def check_folder(folder: Path | str) -> tuple[str, ...]:
    """What keeps an output folder from being one whole set, a sentence each; empty if nothing does."""
    from puncture_twin.planning.base.output.manifest import problems

    return problems(Path(folder))


@checked
def write_plan(plan: Plan, path: Path | str) -> None:
    """Write a plan as JSON, whole or not at all."""
    from puncture_twin.planning.plan.plan_document import write_plan

    write_plan(plan, Path(path))


@checked
def rehearse(
    context: CaseContext,
    plan: Plan,
    *,
    seed: int | None = None,
    seeds: int | None = None,
    physics: int = 0,
    guidance: str | None = None,
    steps: int | None = None,
) -> Rehearsal:
    """Execute a plan in the twin, where the ground truth differs from the belief.

    Args:
        seed: What the ground truth is drawn from; the case's by default.
        seeds: Draw so many rooms: the median one is executed, and ``distribution`` holds all.
        physics: So many of them are executed in the simulator too.
        guidance: How the needle is led in the rooms: ct, stereo, us, us+tip, ct+stereo, ct+us, ct+us+tip or all, by the
            devices that the case declares, or assumed ones, in bodies that move as it declares; None by the markers, in
            bodies at rest.
        steps: Of ct: after each of so many, 1 to 10, a control scan is read and the needle corrected.

    Raises:
        NoAnswerError: The arm reaches the target in none of the rooms.
    """
    from puncture_twin.planning.base.errors import require_extra

    require_extra("twin", "rehearse")
    from puncture_twin.twin.jobs.patient.rehearsed import rehearse_once
    from puncture_twin.twin.jobs.patient.run import trial_count

    rooms = trial_count(seeds, physics, guidance, steps)
    return rehearse_once(context, _own_plan(context, plan, "rehearse: plan"), rooms, seed)


@checked
def camera_view(context: CaseContext, plan: Plan) -> CameraView:
    """Where two cameras look from, and what both see of the balls on the needle and of the markers at each depth.

    Args:
        context: With the arm, of a case with ``[stereo]``.

    Raises:
        NoAnswerError: The surroundings leave no place for cameras that the case does not state.
    """
    from puncture_twin.planning.visibility.cameras import camera_view

    return camera_view(context, _own_plan(context, plan, "camera_view: plan"))


@checked
def probe_view(context: CaseContext, plan: Plan) -> ProbeView:
    """Where an ultrasound probe on an arm of its own sees needle and target; or that it does not, why, and the way out.

    Args:
        context: With the arm, of a case with ``[ultrasound]``.
    """
    from puncture_twin.planning.visibility.probe import probe_view

    return probe_view(context, _own_plan(context, plan, "probe_view: plan"))


@checked
def touch(
    context: CaseContext,
    *,
    theta_deg: float | None = None,
    beta_deg: float | None = None,
    candidate: Pick | None = None,
    window: int | None = None,
    entry: ArrayLike | None = None,
    seed: int = 0,
) -> TouchRun:
    """Plan how the markers are touched for a puncture, and touch them in the twin; ``points`` are what was read.

    Args:
        context: With the arm, declared errors and markers.
        theta_deg: The choice of the puncture, as in `check`; without one the best.
        seed: Of the motions and of the truth.

    Raises:
        NoAnswerError: Nothing is safe, or too few markers can be touched.
    """
    from puncture_twin.planning.base.errors import require_extra
    from puncture_twin.planning.search.choice import stated_choice

    require_extra("twin", "touch")
    from puncture_twin.twin.jobs.experiment.touch_job import touch

    return touch(context, stated_choice("touch", context, theta_deg, beta_deg, candidate, window, entry), seed)


@checked
def confirm(context: CaseContext, scan: Path | str, *, plan: Path | str | None = None) -> Confirmed:
    """The needle in a control CT: where it is, what the line that it takes comes near to, and what to do next.

    Args:
        scan: A DICOM folder or a file in it, NIfTI or NRRD; of the same patient, in any frame.
        plan: The ``plan.json`` that was executed, to compare.

    Raises:
        InputError: A scan that cannot be read, or tied to the case; no needle, two of them, or a tip that is not seen.
    """
    from puncture_twin.twin.jobs.patient.confirm_job import ScanFiles, confirm_needle

    return confirm_needle(context, ScanFiles(Path(scan)), None if plan is None else Path(plan))


@checked
def place(context: CaseContext, *, jobs: int = 2, quick_s: float | None = None) -> PlaceSearch:
    """The base positions from which the arm reaches most organ-safe directions; ``rated`` has the best first.

    ``prepare(context.case.replace(mount=dict(found.rated[0].mount)))`` is the case with the arm there.

    Args:
        jobs: Processes; the answer of a whole search is the same.
        quick_s: Stop after about this time with the best so far; ``complete`` is then False. A fraction of a verdict
            whose ``count`` is below ``directions`` is an estimate. None searches to the end.

    Raises:
        NoAnswerError: No direction is safe for the organs, or the arm reaches none from any placement.
    """
    from puncture_twin.twin.jobs.patient.place_job import find_places, refuse_unreached

    found = find_places(context, jobs, math.inf if quick_s is None else time.perf_counter() + quick_s).search
    refuse_unreached(found)
    return found


@checked
def compare(
    context: CaseContext,
    one: Explanation | Plan | Pick,
    other: Explanation | Plan | Pick,
    *,
    candidates: Candidates | None = None,
) -> Comparison:
    """Two paths of a case side by side: numbers, and why one is not safe. ``text()`` is the command's table.

    Args:
        one: From `check` or `plan`, or a candidate such as ``candidates.best``; so is the other.
        candidates: From `search`, for ranks and windows; None searches.
    """
    from puncture_twin.planning.search.candidates import Pick
    from puncture_twin.planning.search.explain import Explanation
    from puncture_twin.twin.jobs.choosing.compare_job import compare_paths

    paths = [check(context, candidate=path) if isinstance(path, Pick) else path for path in (one, other)]
    for path in paths:
        if isinstance(path, Explanation):
            context.own(path.candidates)
    return compare_paths(context, context.own(candidates), *zip(("one", "other"), paths, strict=True))


@checked
def export(
    source: Plan | Candidates | Explanation, format_name: str, folder: Path | str, *, context: CaseContext | None = None
) -> Written:
    """Write a plan for a robot, the table of candidates, or a direction for 3D Slicer or an archive; read back.

    Args:
        source: A plan (``urscript``, ``ros2``, ``csv``, ``moveit``, or another package's format; ``plan.json`` is
            written beside it), candidates (``candidates-csv``, ``candidates-json``), or a checked direction
            (``slicer``, ``dicom``).
        context: The plan is checked again against this case, and corners are rounded where that is free; ``moveit``,
            ``slicer`` and ``dicom`` need it.
    """
    from puncture_twin.twin.jobs.patient.export_jobs import export_value

    return export_value(source, format_name, folder, context)


@checked
def report(
    context: CaseContext,
    candidates: Candidates,
    folder: Path | str,
    *,
    plan: Plan | None = None,
    rehearsal: Rehearsal | None = None,
) -> Path:
    """Write the page and the pictures of a search, and of a plan and its rehearsal, and return the page's path.

    Args:
        folder: Made where it is missing.
        plan: Shown as the chosen path; `rehearsal` is of it.
    """
    from puncture_twin.planning.base.files import check_writable
    from puncture_twin.twin.jobs.patient.main_job import report_case
    from puncture_twin.twin.jobs.patient.run import PAGE, Run

    if rehearsal is not None and plan is None:
        refuse("a rehearsal without its plan", "report", "plan=... beside it", "missing_option")
    candidates = context.own(candidates)
    plan = None if plan is None else _own_plan(context, plan, "report: plan")
    pick = None if plan is None else context.check(plan.theta, plan.beta).pick(0)
    distribution = None if rehearsal is None else rehearsal.distribution
    out = check_writable(folder)
    report_case(Run(context, candidates, (), plan, rehearsal=rehearsal, distribution=distribution, pick=pick), out)
    return out / PAGE


@checked
def batch(
    cohort: Path | str,
    folder: Path | str,
    *,
    jobs: int = 1,
    arm: bool | None = None,
    expect: Path | str | None = None,
    tolerance_mm: float = 0.01,
) -> Merged:
    """Search every case of a cohort, and merge them: what `batch plan`, `batch run` and `batch merge` do.

    What has its result in the folder already is not searched again.

    Args:
        cohort: A folder of cases, a CSV with the column ``case``, or a ``cohort.toml``.
        folder: The cohort's results.
        jobs: 1 searches in this process; more start so many others, and a script then needs Python's usual
            ``if __name__ == "__main__":``.
        arm: Whether a candidate must be reachable too; None asks it where a case says where the robot's base is.
        expect: An earlier ``cases.parquet``, or its folder; ``changed`` then lists what differs.
        tolerance_mm: By so much a best clearance may differ from it.

    Raises:
        InputError: No cohort, or a folder that cannot be written to. A case that cannot be read is a row that says so.
    """
    from puncture_twin.planning.base.files import check_writable
    from puncture_twin.planning.base.progress import Silent
    from puncture_twin.planning.batch.run import run_cohort
    from puncture_twin.planning.batch.run_case import run_here
    from puncture_twin.twin.jobs.batch.jobs import merge_cohort, plan_cohort

    out, watcher = check_writable(folder), Silent()
    plan_cohort(Path(cohort), out, arm=arm, dry=False, watcher=watcher)
    run_cohort(out, watcher, jobs=jobs, elsewhere=run_here if jobs == 1 else None)
    return merge_cohort(out, None if expect is None else Path(expect), tolerance_mm, watcher)


def _own_plan(context: CaseContext, plan: Plan, where: str) -> Plan:
    """A plan that holds in this case, whatever it was made for or has become since."""
    from puncture_twin.planning.budget.guidance import check_ways
    from puncture_twin.planning.plan.plan_check import check_plan, with_case_arm

    check_plan(plan, context, Path(where))
    check_ways(context, plan, where)
    return with_case_arm(plan, context.case)
