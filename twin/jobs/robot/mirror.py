"""A running UR, or a recording of one, mirrored into the twin. It reads; nothing here can command a robot."""

from __future__ import annotations

import csv
import socket
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import user_cache
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.input_file import decode_text, read_input, unfinished_warnings
from puncture_twin.planning.base.provenance import Input, content_input
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.registration.checks.checked_placement import checked_placement
from puncture_twin.twin.jobs.extras import require_extra

JOINT_COLUMNS = tuple(f"q{joint}_rad" for joint in range(1, 7))
"""Of a recording, beside ``time_s``: the columns that ``export --format csv`` writes."""

MAX_RECORDING_BYTES = 200_000_000
"""An hour at 125 states a second is 60 MB."""

RTDE_PORT = 30004
"""On which a controller tells its state; the only port that is used."""

VARIABLES = ("timestamp", "actual_q")
"""What the controller is queried to tell."""

MAX_HOST = 253
"""Characters of a name on a network (RFC 1035)."""

ANSWER_S = 5.0
"""A controller that does not take the call within this time is not there."""

SILENCE_S = 1.0
"""A controller that tells nothing new for so long has stopped: it tells its state at least every 8 ms."""


class Receiver(Protocol):
    """The part of ``rtde_receive.RTDEReceiveInterface`` that is used: it only reads."""

    def getActualQ(self) -> list[float]:  # noqa: N802  # the library's name
        """The joint angles, rad."""
        ...

    def getTimestamp(self) -> float:  # noqa: N802  # the library's name
        """Seconds since the controller started; 0 before its first word."""
        ...

    def isConnected(self) -> bool:  # noqa: N802  # the library's name
        """Whether the line stands."""
        ...


class RecordedState(NamedTuple):
    """The joints at one time."""

    time_s: float
    q: Floats
    """Shape (6,), rad."""


class Mirrored(NamedTuple):
    """What the twin shows for one joint state; CT frame, mm."""

    time_s: float
    q: Floats
    T_ct_flange: Floats
    tip_ct: Floats
    to_target_mm: float
    """Tip to target."""
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
        """The mirror of a case.

        Raises:
            InputError: The case does not say where the robot stands, or its markers cannot be trusted.
        """
        checked = checked_placement(case, user_cache())
        if checked is None:
            allowed = "[registration] with markers, or [robot.mount]"
            raise InputError("the case does not say where the robot stands", where=case.path, allowed=allowed)
        return cls(case.robot.model, checked.placement.T_base_ct, case.needle.length_mm, case.target_ct)

    def show(self, state: RecordedState) -> Mirrored:
        """One joint state."""
        T = np.linalg.inv(self.T_base_ct) @ flange_pose(self.model, state.q)
        forward = T[:3, 2]
        tip = T[:3, 3] + self.needle_length_mm * forward
        to_target = self.target_ct - tip
        off = np.linalg.norm(to_target - (to_target @ forward) * forward)
        return Mirrored(state.time_s, state.q, T, tip, float(np.linalg.norm(to_target)), float(off))

    def follow(self, states: Iterable[RecordedState]) -> Iterator[Mirrored]:
        """One after the other."""
        return map(self.show, states)


def connect(host: str) -> Receiver:
    """The receiving half of RTDE; the controlling half is never opened.

    Raises:
        InputError: The extra is not installed, or no robot answers there.
    """
    require_extra("mirror", "mirror")
    from rtde_receive import RTDEReceiveInterface

    _check_host(host)
    try:  # first by ourselves: the library waits for minutes, and cannot be interrupted
        socket.create_connection((host, RTDE_PORT), timeout=ANSWER_S).close()
        receiver: Receiver = RTDEReceiveInterface(host, variables=list(VARIABLES))
    except (OSError, RuntimeError, ValueError) as error:  # ValueError: a name that no address can have
        where = f"mirror {host}, port {RTDE_PORT}"
        raise InputError(f"no robot answers: {error}", where=where, allowed="a UR that is on") from error
    return receiver


def _check_host(host: str) -> None:
    if not 0 < len(host) <= MAX_HOST or not host.isprintable() or any(c.isspace() for c in host):
        what = f"host of {len(host)} characters, or with spaces in it"
        raise InputError(what, where=f"mirror {host}", allowed=f"a name or address of 1 to {MAX_HOST} characters")


def live_states(receiver: Receiver, *, period_s: float, seconds: float | None) -> Iterator[RecordedState]:
    """What a receiver reads, every so often; nothing twice. Time and angles may be one package (8 ms) apart.

    Args:
        receiver: A running arm.
        period_s: Between two readings.
        seconds: How long, by the robot's clock; None for ever.

    Raises:
        InputError: The robot hangs up or falls silent, or tells something that is no joint angles.
    """
    start, last, heard = None, 0.0, time.monotonic()
    while True:
        state = checked(receiver.getTimestamp(), receiver.getActualQ(), "the robot's answer")
        if state.time_s != last:
            start = state.time_s if start is None else start
            last, heard = state.time_s, time.monotonic()
            if seconds is not None and state.time_s - start > seconds:
                return
            yield state
        elif not receiver.isConnected() or time.monotonic() - heard > SILENCE_S:
            # the library goes on to give the last state it has heard
            said = "hung up" if not receiver.isConnected() else "tells nothing new"
            raise InputError(f"the robot {said}, {last:.3f} s by its clock", where="mirror", allowed="a UR that is on")
        time.sleep(period_s)


@dataclass(frozen=True, eq=False)
class RecordedJoints:
    """A recording: CSV with ``time_s`` and ``q1_rad`` .. ``q6_rad``; other columns and lines with # do not count."""

    path: Path
    data: bytes

    @classmethod
    def read(cls, path: Path) -> RecordedJoints:
        """Read the file, once.

        Raises:
            InputError: It cannot be read.
        """
        return cls(path, read_input(path, max_bytes=MAX_RECORDING_BYTES, where=str(path)))

    @property
    def input(self) -> Input:
        """As an input of what is shown."""
        return content_input("recording", self.path.name, self.data)

    def states(self) -> Iterator[RecordedState]:
        """One row after the other.

        Raises:
            InputError: A column is missing, or something is no number.
        """
        lines = decode_text(self.data, str(self.path)).splitlines()
        table = csv.DictReader((line for line in lines if line.strip() and not line.startswith("#")), strict=True)
        try:
            yield from _states(table, self.path)
        except csv.Error as error:
            raise InputError(f"is no CSV ({error})", where=self.path, allowed="a CSV of joint angles") from error

    def warnings(self) -> tuple[str, ...]:
        """What the recording's end leaves open, one sentence each."""
        return unfinished_warnings(self.data, self.path.name)


def _states(table: csv.DictReader[str], path: Path) -> Iterator[RecordedState]:
    wanted = ("time_s", *JOINT_COLUMNS)
    missing = [name for name in wanted if name not in (table.fieldnames or ())]
    if missing:
        raise InputError(f"lacks {', '.join(missing)}", where=path, allowed=", ".join(wanted))
    for number, row in enumerate(table, start=1):
        try:
            t, *q = (float(row[name]) for name in wanted)
        except (TypeError, ValueError) as error:
            raise InputError(f"row {number} holds no number", where=path, allowed="numbers: s and rad") from error
        yield checked(t, q, f"{path}: row {number}")


def checked(time_s: float, q: list[float], where: str) -> RecordedState:
    """Joint angles that are six finite numbers.

    Raises:
        InputError: They are not.
    """
    angles = np.asarray(q, dtype=np.float64)
    if angles.shape != (6,) or not np.isfinite(angles).all() or not np.isfinite(time_s):
        raise InputError(f"joint angles {q} at {time_s} s", where=where, allowed="a time and six finite angles, rad")
    return RecordedState(float(time_s), angles)


def mirror_text(shown: Mirrored) -> str:
    """One state of a mirrored arm."""
    x, y, z = shown.tip_ct
    joints = " ".join(f"{angle:7.2f}" for angle in np.degrees(shown.q))
    return (
        f"{shown.time_s:9.3f} s  joints {joints} deg  tip (CT) {x:8.2f} {y:8.2f} {z:8.2f} mm"
        f"  to target {shown.to_target_mm:7.2f} mm, off its line {shown.off_axis_mm:6.2f} mm"
    )
