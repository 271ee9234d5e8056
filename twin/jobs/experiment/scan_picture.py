"""One axial slice of a scan: through the target, or as near to it as the field of view comes."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.formats.points import NamedPoints
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.twin.guidance.ct.needle import FoundNeedle
from puncture_twin.twin.plant.scanner.image import CtImage
from puncture_twin.twin.report.figures import halo, write_png

WINDOW_HU = (-160.0, 240.0)
"""What abdomens are read in: 400 wide about 40."""
NEAR_MM = 6.0
"""A marker so near to the slice is named in it."""
INCHES, DPI = 9.0, 100
GREEN, YELLOW, RIM = "#38d39f", "#ffd34d", halo(3, "black")
"""On black and on grey; the rim makes them seen on bone."""


class Shown(NamedTuple):
    """What is drawn over a slice, LPS mm.

    Attributes:
        target: Shape (3,).
        markers: As they were found, or None.
        needle: As it was found, or None.
        length_mm: Of the needle.
    """

    target: Floats
    markers: NamedPoints | None
    needle: FoundNeedle | None
    length_mm: float


def draw_scan(image: CtImage, shown: Shown, path: Path) -> Path:
    """Draw it; the patient's right is on the left, as radiologists look at it."""
    T, (nx, ny, nz), (dx, dy, _) = image.grid.T_ct_index, image.grid.shape, image.grid.spacing_mm
    index = apply(np.linalg.inv(T), shown.target)
    k = int(np.clip(round(float(index[2])), 0, nz - 1))
    x0, y0, z = apply(T, np.array([-0.5, -0.5, k]))
    figure = Figure(figsize=(INCHES, INCHES * ny * dy / (nx * dx) + 0.6), dpi=DPI)
    ax = figure.add_axes((0.09, 0.1, 0.89, 0.82))
    extent = (x0, x0 + nx * dx, y0 + ny * dy, y0)
    low, high = WINDOW_HU
    ax.imshow(image.hu[:, :, k].T, cmap="gray", vmin=low, vmax=high, extent=extent, interpolation="nearest")
    ax.plot(*shown.target[:2], "+", color=GREEN, markersize=12, label="target", path_effects=RIM)
    if shown.needle is not None:
        _draw_needle(ax, shown.needle, shown.length_mm)
    if shown.markers is not None:
        _draw_markers(ax, shown.markers, z)
    ax.legend(loc="upper left", fontsize=8)
    ax.set(xlabel="x, mm (patient's left to the right)", ylabel="y, mm (front above)")
    ax.set_title(f"slice {k + 1} of {nz}, z {z:.1f} mm; simulated", fontsize=10)
    ax.set_xlim(extent[:2])
    ax.set_ylim(extent[2:])
    write_png(figure, path)
    return path


def _draw_markers(ax: Axes, markers: NamedPoints, z: float) -> None:
    """The names of those that the slice shows."""
    for name, point in zip(markers.names, markers.points, strict=True):
        if abs(point[2] - z) <= NEAR_MM:
            text = ax.annotate(name, point[:2], (0, 8), textcoords="offset points", color=YELLOW, ha="center")
            text.set_path_effects(RIM)


def _draw_needle(ax: Axes, needle: FoundNeedle, length_mm: float) -> None:
    """Its axis as found, of which the slice shows a cut."""
    ends = np.stack([needle.tip_ct, needle.tip_ct - length_mm * needle.forward_ct])
    ax.plot(ends[:, 0], ends[:, 1], "--", color=YELLOW, linewidth=0.8, label="needle as found, projected")
    ax.plot(*needle.tip_ct[:2], "x", color=YELLOW, label="its tip")
