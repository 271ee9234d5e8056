"""The one declaration of errors, in the planner's units: belief computes with it, the twin's truth is drawn from it.

Defaults and their reasons: docs/concepts/uncertainty.md. What is not here (breathing, a needle that bends, tissue that
moves) is not modelled, which is something else than 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, NamedTuple, Self

import numpy as np
from pydantic import Field

from puncture_twin.planning.base.arrays import Floats, read_only
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.case.case_file import CaseFile
from puncture_twin.planning.case.entry import lps_axis
from puncture_twin.planning.case.named_files import CaseVolumes
from puncture_twin.planning.case.tables import ErrorsSection, Number, Section
from puncture_twin.planning.geometry.spaces import Space

DEFAULT_READING_MM, DEFAULT_TOUCH_MM, DEFAULT_DRIFT_DEG = 0.5, 0.35, 0.02
"""Of a marker in a CT whose pixel and slice spacing nobody stated; what the touches of Chen 2019 show without any CT
(distances between its markers, measured twice); of every joint between touch and insertion."""
UNIFORM = 1.0 / np.sqrt(12.0)
"""Standard deviation of an error that is uniform over one cell, over the cell."""
THICK_MM, SIDEWAYS = 3.0, 0.5
"""Slices up to this let a contour err by its own cell alone, in every direction. Of what slices exceed that by: between
them a contour that leans is a stair, which errs sideways too. Balls of 8 mm and more, averaged over slices of up to
10 mm, err by that at most (docs/concepts/uncertainty.md)."""


class ArmKind(NamedTuple):
    """How well the kinematic parameters of an arm are known: standard deviations in mm and degrees."""

    link_mm: float
    twist_deg: float
    joint_deg: float


ARM_KINDS: Mapping[str, ArmKind] = MappingProxyType(
    {"calibrated": ArmKind(0.05, 0.005, 0.005), "nominal": ArmKind(0.5, 0.05, 0.1)}
)
"""``calibrated``: with the maker's own kinematic calibration. ``nominal``: by data sheet; assumed, nobody states it."""


class ArmErrors(Section):
    """How far an arm is from its nominal model: standard deviations, and the full width of every joint's play.

    ``link_mm`` is of every Denavit-Hartenberg length, ``joint_deg`` of every joint's zero, ``repeatability_deg`` of
    every joint, anew at each arrival.
    """

    link_mm: Annotated[Number, Field(ge=0, le=50)] = ARM_KINDS["calibrated"].link_mm
    twist_deg: Annotated[Number, Field(ge=0, le=10)] = ARM_KINDS["calibrated"].twist_deg
    joint_deg: Annotated[Number, Field(ge=0, le=10)] = ARM_KINDS["calibrated"].joint_deg
    backlash_deg: Annotated[Number, Field(ge=0, le=10)] = 0.0
    repeatability_deg: Annotated[Number, Field(ge=0, le=10)] = 0.003

    @property
    def twist(self) -> float:
        """Standard deviation of every link's twist, rad."""
        return float(np.radians(self.twist_deg))

    @property
    def joint(self) -> float:
        """Standard deviation of every joint's zero, rad."""
        return float(np.radians(self.joint_deg))

    @property
    def backlash(self) -> float:
        """Full width of every joint's play, rad."""
        return float(np.radians(self.backlash_deg))

    @property
    def repeatability(self) -> float:
        """Standard deviation of every joint at each arrival, rad."""
        return float(np.radians(self.repeatability_deg))

    def scaled(self, factor: float) -> Self:
        """Each number times a factor, the play too."""
        stated = {key: value for key, value in self.model_dump().items() if isinstance(value, float | tuple)}
        grown = {key: (factor * np.array(value)).tolist() for key, value in stated.items()}
        return self.model_copy(update={key: tuple(v) if isinstance(v, list) else v for key, v in grown.items()})


@dataclass(frozen=True)
class ArmUncertainty:
    """Standard deviations of an arm and the needle on it; mm and radians."""

    link_mm: float  # of every Denavit-Hartenberg length a_i and d_i
    twist: float  # of every twist alpha_i
    joint: float  # of every joint's zero
    repeatability: float  # of every joint, anew at each arrival
    drift: float  # of every joint, since the markers were touched
    tip_offset_mm: float  # of the needle's tip, per axis of the flange
    needle_direction: float  # of the needle's direction, about each of the flange's x and y axes
    jitter: float = 0.0  # of every joint about where it arrived, at any one moment; a touch reads its mean

    @property
    def arriving(self) -> float:
        """Standard deviation of every joint at one moment after an arrival: repeatability and jitter, rad."""
        return float(np.hypot(self.repeatability, self.jitter))

    def scaled(self, factor: float) -> ArmUncertainty:
        """Each deviation times a factor."""
        return ArmUncertainty(**{name: factor * value for name, value in vars(self).items()})


@dataclass(frozen=True, eq=False)
class ErrorModel:
    """All declared errors of a case; covariances (3, 3), mm^2, of one marker and of the target as read in the CT."""

    marker_cov_ct: Floats  # shape (3, 3), mm^2: of one marker read in the CT
    touch_mm: float
    """Standard deviation of one touch, per axis of the base frame, besides the arm's errors."""
    target_cov_ct: Floats  # shape (3, 3), mm^2: of the target read in the CT
    arm: ArmUncertainty
    surface_mm: float | None
    """By which a whole structure's surface may lie off, along its normal; None where every structure's own voxels say
    it."""
    found: bool = False
    """Whether the markers' residuals give the size of all errors, and the declaration their shape."""
    size: float = 1.0
    """Factor by which all declared deviations have been scaled."""

    def __post_init__(self) -> None:
        for name in ("marker_cov_ct", "target_cov_ct"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    @property
    def anisotropic(self) -> bool:
        """Whether a marker is read better along some axes of the CT than along others."""
        values = np.linalg.eigvalsh(self.marker_cov_ct)
        return bool(values[-1] > values[0] * (1 + 1e-9))

    def scaled(self, factor: float) -> ErrorModel:
        """Each deviation times a factor."""
        return replace(
            self,
            marker_cov_ct=factor**2 * self.marker_cov_ct,
            touch_mm=factor * self.touch_mm,
            target_cov_ct=factor**2 * self.target_cov_ct,
            arm=self.arm.scaled(factor),
            surface_mm=None if self.surface_mm is None else factor * self.surface_mm,
            size=factor * self.size,
        )

    def surface_cov_ct(self, voxel_ct: Floats | None) -> Floats:
        """S, shape (3, 3), mm^2: a surface of unit normal n may lie off by sqrt(n' S n), a structure's as a whole.

        By its voxels' edges as columns, shape (3, 3), mm; None for a mesh, of which nobody knows it: 0.
        """
        if self.surface_mm is not None:
            return np.asarray(self.surface_mm**2 * np.eye(3))
        if voxel_ct is None:
            return np.zeros((3, 3))
        stairs = SIDEWAYS * max(float(np.linalg.norm(voxel_ct, axis=0).max()) - THICK_MM, 0.0)
        return np.asarray((self.size * UNIFORM) ** 2 * (voxel_ct @ voxel_ct.T + stairs**2 * np.eye(3)))


class Cells(NamedTuple):
    """The voxels of a CT: pixel and slice spacing, mm, and the unit normal of its slices, shape (3,), LPS."""

    pixel_mm: float
    spacing_mm: float
    normal_ct: Floats


def error_model(
    section: ErrorsSection,
    *,
    space: Space,
    cells: Cells | None = None,
    fle_mm: float | None = None,
    where: str | Path = "errors",
) -> ErrorModel:
    """The declaration in mm and radians, with the defaults filled in.

    Args:
        cells: Of the case's own CT, which give pixel, spacing and bed axis where the section does not.
        fle_mm: ``registration.fle_mm``, the short form: rms length of a marker's whole error, touch included.

    Raises:
        InputError: One error declared twice, or slices that differ from pixels without a bed axis.
    """
    stated = section.model_fields_set
    if fle_mm is not None:
        twice = sorted(stated & {"ct_pixel_mm", "ct_spacing_mm", "ct_in_plane_mm", "ct_slice_mm", "touch_mm"})
        if twice:
            message = f"registration.fle_mm and errors.{twice[0]} state the same error"
            refuse(message, where, "only fle_mm, or CT and touch in [errors]", "stated_twice")
    reading, touch = _reading_cov(section, space, cells, where), _or(section.touch_mm, DEFAULT_TOUCH_MM)
    target = reading if section.target_mm is None else section.target_mm**2 * np.eye(3)
    if fle_mm is not None:
        reading, touch = fle_mm**2 / 3 * np.eye(3), 0.0
    size_found = section.marker_noise == "found"
    return ErrorModel(reading, touch, target, _arm(section), section.surface_mm, size_found)


def _arm(section: ErrorsSection) -> ArmUncertainty:
    kind = ARM_KINDS[section.arm]
    return ArmUncertainty(
        link_mm=_or(section.link_mm, kind.link_mm),
        twist=np.radians(_or(section.twist_deg, kind.twist_deg)),
        joint=np.radians(_or(section.joint_deg, kind.joint_deg)),
        repeatability=np.radians(section.repeatability_deg),
        drift=np.radians(_or(section.joint_drift_deg, DEFAULT_DRIFT_DEG)),
        tip_offset_mm=section.tip_offset_mm,
        needle_direction=np.radians(section.needle_direction_deg),
        jitter=np.radians(section.jitter_deg),
    )


def _reading_cov(section: ErrorsSection, space: Space, cells: Cells | None, where: str | Path) -> Floats:
    """sigma_p^2 (I - b b') + sigma_s^2 b b', with b the axis across the slices."""
    in_plane = _deviation(section.ct_in_plane_mm, section.ct_pixel_mm, None if cells is None else cells.pixel_mm)
    across = _deviation(section.ct_slice_mm, section.ct_spacing_mm, None if cells is None else cells.spacing_mm)
    if in_plane == across:
        return np.asarray(in_plane**2 * np.eye(3))
    axis = _bed_axis(section, space, cells, where)
    return np.asarray(in_plane**2 * np.eye(3) + (across**2 - in_plane**2) * np.outer(axis, axis))


def _deviation(stated: float | None, cell: float | None, of_ct: float | None) -> float:
    cell = of_ct if cell is None else cell
    return _or(stated, DEFAULT_READING_MM if cell is None else float(cell * UNIFORM))


def _bed_axis(section: ErrorsSection, space: Space, cells: Cells | None, where: str | Path) -> Floats:
    """The unit vector across the slices, LPS (or the case's local frame)."""
    axis = section.bed_axis
    if axis is None and space is Space.LOCAL:
        message = 'ct_slice_mm differs from ct_in_plane_mm, and space "local" has no bed'
        refuse(message, where, "bed_axis = [x, y, z], the direction across the slices", "local_space")
    if isinstance(axis, str) and space is Space.LOCAL:
        refuse('bed_axis: space "local" has no head', where, "bed_axis = [x, y, z]", "local_space")
    if axis is None:
        return np.array([0.0, 0.0, 1.0]) if cells is None else np.asarray(cells.normal_ct)
    vector = lps_axis(axis, space)
    length = float(np.linalg.norm(vector))
    if length == 0:
        refuse("bed_axis is zero", where, "a direction", "zero_direction")
    return np.asarray(vector / length)


def _or(value: float | None, default: float) -> float:
    return default if value is None else value


def errors_of(
    content: CaseFile, section: ErrorsSection | None, case_volumes: CaseVolumes, path: Path, *, truth: bool = False
) -> ErrorModel | None:
    """The declared errors, or the truth's own, which know no short form."""
    if section is None:
        return None
    cells = None
    if content.ct_name is not None:
        grid = case_volumes.source(content.ct_name).grid
        x_mm, y_mm, slices_mm = grid.spacing_mm.tolist()
        cells = Cells(max(x_mm, y_mm), slices_mm, grid.T_ct_index[:3, 2] / slices_mm)
    fle_mm = None if truth or content.registration is None else content.registration.fle_mm
    where = f"{path}: {'rehearsal.errors' if truth else 'errors'}"
    return error_model(section, space=Space(content.space), cells=cells, fle_mm=fle_mm, where=where)
