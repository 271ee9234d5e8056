"""Wire calibration of the PLUS toolkit: its files (phantom and place, frames, matrix found), and a fit of our own.

The unknowns are those of PLUS: T_probe_image without its third column, which no image point excites (9 numbers: the two
axes in mm per pixel, with their lengths and the angle between them free, and the origin). A point (u, v), seen on a
wire through a with unit direction d, satisfies (I - d d^T)(R_i (u x1 + v x2 + t) + t_i - a) = 0: it is linear in the
unknowns, so that the least squares of the distances need no start.
"""

from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.errors import refuse

Floats = NDArray[np.float64]
LEAST_RATIO = 1e-4
"""Least over largest singular value of the system (pixels in hundreds) below which the fit is refused."""
PIXELS = 100.0
"""Pixels are counted in this unit, so that the columns of the system are of one size."""


class Wires(NamedTuple):
    """Straight wires in the reference frame; directions (k, 3), unit."""

    names: tuple[str, ...]
    points: Floats
    directions: Floats


class WireFrames(NamedTuple):
    """Images of the wires, and where each wire was seen, (n, k, 2), pixels."""

    T_reference_probe: Floats
    points_px: Floats


def point_to_wire_mm(T_probe_image: Floats, frames: WireFrames, wires: Wires) -> Floats:
    """Distance of every seen point from its wire, shape (n, k), mm."""
    in_probe = frames.points_px @ T_probe_image[:3, :2].T + T_probe_image[:3, 3]
    T = frames.T_reference_probe
    offset = np.einsum("nij,nkj->nki", T[:, :3, :3], in_probe) + T[:, None, :3, 3] - wires.points
    along = np.einsum("nki,ki->nk", offset, wires.directions)
    return np.asarray(np.linalg.norm(offset - along[:, :, None] * wires.directions, axis=2))


def fit_image(frames: WireFrames, wires: Wires) -> Floats:
    """T_probe_image of least squared distances, (4, 4); its third column is the normal, as long as a mean pixel."""
    across = np.eye(3) - wires.directions[:, :, None] * wires.directions[:, None, :]
    T, scaled = frames.T_reference_probe, frames.points_px / PIXELS
    weights = np.concatenate([scaled, np.ones((*scaled.shape[:2], 1))], axis=2)
    blocks = np.einsum("nkc,kij,njm->nkicm", weights, across, T[:, :3, :3])
    right = np.einsum("kij,nkj->nki", across, wires.points - T[:, None, :3, 3])
    system = blocks.reshape(-1, 9)
    solution, _, _, values = np.linalg.lstsq(system, right.ravel(), rcond=None)
    if values[-1] < LEAST_RATIO * values[0]:
        what = f"the probe hardly moved (singular value ratio {values[-1] / values[0]:.1e})"
        refuse(what, "wires", "frames from several sides of the wires", "undetermined")
    x1, x2, origin = solution.reshape(3, 3) / np.array([[PIXELS], [PIXELS], [1.0]])
    normal = np.cross(x1, x2)
    T_probe_image = np.eye(4)
    T_probe_image[:3] = np.column_stack([x1, x2, normal / np.sqrt(np.linalg.norm(normal)), origin])
    return T_probe_image


class PlusCalibration(NamedTuple):
    """A results file; the published matrix has shape (4, 4), pixels to mm."""

    T_probe_image: Floats
    calibration: WireFrames
    validation: WireFrames


def read_wires(path: Path) -> Wires:
    """The wires of a device set file, in the reference frame (its Phantom-to-Reference transform applied)."""
    root = ElementTree.parse(path).getroot()
    placed, wires = _named_transform(root, "Phantom", "Reference"), list(root.iter("Wire"))
    ends = (np.array([_numbers(wire.attrib[f"EndPoint{end}"]) for wire in wires]) for end in ("Front", "Back"))
    front, back = (points @ placed[:3, :3].T + placed[:3, 3] for points in ends)
    along = back - front
    directions = along / np.linalg.norm(along, axis=1, keepdims=True)
    return Wires(tuple(wire.attrib["Name"] for wire in wires), front, directions)


def read_results(path: Path, wires: Wires) -> PlusCalibration:
    """The frames and the matrix of a results file; points are sorted as the wires are."""
    root = ElementTree.parse(path).getroot()
    sets = [_frames(next(root.iter(tag)), wires) for tag in ("CalibrationData", "ValidationData")]
    return PlusCalibration(_named_transform(root, "Image", "Probe"), *sets)


def _frames(parent: ElementTree.Element, wires: Wires) -> WireFrames:
    poses, points = [], []
    for frame in parent.findall("Frame"):
        fields = {field.get("Name"): field.get("Value", "") for field in frame.iter("CustomFrameField")}
        probe, reference = (_matrix(fields[f"{name}ToTrackerTransform"]) for name in ("Probe", "Reference"))
        poses.append(np.linalg.inv(reference) @ probe)
        listed = next(frame.iter("SegmentedPoints")).findall("Point")
        seen = {point.get("WireName"): _numbers(point.attrib["Position"])[:2] for point in listed}
        assert set(seen) == set(wires.names)
        points.append([seen[name] for name in wires.names])
    poses = np.array(poses)
    R = poses[:, :3, :3]
    assert np.abs(R.transpose(0, 2, 1) @ R - np.eye(3)).max() < 2e-3 and np.linalg.det(R).min() > 0  # six digits
    return WireFrames(poses, np.array(points))


def _named_transform(root: ElementTree.Element, source: str, target: str) -> Floats:
    named = (one for one in root.iter("Transform") if (one.get("From"), one.get("To")) == (source, target))
    return _matrix(next(named).attrib["Matrix"])


def _matrix(text: str) -> Floats:
    return _numbers(text).reshape(4, 4)


def _numbers(text: str) -> Floats:
    return np.array(text.split(), dtype=np.float64)
