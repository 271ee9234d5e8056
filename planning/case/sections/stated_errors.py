"""The errors that a case declares, with the cells of its own CT."""

from __future__ import annotations

from pathlib import Path

from puncture_twin.planning.case.case_file import CaseFile
from puncture_twin.planning.case.case_volumes import CaseVolumes
from puncture_twin.planning.case.errors import Cells, ErrorModel, error_model
from puncture_twin.planning.case.tables.errors_section import ErrorsSection
from puncture_twin.planning.geometry.spaces import Space


def errors_of(
    content: CaseFile, section: ErrorsSection | None, case_volumes: CaseVolumes, path: Path, *, truth: bool = False
) -> ErrorModel | None:
    """The declared errors, or the truth's own, which know no short form and no older names."""
    if section is None:
        return None
    return error_model(
        section,
        space=Space(content.space),
        cells=_ct_cells(content, case_volumes),
        fle_mm=None if truth or content.registration is None else content.registration.fle_mm,
        rehearsal=None if truth else content.rehearsal,
        where=f"{path}: {'rehearsal.errors' if truth else 'errors'}",
    )


def _ct_cells(content: CaseFile, case_volumes: CaseVolumes) -> Cells | None:
    """Pixel, slice spacing and slice normal of the case's CT; None without one."""
    name = content.ct_name
    if name is None:
        return None
    grid = case_volumes.source(name).grid
    spacing = grid.spacing_mm
    return Cells(float(spacing[:2].max()), float(spacing[2]), grid.T_ct_index[:3, 2] / spacing[2])
