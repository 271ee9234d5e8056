"""Where the patient lies for the robot, as a case states it: by markers, or by a transform that somebody else found."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np
from pydantic import model_validator

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.toml_types import Positive, Section, Sextuple, Text, Yes
from puncture_twin.planning.geometry.rigid import inverse, pose

RAS_OF_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
"""Its own inverse."""
NO_RESIDUALS = "stated transform {file}: no residuals, expected error unknown"

_OF_MARKERS = ("method", "correct", "correct_joints_deg")
_OF_COMPARISON = ("use", "fle_mm", "accept_residuals", "accept_symmetry")


class RegistrationSection(Section):
    """Markers seen in the CT and touched by the robot, or the transform between both in a file of ITK.

    Markers beside a transform do not place the base: the transform is held against them.
    """

    method: Literal["triad", "rigid", "weighted", "affine"] | None = None
    markers_ct: str | None = None
    markers_base: str | None = None
    use: tuple[Text, ...] | None = None
    fle_mm: Positive | None = None
    correct: Yes = False
    correct_joints_deg: Sextuple | None = None
    accept_residuals: Yes = False
    accept_symmetry: Yes = False
    transform: str | None = None
    transform_maps: Literal["base_to_ct", "ct_to_base"] | None = None
    base_axes: Literal["LPS", "RAS"] | None = None

    @model_validator(mode="after")
    def _corrected(self) -> Self:
        if self.correct_joints_deg is not None and not self.correct:
            raise ValueError("correct_joints_deg is the insertion that correct = true corrects for")
        if self.correct and self.method not in {None, "weighted"}:
            raise ValueError(f'correct = true has a fit of its own; method "{self.method}" has another')
        return self

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        markers = [key for key in ("markers_ct", "markers_base") if getattr(self, key) is None]
        if self.transform is None:
            if markers:
                raise ValueError(f"{' and '.join(markers)}: missing; markers_ct and markers_base, or transform")
            if self.transform_maps or self.base_axes:
                raise ValueError("transform_maps and base_axes belong to transform")
            return self
        if len(markers) == 1:
            raise ValueError(f"{markers[0]}: missing; beside transform both lists of markers, which it is held against")
        placing = (*_OF_MARKERS, *_OF_COMPARISON) if markers else _OF_MARKERS
        given = [key for key in placing if getattr(self, key)]
        if given:
            raise ValueError(f"transform stands in place of markers; {', '.join(given)} belongs to markers")
        if self.transform_maps is None:
            raise ValueError(
                'transform needs transform_maps = "base_to_ct" (as Slicer saves a transform that moves the CT to the '
                'robot) or "ct_to_base": no file says which way it goes'
            )
        if self.base_axes is None:
            raise ValueError(
                'transform needs base_axes = "RAS" (the robot\'s x, y, z are what Slicer shows as R, A, S) or "LPS" '
                "(they stand in the file as they are)"
            )
        return self


class MarkerSection(RegistrationSection):
    """The section where it names markers."""

    markers_ct: str
    markers_base: str


def stated_base_ct(section: RegistrationSection, T_file: Floats) -> Floats:
    """T_base_ct, shape (4, 4), mm, of a stated transform.

    Args:
        section: Says which way it goes, and what its coordinates on the robot's side are.
        T_file: Shape (4, 4), what the file does to a point; rigid to the digits of its file.
    """
    U, _, Vt = np.linalg.svd(T_file[:3, :3])
    T = pose(U @ Vt, T_file[:3, 3])
    return _read_as(T, inverted=section.transform_maps == "base_to_ct", turned=section.base_axes == "RAS")


def other_readings(section: RegistrationSection, T_base_ct: Floats) -> dict[str, Floats]:
    """What T_base_ct would be with other values of ``transform_maps`` and ``base_axes``, by these keys as text.

    Args:
        section: As the case states it.
        T_base_ct: Shape (4, 4), mm, by its own keys.
    """
    T = RAS_OF_LPS @ T_base_ct if section.base_axes == "RAS" else T_base_ct
    maps = "ct_to_base" if section.transform_maps == "base_to_ct" else "base_to_ct"
    axes = "LPS" if section.base_axes == "RAS" else "RAS"
    inverted, turned = f'transform_maps = "{maps}"', f'base_axes = "{axes}"'
    return {
        inverted: _read_as(T, inverted=True, turned=section.base_axes == "RAS"),
        turned: _read_as(T, inverted=False, turned=axes == "RAS"),
        f"{inverted} and {turned}": _read_as(T, inverted=True, turned=axes == "RAS"),
    }


def _read_as(T: Floats, *, inverted: bool, turned: bool) -> Floats:
    T = inverse(T) if inverted else T
    return np.asarray(RAS_OF_LPS @ T if turned else T)
