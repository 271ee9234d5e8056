"""What ``scan`` prints: how it scanned, both readings of each marker beside the truth, and the next command."""

from __future__ import annotations

from typing import Any

import numpy as np

from puncture_twin.twin.jobs.experiment.scan_job import SERIES, ScanRun


def scan_text(run: ScanRun) -> str:
    """Errors in mm along x, y, z of the scan (left, back, head)."""
    facts = run.summary()
    settings, shape = facts["settings"], " x ".join(map(str, facts["voxels"]))
    pixel, spacing = settings["pixel_mm"], settings["spacing_mm"]
    folder = run.files[-1].parent
    target = ",".join(f"{one:.2f}" for one in facts["target_mm"])
    return "\n".join(
        [
            f"{folder}",
            f"  scan           {shape} voxels of {pixel:g} x {pixel:g} x {spacing:g} mm, noise "
            f"{settings['noise_hu']:g} HU, seed {settings['seed']}",
            *_marker_lines(facts),
            f"  {'lesion':<15}{_vector(facts['lesion']['error_mm'])}   read against true",
            *_needle_lines(facts["needle"]),
            *_beside_lines(facts["beside"]),
            *_thin_lines(facts["thin_voxels"]),
            f"next: run-twin init {folder} --ct {SERIES} --target={target}",
        ]
    )


def _marker_lines(facts: dict[str, Any]) -> list[str]:
    if not facts["markers"]:
        return ["  markers        none"]
    lines = ["  errors, mm     slice and millimetre     middle of the metal"]
    lines += [
        f"  {one['name']:<15}{_vector(one['rule_error_mm'])}    {_vector(one['error_mm'])}" for one in facts["markers"]
    ]
    theory = facts["theory_mm"]
    rms = [np.sqrt(np.mean(np.square([one[key] for one in facts["markers"]]), axis=0)) for key in _KEYS]
    expected = f"{theory['rule_in_plane']:.2f} in the plane, {theory['rule_along_bed']:.2f} along the bed"
    return [
        *lines,
        f"  {'rms':<15}{_vector(rms[0])}    {_vector(rms[1])}",
        f"  standard dev.  {expected}; the middle of the metal is held to {theory['middle_along_bed']:.2f} there",
    ]


_KEYS = ("rule_error_mm", "error_mm")


def _needle_lines(needle: dict[str, Any] | None) -> list[str]:
    if needle is None:
        return []
    found, true = needle["found"], needle["true"]
    if found is None:
        return [f"  needle         not read: {needle['why_not']}"]
    return [
        f"  needle         tip {found['tip_to_target_mm']:.2f} mm from the target in the control CT "
        f"({found['lateral_mm']:.2f} across, {found['depth_mm']:+.2f} along)",
        f"                 truly {true['tip_to_target_mm']:.2f} ({true['lateral_mm']:.2f}, {true['depth_mm']:+.2f}), "
        "so that the "
        f"tip was read {needle['tip_reading_error_mm']:.2f} mm and {needle['angle_reading_error_deg']:.2f}° off",
    ]


def _beside_lines(parts: list[dict[str, Any]]) -> list[str]:
    shown = ", ".join(one["name"] for one in parts if one["place"] != "within" and not one["name"].endswith(INSIDE))
    return [f"  beside         {shown}: surfaces in beside/"] if shown else []


INSIDE = ("_core", "_foam")
"""Ends of the names of what fills a line or a bed."""


def _thin_lines(thin: dict[str, int]) -> list[str]:
    parts = ", ".join(f"{name} ({count})" for name, count in thin.items())
    return [f"  thin           parts thinner than a voxel have whole voxels of the labels: {parts}"] if thin else []


def _vector(numbers: list[float]) -> str:
    return " ".join(f"{one:+6.2f}" for one in numbers)
