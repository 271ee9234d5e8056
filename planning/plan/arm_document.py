"""The arm of a plan as its file states it: a name, and for any but the table's own arm the numbers behind it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from puncture_twin.planning.arm.ur import UR_MODELS, UrModel, ur_model
from puncture_twin.planning.base.strict_json import array, number, text

ARM_NAMES = (
    *("shipped", "lengths_mm", "joint_limits_rad", "max_speeds_rad_s", "max_torques_nm"),
    *("max_acceleration_rad_s2", "joint_names"),
)
"""Keys of an arm that is stated by its numbers."""


def arm_document(model: UrModel) -> dict[str, Any] | None:
    """The numbers of an arm; None for one of the table, whose name says them."""
    if UR_MODELS.get(model.name) == model:
        return None
    return {
        "shipped": model.shipped,
        "lengths_mm": model.lengths.tolist(),
        "joint_limits_rad": model.joint_limits.tolist(),
        "max_speeds_rad_s": model.max_speeds.tolist(),
        "max_torques_nm": model.max_torques.tolist(),
        "max_acceleration_rad_s2": model.max_acceleration,
        "joint_names": list(model.joint_names),
    }


def read_arm(name: str, document: Any) -> UrModel:
    """The arm of a plan that was read; one of the user's own has no shapes yet, which its case holds.

    Args:
        name: As the plan states it.
        document: Of `arm_document`, or None.

    Raises:
        InputError: No arm of that name.
        TypeError, KeyError, ValueError: Numbers that are no arm's.
    """
    if document is None:
        return ur_model(name)
    if set(document) != set(ARM_NAMES):
        raise ValueError(f"an arm is stated by {', '.join(ARM_NAMES)}")
    d1, a2, a3, d4, d5, d6 = array(document["lengths_mm"], (6,)).tolist()
    model = UrModel(
        *(name, d1, a2, a3, d4, d5, d6),
        joint_limits=array(document["joint_limits_rad"], (6, 2)),
        max_speeds=array(document["max_speeds_rad_s"], (6,)),
        max_torques=array(document["max_torques_nm"], (6,)),
        max_acceleration=number(document["max_acceleration_rad_s2"]),
        joint_names=tuple(text(one) for one in document["joint_names"]),
        shipped=document["shipped"] is True,
    )
    _check(model)
    return model


def same_arm(one: UrModel, other: UrModel) -> bool:
    """Whether two arms have the same numbers; the shapes of an own arm are those of the case's inputs."""
    return replace(one, urdf=None) == replace(other, urdf=None)


def _check(model: UrModel) -> None:
    """Refuse numbers that no arm has, and an arm of the table that is not the table's but for narrower limits."""
    positive = np.array([1, -1, -1, 1, 1, 1]) * model.lengths
    low, high = model.joint_limits.T
    above_zero = [positive, high - low, model.max_speeds, model.max_torques, np.array([model.max_acceleration])]
    if not all(bool((values > 0.0).all()) for values in above_zero) or len(model.joint_names) != len(low):
        raise ValueError("lengths, limits, speeds and torques are those of no arm")
    if model.shipped:
        known = ur_model(model.name)
        narrower = replace(known, joint_limits=model.joint_limits, max_speeds=model.max_speeds)
        within = known.within_limits(model.joint_limits.T).all() and (model.max_speeds <= known.max_speeds).all()
        if narrower != model or not within:
            raise ValueError(f"the numbers are not those of a {model.name}")
