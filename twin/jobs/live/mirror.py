"""A running UR, read by RTDE, or a recording of one. It reads; nothing here can command a robot.

`mirror` shows its needle in the CT; `touch CASE --host HOST` takes off its joints the markers that somebody touches.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from puncture_twin.planning.arm.kinematics import check_recording, flange_pose
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import user_cache
from puncture_twin.planning.base.errors import InputError, NoAnswerError, refuse, require_extra
from puncture_twin.planning.base.files import read_input, unfinished_warnings
from puncture_twin.planning.base.output.output_set import writing
from puncture_twin.planning.base.provenance import Input, content_input, inputs_document
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.formats.points import NamedPoints, joint_readings, parse_joint_recording, write_points
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.checks.checked_placement import checked_placement
from puncture_twin.planning.registration.fits import fit_rigid
from puncture_twin.planning.registration.marker_pairs import MIN_MARKERS
from puncture_twin.planning.search.choice import Choice
from puncture_twin.planning.search.context import ALLOWED_BASE, NO_BASE
from puncture_twin.twin.jobs.terminal import write_result
from puncture_twin.twin.plant.truth import read_points
from puncture_twin.twin.report.present import Field, Section, footer, grid, text

if TYPE_CHECKING:  # with the planner of motions, which reading an arm does not need
    from puncture_twin.twin.devices import Arm

RTDE_PORT = 30004  # on which a controller tells its state; the only port that is used
VARIABLES = ("timestamp", "actual_q")  # what the controller is queried to tell
MAX_HOST, MAX_LABEL = 253, 63  # characters of a name on a network, and between two of its dots (RFC 1035)
ANSWER_S = 5.0  # a controller that does not take the call within this time is not there
SILENCE_S = 1.0  # a controller that tells nothing new for so long has stopped: it tells its state at least every 8 ms
STILL_RAD, STILL_S = np.radians(0.02), 0.5  # an arm rests that turned no joint by more for so long by its clock
NEAR_RAD = np.radians(0.5)  # an arm that is led rests where it is wished when no joint is farther from there
LED_S = 300.0  # by its clock, an arm that is not led to rest by then is not led
MAX_RECORDING_BYTES = 200_000_000  # an hour at 125 states a second is 60 MB
TOUCH, SUMMARY = "touch.csv", "touch.json"


class Receiver(Protocol):
    """The part of ``rtde_receive.RTDEReceiveInterface`` that is used: it only reads."""

    def getActualQ(self) -> list[float]:  # noqa: N802  # the library's name
        """The joint angles, rad."""

    def getTimestamp(self) -> float:  # noqa: N802  # the library's name
        """Seconds since the controller started; 0 before its first word."""

    def isConnected(self) -> bool:  # noqa: N802  # the library's name
        """Whether the connection is up."""


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
    """States that a receiver reads, at intervals, none twice. Time and angles may be one package (8 ms) apart.

    It ends after so many seconds of the robot's clock, or never of None. Raises InputError: The robot hangs up or falls
    silent, or tells something that is no joint angles.
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
        """Rests of the arm, one after the other; a long one again and again."""
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


class Mirrored(NamedTuple):
    """Needle and arm of one joint state; CT frame, mm."""

    time_s: float
    q: Floats
    T_ct_flange: Floats
    tip_ct: Floats
    to_target_mm: float
    off_axis_mm: float  # the target's distance from the needle's line: what a straight drive would miss by

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
    """Computes the needle in the case's patient from joint angles. The arm is its nominal model."""

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
        """The mirrored needle and arm of one joint state."""
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

    Raises InputError: It cannot be read, a column is missing, something is no number, or no such arm has them.
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
    """Text of one state of a mirrored arm."""
    x, y, z = shown.tip_ct
    joints = " ".join(f"{angle:7.2f}" for angle in np.degrees(shown.q))
    return (
        f"{shown.time_s:9.3f} s  joints {joints} deg  tip (CT) {x:8.2f} {y:8.2f} {z:8.2f} mm"
        f"  to target {shown.to_target_mm:7.2f} mm, off its line {shown.off_axis_mm:6.2f} mm"
    )


@dataclass(frozen=True, eq=False)
class LedTouches:
    """The k markers that were touched of a case's n, in its CT, and where the arm read them, base frame, mm."""

    case: Case
    ct: NamedPoints
    base: NamedPoints
    left_out: tuple[str, ...]
    files: tuple[Path, ...] = ()

    @property
    def suffices(self) -> bool:
        """Whether the readings register."""
        return len(self.base.names) >= MIN_MARKERS

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON: mm and degrees; what the rigid fit leaves of each marker, None of fewer than three."""
        assert self.base.joints is not None
        left: Floats | None = None
        if self.suffices:
            T_base_ct = fit_rigid(self.ct.points, self.base.points)
            left = np.linalg.norm(apply(T_base_ct, self.ct.points) - self.base.points, axis=1)
        rows = zip(self.base.names, self.base.points, np.degrees(self.base.joints), strict=True)
        return {
            "case": self.case.name,
            "touches": [
                {"marker": name, "point_mm": point.tolist(), "joints_deg": q.tolist(),
                 "residual_mm": None if left is None else float(left[row])}
                for row, (name, point, q) in enumerate(rows)
            ],
            "left_out": list(self.left_out),
            "suffices": self.suffices,
            "fre_mm": None if left is None else float(np.sqrt(np.mean(left**2))),
            "inputs": inputs_document(self.case.inputs),
            "files": [str(path) for path in self.files],
        }  # fmt: skip


def refuse_twin_options(choice: Choice, seed: int) -> None:
    """Refuse options of the twin alone beside ``--host``."""
    if choice != Choice() or seed:
        refuse("a direction, or a seed, beside --host", "touch", "--host HOST alone: no tour is planned",
               "conflicting_options")  # fmt: skip


def touch_by_hand(case: Case, arm: Arm, ready: Callable[[str], bool], out: Path) -> LedTouches:
    """Read the arm at each of a case's markers, by its nominal kinematics; written as `markers_base` is read.

    `ready` asks for a marker, and returns when the tip is on it; False where nobody touches any more. Raises
    InputError: No markers, none is touched, or the robot hangs up. NoAnswerError: The arm does not come to rest.
    """
    if case.registration is None:
        refuse("no list of markers", case.path, "[registration] markers_ct", "no_markers")
    listed = read_points(case, case.registration.markers_ct, case.space)
    q = np.array([arm.measured_jp() for _ in takewhile(ready, listed.names)]).reshape(-1, 6)
    if not (count := len(q)):
        refuse("no marker was touched", "touch --host", "a line (Enter) for each, the tip on it", "empty")
    T = flange_pose(case.robot.model, q)
    tips = T[:, :3, 3] + case.needle.length_mm * T[:, :3, 2]
    ct = NamedPoints(listed.names[:count], listed.points[:count], listed.space)
    read = LedTouches(case, ct, NamedPoints(ct.names, tips, None, joints=q), listed.names[count:])
    with writing(out, "touch", inputs=case.inputs, names=(TOUCH, SUMMARY)) as draft:
        read = replace(read, files=draft.final(tuple(draft.folder / name for name in (TOUCH, SUMMARY))))
        write_points(draft.folder / TOUCH, read.base)
        write_result(read.summary(), draft.folder / SUMMARY, out)
    return read


ROWS = (
    Field("marker", "marker"),
    Field("base frame, mm", lambda row: "  ".join(f"{mm:8.2f}" for mm in row["point_mm"])),
    Field("the rigid fit leaves", "residual_mm", 2, "mm"),
)


def led_text(read: LedTouches) -> str:
    """Text of touches that were led by hand, for the terminal."""
    said = read.summary()
    left = [f"not touched: {', '.join(said['left_out'])}"] if said["left_out"] else []
    few = [] if read.suffices else [f"no registration: {MIN_MARKERS} markers are needed"]
    head = f"{len(said['touches'])} markers read off the joints of the nominal {read.case.robot.model.name}"
    return text([Section(head, [grid(ROWS, said["touches"]), *left, *few]), *footer(read.files)])
