"""The public API: what `puncture_twin` hands on. Lengths are mm, angles degrees, points in the CT frame (LPS).

Each function is what the command of its name does: values in, one value out. Nothing is written but where the name says
so (`export`, `report`, `batch`, ``.write``). Whatever cannot be used is refused by one `InputError`.
"""

from __future__ import annotations

import functools
import inspect
import math
import numbers
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple, ParamSpec, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from puncture_twin.planning.base.errors import InputError, refuse

if TYPE_CHECKING:
    from puncture_twin.planning.base.arrays import Floats
    from puncture_twin.planning.case.case import Case
    from puncture_twin.planning.certify.certificate import Certificate
    from puncture_twin.planning.certify.checker import Verification
    from puncture_twin.planning.formats.points import NamedPoints
    from puncture_twin.planning.formats.volumes.volume_files import Volume
    from puncture_twin.planning.geometry.mesh import TriangleMesh
    from puncture_twin.planning.plan.plan import Plan
    from puncture_twin.planning.registration.method import Method
    from puncture_twin.planning.registration.registration import Registration
    from puncture_twin.planning.search.candidates import Candidates, Pick
    from puncture_twin.planning.search.choice import Choice
    from puncture_twin.planning.search.context import CaseContext
    from puncture_twin.planning.search.explain import Explanation
    from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import Calibration
    from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording
    from puncture_twin.twin.rehearsal.result import Rehearsal

    Points = NamedPoints | Mapping[str, ArrayLike]
    """Named points: read from a file, or name to (x, y, z) in mm."""


Given = ParamSpec("Given")
Found = TypeVar("Found")

RANGES: Mapping[str, tuple[float, float]] = MappingProxyType(
    {"seed": (0, 2**31 - 1), "seeds": (1, 1_000_000), "jobs": (1, 1024), "size_deg": (0.05, 10), "fle_mm": (0.001, 1e3)}
)
"""Least and greatest of an argument, by its name."""


def _public(function: Callable[Given, Found]) -> Callable[Given, Found]:
    """Hold each argument against its annotation and `RANGES` before the function sees it.

    Annotations are read as words: whoever only registers markers loads no simulator for the sake of a type.
    """
    signature = inspect.signature(function)
    words = {name: one.annotation.split(" | ") for name, one in signature.parameters.items()}

    @functools.wraps(function)
    def guarded(*arguments: Given.args, **named: Given.kwargs) -> Found:
        for name, value in signature.bind(*arguments, **named).arguments.items():
            if not any(_is(word, value) for word in words[name]):
                allowed = " or ".join(KINDS[word].text if word in KINDS else word for word in words[name])
                refuse(f"{name} is {_short(value)}", function.__name__, allowed, "wrong_type")
            if isinstance(value, numbers.Real):
                _check_number(name, float(value), function.__name__)
        return function(*arguments, **named)

    return guarded


def _check_number(name: str, value: float, where: str) -> None:
    low, high = RANGES.get(name, (-math.inf, math.inf))
    if not math.isfinite(value):
        refuse(f"{name} is {value}", where, "a finite number", "not_finite")
    if not low <= value <= high:
        refuse(f"{name} is {value:g}", where, f"{low:g} to {high:g}", "out_of_range")


def _is(word: str, value: object) -> bool:
    """Whether a value is of the kind that one word of an annotation names."""
    if word in KINDS:
        return KINDS[word].holds(value)
    return word.partition("[")[0] in {kind.__name__ for kind in type(value).__mro__}


def _is_path(value: object) -> bool:
    """Whether a file may have this name, whether or not there is one."""
    if not isinstance(value, str | Path):
        return False
    try:
        name = os.fsencode(value)
    except UnicodeEncodeError:
        return False
    return b"\0" not in name and len(name) < MOST_PATH and max(map(len, name.split(b"/"))) <= MOST_NAME


MOST_PATH, MOST_NAME = 4096, 255
"""Bytes of a path and of a name in it, of Linux."""


class Kind(NamedTuple):
    """What a word of an annotation means that is no class of this project."""

    text: str
    holds: Callable[[Any], bool]


KINDS: Mapping[str, Kind] = MappingProxyType(
    {
        "None": Kind("None", lambda value: value is None),
        "bool": Kind("True or False", lambda value: isinstance(value, bool)),
        "int": Kind("a whole number", lambda one: isinstance(one, numbers.Integral) and not isinstance(one, bool)),
        "float": Kind("a number", lambda value: isinstance(value, numbers.Real) and not isinstance(value, bool)),
        "str": Kind("text", _is_path),
        "Path": Kind("a path", _is_path),
        "Method": Kind("rigid or triad", lambda value: isinstance(value, str)),
        "ArrayLike": Kind("an array", lambda value: value is not None),
        "Points": Kind("points by their names", lambda value: isinstance(value, Mapping) or _is("NamedPoints", value)),
    }
)


def _short(value: object) -> str:
    """A value in an error: what it is, and a number or text itself."""
    return repr(value)[:80] if isinstance(value, int | float | complex | str) else f"of type {type(value).__name__}"


@_public
def load_case(path: Path | str) -> Case:
    """A validated case, without what its files hold. `prepare` reads those too.

    Args:
        path: Case file, or the folder that holds ``case.toml``.

    Raises:
        InputError: One line: what is wrong, where, and what is allowed.
    """
    from puncture_twin.planning.case.case import load_case

    return load_case(path)


@_public
def prepare(case: Case | Path | str, *, arm: bool | None = None, engine: str = "fast") -> CaseContext:
    """Read a case and all that it names: structures, registration, arm. It can be pickled, and used in threads.

    Args:
        case: A case, such as ``load_case(...).replace(...)``, its file, or the folder that holds ``case.toml``.
        arm: Whether a candidate must be reachable too; None asks it where the case says where the robot's base is.
        engine: ``fast``, or ``fcl``, the plain reference.

    Raises:
        InputError: Anything in the case that cannot be used.
    """
    from puncture_twin.planning.search.context import prepare

    return prepare(case, arm=arm, engine=engine)


@_public
def search(context: CaseContext) -> Candidates:
    """Every direction of the case's grid with its verdict, ranked."""
    return context.search()


@_public
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
        context: From `prepare`.
        theta_deg: Puncture angle θ, 0 to 180, with `beta_deg`.
        beta_deg: Azimuth β, 0 to 360.
        candidate: Or one of a search, such as ``candidates.best`` or ``candidates.pick(row)``.
        window: Or the best of this window of the search; 1 holds the best of all.
        entry: Or where the needle enters the skin: shape (3,), mm, in the case's space; or a Slicer file of it.

    Raises:
        InputError: An angle outside of its range, two choices, or an entry from which no straight path enters there.
        NoAnswerError: Nothing is safe, so that nothing is the best.
    """
    from puncture_twin.planning.search.choice import explain_choice

    return explain_choice(context, _choice("check", theta_deg, beta_deg, candidate, window, entry))


@_public
def check_many(context: CaseContext, theta_deg: ArrayLike, beta_deg: ArrayLike) -> Candidates:
    """Many directions at once: a row each, ranked among themselves; without the windows and safe cones of a grid.

    Args:
        context: From `prepare`.
        theta_deg: Shape (n,), puncture angles θ, 0 to 180.
        beta_deg: Shape (n,), azimuths β, 0 to 360.

    Raises:
        InputError: No directions, two lengths, or an angle outside of its range.
    """
    theta = _angles(theta_deg, 180.0, "check_many: theta_deg")
    beta = _angles(beta_deg, 360.0, "check_many: beta_deg")
    if theta.shape != beta.shape:
        refuse(f"{len(theta)} theta and {len(beta)} beta", "check_many", "as many of both", "wrong_shape")
    return context.check(np.radians(theta), np.radians(beta))


@_public
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


@_public
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
    from puncture_twin.planning.registration import marker_pairs, registration

    pairs = marker_pairs.match(_named(markers_ct, "register"), _named(markers_base, "register"), use=None)
    target = _named({"target": target_ct}, "register: target_ct").points[0]
    return registration.register(pairs, method=method, target_ct=target, fle_mm=fle_mm)


@_public
def certify(context: CaseContext, *, size_deg: float = 0.25) -> Certificate:
    """The map between the grid points: cells of directions that are proven safe for the organs, or rejected.

    Args:
        context: From `prepare`.
        size_deg: Cells are halved down to this size.
    """
    from puncture_twin.planning.certify.subdivision import certify

    return certify(context.case, context.anatomy, size=float(np.radians(size_deg)))


@_public
def verify(certificate: Certificate, context: CaseContext) -> Verification:
    """Prove every cell of a certificate again, by a plain checker that shares none of the fast code.

    Raises:
        InputError: A certificate of another case, or a cell whose verdict does not follow.
    """
    from puncture_twin.planning.certify.checker import verify

    return verify(certificate, context.case, context.anatomy)


@_public
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
        context: From `prepare`, with the arm.
        candidates: From `search`, or ranked anew by `rerank`; None searches where the choice needs it.
        theta_deg: Puncture angle θ, 0 to 180, with `beta_deg`.
        beta_deg: Azimuth β, 0 to 360.
        candidate: Or one of a search, such as ``candidates.best`` or ``candidates.pick(row)``.
        window: Or the best of this window of the search; 1 holds the best of all.
        entry: Or where the needle enters the skin: shape (3,), mm, in the case's space; or a Slicer file of it.
        seed: Of the approach's planner; the case's by default.

    Raises:
        InputError: The case does not say where the robot's base is, or there is nothing of what was chosen.
        NoAnswerError: Nothing is safe, what was chosen is rejected, or the arm finds no free approach to it.
    """
    from puncture_twin.planning.plan.planner import make_plan

    choice = _choice("plan", theta_deg, beta_deg, candidate, window, entry)
    return make_plan(context, candidates, choice, seed=seed).plan


@_public
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


@_public
def read_certificate(path: Path | str) -> Certificate:
    """A certificate from its file; `verify` proves it.

    Raises:
        InputError: Not a certificate, another version, missing or contradicting parts.
    """
    from puncture_twin.planning.certify.certificate import read_certificate

    return read_certificate(Path(path))


@_public
def read_points(path: Path | str) -> NamedPoints:
    """Named points from CSV, Slicer markups (.mrk.json) or .fcsv: mm, and LPS where the file states a space.

    Raises:
        InputError: It cannot be read, or is not whole.
    """
    from puncture_twin.planning.formats.points import read_points

    return read_points(Path(path))


@_public
def write_points(points: Points, path: Path | str) -> None:
    """Write named points as CSV in mm, whole or not at all; the space is not written, a CSV speaks in its case's.

    Raises:
        InputError: A point that is not three finite numbers, or a place that cannot be written to.
    """
    from puncture_twin.planning.formats.points import write_points

    write_points(Path(path), _named(points, "write_points"))


@_public
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


@_public
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


@_public
def read_recording(path: Path | str) -> Recording:
    """What two arms and a probe's image said, pose by pose, from ``recording.csv`` or its folder; see `calibrate`.

    Raises:
        InputError: It cannot be read, or a row is no pair of rigid motions with a point.
    """
    from puncture_twin.twin.guidance.ultrasound.recording_file import read_recording

    return read_recording(Path(path))


@_public
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


@_public
def check_folder(folder: Path | str) -> tuple[str, ...]:
    """What keeps an output folder from being one whole set, a sentence each; empty if nothing does.

    Raises:
        InputError: Its ``manifest.json`` cannot be read, or is another program's.
    """
    from puncture_twin.planning.base.output.manifest import problems

    return problems(Path(folder))


@_public
def write_plan(plan: Plan, path: Path | str) -> None:
    """Write a plan as JSON, whole or not at all."""
    from puncture_twin.planning.plan.plan_document import write_plan

    write_plan(plan, Path(path))


@_public
def rehearse(context: CaseContext, plan: Plan, *, seed: int | None = None) -> Rehearsal:
    """Execute a plan in the twin, where the ground truth differs from the belief.

    Args:
        context: The plan's case.
        plan: From `plan` or `read_plan`.
        seed: What the ground truth is drawn from; the case's by default.

    Raises:
        InputError: The extra ``twin`` is not installed.
    """
    from puncture_twin.planning.base.errors import require_extra

    require_extra("twin", "rehearse")
    from puncture_twin.twin.rehearsal.plan_truth import plan_truth
    from puncture_twin.twin.rehearsal.rehearsal import rehearse

    return rehearse(plan, context.case, context.anatomy, plan_truth(context, plan, seed))


def _choice(
    where: str,
    theta_deg: float | None,
    beta_deg: float | None,
    candidate: Pick | None,
    window: int | None,
    entry: ArrayLike | None,
) -> Choice:
    """The one choice that was stated.

    Raises:
        InputError: Two of them, half of one, or a value outside of its range.
    """
    from puncture_twin.planning.search.choice import Choice, parse_choice

    for name, angle, most in (("theta_deg", theta_deg, 180.0), ("beta_deg", beta_deg, 360.0)):
        if angle is not None:
            _angles([angle], most, f"{where}: {name}")
    if entry is not None and not isinstance(entry, str | Path):
        point = _named({"entry": entry}, f"{where}: entry").points[0]
        entry = ",".join(map(repr, point.tolist()))
    stated = parse_choice(theta_deg, beta_deg, None, window, None if entry is None else str(entry))
    if candidate is None:
        return stated
    if stated != Choice():
        refuse("a candidate beside another choice", where, "one of them", "conflicting_options")
    found, row = candidate
    return Choice(angles=(float(found.theta[row]), float(found.beta[row])))


def _angles(angles_deg: ArrayLike, most: float, where: str) -> Floats:
    """Angles in degrees, shape (n,), each from 0 to the largest that there is.

    Raises:
        InputError: Another shape, none, or what is no such number.
    """
    allowed = f"numbers of degrees from 0 to {most:g}, shape (n,)"
    try:
        given = np.asarray(angles_deg)
    except ValueError as error:
        raise InputError("rows of different length", where=where, allowed=allowed, code="wrong_shape") from error
    if given.dtype.kind not in "iuf":
        refuse(f"values of type {given.dtype}", where, allowed, "wrong_type")
    if given.ndim != 1 or not len(given):
        refuse(f"shape {given.shape}", where, allowed, "wrong_shape")
    wrong = ~((given >= 0.0) & (given <= most))  # NaN too
    if wrong.any():
        refuse(f"{given[wrong][0]:g}", where, allowed, "out_of_range")
    return np.asarray(given, dtype=np.float64)


def _named(points: Points, where: str) -> NamedPoints:
    """Named points, from whichever form.

    Raises:
        InputError: A point that is not three finite numbers.
    """
    from puncture_twin.planning.formats.guard import guard_points
    from puncture_twin.planning.formats.points import NamedPoints

    if isinstance(points, NamedPoints):
        return points
    if not all(isinstance(name, str) for name in points):
        refuse("a name is no text", where, "name to three finite numbers, mm", "wrong_type")
    return NamedPoints(tuple(points), guard_points(list(points.values()), tuple(points), where=where), None)
