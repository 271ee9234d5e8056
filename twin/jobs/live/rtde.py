"""A running UR, read by RTDE: its states, and an `Arm` that somebody else moves. Nothing here can command a robot."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError, NoAnswerError, refuse, require_extra
from puncture_twin.planning.formats.points import joint_readings

RTDE_PORT = 30004
"""On which a controller tells its state; the only port that is used."""
VARIABLES = ("timestamp", "actual_q")
"""What the controller is queried to tell."""
MAX_HOST, MAX_LABEL = 253, 63
"""Characters of a name on a network, and between two of its dots (RFC 1035)."""
ANSWER_S = 5.0
"""A controller that does not take the call within this time is not there."""
SILENCE_S = 1.0
"""A controller that tells nothing new for so long has stopped: it tells its state at least every 8 ms."""
STILL_RAD, STILL_S = np.radians(0.02), 0.5
"""An arm rests that has not turned a joint by more for so long, by its own clock."""
NEAR_RAD = np.radians(0.5)
"""An arm that is led rests where it is wished when no joint is farther from there."""
LED_S = 300.0
"""By its clock, an arm that is not led to rest by then is not led."""


class Receiver(Protocol):
    """The part of ``rtde_receive.RTDEReceiveInterface`` that is used: it only reads."""

    def getActualQ(self) -> list[float]:  # noqa: N802  # the library's name
        """The joint angles, rad."""

    def getTimestamp(self) -> float:  # noqa: N802  # the library's name
        """Seconds since the controller started; 0 before its first word."""

    def isConnected(self) -> bool:  # noqa: N802  # the library's name
        """Whether the line stands."""


class RecordedState(NamedTuple):
    """The joints (6,), rad, at one time."""

    time_s: float
    q: Floats  # shape (6,), rad


def connect(host: str, command: str = "mirror") -> Receiver:
    """The receiving half of RTDE; the controlling half is never opened. Who does not answer is refused."""
    labels = [len(label) for label in host.removesuffix(".").split(".")]
    fits = len(host) <= MAX_HOST and min(labels) > 0 and max(labels) <= MAX_LABEL
    if not fits or not host.isprintable() or any(map(str.isspace, host)):
        what = f"host name of {len(host)} characters, {min(labels)} to {max(labels)} between dots, or with spaces"
        allowed = f"a name or address of 1 to {MAX_HOST} characters, 1 to {MAX_LABEL} between dots"
        refuse(what, f"{command} {host}", allowed, "bad_host")
    require_extra("mirror", command)
    from rtde_receive import RTDEReceiveInterface

    try:  # first by ourselves: the library waits for minutes, and cannot be interrupted
        socket.create_connection((host, RTDE_PORT), timeout=ANSWER_S).close()
        receiver: Receiver = RTDEReceiveInterface(host, variables=list(VARIABLES))
    except (OSError, RuntimeError, ValueError) as error:  # ValueError: a name that no address can have
        where = f"{command} {host}, port {RTDE_PORT}"
        what = f"the robot does not answer: {error}"
        raise InputError(what, where=where, allowed="a UR that is switched on", code="no_robot_answers") from error
    return receiver


def live_states(receiver: Receiver, *, period_s: float, seconds: float | None) -> Iterator[RecordedState]:
    """What a receiver reads, every so often; nothing twice. Time and angles may be one package (8 ms) apart.

    Args:
        seconds: How long, by the robot's clock; None for ever.

    Raises:
        InputError: The robot hangs up or falls silent, or tells something that is no joint angles.
    """
    start, last, heard = None, 0.0, time.monotonic()
    while True:
        time_s, where = receiver.getTimestamp(), "the robot's answer"
        if not np.isfinite(time_s):
            refuse(f"a time of {time_s} s", where, "a finite time", "not_finite")
        state = RecordedState(float(time_s), joint_readings([receiver.getActualQ()], "rad", where=where)[0])
        if state.time_s != last:
            start = state.time_s if start is None else start
            last, heard = state.time_s, time.monotonic()
            if seconds is not None and state.time_s - start > seconds:
                return
            yield state
        elif not receiver.isConnected() or time.monotonic() - heard > SILENCE_S:
            # the library goes on to give the last state it has heard
            said = "closed the connection" if not receiver.isConnected() else "sends nothing new"
            refuse(f"the robot {said}, {last:.3f} s by its clock", "RTDE", "a UR that is switched on", "robot_silent")
        time.sleep(period_s)


@dataclass(frozen=True)
class LedArm:
    """A UR that somebody else moves, by hand or by its pendant: an `Arm` that reads, and waits until it is there."""

    receiver: Receiver
    period_s: float = 0.02

    def measured_jp(self) -> Floats:
        """Joints (6,), rad, of the first rest from now on, a mean; a `NoAnswerError` where none begins in `LED_S`."""
        return next(self._rests())

    def move_jp(self, q: Floats) -> None:
        """Wait until it rests at joints (6,), rad, within `NEAR_RAD`; errors as of `measured_jp`."""
        next(rest for rest in self._rests() if np.abs(rest - q).max() <= NEAR_RAD)

    def _rests(self) -> Iterator[Floats]:
        """One rest after the other; a long one again and again."""
        since: list[RecordedState] = []
        for state in live_states(self.receiver, period_s=self.period_s, seconds=LED_S):
            if since and np.abs(state.q - since[0].q).max() > STILL_RAD:
                since.clear()
            since.append(state)
            if state.time_s - since[0].time_s >= STILL_S:
                yield np.mean([one.q for one in since], axis=0)
                since.clear()
        what = f"in {LED_S:g} s the arm did not come to rest where it was to be led"
        raise NoAnswerError(what, code="not_led")
