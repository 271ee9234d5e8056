"""The commands that answer without writing files: register, verify, calibrate hand-eye."""

from __future__ import annotations

import hashlib
from dataclasses import asdict
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from puncture_twin.planning.anatomy.anatomy import load_anatomy, load_skin
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import user_cache
from puncture_twin.planning.base.errors import InputListError, Severity, refuse
from puncture_twin.planning.base.files import read_input
from puncture_twin.planning.base.output.manifest import read_output
from puncture_twin.planning.base.provenance import Input, inputs_document
from puncture_twin.planning.case.case import Case, load_case
from puncture_twin.planning.certify.certificate import MAX_CERTIFICATE_BYTES, parse_certificate
from puncture_twin.planning.certify.checker import verify
from puncture_twin.planning.formats.points import MAX_FILE_BYTES, parse_coordinate, parse_points, parse_triple
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.geometry.spaces import Space, to_lps
from puncture_twin.planning.registration.checks.checked_placement import checked_placement
from puncture_twin.planning.registration.checks.places import touchable_points
from puncture_twin.planning.registration.fits import ReadingNoise, rigid_fre_mm
from puncture_twin.planning.registration.hand_eye import HandEye, HandEyeNoise, noise_of
from puncture_twin.planning.registration.marker_pairs import MarkerPairs, match
from puncture_twin.planning.registration.method import LEAST_FOUND_MM
from puncture_twin.planning.registration.placement import OneMore, odd_branches, one_more, without_each
from puncture_twin.planning.registration.registration import Registration, register
from puncture_twin.planning.registration.residuals import INTERVAL
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.uncertainty.hit import radius_for_chance
from puncture_twin.twin.jobs.patient.budget import budget_facts, correction_facts
from puncture_twin.twin.jobs.patient.run import registration_summary
from puncture_twin.twin.report import patient
from puncture_twin.twin.report.present import Field, Section, Table, Warn, facts, text, vector


def register_report(
    source: Path, markers_base: Path | None, target: str | None, space: Space, fle_mm: float | None
) -> dict[str, Any]:
    """The report of a case's markers, or of two lists of markers; see the functions below.

    Raises:
        InputError: Two lists without a target, or see there.
    """
    if markers_base is None:
        return registration_report(source)
    if target is None:
        refuse("two lists of markers were given without a target", "register", "--target X,Y,Z in mm", "missing_option")
    return lists_report(source, markers_base, target, space, fle_mm)


def registration_report(path: Path) -> dict[str, Any]:
    """Everything known about a case's registration, as plain values."""
    case = load_case(path)
    checked = checked_placement(case, user_cache())
    if checked is None or checked.placement.registration is None:
        file = case.robot.transform
        what = "no [registration] with markers" if file is None else f"the base is registered by the transform {file}"
        compared = () if checked is None else (one.sentence for one in checked.findings)
        allowed = "only markers_ct and markers_base"
        raise InputListError("; ".join((what, *compared)), where=case.path, allowed=allowed, code="no_markers")
    placement, registration = checked.placement, checked.placement.registration
    report = registration_summary(registration)
    pose = case.target_ct + case.needle.shaft_mm * case.T_ct_entry[:3, 2]
    along = np.linspace(case.target_ct, pose, 4)
    report["case"] = case.name
    report["inputs"] = inputs_document(case.inputs)
    report["expected_tre_target_mm"] = placement.target_error_mm
    report["expected_tre_target_interval_mm"] = list(registration.expected_tre_interval_mm(case.target_ct))
    read = None if case.errors is None else case.errors.target_cov_ct
    report |= one_insertion(registration, case.target_ct, read)
    report["expected_tre_along_shaft_mm"] = registration.expected_tre_mm(along).tolist()
    found = {kind: [one.sentence for one in checked.findings if one.severity is kind] for kind in Severity}
    report["warnings"] = [*case.warnings, *found[Severity.WARNING], *_branch_warning(case, registration)]
    report |= _advice(case, registration)
    report["notes"] = found[Severity.NOTE]
    report["findings"] += [one.document() for one in checked.findings]
    return report


def lists_report(
    markers_ct: Path, markers_base: Path, target: str, space: Space, fle_mm: float | None
) -> dict[str, Any]:
    """The registration of two lists of markers alone, as plain values."""
    numbers = parse_triple(target, "--target")
    content = [read_input(path, max_bytes=MAX_FILE_BYTES, where=str(path)) for path in (markers_ct, markers_base)]
    read = [parse_points(content[0], markers_ct, default_space=space), parse_points(content[1], markers_base)]
    target_ct = to_lps(np.array([numbers]), space)[0]
    pairs = match(*read, use=None, where=f"{markers_ct}, {markers_base}")
    stated = {"method": "rigid", "target_ct": target_ct, "where": str(markers_base)}
    noise = noise_of_lists(pairs, fle_mm)
    given = {"fle_mm": fle_mm} if noise is None else {"noise": noise, "noise_found": fle_mm is None}
    registration = register(pairs, **stated, **given)
    report = registration_summary(registration)
    report["case"] = f"{markers_ct} and {markers_base}"
    report["target_mm"], report["space"] = list(numbers), str(space)
    named = zip(("markers_ct", "markers_base"), (markers_ct, markers_base), content, strict=True)
    report["inputs"] = inputs_document(
        tuple(Input(role, str(path), hashlib.sha256(data).hexdigest()) for role, path, data in named)
    )
    report["expected_tre_target_mm"] = float(registration.expected_tre_mm(target_ct[None])[0])
    report["expected_tre_target_interval_mm"] = list(registration.expected_tre_interval_mm(target_ct))
    report |= one_insertion(registration, target_ct, None)
    report["expected_tre_along_shaft_mm"] = []
    report |= _advice_of_lists(registration, target_ct, space)
    report["warnings"] = []
    report["notes"] = ["only two lists: no skin or couch to check the axes and names against"]
    return report


def one_insertion(registration: Registration, target_ct: Floats, read_cov_ct: Floats | None) -> dict[str, Any]:
    """Within which of its true place a target is sent to in 95 of 100 registrations, its own reading in it.

    Args:
        target_ct: Shape (3,), mm.
        read_cov_ct: Of the target's reading, as declared; None where it is read as a marker is, in both lists.
    """
    cov, R = registration.tre_covariance(target_ct), registration.T_base_ct[:3, :3]
    read, how = registration.fle_mm**2 / 3.0 * np.eye(3), "like a marker, in both lists"
    if read_cov_ct is not None:
        scale = 1.0 if registration.uncertainty is None else registration.uncertainty.test.scale
        read, how = scale**2 * R @ read_cov_ct @ R.T, "as declared (target_mm)"
    limit = radius_for_chance(cov + read, INTERVAL, registration.freedom)
    return {"one_insertion_95_mm": limit, "target_read": how}


def noise_of_lists(pairs: MarkerPairs, fle_mm: float | None) -> ReadingNoise | None:
    """Equal in all axes, of both lists together, stated or to be found; None where they agree to rounding."""
    if fle_mm is None and rigid_fre_mm(pairs.points_ct, pairs.points_base) < LEAST_FOUND_MM:
        return None
    count = len(pairs)
    found_mm = rigid_fre_mm(pairs.points_ct, pairs.points_base) * np.sqrt(
        count / (count - 2)
    )  # Fitzpatrick 1998: FRE^2 = (1 - 2 / N) FLE^2
    each = np.eye(3) * (found_mm if fle_mm is None else fle_mm) ** 2 / 6.0
    return ReadingNoise(
        cov_ct=each,
        cov_base=np.broadcast_to(each, (count, 3, 3)),
        arm_jacobian=np.zeros((3 * count, 1)),
        eta_variances=np.zeros(1),
        touches_known=True,
    )


def _advice_of_lists(registration: Registration, target_ct: Floats, space: Space) -> dict[str, Any]:
    """As `_advice`, by the readings alone: which marker to drop, and to which side one more would help most."""
    uncertainty = registration.uncertainty
    if uncertainty is None:
        return {}
    cov = uncertainty.cov_at(apply(registration.T_base_ct, target_ct))[:3, :3]
    far = np.linalg.norm(registration.markers.points_ct - target_ct, axis=1).max()
    sides = np.array([side for side in product((-1.0, 0.0, 1.0), repeat=3) if any(side)])
    sides /= np.linalg.norm(sides, axis=1, keepdims=True)
    more = one_more(registration, target_ct, target_ct + far * sides)
    test = uncertainty.test
    stated = test.text().replace("the declared errors", "--fle")
    found = f"noise estimated from the residuals: {registration.fle_mm:.3f} mm, with {test.freedom} degrees of freedom"
    return {
        "budget": None,
        "fle_source": "estimated from the FRE of the rigid fit" if test.scaled else "stated by --fle",
        "declaration": {**registration_summary(registration)["declaration"], "text": found if test.scaled else stated},
        "half_axes_95_mm": (uncertainty.test.region_factor * np.sqrt(np.linalg.eigvalsh(cov)[::-1])).tolist(),
        "share": {"the markers in both lists": 1.0},
        "without": _without(registration, target_ct),
        "one_more": None if more is None else _one_more(space, more),
    }


def _without(registration: Registration, target_ct: Floats) -> dict[str, Any]:
    return {
        one.name: {"rms_mm": one.rms_mm, "probability": one.probability}
        for one in without_each(registration, target_ct)
    }


def _branch_warning(case: Case, registration: Registration) -> tuple[str, ...]:
    odd = odd_branches(registration, case.robot.model)
    if not odd:
        return ()
    return (f"{', '.join(odd)} touched in another branch of the arm than the rest: arm errors do not cancel there",)


def _advice(case: Case, registration: Registration) -> dict[str, Any]:
    """Ellipsoid and sources at the target by the readings alone, and what would make it better; for declared errors."""
    uncertainty = registration.uncertainty
    if uncertainty is None:
        return {}
    target_base = apply(registration.T_base_ct, case.target_ct)
    cov = uncertainty.cov_at(target_base)[:3, :3]
    read, touched = (np.trace(part) for part in uncertainty.parts_at(target_base))
    skin = load_skin(case, user_cache())
    touchable = touchable_points(case, skin.mesh, registration.T_base_ct)
    more = one_more(registration, case.target_ct, touchable)
    return {
        "budget": budget_facts(case, registration, touchable, partial(load_anatomy, case, cache=user_cache())),
        **({} if registration.aim is None else {"correction": correction_facts(case, registration)}),
        "half_axes_95_mm": (uncertainty.test.region_factor * np.sqrt(np.linalg.eigvalsh(cov)[::-1])).tolist(),
        "share": {"markers_ct": float(read / (read + touched)), "touch": float(touched / (read + touched))},
        "without": _without(registration, case.target_ct),
        "one_more": None if more is None else _one_more(case.space, more),
    }


def _one_more(space: Space, more: OneMore) -> dict[str, Any]:
    """Where: LPS, and in the space that the user reads."""
    typed = to_lps(more.point_ct[None], space)[0]  # its own inverse
    place = {"point_ct_mm": more.point_ct.tolist(), "point_mm": typed.tolist(), "space": str(space)}
    return {**place, "rms_mm": more.rms_mm}


def verify_certificate(path: Path, context: CaseContext) -> dict[str, Any]:
    """Prove every cell of a certificate again, by the plain checker.

    Raises:
        InputError: Not a certificate, not of this case, or a cell whose verdict does not follow.
    """
    found = read_output(path, max_bytes=MAX_CERTIFICATE_BYTES)
    stated, certificate = found.input("certificate"), parse_certificate(found.data, path)
    if found.note:
        context.watcher.note(f"warning: {found.note}")
    cells, error = partial(context.watcher.count, "cells"), context.pose_error
    done = verify(certificate, context.case, context.anatomy, cells, error=error)
    inputs = inputs_document((stated, *context.case.inputs))
    return {"certificate": str(path), "inputs": inputs, **certificate.summary(), "verified": asdict(done)}


def certificate_text(report: dict[str, Any]) -> str:
    """What the plain checker proved."""
    done = report["verified"]
    proven = f"{done['safe']} safe and {done['rejected']} rejected cells proven again, {done['undecided']} undecided"
    return text([Section(f"{report['certificate']}: every cell is proven", [proven, *patient.certificate(report)])])


def registration_text(report: dict[str, Any]) -> str:
    """Residuals, expected error, weak points and error budget of a registration."""
    target = f", target {vector(report['target_mm'], 1, 'mm')} {report['space']}" if "target_mm" in report else ""
    return text([
        Section(f"case {report['case']}: registration{target}", patient.registration(report)),
        *(Section("error budget", patient.budget(one)) for one in [report.get("budget")] if one),
        *(Section(f"{kind}: {one}", []) for kind in ("warning", "note") for one in report[f"{kind}s"]),
    ])  # fmt: skip


def parse_noise(words: str | None) -> HandEyeNoise | None:
    """The noise as it is typed, ``MM,DEG,MM,DEG``; None where nothing is.

    Raises:
        InputError: It is not four numbers.
    """
    if words is None:
        return None
    return noise_of([parse_coordinate(word.strip(), "--noise") for word in words.split(",")])


def hand_eye_summary(found: HandEye) -> dict[str, Any]:
    """What was found, mm and degrees."""
    half = found.intervals()
    half = np.where(np.arange(len(half)) % 6 < 3, np.degrees(half), half)
    rad, mm = found.spread
    return {
        "equation": "AX = XB" if found.Z is None else "AX = ZB",
        "T_flange_camera": found.X.tolist(),
        "T_base_board": None if found.Z is None else found.Z.tolist(),
        "poses": len(found.names),
        "interval_95": {
            f"T_{name}": {"rotation_deg": half[at : at + 3].tolist(), "translation_mm": half[at + 3 : at + 6].tolist()}
            for name, at in zip(("flange_camera", "base_board"), range(0, len(half), 6), strict=False)
        },
        "residual_deg": float(np.degrees(rad)),
        "residual_mm": mm,
        "chi_squared": found.chi_squared,
        "freedom": found.freedom,
        "condition": found.condition,
        "covariance": found.covariance.tolist(),
        "findings": [one.document() for one in found.findings()],
    }


def hand_eye_text(summary: dict[str, Any]) -> str:
    """For a person."""
    rows = [
        (name, " x ".join(f"{one:.3f}" for one in half["rotation_deg"]), " x ".join(
            f"{one:.3f}" for one in half["translation_mm"]))
        for name, half in summary["interval_95"].items()
    ]  # fmt: skip
    return text([
        Section(f"hand-eye, {summary['equation']}, {summary['poses']} pairs of poses", [facts(FACTS, summary)]),
        *(
            Section(name, [Table((), tuple(tuple(f"{one:.5f}" for one in row) for row in summary[name][:3]))])
            for name in ("T_flange_camera", "T_base_board")
            if summary[name] is not None
        ),
        Section("95 % intervals, half widths", [Table(("", "rotation °", "translation mm"), tuple(rows))]),
        Section("", [Warn(tuple(one["sentence"] for one in summary["findings"]))]),
    ])  # fmt: skip


FACTS = (
    Field("residuals, rotation", "residual_deg", 4, "°"),
    Field("residuals, translation", "residual_mm", 4, "mm"),
    Field("condition σ_min/σ_max, lengths in 100 mm", lambda one: f"{one['condition']:.2e}"),
)
