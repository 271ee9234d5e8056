"""An arm from a URDF of the user's: a model as good as those of the table, if it is built as a UR."""

from __future__ import annotations

from pathlib import Path

from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.arm.urdf.arm_urdf import read_arm_urdf
from puncture_twin.planning.arm.urdf.limits import NOTHING_STATED, StatedLimits, urdf_limits
from puncture_twin.planning.arm.urdf.shapes import Read


def own_arm(data: bytes, where: Path, *, flange: str, read: Read, stated: StatedLimits = NOTHING_STATED) -> UrModel:
    """The arm of a URDF, with the limits that the URDF states; its name is the robot's.

    Args:
        data: The URDF's bytes.
        where: The file, to which its meshes are relative.
        flange: Name of the link that carries the needle.
        read: Reads a mesh file by its address in the URDF.
        stated: Limits that the case states, for joints for which the URDF has none.

    Raises:
        InputError: It cannot be read whole, or is not built as a UR; says what and where.
    """
    urdf = read_arm_urdf(data, where, flange=flange, read=read)
    limits = urdf_limits(urdf.chain.joints, stated, where)
    d1, a2, a3, d4, d5, d6 = urdf.lengths_mm
    return UrModel(
        urdf.document.name,
        d1,
        a2,
        a3,
        d4,
        d5,
        d6,
        limits.angles,
        limits.speeds,
        limits.torques,
        joint_names=urdf.joint_names,
        shipped=False,
        urdf=urdf,
    )
