"""One slice: the CT in its plane, and over it outlines, needle, margin, region, target, directions and a scale."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from matplotlib import patheffects
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, PathPatch, Polygon
from matplotlib.path import Path
from matplotlib.text import Text
from matplotlib.transforms import Affine2D, Transform
from PIL import Image

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.reasons import css
from puncture_twin.twin.report.annotate import SCALE_BARS_MM
from puncture_twin.twin.report.palette import SKIN, TARGET_POINT
from puncture_twin.twin.report.slices.cuts import capsule, ellipse, outline
from puncture_twin.twin.report.slices.planes import Plane, letters
from puncture_twin.twin.report.slices.subject import Subject

PIXELS, DPI = 480, 96
NEEDLE_COLOUR, REGION_COLOUR, BENT_COLOUR = "#00e5ff", "#ff4df0", "#b6ff00"
"""On grey none is near a structure's colour."""

HALO = (patheffects.withStroke(linewidth=2.4, foreground="black"),)
"""Behind letters and thin lines, so that they show on bright tissue too."""

IN_PLANE = 1e-3
"""A needle whose direction has less than this along a plane's normal lies in it."""

DASHED: Any = {"edgecolor": NEEDLE_COLOUR, "lw": 1.0, "ls": "--"}
"""The needle with the greatest margin."""

BEADS = 0.025
"""Between two beads, of half a picture's side."""
MOST_BEADS = 1 << 20
"""More than beads side by side; numbers their rows and columns as one."""

SCALE_FRACTION = 0.34
"""Of a picture's side, the scale bar at most."""


class Panel(NamedTuple):
    """One slice.

    Attributes:
        plane: Where it lies.
        hu: Shape (PIXELS, PIXELS), NaN where the image ends; None in a case without CT.
        overlay: RGBA, transparent where nothing is drawn.
    """

    plane: Plane
    hu: Floats | None
    overlay: Image.Image


def draw_panel(subject: Subject, plane: Plane) -> Panel:
    """Draw one plane of a direction."""
    scan = subject.anatomy.scan
    hu = None if scan is None else scan.hu_at(plane.points_ct(PIXELS)).reshape(PIXELS, PIXELS)
    sheet = _Sheet(plane)
    _outlines(sheet, subject, plane)
    _needle(sheet, subject, plane)
    _target(sheet, subject, plane)
    _directions(sheet, subject, plane)
    _scale(sheet, plane)
    return Panel(plane, hu, drawn(sheet.canvas))


class _Sheet:
    """What one draws on in a plane's mm: a figure without axes, which take longer to make than all that is drawn.

    Args:
        plane: The plane.
    """

    def __init__(self, plane: Plane) -> None:
        self._figure = Figure(figsize=(PIXELS / DPI, PIXELS / DPI), dpi=DPI, facecolor="none")
        self.canvas = FigureCanvasAgg(self._figure)
        corner = plane.centre - plane.half_mm
        self._to_pixels = Affine2D().translate(*-corner).scale(PIXELS / (2 * plane.half_mm))

    def line(self, points: Floats, **look: Any) -> None:
        """A line through points (n, 2), mm."""
        self._add(Line2D(*np.asarray(points, dtype=float).T, **look))

    def segments(self, segments: Floats, **look: Any) -> None:
        """Lines from point to point, each alone, shape (n, 2, 2), mm."""
        codes = np.tile(np.array([Path.MOVETO, Path.LINETO], dtype=Path.code_type), len(segments))
        path = Path(np.asarray(segments, dtype=float).reshape(-1, 2), codes)
        self._add(PathPatch(path, fill=False, **look))

    def patch(self, patch: Patch) -> None:
        """A patch in mm."""
        self._add(patch)

    def words(self, x: float, y: float, text: str, *, relative: bool = False, **look: Any) -> None:
        """Text at a point, mm, or as a fraction of the picture."""
        self._add(Text(x, y, text, **look), self._figure.transFigure if relative else self._to_pixels)

    def _add(self, artist: Artist, transform: Transform | None = None) -> None:
        artist.set_transform(self._to_pixels if transform is None else transform)
        self._figure.add_artist(artist)


def drawn(canvas: FigureCanvasAgg) -> Image.Image:
    """The canvas as it looks, RGBA."""
    pixels, size = canvas.print_to_buffer()  # type: ignore[no-untyped-call]  # matplotlib states no types there
    return Image.frombytes("RGBA", size, bytes(pixels))


def _outlines(sheet: _Sheet, subject: Subject, plane: Plane) -> None:
    """Every structure that the plane cuts: the near ones and the target's strongly, unknown ones as beads."""
    strong = {one.name for one in subject.near} | {subject.case.target_structure}
    for one in subject.anatomy.checked:
        segments, colour = outline(one.mesh, plane), css(subject.colours[one.name])
        if str(one.role) == "unknown":
            sheet.line(_beads(segments, plane), ls="none", marker=".", ms=4, mec=colour, mfc=colour)
        elif len(segments):
            sheet.segments(segments, edgecolor=colour, lw=1.9 if one.name in strong else 0.8)
    sheet.segments(outline(subject.anatomy.skin.mesh, plane), edgecolor=css(SKIN), lw=1.2)


def _beads(segments: Floats, plane: Plane) -> Floats:
    """Points along segments (n, 2, 2), about evenly apart, shape (m, 2)."""
    cell = BEADS * plane.half_mm
    beyond = np.all(np.abs(segments - plane.centre) > plane.half_mm, axis=1)
    segments = segments[~np.any(beyond, axis=1)]
    if not len(segments):
        return np.zeros((0, 2))
    length = float(np.linalg.norm(np.diff(segments, axis=1), axis=2).max())
    fraction = np.linspace(0, 1, 2 + int(length / cell))[:, None, None]
    points = (segments[:, 0] * (1 - fraction) + segments[:, 1] * fraction).reshape(-1, 2)
    points = points[(np.abs(points - plane.centre) <= plane.half_mm).all(axis=1)]
    column, row = np.round(points / cell).astype(np.int64).T
    return np.asarray(points[np.unique(column * MOST_BEADS + row, return_index=True)[1]])


def _needle(sheet: _Sheet, subject: Subject, plane: Plane) -> None:
    """The needle as thick as it is where the plane holds it, else its cut and, dotted, its shadow."""
    outward, radius = subject.outward_ct, subject.needle_radius_mm
    shaft = subject.case.needle.shaft_mm
    end, across = plane.place(plane.at_ct + shaft * outward), abs(float(outward @ plane.normal))
    if IN_PLANE < across < 1 - IN_PLANE:
        sheet.line(np.stack([np.zeros(2), end]), color=NEEDLE_COLOUR, lw=1.1, ls=":", path_effects=HALO)
    body = capsule(outward, shaft, radius, plane)
    sheet.patch(Polygon(body, facecolor=NEEDLE_COLOUR, lw=0, zorder=3))
    path = subject.path_mm if np.isfinite(subject.path_mm) else shaft
    if subject.margin_mm > 0:
        wide = capsule(outward, path, radius + subject.margin_mm, plane)
        sheet.patch(Polygon(wide, fill=False, **DASHED))
    if subject.bent_mm is not None:
        _bent(sheet, subject, plane, subject.bent_mm)


def _bent(sheet: _Sheet, subject: Subject, plane: Plane, bent_mm: Floats) -> None:
    """Where the bevel may take the needle: its line to both sides, or how far off the axis it may be at the plane."""
    outward, off = subject.outward_ct, abs(float(bent_mm[-1, 1]))
    if abs(float(outward @ plane.normal)) > IN_PLANE:
        if off > 0:
            sheet.patch(Polygon(capsule(outward, subject.path_mm, off, plane), fill=False, edgecolor=BENT_COLOUR))
        return
    along = plane.place(plane.at_ct + outward)
    for aside in (np.array([-along[1], along[0]]), np.array([along[1], -along[0]])):
        sheet.line(bent_mm @ np.stack([along, aside]), color=BENT_COLOUR, lw=1.3, zorder=4, solid_capstyle="butt")


def _target(sheet: _Sheet, subject: Subject, plane: Plane) -> None:
    """A cross at the target, and the region of the tip where errors are declared."""
    near, far = 0.03 * plane.half_mm, 0.09 * plane.half_mm
    arms = [((near, 0), (far, 0)), ((-near, 0), (-far, 0)), ((0, near), (0, far)), ((0, -near), (0, -far))]
    sheet.segments(np.array(arms), edgecolor=css(TARGET_POINT), lw=1.8, zorder=4)
    if subject.region_ct is not None:
        sheet.line(ellipse(subject.region_ct, plane), color=REGION_COLOUR, lw=1.3, path_effects=HALO)


def _directions(sheet: _Sheet, subject: Subject, plane: Plane) -> None:
    """What lies beyond each edge of the picture."""
    edges = ((0.985, 0.5, plane.right), (0.015, 0.5, -plane.right), (0.5, 0.985, plane.up), (0.5, 0.015, -plane.up))
    for x, y, direction in edges:
        sheet.words(
            x,
            y,
            letters(subject.case.space, direction),
            relative=True,
            ha="right" if x > 0.9 else "left" if x < 0.1 else "center",
            va="top" if y > 0.9 else "bottom" if y < 0.1 else "center",
            color="white",
            fontsize=12,
            fontweight="bold",
            path_effects=HALO,
        )


def _scale(sheet: _Sheet, plane: Plane) -> None:
    """A bar of a round length in the lower left corner."""
    side = 2 * plane.half_mm
    length = max((mm for mm in SCALE_BARS_MM if mm <= SCALE_FRACTION * side), default=SCALE_BARS_MM[0])
    left, low = plane.centre - plane.half_mm * np.array([0.94, 0.93])
    bar = np.array([(left, low), (left + length, low)])
    sheet.line(bar, color="white", lw=3, solid_capstyle="butt", path_effects=HALO)
    words = f"{length} mm"
    sheet.words(left, low + 0.022 * side, words, color="white", fontsize=9, va="bottom", path_effects=HALO)
