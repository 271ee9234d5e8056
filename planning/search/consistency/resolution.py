"""What a case's grids miss: what lies between two slices of a scan, and between two angles of the search."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.label_grids import label_grids
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.collision.workcell import ARM_PADDING_MM
from puncture_twin.planning.search.consistency.volume_headers import Headers

STEP_SLACK = 1e-9
"""Steps by which a range may miss a whole number of them: rounding of radians."""


def resolution_warnings(case: Case, anatomy: Anatomy, headers: Headers) -> tuple[str, ...]:
    """Where slices are too thick for what is demanded of them, and where the search's grid ends before its range.

    Args:
        case: The case.
        anatomy: Its structures.
        headers: Of the case's CT and label maps, by file name.
    """
    return (*_map_warnings(case, anatomy), *_skin_warnings(case, headers), *_grid_warnings(case))


def _map_warnings(case: Case, anatomy: Anatomy) -> Iterator[str]:
    """Label maps whose voxels lie farther apart than the least margin that is demanded from them."""
    for grid in label_grids(case):
        demanding = [structure for structure in grid.own(anatomy.structures) if structure.demands_margin]
        if not demanding:
            continue
        least = min(demanding, key=lambda structure: structure.margin_mm)
        spacing = float(grid.voxels.spacing_mm.max())
        if spacing > least.margin_mm:
            yield (
                f"{grid.name}: slices {spacing:.3g} mm apart, and the least margin demanded from it is "
                f"{least.margin_mm:g} mm ({least.name}): what lies between two slices is not seen"
            )


def _skin_warnings(case: Case, headers: Headers) -> Iterator[str]:
    """A CT whose slices lie farther apart than what needle and arm keep from the skin that is found in it."""
    name = case.skin_section.ct
    if name is not None and (spacing := float(headers[name].spacing_mm.max())) > ARM_PADDING_MM:
        yield (
            f"{name}: slices {spacing:.3g} mm apart, and needle and arm keep {ARM_PADDING_MM:g} mm from the skin "
            "that is found in it"
        )


def _grid_warnings(case: Case) -> Iterator[str]:
    """Ranges that the step does not divide: the grid ends before they do."""
    step = float(np.degrees(case.search.step))
    for key, limits in (("theta_deg", case.search.theta), ("beta_deg", case.search.beta)):
        low, high = np.degrees(limits).round(9)
        last = low + step * np.floor((high - low) / step + STEP_SLACK)
        if high - last > STEP_SLACK * step:
            yield (
                f"search.{key} [{low:g}, {high:g}] is no whole number of steps of {step:g}: the last angle that is "
                f"checked is {last:g}"
            )
