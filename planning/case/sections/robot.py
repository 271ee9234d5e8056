"""The robot that a case states: an arm of the table or of the user's own URDF, and where it is located."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np

from puncture_twin.planning.arm.model_urdf import own_arm
from puncture_twin.planning.arm.speed_limits import SpeedLimits
from puncture_twin.planning.arm.ur import UrModel, ur_model
from puncture_twin.planning.arm.urdf.document import MOST_BYTES
from puncture_twin.planning.arm.urdf.lengths import NOTHING_STATED, JointLimits, StatedLimits, narrowed
from puncture_twin.planning.base.arrays import read_only
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.provenance import InputFiles
from puncture_twin.planning.case.case_file import CaseFile
from puncture_twin.planning.case.mount import mount_pose
from puncture_twin.planning.case.settings import RobotSettings
from puncture_twin.planning.case.tables.registration_section import stated_base_ct
from puncture_twin.planning.case.tables.robot_section import LimitsSection, RobotSection
from puncture_twin.planning.formats import itk_transform
from puncture_twin.planning.formats.meshes import mesh_files as meshes
from puncture_twin.planning.geometry.spaces import Space

URDF_ROLE, MESH_ROLE = "urdf", "urdf mesh"
"""Of the files that decide an arm."""


def robot_of(content: CaseFile, space: Space, path: Path, files: InputFiles) -> RobotSettings:
    """The arm with its home, its speeds, and where it is located, as far as mount or transform say so.

    Args:
        content: The case file.
        space: The case's.
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

    Args:
        section: As the case states it.
        files: The case's files.
        path: The case file, for errors.

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
        what = f"robot.urdf: mesh '{address}' is no path beside the URDF"
        raise InputError(what, where=path, allowed="paths relative to the URDF's folder, such as meshes/base.stl")
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
