"""The commands that answer without writing files: register, verify, calibrate hand-eye."""

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
from puncture_twin.planning.formats.csv_table import parse_coordinate
from puncture_twin.planning.formats.points import MAX_FILE_BYTES, parse_points, parse_triple
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.geometry.spaces import Space, to_lps
from puncture_twin.planning.registration.checks.checked_placement import checked_placement
from puncture_twin.planning.registration.checks.markers import touchable_points
from puncture_twin.planning.registration.fits import INTERVAL, LEAST_FOUND_MM, ReadingNoise, rigid_fre_mm
from puncture_twin.planning.registration.hand_eye import HandEye, HandEyeNoise, noise_of
from puncture_twin.planning.registration.marker_pairs import MarkerPairs, match
from puncture_twin.planning.registration.placement import odd_branches, one_more, without_each
from puncture_twin.planning.registration.registration import Registration, register
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.uncertainty.hit import radius_for_chance
from puncture_twin.twin.jobs.patient.budget import budget_facts, correction_facts
from puncture_twin.twin.jobs.patient.run import plain_fields, registration_summary
from puncture_twin.twin.report import patient
from puncture_twin.twin.report.present import Field, Section, Table, Warn, facts, text, vector


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
    registration, kinds = checked.placement.registration, (Severity.WARNING, Severity.NOTE)
    warned, notes = ([one.sentence for one in checked.findings if one.severity is kind] for kind in kinds)
    unlike = odd_branches(registration, case.robot.model)
    touched = f"{', '.join(unlike)} touched in another branch of the arm than the rest: arm errors do not cancel there"
    along = np.linspace(case.target_ct, case.target_ct + case.needle.shaft_mm * case.T_ct_entry[:3, 2], 4)
    stated = {
        "case": case.name,
        "inputs": inputs_document(case.inputs),
        "expected_tre_target_mm": checked.placement.target_error_mm,
    }
    read_cov_ct = None if case.errors is None else case.errors.target_cov_ct
    report = _report(registration, stated, case.target_ct, read_cov_ct)
    report["findings"] += [one.document() for one in checked.findings]
    return {
        **report,
        "expected_tre_along_shaft_mm": registration.expected_tre_mm(along).tolist(),
        "warnings": [*case.warnings, *warned, *([touched] if unlike else [])],
        **_advice_of_case(case, registration),
        "notes": notes,
    }


def lists_report(
    markers_ct: Path, markers_base: Path, target: str | None, space: Space, fle_mm: float | None
) -> dict[str, Any]:
    """The registration of two lists of markers alone, which need a target, as plain values."""
    if target is None:
        refuse("two lists of markers were given without a target", "register", "--target X,Y,Z in mm", "missing_option")
    numbers, paths = parse_triple(target, "--target"), (markers_ct, markers_base)
    content = [read_input(path, max_bytes=MAX_FILE_BYTES, where=str(path)) for path in paths]
    read = [parse_points(content[0], markers_ct, default_space=space), parse_points(content[1], markers_base)]
    target_ct = to_lps(np.array([numbers]), space)[0]
    pairs = match(*read, use=None, where=f"{markers_ct}, {markers_base}")
    noise = noise_of_lists(pairs, fle_mm)
    given: dict[str, Any] = {"fle_mm": fle_mm} if noise is None else {"noise": noise, "noise_found": fle_mm is None}
    registration = register(pairs, method="rigid", target_ct=target_ct, where=str(markers_base), **given)
    named = zip(("markers_ct", "markers_base"), paths, content, strict=True)
    inputs = [Input(role, str(path), hashlib.sha256(data).hexdigest()) for role, path, data in named]
    stated = {
        "case": f"{markers_ct} and {markers_base}",
        "target_mm": list(numbers),
        "space": str(space),
        "inputs": inputs_document(inputs),
        "expected_tre_target_mm": float(registration.expected_tre_mm(target_ct[None])[0]),
    }
    return {
        **_report(registration, stated, target_ct, None),
        "expected_tre_along_shaft_mm": [],
        **_advice_of_lists(registration, target_ct, space),
        "warnings": [],
        "notes": ["only two lists: no skin or couch to check the axes and names against"],
    }


def _report(
    registration: Registration, stated: dict[str, Any], target_ct: Floats, read_cov_ct: Floats | None
) -> dict[str, Any]:
    return {
        **registration_summary(registration),
        **stated,
        "expected_tre_target_interval_mm": list(registration.expected_tre_interval_mm(target_ct)),
        **one_insertion(registration, target_ct, read_cov_ct),
    }


def one_insertion(registration: Registration, target_ct: Floats, read_cov_ct: Floats | None) -> dict[str, Any]:
    """Distance from the true target (3,), mm, within which 95 of 100 registrations send the tip, its own reading in it.

    `read_cov_ct`, (3, 3), mm^2, is of that reading, as declared; None where it is read as a marker is, in both lists.
    """
    cov, R = registration.tre_covariance(target_ct), registration.T_base_ct[:3, :3]
    read, how = registration.fle_mm**2 / 3.0 * np.eye(3), "like a marker, in both lists"
    if read_cov_ct is not None:
        scale = 1.0 if registration.uncertainty is None else registration.uncertainty.test.scale
        read, how = scale**2 * R @ read_cov_ct @ R.T, "as declared (target_mm)"
    limit = radius_for_chance(cov + read, INTERVAL, registration.freedom)
    return {"one_insertion_95_mm": limit, "target_read": how}


def noise_of_lists(pairs: MarkerPairs, fle_mm: float | None) -> ReadingNoise | None:
    """Noise equal in all axes, of both lists together, stated or to be estimated; None where they agree to rounding."""
    if fle_mm is None and rigid_fre_mm(pairs.points_ct, pairs.points_base) < LEAST_FOUND_MM:
        return None
    count = len(pairs)
    # Fitzpatrick 1998: FRE^2 = (1 - 2 / N) FLE^2
    found_mm = rigid_fre_mm(pairs.points_ct, pairs.points_base) * np.sqrt(count / (count - 2))
    each = np.eye(3) * (found_mm if fle_mm is None else fle_mm) ** 2 / 6.0
    arm_jacobian, eta_variances = np.zeros((3 * count, 1)), np.zeros(1)
    return ReadingNoise(each, np.broadcast_to(each, (count, 3, 3)), arm_jacobian, eta_variances, touches_known=True)


def _advice_of_lists(registration: Registration, target_ct: Floats, space: Space) -> dict[str, Any]:
    if registration.uncertainty is None:
        return {}
    far = np.linalg.norm(registration.markers.points_ct - target_ct, axis=1).max()
    sides = np.array([side for side in product((-1.0, 0.0, 1.0), repeat=3) if any(side)])
    sides /= np.linalg.norm(sides, axis=1, keepdims=True)
    test = registration.uncertainty.test
    stated = test.text().replace("the declared errors", "--fle")
    noise = f"noise estimated from the residuals: {registration.fle_mm:.3f} mm, with {test.freedom} degrees of freedom"
    return {
        "budget": None,
        "fle_source": "estimated from the FRE of the rigid fit" if test.scaled else "stated by --fle",
        "declaration": {**registration_summary(registration)["declaration"], "text": noise if test.scaled else stated},
        **_advice(registration, target_ct, space, target_ct + far * sides, {"the markers in both lists": 1.0}),
    }


def _advice_of_case(case: Case, registration: Registration) -> dict[str, Any]:
    if registration.uncertainty is None:
        return {}
    read, touched = map(np.trace, registration.uncertainty.parts_at(apply(registration.T_base_ct, case.target_ct)))
    fractions = {"markers_ct": float(read / (read + touched)), "touch": float(touched / (read + touched))}
    touchable = touchable_points(case, load_skin(case, user_cache()).mesh, registration.T_base_ct)
    return {
        "budget": budget_facts(case, registration, touchable, partial(load_anatomy, case, cache=user_cache())),
        **({} if registration.aim is None else {"correction": correction_facts(case, registration)}),
        **_advice(registration, case.target_ct, case.space, touchable, fractions),
    }


def _advice(
    registration: Registration, target_ct: Floats, space: Space, places_ct: Floats, fractions: dict[str, float]
) -> dict[str, Any]:
    """The target's ellipsoid, the rest without each marker, and at which of the places (n, 3) one more helps most."""
    assert registration.uncertainty is not None
    cov = registration.uncertainty.cov_at(apply(registration.T_base_ct, target_ct))[:3, :3]
    without = without_each(registration, target_ct)
    best = None
    if more := one_more(registration, target_ct, places_ct):
        typed = to_lps(more.point_ct[None], space)[0].tolist()  # its own inverse
        best = {"point_ct_mm": more.point_ct.tolist(), "point_mm": typed, "space": str(space), "rms_mm": more.rms_mm}
    return {
        "half_axes_95_mm": (
            registration.uncertainty.test.region_factor * np.sqrt(np.linalg.eigvalsh(cov)[::-1])
        ).tolist(),
        "share": fractions,
        "without": {one.name: {"rms_mm": one.rms_mm, "probability": one.probability} for one in without},
        "one_more": best,
    }


def verify_certificate(path: Path, context: CaseContext) -> dict[str, Any]:
    """Prove every cell of a certificate again, by the plain checker; one that does not follow is refused."""
    output = read_output(path, max_bytes=MAX_CERTIFICATE_BYTES)
    stated, certificate = output.input("certificate"), parse_certificate(output.data, path)
    if output.note:
        context.watcher.note(f"warning: {output.note}")
    cells, error = partial(context.watcher.count, "cells"), context.pose_error
    done = verify(certificate, context.case, context.anatomy, cells, error=error)
    inputs = inputs_document((stated, *context.case.inputs))
    return {"certificate": str(path), "inputs": inputs, **certificate.summary(), "verified": asdict(done)}


def certificate_text(report: dict[str, Any]) -> str:
    """Text of the plain checker's proof."""
    done = report["verified"]
    proven = f"{done['safe']} safe and {done['rejected']} rejected cells proven again, {done['undecided']} undecided"
    return text([Section(f"{report['certificate']}: every cell is proven", [proven, *patient.certificate(report)])])


def registration_text(report: dict[str, Any]) -> str:
    """Text of a registration: residuals, expected error, ill-conditioned markers and error budget."""
    target = f", target {vector(report['target_mm'], 1, 'mm')} {report['space']}" if "target_mm" in report else ""
    return text([
        Section(f"case {report['case']}: registration{target}", patient.registration(report)),
        *(Section("error budget", patient.budget(one)) for one in [report.get("budget")] if one),
        *(Section(f"{kind}: {one}", []) for kind in ("warning", "note") for one in report[f"{kind}s"]),
    ])  # fmt: skip


def parse_noise(words: str | None) -> HandEyeNoise | None:
    """The noise as it is typed, ``MM,DEG,MM,DEG``; None where nothing is. Raises InputError: It is not four numbers."""
    return None if words is None else noise_of([parse_coordinate(one.strip(), "--noise") for one in words.split(",")])


def hand_eye_summary(fit: HandEye) -> dict[str, Any]:
    """A hand-eye calibration as plain values, mm and degrees."""
    half = fit.intervals()
    half = np.where(np.arange(len(half)) % 6 < 3, np.degrees(half), half)
    rad, mm = fit.spread
    return {
        "equation": "AX = XB" if fit.Z is None else "AX = ZB",
        "T_flange_camera": fit.X.tolist(),
        "T_base_board": None if fit.Z is None else fit.Z.tolist(),
        "poses": len(fit.names),
        "interval_95": {
            f"T_{name}": {"rotation_deg": half[at : at + 3].tolist(), "translation_mm": half[at + 3 : at + 6].tolist()}
            for name, at in zip(("flange_camera", "base_board"), range(0, len(half), 6), strict=False)
        },
        "residual_deg": float(np.degrees(rad)),
        "residual_mm": mm,
        **plain_fields(fit, "chi_squared", "freedom", "condition", "covariance"),
        "findings": [one.document() for one in fit.findings()],
    }


def hand_eye_text(summary: dict[str, Any]) -> str:
    """Text of a hand-eye calibration."""
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
