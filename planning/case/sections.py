"""The robot that a case states: an arm of the table or of the user's own URDF, and where it is located.

The needle that bends, as a case declares it.

The breathing that a case declares, in mm and in the CT's frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np

from puncture_twin.planning.arm.kinematics import SpeedLimits
from puncture_twin.planning.arm.links import own_arm
from puncture_twin.planning.arm.ur import UrModel, ur_model
from puncture_twin.planning.arm.urdf.document import MOST_BYTES
from puncture_twin.planning.arm.urdf.lengths import NOTHING_STATED, JointLimits, StatedLimits, narrowed
from puncture_twin.planning.base.arrays import Floats, read_only
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.provenance import InputFiles
from puncture_twin.planning.breathing.breathing import Breathing
from puncture_twin.planning.case.case_file import CaseFile
from puncture_twin.planning.case.entry import ANATOMICAL_LPS
from puncture_twin.planning.case.settings import RobotSettings, mount_pose
from puncture_twin.planning.case.tables import (
    BreathingSection,
    LimitsSection,
    NeedleSection,
    RobotSection,
    TissueSection,
    stated_base_ct,
)
from puncture_twin.planning.case.toml_types import Vector
from puncture_twin.planning.formats import itk_transform
from puncture_twin.planning.formats.labels.naming import REST, ByName
from puncture_twin.planning.formats.meshes import mesh_files as meshes
from puncture_twin.planning.geometry.spaces import Space, to_lps
from puncture_twin.planning.needle.deflection import GAUGES, STEEL_GPA, Bending, Shaft, Tissue

URDF_ROLE, MESH_ROLE = "urdf", "urdf mesh"
"""Of the files that decide an arm."""


def robot_of(content: CaseFile, space: Space, path: Path, files: InputFiles) -> RobotSettings:
    """The arm with its home, its speeds, and where it is located, as far as mount or transform say so.

    Args:
        path: Where the case file is, for errors.
        files: What it names; each file that decides the arm is added.

    Raises:
        InputError: An arm, a mount or a transform that cannot be used.
    """
    robot, stated, model = content.robot, content.registration, arm_of(content.robot, files, path)
    home = None if robot.home_deg is None else read_only(np.radians(np.asarray(robot.home_deg)))
    mount = None if robot.mount is None else mount_pose(robot.mount, space, path)
    speeds = SpeedLimits(*(getattr(robot, name) for name in SpeedLimits._fields))
    if stated is not None and stated.transform is not None:
        T_file = itk_transform.parse_transform(files.content(stated.transform), path.parent / stated.transform)
        mount = read_only(stated_base_ct(stated, T_file))
        return RobotSettings(model, home, mount, stated, speeds)
    return RobotSettings(model, home, mount, speeds=speeds)


def arm_of(section: RobotSection, files: InputFiles, path: Path) -> UrModel:
    """The arm's model; each file that decides it becomes an input of the case.

    Raises:
        InputError: An unknown name, a URDF or a mesh that cannot be used, or limits that are wider than the arm's own.
    """
    stated = stated_limits(section.limits)
    if section.urdf is None:
        model = ur_model(section.model)
    else:
        data = files.read(URDF_ROLE, section.urdf, max_bytes=MOST_BYTES, key="robot.urdf", where=path)
        read = partial(_mesh, urdf=section.urdf, files=files, path=path)
        model = own_arm(data, path.parent / section.urdf, flange=section.flange, read=read, stated=stated)
    if section.limits is None:
        return model
    known = JointLimits(model.joint_limits, model.max_speeds, model.max_torques)
    limits = narrowed(known, stated, f"{path}: robot.limits")
    return replace(model, joint_limits=limits.angles, max_speeds=limits.speeds)


def _mesh(address: str, *, urdf: str, files: InputFiles, path: Path) -> bytes:
    """The bytes of a mesh that a URDF names."""
    if "://" in address or PurePosixPath(address).is_absolute():
        allowed = "paths relative to the URDF's folder, such as meshes/base.stl"
        refuse(f"robot.urdf: mesh '{address}' is not a path next to the URDF", path, allowed, "outside_folder")
    name = str(PurePosixPath(urdf).parent / address)
    return files.read(MESH_ROLE, name, max_bytes=meshes.MAX_FILE_BYTES, key=f"robot.urdf: mesh '{address}'", where=path)


def stated_limits(section: LimitsSection | None) -> StatedLimits:
    """The limits in radians; nothing where the case states none."""
    if section is None:
        return NOTHING_STATED
    angles = (
        None
        if section.lowest_deg is None
        else np.radians(np.stack([section.lowest_deg, section.highest_deg or ()], axis=1))
    )
    return StatedLimits(angles, None if section.max_speed_deg_s is None else np.radians(section.max_speed_deg_s))


SAME_MM = 0.03
"""By which ``diameter_mm`` may differ from its gauge: twice the usual tolerance of the chart."""


def bending_of(needle: NeedleSection, tissue: Mapping[str, TissueSection], where: str | Path) -> Bending | None:
    """The bending of a case's needle; None where it declares no tissue.

    Raises:
        InputError: Half of what is needed, an unknown gauge, or one that is not the needle's diameter.
    """
    stated = [key for key in ("gauge", "solid", "bevel_deg", "modulus_gpa") if getattr(needle, key) is not None]
    if not tissue:
        if stated:
            message = f"needle.{stated[0]}: the bending depends on the tissue, and there is no [tissue]"
            refuse(message, where, "[tissue.PATTERN] for each pattern of names; or omit this key", "no_tissue")
        return None
    if needle.bevel_deg is None:
        refuse("[tissue] needs needle.bevel_deg", where, "degrees; 0 for a symmetric tip", "no_bevel")
    if REST not in tissue:
        message = f'[tissue."{REST}"] is missing: there is tissue between the structures too'
        refuse(message, where, f'a table for "{REST}", the rest of the body', "no_tissue")
    tissues = {pattern: Tissue(**section.model_dump()) for pattern, section in tissue.items()}
    return Bending(_shaft(needle, where), float(np.radians(needle.bevel_deg)), ByName(tissues))


def _shaft(needle: NeedleSection, where: str | Path) -> Shaft:
    modulus = STEEL_GPA if needle.modulus_gpa is None else needle.modulus_gpa
    if needle.gauge is None:
        return Shaft(needle.shaft_mm, needle.diameter_mm, 0.0, modulus)
    if needle.gauge not in GAUGES:
        what = f"needle.gauge {needle.gauge} is not in the chart"
        refuse(what, where, f"{min(GAUGES)} to {max(GAUGES)}", "unknown_gauge")
    gauge = GAUGES[needle.gauge]
    if abs(gauge.outer_mm - needle.diameter_mm) > SAME_MM:
        message = (
            f"needle.gauge {needle.gauge} is {gauge.outer_mm:g} mm wide, but diameter_mm is {needle.diameter_mm:g}"
        )
        refuse(message, where, f"diameter_mm within {SAME_MM:g} of the gauge's", "gauge_contradicted")
    return Shaft(needle.shaft_mm, gauge.outer_mm, 0.0 if needle.solid else gauge.inner_mm, modulus)


def breathing_of(section: BreathingSection | None, space: Space, where: str | Path) -> Breathing | None:
    """The breathing of a case; None where it declares none.

    Args:
        space: Of the case, in which a direction is meant.

    Raises:
        InputError: A direction without length, or an anatomical one in a space that knows no patient.
    """
    if section is None:
        return None
    return Breathing(
        amplitude_mm=section.amplitude_mm,
        direction_ct=_unit(section.direction, space, where),
        weights=ByName(section.weights),
        phases=section.phases,
        exponent=section.exponent,
        scanned_at=section.scanned_at,
        gate=section.gate,
    )


def _unit(direction: str | Vector, space: Space, where: str | Path) -> Floats:
    """Shape (3,), unit, LPS (or the case's local frame)."""
    if isinstance(direction, str):
        if space is Space.LOCAL:
            message = f'breathing.direction: space "local" has no {direction}'
            refuse(message, where, "direction = [x, y, z]", "local_space")
        return np.array(ANATOMICAL_LPS[direction], dtype=np.float64)
    vector = to_lps(np.array([direction], dtype=np.float64), space)[0]
    length = float(np.linalg.norm(vector))
    if length == 0:
        refuse("breathing.direction is zero", where, "a direction of any length", "zero_direction")
    return np.asarray(vector / length)
