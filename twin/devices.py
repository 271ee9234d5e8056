"""The devices that guidance speaks to: commands in, readings out, named as the CRTK convention names them.

``jp`` are joint positions, ``cp`` is a place in space; `measured` is what a device reads, `move` ends at rest.
"""

from contextlib import AbstractContextManager
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats, Pixels
from puncture_twin.planning.base.provenance import Input
from puncture_twin.planning.formats.volumes.volume_files import Volume
from puncture_twin.planning.motion.trajectory import Trajectory
from puncture_twin.planning.touch.tour_motions import Touch


class GreyImage(NamedTuple):
    """A grey image, or a part of one."""

    grey: NDArray[np.uint8]
    """Shape (h, w)."""
    offset: tuple[int, int] = (0, 0)
    """Column and row, in the camera's image, of the part's first pixel."""


class Arm(Protocol):
    """An arm under position control."""

    def move_jp(self, q: Floats) -> None:
        """Move to joints (6,), rad, and return when they are at rest."""

    def measured_jp(self) -> Floats:
        """Joints (6,), rad, that the encoders read at rest."""


class Cameras(Protocol):
    """Cameras that are read one at a time."""

    def measured_image(self, number: int, about_px: Floats, reach_px: float) -> GreyImage:
        """A new image of a camera, from 0, that shows at least what is within reach of a pixel (2,)."""


class MeasuringArm(Protocol):
    """A coordinate measuring arm that touches the ball on the tool."""

    def measured_cp(self) -> Floats:
        """The ball's centre, shape (3,), mm, in the measuring arm's own frame."""


class Operator(Protocol):
    """A person who points at a marker in the images of both cameras."""

    def pointed_cp(self, marker: str) -> Floats:
        """Rough position of the marker, shape (3,), mm, in the measuring arm's frame."""


class Probe(Protocol):
    """An ultrasound probe."""

    def measured_image(self) -> Pixels:
        """A new B-mode image, grey levels, shape (rows, columns)."""


class JogOperator(Protocol):
    """A person who jogs the needle's arm until the needle shows in the image, or a servo that does."""

    def jogged_jp(self, tip_mm: Floats, direction: Floats, roll: float, q: Floats) -> Floats:
        """Joints (6,), rad, at which tip (2,) and direction (2,) show as wished, not moved to yet; NaN out of reach."""


class ControlScan(NamedTuple):
    """A CT of the patient in the scanner's own frame, LPS mm, Hounsfield units."""

    volume: Volume
    frame: str = ""
    """Its frame of reference by the scanner's own name, as in DICOM; empty where it states none."""
    inputs: tuple[Input, ...] = ()
    """Files that the scan was read from."""


class Scanner(Protocol):
    """A CT scanner."""

    def measured_scan(self) -> ControlScan:
        """A new scan, or the one that was taken."""


class StoppedError(Exception):
    """The arm stopped where it had no planned path: something is not where it is believed to be."""


class Moved(NamedTuple):
    """Result of a motion of an arm with a force sensor."""

    q: Floats
    """Shape (6,), rad: encoders at its end."""
    seconds: float
    force_n: float
    """The largest on the needle."""
    contact: bool
    """Whether it ended at a contact, before its own end."""


class TouchingArm(Protocol):
    """An arm whose needle touches markers, with a force sensor, and somebody who sets the needle's line by eye.

    Every motion raises `StoppedError` where arm or needle touches what it should not.
    """

    def at_marker(self, touch: Touch) -> AbstractContextManager[Floats]:
        """For as long as one marker is touched: joints (6,), rad, at which the needle's line is set onto it by eye."""

    def move(self, motion: Trajectory, *, in_air: bool = False) -> Moved:
        """Follow a motion by the motors; ``in_air`` the needle must stay out of the patient."""

    def move_until_contact(self, motion: Trajectory, *, yielding: bool) -> Moved:
        """Follow a motion until the needle's tip is pressed; ``yielding`` with a spring at the tip."""
