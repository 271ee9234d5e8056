"""The one place where the project's millimetres become PyBullet's metres, and back; surfaces as OBJ files in metres."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import pose

MM_PER_M = 1000.0


class PoseM(NamedTuple):
    """A pose as PyBullet takes it."""

    position_m: list[float]
    """x, y, z in m."""
    quaternion: list[float]
    """x, y, z, w."""


def to_m(length_mm: ArrayLike) -> Floats:
    """Lengths or points, any shape, mm to m.

    >>> to_m([1500.0, -2.0]).tolist()
    [1.5, -0.002]
    """
    return np.asarray(length_mm, dtype=np.float64) / MM_PER_M


def to_mm(length_m: ArrayLike) -> Floats:
    """Lengths or points, any shape, m to mm."""
    return np.asarray(length_m, dtype=np.float64) * MM_PER_M


def pose_to_m(T_a_b: Floats) -> PoseM:
    """A rigid pose, shape (4, 4), mm, as position in m and quaternion."""
    quaternion = Rotation.from_matrix(T_a_b[:3, :3]).as_quat()
    return PoseM(to_m(T_a_b[:3, 3]).tolist(), quaternion.tolist())


def pose_to_mm(position_m: Sequence[float], quaternion: Sequence[float]) -> Floats:
    """T_a_b, shape (4, 4), mm, of a position in m and a quaternion x, y, z, w."""
    return pose(Rotation.from_quat(quaternion).as_matrix(), to_mm(position_m))


def write_obj(mesh: TriangleMesh, path: Path) -> None:
    """Write a surface, mm, as OBJ in metres, to a tenth of a micrometre."""
    corners = [f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in to_m(mesh.vertices).tolist()]
    faces = [f"f {a} {b} {c}" for a, b, c in (mesh.faces + 1).tolist()]
    path.write_text("\n".join(corners + faces) + "\n")
