"""What the inputs leave out: between two slices, between two angles of the search, and organs that nobody named."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.default_roles import default_role
from puncture_twin.planning.anatomy.label_grids import label_grids
from puncture_twin.planning.anatomy.regions import absent_organs
from puncture_twin.planning.base.findings import Finding, Severity
from puncture_twin.planning.base.text_names import first_few
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.collision.workcell import ARM_PADDING_MM

STEP_SLACK = 1e-9
"""Steps by which a range may miss a whole number of them: rounding of radians."""


def thick_slices(case: Case, anatomy: Anatomy) -> Iterator[Finding]:
    """Label maps whose voxels lie farther apart than the least margin that is demanded from them, and such a CT."""
    for grid in label_grids(case):
        demanding = [structure for structure in grid.own(anatomy.structures) if structure.demands_margin]
        if not demanding:
            continue
        least = min(demanding, key=lambda structure: structure.margin_mm)
        spacing = float(grid.voxels.spacing_mm.max())
        if spacing > least.margin_mm:
            said = (
                f"{grid.name}: slices {spacing:.3g} mm apart, and the least margin demanded from it is "
                f"{least.margin_mm:g} mm ({least.name}): what lies between two slices is not seen"
            )
            yield Finding("thick_slices", Severity.WARNING, said, {"slices_mm": spacing, "margin_mm": least.margin_mm})
    name = case.skin_section.ct
    if name is not None and (spacing := float(case.volumes.source(name).grid.spacing_mm.max())) > ARM_PADDING_MM:
        said = (
            f"{name}: slices {spacing:.3g} mm apart, and needle and arm keep {ARM_PADDING_MM:g} mm from the skin "
            "that is found in it"
        )
        yield Finding("thick_slices", Severity.WARNING, said, {"slices_mm": spacing, "margin_mm": ARM_PADDING_MM})


def short_grid(case: Case) -> Iterator[Finding]:
    """Ranges that the step does not divide: the grid ends before they do."""
    step = float(np.degrees(case.search.step))
    for key, limits in (("theta_deg", case.search.theta), ("beta_deg", case.search.beta)):
        low, high = np.degrees(limits).round(9)
        last = low + step * np.floor((high - low) / step + STEP_SLACK)
        if high - last > STEP_SLACK * step:
            said = (
                f"search.{key} [{low:g}, {high:g}] is no whole number of steps of {step:g}: the last angle that is "
                f"checked is {last:g}"
            )
            yield Finding("short_grid", Severity.WARNING, said, {"last_deg": float(last)})


def ignored_organs(case: Case, anatomy: Anatomy) -> Iterator[Finding]:
    """What the case leaves out on purpose, though its name is that of something to be avoided: it counts as free."""
    roles = {name: default_role(name, case.region or "other") for name in anatomy.ignored}
    avoided = [name for name, role in roles.items() if role is not None and role.kind == "avoid"]
    if avoided:
        said = f"ignored by the case, and so free to cross: {first_few(avoided)}"
        yield Finding("organs_ignored", Severity.WARNING, said, {"count": float(len(avoided))})


def absent_usual_organs(case: Case, anatomy: Anatomy) -> Iterator[Finding]:
    """The usual organs of the case's region that nobody named: they count as free."""
    absent = absent_organs(case.region, [*(structure.name for structure in anatomy.structures), *anatomy.ignored])
    if absent:
        said = f"no structure is named like {', '.join(absent)}; what has no structure counts as free"
        yield Finding("organs_absent", Severity.WARNING, f"region {case.region}: {said}")
