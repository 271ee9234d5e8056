"""The UR family as data: link lengths, joint limits and speeds of each model.

Source of the Denavit-Hartenberg numbers: Universal Robots, "DH parameters for calculations of kinematics and
dynamics"; joint ranges and speeds: the data sheets. An old manual prints d1 = 118 mm for the UR3: wrong.
"""

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.arm.urdf.arm_urdf import ArmUrdf
from puncture_twin.planning.base.arrays import read_only
from puncture_twin.planning.base.errors import refuse

ELBOW = 2
"""Index of the elbow among the six joints."""
JOINT_NAMES = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
"""The joints as a UR's URDF (and ROS) names them."""
DEFAULT_MAX_ACCELERATION = 1.4
"""rad/s^2: what the controller itself takes for a joint move when the program names none (URScript ``movej``)."""


@dataclass(frozen=True, eq=False)
class UrModel:
    """One arm of the family. Lengths in mm, angles in rad."""

    name: str  # such as ``ur3``
    d1: float  # height of the shoulder axis above the base, mm
    a2: float  # upper arm, mm, negative as in the DH table
    a3: float  # forearm, mm, negative as in the DH table
    d4: float  # sideways offset of the wrist, mm
    d5: float  # from wrist 1 to wrist 2, mm
    d6: float  # from wrist 2 to the flange, mm
    joint_limits: NDArray[np.float64]  # shape (6, 2), rad: lowest and highest angle of each joint
    max_speeds: NDArray[np.float64]  # shape (6,), rad/s
    max_torques: NDArray[np.float64]  # shape (6,), N m: what each joint's motor can give
    max_acceleration: float = DEFAULT_MAX_ACCELERATION  # rad/s^2, for every joint
    joint_names: tuple[str, ...] = JOINT_NAMES
    shipped: bool = True  # whether its shapes are those that ship under its name
    urdf: ArmUrdf | None = None
    """Its own URDF, if it has one; an arm that neither ships nor has one is known by its numbers alone."""

    def __post_init__(self) -> None:
        for name in ("joint_limits", "max_speeds", "max_torques"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    @cached_property
    def digest(self) -> str:
        """Hexadecimal SHA-256 of all the model's numbers: two arms of one digest are the same to the bit."""
        numbers = (self.lengths, self.joint_limits, self.max_speeds, self.max_torques, np.array(self.max_acceleration))
        words = (self.name, *self.joint_names, str(self.shipped), "" if self.urdf is None else self.urdf.digest)
        return hashlib.sha256("\n".join(words).encode() + b"".join(one.tobytes() for one in numbers)).hexdigest()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, UrModel) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    @property
    def a(self) -> tuple[float, ...]:
        """DH link lengths a1..a6, mm."""
        return (0.0, self.a2, self.a3, 0.0, 0.0, 0.0)

    @property
    def d(self) -> tuple[float, ...]:
        """DH link offsets d1..d6, mm."""
        return (self.d1, 0.0, 0.0, self.d4, self.d5, self.d6)

    @property
    def alpha(self) -> tuple[float, ...]:
        """DH link twists, rad: the same for the whole family."""
        return (math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0)

    @cached_property
    def lengths(self) -> NDArray[np.float64]:
        """(d1, a2, a3, d4, d5, d6), shape (6,), mm: the arm as compiled code takes it."""
        return read_only([self.d1, self.a2, self.a3, self.d4, self.d5, self.d6])

    @property
    def shoulder_base(self) -> NDArray[np.float64]:
        """The shoulder point, where axes 1 and 2 intersect, base frame, shape (3,), mm."""
        return np.array([0.0, 0.0, self.d1])

    def within_limits(self, q: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether configurations (..., 6), rad, keep every joint within its limits, shape (...); NaN is outside."""
        return np.asarray(np.all((q >= self.joint_limits[:, 0]) & (q <= self.joint_limits[:, 1]), axis=-1))


def _model(
    name: str, lengths_mm: tuple[float, ...], max_speeds_deg: tuple[float, ...], max_torques: tuple[float, ...]
) -> UrModel:
    d1, a2, a3, d4, d5, d6 = lengths_mm
    turns = np.full(6, 2 * math.pi)
    turns[ELBOW] = math.pi
    limits = np.stack([-turns, turns], axis=1)
    speeds, torques = np.radians(max_speeds_deg), np.array(max_torques)
    return UrModel(name, d1, a2, a3, d4, d5, d6, joint_limits=limits, max_speeds=speeds, max_torques=torques)


_SMALL = (180.0, 180.0, 180.0, 360.0, 360.0, 360.0)
_MEDIUM = (180.0,) * 6
_LARGE = (120.0, 120.0, 180.0, 180.0, 180.0, 180.0)

_WEAK = (56.0, 56.0, 28.0, 12.0, 12.0, 12.0)
_STRONG = (150.0, 150.0, 150.0, 28.0, 28.0, 28.0)
_STRONGEST = (330.0, 330.0, 150.0, 56.0, 56.0, 56.0)
"""The manufacturer's joint torques; the URDF of the UR3 carries those of a UR10. The e-Series': of its URDFs."""
UR_MODELS: Mapping[str, UrModel] = MappingProxyType(
    {
        model.name: model
        for model in (
            _model("ur3", (151.9, -243.65, -213.25, 112.35, 85.35, 81.9), _SMALL, _WEAK),
            _model("ur3e", (151.85, -243.55, -213.2, 131.05, 85.35, 92.1), _SMALL, _WEAK),
            _model("ur5", (89.159, -425.0, -392.25, 109.15, 94.65, 82.3), _MEDIUM, _STRONG),
            _model("ur5e", (162.5, -425.0, -392.2, 133.3, 99.7, 99.6), _MEDIUM, _STRONG),
            _model("ur10", (127.3, -612.0, -572.3, 163.941, 115.7, 92.2), _LARGE, _STRONGEST),
            _model("ur10e", (180.7, -612.7, -571.55, 174.15, 119.85, 116.55), _LARGE, _STRONGEST),
        )
    }
)
"""Every model that the planner knows, by name."""


def ur_model(name: str) -> UrModel:
    """The model of a name such as ``ur3``, in upper or lower case. Raises InputError: No such model is known."""
    model = UR_MODELS.get(name.lower())
    if model is None:
        refuse(f"unknown robot model {name!r}", "robot model", ", ".join(UR_MODELS), "unknown_robot")
    return model
