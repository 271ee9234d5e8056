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
import time
from collections.abc import Callable, Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple, ParamSpec, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from puncture_twin.planning.base.arrays import any_masked
from puncture_twin.planning.base.errors import InputError, refuse

if TYPE_CHECKING:
    from puncture_twin.planning.base.arrays import Floats
    from puncture_twin.planning.case.case import Case
    from puncture_twin.planning.certify.certificate import Certificate
    from puncture_twin.planning.certify.checker import Verification
    from puncture_twin.planning.export.exporter import Exported
    from puncture_twin.planning.formats.points import NamedPoints
    from puncture_twin.planning.formats.volumes.volume_files import Volume
    from puncture_twin.planning.geometry.mesh import TriangleMesh
    from puncture_twin.planning.place.search import PlaceSearch
    from puncture_twin.planning.plan.plan import Plan
    from puncture_twin.planning.registration.method import Method
    from puncture_twin.planning.registration.registration import Registration
    from puncture_twin.planning.search.candidates import Candidates, Pick
    from puncture_twin.planning.search.choice import Choice
    from puncture_twin.planning.search.context import CaseContext, EngineChoice
    from puncture_twin.planning.search.explain import Explanation
    from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import Calibration
    from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording
    from puncture_twin.twin.jobs.batch.jobs import Merged
    from puncture_twin.twin.jobs.choosing.compare_job import Comparison
    from puncture_twin.twin.jobs.experiment.touch_job import TouchRun
    from puncture_twin.twin.jobs.patient.candidates_export import ExportedTable
    from puncture_twin.twin.jobs.patient.export_jobs import SlicerExport
    from puncture_twin.twin.rehearsal.result import Rehearsal

    Points = NamedPoints | Mapping[str, ArrayLike]
    """Named points: read from a file, or name to (x, y, z) in mm."""


Given = ParamSpec("Given")
Found = TypeVar("Found")
Word = TypeVar("Word", bound=StrEnum)

RANGES: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "seed": (0, 2**31 - 1),
        "seeds": (1, 1_000_000),
        "jobs": (1, 1024),
        "size_deg": (0.05, 10),
        "fle_mm": (0.001, 1e3),
        "physics": (0, 10_000),
        "touch": (0, 1),
        "quick_s": (1, 1e9),
        "tolerance_mm": (0, 1e3),
    }
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
        bound = signature.bind(*arguments, **named)
        for name, given in bound.arguments.items():
            value = given[()] if isinstance(given, np.ndarray) and given.ndim == 0 else given
            if not any(_is(word, value) for word in words[name]):
                allowed = " or ".join(KINDS[word].text if word in KINDS else word for word in words[name])
                refuse(f"{name} is {_short(value)}", function.__name__, allowed, "wrong_type")
            if isinstance(value, numbers.Real):
                _check_number(name, float(value), function.__name__)
            if isinstance(value, numbers.Real) and not isinstance(
                value, bool | int
            ):  # half precision counts no further
                bound.arguments[name] = int(value) if isinstance(value, numbers.Integral) else float(value)
        return function(*bound.args, **bound.kwargs)

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
        "EngineChoice": Kind(
            "a class with measure, collides and of",
            lambda value: isinstance(value, type) and all(hasattr(value, one) for one in ("measure", "collides", "of")),
        ),
        "ArrayLike": Kind("an array", lambda value: value is not None),
        "Sequence[str]": Kind("a list of texts", lambda value: isinstance(value, list | tuple)),
        "Points": Kind("points by their names", lambda value: isinstance(value, Mapping) or _is("NamedPoints", value)),
    }
)


def _short(value: object) -> str:
    """A value in an error: what it is, and a number or text itself."""
    return repr(value)[:80] if isinstance(value, int | float | complex | str) else f"of type {type(value).__name__}"


@_public
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
        folder: With a CT and a segmentation.
        target: Shape (3,), mm, in `space`.
        target_label: Or the deepest point of this structure.
        hit_radius_mm: The target is a ball of its own, in no structure.
        region: What the CT shows; else inferred from the organs.
        space: ``LPS`` or ``RAS``: of the target, of the case, and of meshes; LPS by default.
        naming: Of labels: ``totalsegmentator-v1``, ``-v2``, or a table.
        unit: Of meshes: ``mm``, ``cm`` or ``m``; else inferred from their extent.
        up: Axis of meshes that is up: ``y`` or ``z``.
        ct: Which file, where the folder holds several CTs.
        segmentation: Which file or folder, where it holds several.
        skin: Structure that is the skin; else the CT's body.
        ignore: Structures or files to be left out.
        unknown: Structures that no path may cross.
        settings: Keys of the case, such as ``ct.arms=none`` or ``search.trust_labels=true``.
        force: Replace a case.toml that is there.

    Raises:
        InputError: Everything that keeps the case from being searched, in one line; nothing is written then.
    """
    from puncture_twin.planning.base.progress import Silent
    from puncture_twin.planning.geometry.spaces import Space, Unit, Up
    from puncture_twin.planning.init.finder import Wanted
    from puncture_twin.planning.init.overrides import overrides_of
    from puncture_twin.planning.init.start import Request
    from puncture_twin.twin.jobs.patient.init_job import init_case

    for name, texts in (("ignore", ignore), ("unknown", unknown), ("settings", settings)):
        if not all(isinstance(text, str) for text in texts):
            refuse(f"{name} holds what is no text", "init_case", "a list of texts", "wrong_type")
    words = _words(Space, space), _words(Unit, unit), _words(Up, up)
    overrides = overrides_of(skin, list(ignore), list(unknown), list(settings))
    wanted = Wanted(words[0] or Space.LPS, naming, words[1], ct, segmentation, words[2], overrides)
    point = None if target is None else _typed(target, "init_case: target")
    request = Request(Path(folder), point, target_label, region, wanted, space is not None, hit_radius_mm)
    return load_case(init_case(request, force=force, watcher=Silent()).path)


@_public
def load_case(path: Path | str) -> Case:
    """A validated case, without what its files hold. `prepare` reads those too.

    ``case.replace(target_ct=..., mount=..., needle=...)`` is what the case would be if its file had these values.

    Args:
        path: Case file, or the folder that holds ``case.toml``.

    Raises:
        InputError: One line: what is wrong, where, and what is allowed.
    """
    from puncture_twin.planning.case.case import load_case

    return load_case(path)


@_public
def prepare(case: Case | Path | str, *, arm: bool | None = None, engine: str | EngineChoice = "fast") -> CaseContext:
    """Read a case and all that it names: structures, registration, arm. It can be pickled, and used in threads.

    Args:
        case: A case, such as ``load_case(...).replace(...)``, its file, or the folder that holds ``case.toml``.
        arm: Whether a candidate must be reachable too; None asks it where the case says where the robot's base is.
        engine: Who measures clearance: ``fast``, ``fcl`` (the plain reference), or a class of your own that keeps the
            protocol `puncture_twin.planning.clearance.engine.ClearanceEngine`. The fast engine measures again what it
            measures: where it finds more clearance than there is, the search ends with an error.

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

    return explain_choice(context, _choice("check", context, theta_deg, beta_deg, candidate, window, entry))


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

    return ranked_by(candidates, _numbers(cost, "rerank", f"{len(candidates)} numbers, shape (n,)"))


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
def certify(context: CaseContext, *, size_deg: float = 0.25, touch: float | None = None) -> Certificate:
    """The map between the grid points: cells of directions that are proven safe for the organs, or rejected.

    Args:
        context: From `prepare`.
        size_deg: Cells are halved down to this size.
        touch: No structure is touched more often than this, 0 to 1, in a safe cell; None proves margins alone.

    Raises:
        InputError: A chance without declared errors, or a case that cannot have a certificate.
    """
    from puncture_twin.planning.certify.subdivision import certify

    error = context.pose_error
    return certify(context.case, context.anatomy, size=float(np.radians(size_deg)), touch=touch, error=error)


@_public
def verify(certificate: Certificate, context: CaseContext) -> Verification:
    """Prove every cell of a certificate again, by a plain checker that shares none of the fast code.

    Raises:
        InputError: A certificate of another case, or a cell whose verdict does not follow.
    """
    from puncture_twin.planning.certify.checker import verify

    return verify(certificate, context.case, context.anatomy, error=context.pose_error)


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

    choice = _choice("plan", context, theta_deg, beta_deg, candidate, window, entry)
    return make_plan(context, candidates, choice, seed=seed).plan


@_public
def read_plan(path: Path | str, context: CaseContext) -> Plan:
    """A plan from its file, checked against its case again: same inputs, still safe, a motion that touches nothing.

    Raises:
        InputError: It cannot be read, or it does not hold any more.
    """
    from puncture_twin.planning.plan.plan_document import read_plan

    return _own_plan(context, read_plan(Path(path)), str(path))


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

    known = _words(Unit, unit) or Unit.MM, _words(Space, space) or Space.LPS
    return read_mesh(Path(path), unit=known[0], space=known[1], up=_words(Up, up))


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
def rehearse(
    context: CaseContext, plan: Plan, *, seed: int | None = None, seeds: int | None = None, physics: int = 0
) -> Rehearsal:
    """Execute a plan in the twin, where the ground truth differs from the belief.

    Args:
        context: The plan's case.
        plan: From `plan` or `read_plan`.
        seed: What the ground truth is drawn from; the case's by default.
        seeds: Draw so many rooms: the median one is executed, and ``distribution`` holds all.
        physics: So many of them are executed in the simulator too.

    Raises:
        InputError: A plan that does not hold in this case, many rooms of a case without declared errors or markers, or
            the extra ``twin`` is not installed.
        NoAnswerError: The arm reaches the target in none of the rooms.
    """
    from puncture_twin.planning.base.errors import require_extra

    require_extra("twin", "rehearse")
    from puncture_twin.twin.jobs.patient.rehearsed import rehearse_once
    from puncture_twin.twin.jobs.patient.run import room_count

    return rehearse_once(context, _own_plan(context, plan, "rehearse: plan"), room_count(seeds, physics), seed)


@_public
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
        context: From `prepare`, with the arm, declared errors and markers.
        theta_deg: Of the puncture, as in `plan`; without a choice the best.
        beta_deg: As in `plan`.
        candidate: As in `plan`.
        window: As in `plan`.
        entry: As in `plan`.
        seed: Of the motions and of the truth.

    Raises:
        InputError: The case declares no errors or has no markers, or the extra ``twin`` is not installed.
        NoAnswerError: Nothing is safe, or too few markers can be touched.
    """
    from puncture_twin.planning.base.errors import require_extra

    require_extra("twin", "touch")
    from puncture_twin.twin.jobs.experiment.touch_job import touch

    return touch(context, _choice("touch", context, theta_deg, beta_deg, candidate, window, entry), seed)


@_public
def place(context: CaseContext, *, jobs: int = 2, quick_s: float | None = None) -> PlaceSearch:
    """The base positions from which the arm reaches most organ-safe directions; ``rated`` has the best first.

    ``prepare(context.case.replace(mount=dict(found.rated[0].mount)))`` is the case with the arm there.

    Args:
        context: From `prepare`.
        jobs: Processes; the answer of a whole search is the same.
        quick_s: Stop after about this time with the best so far; ``complete`` is then False. A fraction of a verdict
            whose ``count`` is below ``directions`` is an estimate. None searches to the end.

    Raises:
        InputError: Bounds that contradict the case.
        NoAnswerError: No direction is safe for the organs, or the arm reaches none from any placement.
    """
    from puncture_twin.twin.jobs.patient.place_job import find_places, refuse_none

    found = find_places(context, jobs, math.inf if quick_s is None else time.perf_counter() + quick_s).found
    refuse_none(found)
    return found


@_public
def compare(
    context: CaseContext,
    one: Explanation | Plan | Pick,
    other: Explanation | Plan | Pick,
    *,
    candidates: Candidates | None = None,
) -> Comparison:
    """Two paths of a case side by side: numbers, and why one is not safe. ``text()`` is the command's table.

    Args:
        context: From `prepare`.
        one: From `check` or `plan`, or a candidate such as ``candidates.best``.
        other: Another.
        candidates: From `search`, for ranks and windows; None searches.

    Raises:
        InputError: A plan that does not hold in this case, or a path of another case.
    """
    from puncture_twin.planning.search.candidates import Pick
    from puncture_twin.planning.search.explain import Explanation
    from puncture_twin.twin.jobs.choosing.compare_job import compare_paths

    paths = [check(context, candidate=path) if isinstance(path, Pick) else path for path in (one, other)]
    for path in paths:
        if isinstance(path, Explanation):
            context.own(path.candidates)
    return compare_paths(context, context.own(candidates), *zip(("one", "other"), paths, strict=True))


@_public
def export(
    source: Plan | Candidates | Explanation, format_name: str, folder: Path | str, *, context: CaseContext | None = None
) -> Exported | ExportedTable | SlicerExport:
    """Write a plan for a robot, the table of candidates, or a direction for 3D Slicer; read back before it is shown.

    Args:
        source: A plan (``urscript``, ``ros2``, ``csv``, ``moveit``, or another package's format; ``plan.json`` is
            written beside it), candidates (``candidates-csv``, ``candidates-json``), or a checked direction
            (``slicer``).
        format_name: One of these.
        folder: Where the files go; made where it is missing.
        context: The plan is checked again against this case, and corners are rounded where that is free; ``moveit`` and
            ``slicer`` need it.

    Raises:
        InputError: A format that is not of this source, a plan that breaks a limit of the arm or does not hold, or
            candidates or a direction of another case than the context's.
    """
    from puncture_twin.twin.jobs.patient.export_jobs import export_value

    return export_value(source, format_name, folder, context)


@_public
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
        context: From `prepare`.
        candidates: From `search`.
        folder: Where they go; made where it is missing.
        plan: From `plan`, shown as the chosen path.
        rehearsal: From `rehearse`, of this plan.

    Raises:
        InputError: A folder that cannot be written to, candidates or a plan of another case, or a rehearsal without its
            plan.
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


@_public
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
    from puncture_twin.planning.batch.run import Request, run_cohort
    from puncture_twin.planning.batch.run_case import run_here
    from puncture_twin.twin.jobs.batch.jobs import merge_cohort, plan_cohort

    out, watcher = check_writable(folder), Silent()
    plan_cohort(Path(cohort), out, arm=arm, dry=False, watcher=watcher)
    run_cohort(out, Request(jobs=jobs), watcher, run_here if jobs == 1 else None)
    return merge_cohort(out, None if expect is None else Path(expect), tolerance_mm, watcher)


def _choice(
    where: str,
    context: CaseContext,
    theta_deg: float | None,
    beta_deg: float | None,
    candidate: Pick | None,
    window: int | None,
    entry: ArrayLike | None,
) -> Choice:
    """The one choice that was stated.

    Raises:
        InputError: Two of them, half of one, a value outside of its range, or a candidate of another case.
    """
    from puncture_twin.planning.search.choice import Choice, parse_choice

    for name, angle, most in (("theta_deg", theta_deg, 180.0), ("beta_deg", beta_deg, 360.0)):
        if angle is not None:
            _angles([angle], most, f"{where}: {name}")
    if entry is not None:
        entry = str(entry) if isinstance(entry, str | Path) else _typed(entry, f"{where}: entry")
    stated = parse_choice(theta_deg, beta_deg, None, window, entry)
    if candidate is None:
        return stated
    if stated != Choice():
        refuse("a candidate beside another choice", where, "one of them", "conflicting_options")
    found, row = _own_pick(context, candidate, where)
    return Choice(angles=(float(found.theta[row]), float(found.beta[row])))


def _own_pick(context: CaseContext, candidate: Pick, where: str) -> Pick:
    """A candidate of this case: the angles of another's are another path here.

    Raises:
        InputError: It is of another case, or no row of a search.
    """
    found, row = candidate
    if not _is("Candidates", found):
        refuse(
            f"a candidate of a value {_short(found)}", where, "candidates.best or candidates.pick(row)", "wrong_type"
        )
    return context.own(found).pick(row)


def _own_plan(context: CaseContext, plan: Plan, where: str) -> Plan:
    """A plan that holds in this case, whatever it was made for or has become since.

    Raises:
        InputError: It does not; see `read_plan`.
    """
    from puncture_twin.planning.plan.plan_check import with_case_arm
    from puncture_twin.planning.plan.recheck import check_plan

    check_plan(plan, context, Path(where))
    return with_case_arm(plan, context.case)


def _typed(point: ArrayLike, where: str) -> str:
    """A point, shape (3,), mm, as it is typed on a command line.

    Raises:
        InputError: It is not three finite numbers.
    """
    return ",".join(map(repr, _named({"point": point}, where).points[0].tolist()))


def _words(kind: type[Word], word: str | None) -> Word | None:
    """One of a few words; None for none.

    Raises:
        InputError: Another word.
    """
    try:
        return None if word is None else kind(word)
    except ValueError as error:
        allowed = ", ".join(kind)
        raise InputError(f"{word!r}", where=kind.__name__.lower(), allowed=allowed, code="unknown_choice") from error


def _angles(angles_deg: ArrayLike, most: float, where: str) -> Floats:
    """Angles in degrees, shape (n,), each from 0 to the largest that there is.

    Raises:
        InputError: Another shape, none, or what is no such number.
    """
    allowed = f"numbers of degrees from 0 to {most:g}, shape (n,)"
    given = _numbers(angles_deg, where, allowed)
    if not len(given):
        refuse("no angle", where, allowed, "empty")
    wrong = ~((given >= 0.0) & (given <= most))  # NaN too
    if wrong.any():
        refuse(f"{float(given[wrong][0])!r}", where, allowed, "out_of_range")
    return given


def _numbers(values: ArrayLike, where: str, allowed: str) -> Floats:
    """Real numbers, shape (n,).

    Raises:
        InputError: Another shape, or values that are no real numbers.
    """
    try:
        given = np.asarray(values)
    except ValueError as error:
        raise InputError("rows of different length", where=where, allowed=allowed, code="wrong_shape") from error
    if given.dtype.kind not in "iuf":
        refuse(f"values of type {given.dtype}", where, allowed, "wrong_type")
    if any_masked(values):
        refuse("a masked value", where, allowed, "not_finite")
    if given.ndim != 1:
        refuse(f"shape {given.shape}", where, allowed, "wrong_shape")
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
