"""The URDF behind an arm's model: the user's own, if it is built as a UR, or the one that ships under its name."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

from puncture_twin import meshes
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.arm.urdf.arm_urdf import FLANGE, ArmUrdf, Read, read_arm_urdf
from puncture_twin.planning.arm.urdf.lengths import NOTHING_STATED, StatedLimits, urdf_limits
from puncture_twin.planning.base.errors import InputError

SHAPES = "ur"
"""Where URDFs and shapes lie below our meshes, and how the URDFs' addresses begin."""

T_BASE_URDFBASE = np.diag([-1.0, -1.0, 1.0, 1.0])
"""A UR's URDF has its ``base_link`` against the controller's base: half a turn about z."""

MEANS = "://"
"""What an address has that is more than a path."""


def model_urdf(model: UrModel) -> ArmUrdf:
    """The URDF of a model, with its shapes.

    Raises:
        InputError: Nobody has the shapes of such a model.
    """
    if model.urdf is not None:
        return model.urdf
    if not model.shipped:
        what = f"the arm {model.name!r} is known by its numbers alone"
        raise InputError(what, where="robot", allowed="the case that names its URDF")
    return _shipped(model.name)


def address_file(urdf: ArmUrdf, address: str) -> str:
    """The absolute path of a mesh that a URDF names, or the address itself where it is one of another program."""
    if address.startswith(f"package://{SHAPES}/"):
        return str(_resolved(address))
    return address if MEANS in address else str((urdf.where.parent / address).resolve())


@cache
def _shipped(name: str) -> ArmUrdf:
    path = meshes.folder() / SHAPES / f"{name}.urdf"
    if not path.is_file():
        allowed = ", ".join(sorted(p.stem for p in path.parent.glob("*.urdf")))
        raise InputError(f"no link meshes for robot {name!r}", where=f"meshes/{SHAPES}", allowed=allowed)
    return read_arm_urdf(
        path.read_bytes(),
        path,
        flange=FLANGE,
        read=lambda address: _resolved(address).read_bytes(),
        T_base_root=T_BASE_URDFBASE,
    )


def _resolved(address: str) -> Path:
    return meshes.folder() / address.removeprefix("package://")


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
