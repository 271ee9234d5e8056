"""What the PLUS toolkit writes about a wire calibration: the phantom and its place, the frames, the matrix found."""

from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
from linear_wires import WireFrames, Wires
from numpy.typing import NDArray

from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.base.files import read_input

Floats = NDArray[np.float64]

MAX_BYTES = 100_000_000
"""A hundred times a usual results file."""

RIGID_TO = 1e-3
"""Largest entry of |R^T R - 1| of a tracker's matrix: it is written with six digits."""


class PlusCalibration(NamedTuple):
    """A results file."""

    T_probe_image: Floats
    """The published matrix, shape (4, 4), pixels to mm."""
    calibration: WireFrames
    validation: WireFrames


def read_wires(path: Path) -> Wires:
    """The wires of a device set file, in the reference frame (its Phantom-to-Reference transform applied).

    Raises:
        InputError: No such file, no XML, or no phantom with wires in it.
    """
    root = _root(path)
    placed = _named_transform(root, "Phantom", "Reference", path)
    wires = list(root.iter("Wire"))
    if not wires:
        refuse("no wire", path, "a PLUS device set with a PhantomDefinition", "empty")
    front, back = (_ends(wires, end, path) @ placed[:3, :3].T + placed[:3, 3] for end in ("Front", "Back"))
    along = back - front
    directions = along / np.linalg.norm(along, axis=1, keepdims=True)
    return Wires(tuple(_attribute(w, "Name", path) for w in wires), front, directions)


def read_results(path: Path, wires: Wires) -> PlusCalibration:
    """The frames and the matrix of a results file; points are sorted as the wires are.

    Raises:
        InputError: No such file, no XML, or a frame that lacks a wire, a pose or a number.
    """
    root = _root(path)
    published = _named_transform(root, "Image", "Probe", path)
    sets = [_frames(_found(root, tag, path), wires, path) for tag in ("CalibrationData", "ValidationData")]
    return PlusCalibration(published, *sets)


def _frames(parent: ElementTree.Element, wires: Wires, path: Path) -> WireFrames:
    poses, points = [], []
    for number, frame in enumerate(parent.findall("Frame")):
        where = f"{path}, {parent.tag}, frame {number}"
        fields = {f.get("Name"): f.get("Value", "") for f in frame.iter("CustomFrameField")}
        probe, reference = (
            _matrix(fields.get(f"{name}ToTrackerTransform", ""), where, rigid=True) for name in ("Probe", "Reference")
        )
        poses.append(np.linalg.inv(reference) @ probe)
        listed = _found(frame, "SegmentedPoints", where).findall("Point")
        seen = {p.get("WireName"): _numbers(_attribute(p, "Position", where), 3, where)[:2] for p in listed}
        if set(seen) != set(wires.names):
            refuse(f"points on {len(seen)} wires", where, f"one on each of {len(wires.names)}", "wrong_count")
        points.append([seen[name] for name in wires.names])
    if not poses:
        refuse(f"no frame in {parent.tag}", path, "frames with points on the wires", "missing_key")
    return WireFrames(np.array(poses), np.array(points))


def _ends(wires: list[ElementTree.Element], end: str, path: Path) -> Floats:
    return np.array([_numbers(_attribute(wire, f"EndPoint{end}", path), 3, path) for wire in wires])


def _root(path: Path) -> ElementTree.Element:
    data = read_input(path, max_bytes=MAX_BYTES, where=str(path))
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        refuse("a document type", path, "XML without one", "xml_doctype")
    try:
        return ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise InputError(
            f"XML cannot be read ({error})", where=path, allowed="a file that PLUS wrote", code="xml_damaged"
        ) from error


def _found(parent: ElementTree.Element, tag: str, where: str | Path) -> ElementTree.Element:
    found = parent.find(f".//{tag}")
    if found is None:
        refuse(f"no {tag}", where, "a file that PLUS wrote", "missing_key")
    return found


def _attribute(element: ElementTree.Element, name: str, where: str | Path) -> str:
    value = element.get(name)
    if value is None:
        refuse(f"{element.tag} without {name}", where, "a file that PLUS wrote", "missing_key")
    return value


def _named_transform(root: ElementTree.Element, source: str, target: str, path: Path) -> Floats:
    for element in root.iter("Transform"):
        if (element.get("From"), element.get("To")) == (source, target):
            return _matrix(_attribute(element, "Matrix", path), path, rigid=source == "Phantom")
    raise InputError(
        f"no transform from {source} to {target}", where=path, allowed="a file that PLUS wrote", code="missing_key"
    )


def _matrix(text: str, where: str | Path, *, rigid: bool) -> Floats:
    T = np.array(_numbers(text, 16, where)).reshape(4, 4)
    R = T[:3, :3]
    off = np.abs(R.T @ R - np.eye(3)).max()
    if T[3].tolist() != [0, 0, 0, 1] or (rigid and (off > RIGID_TO or np.linalg.det(R) < 0)):
        refuse("a matrix that is no rigid motion", where, f"R^T R = 1 to {RIGID_TO:g}", "not_rigid")
    return T


def _numbers(text: str, count: int, where: str | Path) -> list[float]:
    try:
        values = [float(word) for word in text.split()]
    except ValueError as error:
        raise InputError(
            f"{text[:40]!r} holds no number ({error})", where=where, allowed=f"{count} numbers", code="not_a_number"
        ) from error
    if len(values) != count or not np.isfinite(values).all():
        refuse(f"{text[:40]!r}", where, f"{count} finite numbers", "not_a_number")
    return values
