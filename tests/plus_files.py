"""What the PLUS toolkit writes about a wire calibration: the phantom and its place, the frames, the matrix found."""

from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
from linear_wires import WireFrames, Wires
from numpy.typing import NDArray

Floats = NDArray[np.float64]


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
