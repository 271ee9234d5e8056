"""A pinhole camera for the rasteriser and for writing labels at projected points."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.mesh import box_of
from puncture_twin.planning.geometry.rigid import frame_along

SPARE = 1.05  # how much wider than what must be seen a picture is


@dataclass(frozen=True, eq=False)
class ViewCamera:
    """A virtual camera in the CT frame."""

    eye: Floats  # shape (3,), mm
    look_at: Floats  # shape (3,), mm
    up: Floats  # shape (3,), any vector not along the view
    fov: float  # vertical opening angle, rad
    width: int
    height: int

    @cached_property
    def axes(self) -> Floats:
        """Rows: right, up, forward; unit vectors, shape (3, 3)."""
        forward = np.asarray(self.look_at, dtype=float) - self.eye
        forward = forward / np.linalg.norm(forward)
        right, down, _ = frame_along(forward, -np.asarray(self.up)).T
        return np.stack([right, -down, forward])

    @property
    def scale(self) -> float:
        """Pixels per unit of the tangent: px = width / 2 + scale x / z."""
        return float(self.height / 2 / np.tan(self.fov / 2))

    def finer(self, factor: int) -> ViewCamera:
        """This view with more pixels."""
        return replace(self, width=self.width * factor, height=self.height * factor)

    def project(self, points_ct: Floats) -> Floats:
        """Column and row ((0, 0) is the top left corner) and depth along the view, (n, 3); below zero behind it."""
        x, y, z = self.axes @ (np.asarray(points_ct, dtype=float).reshape(-1, 3) - self.eye).T
        with np.errstate(divide="ignore", invalid="ignore"):
            column, row = self.width / 2 + self.scale * x / z, self.height / 2 - self.scale * y / z
        return np.stack([column, row, z], axis=1)


def camera_around(points_ct: Floats, toward: Floats, up: Floats, *, fov: float, width: int, height: int) -> ViewCamera:
    """A camera along `toward`, (3,), with `up`, (3,), and all points (n, 3) in view; `fov`: vertical opening, rad."""
    points = np.asarray(points_ct, dtype=float)
    toward = np.asarray(toward, dtype=float) / np.linalg.norm(toward)
    centre = box_of(points).sum(axis=0) / 2
    axes = ViewCamera(centre - toward, centre, up, fov, width, height).axes
    for _ in range(3):  # centring shifts the perspective a little; three rounds leave less than a pixel
        local = (points - centre) @ axes.T
        slope = np.tan(fov / 2) / SPARE * np.array([width / height, 1.0])
        distance = float(np.max(np.abs(local[:, :2]) / slope - local[:, 2:]))
        seen = local[:, :2] / (local[:, 2:] + distance)
        middle = box_of(seen).sum(axis=0) / 2 * distance
        centre = centre + middle @ axes[:2]
    return ViewCamera(centre - distance * toward, centre, np.asarray(up, dtype=float), fov, width, height)
