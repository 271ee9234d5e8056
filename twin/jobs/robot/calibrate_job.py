"""The command ``calibrate hand-eye``: where a camera is on an arm's flange, as plain values and as text."""

from __future__ import annotations

from typing import Any

import numpy as np

from puncture_twin.planning.formats.points import parse_coordinate
from puncture_twin.planning.registration.hand_eye import HandEye, HandEyeNoise, noise_of
from puncture_twin.twin.report.present import Field, Section, Table, Warn, facts, text


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
