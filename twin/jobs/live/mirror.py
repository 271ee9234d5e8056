"""A running UR, or a recording of one, mirrored into the twin. It reads; nothing here can command a robot."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from puncture_twin.planning.arm.kinematics import check_recording, flange_pose
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import user_cache
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.files import read_input, unfinished_warnings
from puncture_twin.planning.base.provenance import Input, content_input
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.formats.points import parse_joint_recording
from puncture_twin.planning.registration.checks.checked_placement import checked_placement
from puncture_twin.planning.search.context import ALLOWED_BASE, NO_BASE
from puncture_twin.twin.jobs.live.rtde import RecordedState, connect, live_states

MAX_RECORDING_BYTES = 200_000_000
"""An hour at 125 states a second is 60 MB."""


class Mirrored(NamedTuple):
    """What the twin shows for one joint state; CT frame, mm."""

    time_s: float
    q: Floats
    T_ct_flange: Floats
    tip_ct: Floats
    to_target_mm: float
    off_axis_mm: float
    """The target's distance from the needle's line: what a straight drive would miss by."""

    def summary(self) -> dict[str, Any]:
        """Plain values: s, degrees, mm."""
        return {
            "time_s": self.time_s,
            "q_deg": np.degrees(self.q).tolist(),
            "T_ct_flange": self.T_ct_flange.tolist(),
            "tip_ct_mm": self.tip_ct.tolist(),
            "to_target_mm": self.to_target_mm,
            "off_axis_mm": self.off_axis_mm,
        }


@dataclass(frozen=True, eq=False)
class Mirror:
    """Turns joint angles into what the case's patient would see of the needle. The arm is its nominal model."""

    model: UrModel
    T_base_ct: Floats
    needle_length_mm: float
    target_ct: Floats

    @classmethod
    def of(cls, case: Case) -> Mirror:
        """The mirror of a case that says where the robot is mounted, and whose markers can be trusted."""
        checked = checked_placement(case, user_cache())
        if checked is None:
            refuse(NO_BASE, case.path, ALLOWED_BASE, "no_base")
        return cls(case.robot.model, checked.placement.T_base_ct, case.needle.length_mm, case.target_ct)

    def show(self, state: RecordedState) -> Mirrored:
        """One joint state."""
        T = np.linalg.inv(self.T_base_ct) @ flange_pose(self.model, state.q)
        forward = T[:3, 2]
        tip = T[:3, 3] + self.needle_length_mm * forward
        to_target = self.target_ct - tip
        off = np.linalg.norm(to_target - to_target @ forward * forward)
        return Mirrored(state.time_s, state.q, T, tip, float(np.linalg.norm(to_target)), float(off))


class Readings(NamedTuple):
    """The states of an arm, the inputs of what is shown of them, and what they leave open."""

    states: Iterable[RecordedState]
    inputs: tuple[Input, ...]
    warnings: tuple[str, ...] = ()


def recorded(path: Path, case: Case | None = None) -> Readings:
    """The rows of a recording, CSV as ``export --format csv`` or an RTDE client writes it; those of a case's arm.

    Raises:
        InputError: A file that cannot be read, a column is missing, something is no number, or no such arm has them.
    """
    data = read_input(path, max_bytes=MAX_RECORDING_BYTES, where=str(path))
    read = parse_joint_recording(data, path, timed=True)
    assert read.time_s is not None
    if case is not None:
        check_recording(case.robot.model, case.needle.length_mm, read, where=path)
    inputs = (content_input("recording", path.name, data), *(() if case is None else case.inputs))
    return Readings(map(RecordedState, read.time_s.tolist(), read.q), inputs, unfinished_warnings(data, path.name))


def readings_of(
    host: str | None, recording: Path | None, case: Case, *, period_s: float, seconds: float | None
) -> Readings:
    """The readings of a running arm, for so many seconds or until it is interrupted, or of a recording."""
    if recording is None and host is not None:
        return Readings(live_states(connect(host), period_s=period_s, seconds=seconds), case.inputs)
    if recording is None or host is not None:
        refuse("two sources of joints, or none", "mirror", "HOST, or --from joints.csv", "conflicting_options")
    return recorded(recording, case)


def mirror_text(shown: Mirrored) -> str:
    """One state of a mirrored arm."""
    x, y, z = shown.tip_ct
    joints = " ".join(f"{angle:7.2f}" for angle in np.degrees(shown.q))
    return (
        f"{shown.time_s:9.3f} s  joints {joints} deg  tip (CT) {x:8.2f} {y:8.2f} {z:8.2f} mm"
        f"  to target {shown.to_target_mm:7.2f} mm, off its line {shown.off_axis_mm:6.2f} mm"
    )
