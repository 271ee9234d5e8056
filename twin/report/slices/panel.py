"""One slice: the CT in its plane, and over it outlines, needle, margin, region, target, directions and a scale.

Its subject is one direction, its needle and the structures near it, or an image alone. Hounsfield units become grey in
the windows that radiologists use, or by one scale of bytes that holds them all.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.anatomy import ATTACHED_LIMB, OUTSIDE_BODY
from puncture_twin.planning.anatomy.unseen import BEYOND_IMAGE
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.reasons import Rgb, css
from puncture_twin.planning.search.bending import insertion_along
from puncture_twin.planning.search.candidates import Pick
from puncture_twin.twin.report import palette
from puncture_twin.twin.report.annotate import SCALE_BARS_MM
from puncture_twin.twin.report.figures import figure_of, halo, pixels
from puncture_twin.twin.report.numbers import clearance_text
from puncture_twin.twin.report.palette import OUTSIDE, SKIN, TARGET_POINT, organ_colours
from puncture_twin.twin.report.present import number
from puncture_twin.twin.report.slices.planes import Plane, capsule, ellipse, letters, outline, toward_text

NEAR_MM = 30.0  # a structure with a margin that lies nearer to the needle is drawn strongly and named
MOST_NEAR = 8  # so many of them at most, the nearest

BESIDE: dict[str, tuple[str, Rgb]] = {  # of an image alone: what no structure names, for a person, and its colour
    OUTSIDE_BODY: ("beside the body: table, cloths, lines, and their unseen parts", (255, 170, 40)),
    ATTACHED_LIMB: ("what seems to be a limb", (255, 77, 240)),
    BEYOND_IMAGE: ("the body beyond the image", (120, 170, 255)),
}


class Near(NamedTuple):
    """A structure near the needle: name, colour, clearance and margin."""

    name: str
    colour: Rgb
    clearance_mm: float
    margin_mm: float

    @property
    def text(self) -> str:
        """For a legend."""
        margin = f", margin {number(self.margin_mm, 0)}" if np.isfinite(self.margin_mm) else ""
        return f"{self.name.replace('_', ' ')}: {clearance_text(self.clearance_mm, 'mm')}{margin}"


@dataclass(frozen=True, eq=False)
class Subject:
    """A direction or an image, as the slices show it."""

    case: Any
    anatomy: Any
    pick: Pick | None  # the candidate; None for the image alone, in which nobody has proposed a needle yet
    region_ct: Floats | None = None
    """Shape (3, 3), mm^2: the tip is expected within x' inv(region) x <= 1 in 95 of 100; None without declared
    errors."""

    @property
    def outward_ct(self) -> Floats:
        """Unit vector from the target along the needle, shape (3,)."""
        assert self.pick is not None
        return np.asarray(self.pick.candidates.outward_ct[self.pick.row])

    @property
    def path_mm(self) -> float:
        """Path from target to skin, mm, NaN without an entry."""
        return float("nan") if self.pick is None else float(self.pick.candidates.path.length[self.pick.row])

    @cached_property
    def colours(self) -> dict[str, Rgb]:
        """Colour of every structure, as in the other pictures; grey outside of the body."""
        inside = organ_colours(tuple(s.name for s in self.anatomy.structures))
        own = {} if self.pick is not None else {name: colour for name, (_, colour) in BESIDE.items()}
        return {**{s.name: OUTSIDE for s in self.anatomy.surroundings}, **inside, **own}

    @property
    def near(self) -> tuple[Near, ...]:
        """The structures with a margin that lie near the needle, nearest first."""
        return tuple(one for one in self._demanding if one.clearance_mm < NEAR_MM)[:MOST_NEAR]

    @property
    def named(self) -> tuple[Near, ...]:
        """Structures that a legend names: the near ones, or the nearest, however far it is."""
        return self.near or self._demanding[:1]

    @property
    def beside(self) -> list[tuple[str, Rgb]]:
        """Findings of an image alone that no structure names, for a legend."""
        names = {one.name for one in self.anatomy.checked}
        return [] if self.pick is not None else [line for name, line in BESIDE.items() if name in names]

    @cached_property
    def _demanding(self) -> tuple[Near, ...]:
        if self.pick is None:
            return ()
        clearance, row = self.pick.candidates.clearance, self.pick.row
        rows = zip(clearance.structures, clearance.by_structure[row].tolist(), clearance.margins.tolist(), strict=True)
        near = (Near(name, self.colours.get(name, OUTSIDE), mm, margin) for name, mm, margin in rows)
        return tuple(sorted((one for one in near if np.isfinite(one.margin_mm)), key=lambda one: one.clearance_mm))

    @property
    def margin_mm(self) -> float:
        """The greatest margin of the structures near, 0 without any."""
        return max((one.margin_mm for one in self.near), default=0.0)

    @cached_property
    def bent_mm(self) -> Floats | None:
        """A bevel's shaft, shape (m, 2), mm along the path and off it; None without tissue, or without an entry."""
        if self.case.bending is None or not np.isfinite(self.path_mm):
            return None
        where = self.case.target_ct, self.outward_ct, self.path_mm
        shaft = insertion_along(self.case.bending, self.anatomy, *where).path
        return np.stack([self.path_mm - shaft.depth_mm, shaft.needle_mm], axis=1)

    @property
    def title(self) -> str:
        """The direction, or that there is none."""
        if self.pick is None:
            return "what the image shows; no needle is proposed here"
        angles = self.pick.candidates.at(self.pick.row)
        return f"θ {angles['theta_deg']:.4g}°, β {angles['beta_deg']:.4g}°"


PIXELS = 480
STRONG, WEAK, OF_SKIN, OF_BEAD = 2.5, 1.1, 1.6, 4.0  # pixels: how wide outlines are, and how large a bead is
RIM = 1.8  # pixels of black under thin lines, both sides together, so that they show on bright tissue too
LETTERS, SMALL, LETTERS_RIM = 16, 12, halo(3.2, "black")  # pixels: of directions and scale, in white
IN_PLANE = 1e-3  # a needle whose direction has less than this along a plane's normal lies in it
BEADS = 0.025  # between two beads, of half a picture's side
MOST_BEADS = 1 << 20  # more than beads side by side; numbers their rows and columns as one
SCALE_FRACTION = 0.34  # of a picture's side, the scale bar at most
EDGE = 7.0  # pixels between a picture's edge and the letters there
CLEAR = 24.0  # pixels that letters keep from the needle's line, along their edge


class Panel(NamedTuple):
    """One slice: HU (PIXELS, PIXELS), NaN where the image ends, None without a CT; lines over it, RGB and opacity."""

    plane: Plane
    hu: Floats | None
    overlay: NDArray[np.uint8]


def draw_panel(subject: Subject, plane: Plane) -> Panel:
    """Draw one plane, with the needle of the direction if there is one."""
    scan = subject.anatomy.scan
    hu = None if scan is None else scan.hu_at(plane.points_ct(PIXELS)).reshape(PIXELS, PIXELS)
    figure = figure_of(PIXELS, PIXELS, ground="none")
    axes = figure.add_axes((0, 0, 1, 1))  # in the plane's mm
    axes.set_axis_off()
    edges = plane.centre + plane.half_mm * np.array([[-1.0], [1.0]])
    axes.set(xlim=edges[:, 0], ylim=edges[:, 1], autoscale_on=False)
    _outlines(axes, subject, plane)
    if subject.pick is not None:
        _needle(axes, subject, plane)
    near, far = 0.03 * plane.half_mm, 0.09 * plane.half_mm
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        axes.plot((near * x, far * x), (near * y, far * y), color=css(TARGET_POINT), linewidth=2.4)
    _directions(axes, subject, plane)
    side = 2 * plane.half_mm
    length = max((mm for mm in SCALE_BARS_MM if mm <= SCALE_FRACTION * side), default=SCALE_BARS_MM[0])
    left, low = plane.centre - plane.half_mm * np.array([0.94, 0.93])
    bar: dict[str, Any] = {"solid_capstyle": "butt", "linewidth": 4, "path_effects": halo(6, "black")}
    axes.plot((left, left + length), (low, low), color="white", **bar)
    _write(axes, (0.03 * PIXELS, 0.035 * PIXELS + 8), f"{length} mm", SMALL)
    return Panel(plane, hu, pixels(figure))


def leaning(subject: Subject, plane: Plane) -> str:
    """Text of the needle's angle to a plane; "" without one, and where it has no entry."""
    if subject.pick is None or not np.isfinite(subject.path_mm):
        return ""
    lean = float(subject.outward_ct @ plane.normal)
    if abs(lean) <= IN_PLANE:
        return "The needle lies in this plane."
    side = toward_text(subject.case.space, np.sign(lean) * plane.normal)
    return f"The skin entry is {abs(lean) * subject.path_mm:.0f} mm from it, {side}."


def _line(axes: Axes, points: Floats, width: float, colour: Rgb, style: str = "-", rim: float = 0.0) -> None:
    """A line through points (n, 2), mm, later ones over earlier ones."""
    effects = halo(width + rim, "black") if rim else None
    axes.plot(*points.T, color=css(colour), linewidth=width, linestyle=style, path_effects=effects)


def _segments(axes: Axes, segments: Floats, width: float, colour: Rgb) -> None:
    """Lines from point to point, each alone, shape (n, 2, 2), mm: one path, with gaps between."""
    if len(segments) == 0:
        return
    gaps = np.full((len(segments), 1, 2), np.nan)
    points = np.concatenate([segments, gaps], axis=1).reshape(-1, 2)
    axes.plot(*points.T, color=css(colour), linewidth=width, solid_capstyle="round")


def _outlines(axes: Axes, subject: Subject, plane: Plane) -> None:
    """Every structure that the plane cuts: the near ones and the target's strongly, unknown ones as beads."""
    strong = {one.name for one in subject.near} | {subject.case.target_structure}
    for one in subject.anatomy.checked:
        segments, colour = outline(one.mesh, plane), subject.colours[one.name]
        if str(one.role) == "unknown":
            axes.plot(*_beads(segments, plane).T, "o", markersize=OF_BEAD, color=css(colour), markeredgewidth=0)
        else:
            _segments(axes, segments, STRONG if one.name in strong else WEAK, colour)
    _segments(axes, outline(subject.anatomy.skin.mesh, plane), OF_SKIN, SKIN)


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


def _needle(axes: Axes, subject: Subject, plane: Plane) -> None:
    """The cut of the needle, as thick as it is, and of its margin; the tip's region.

    Nothing is drawn of a needle that is not in the plane: its shadow would cross what the needle passes by.
    """
    outward, needle = subject.outward_ct, subject.case.needle
    radius, shaft = float(needle.radius_mm), needle.shaft_mm
    path = subject.path_mm if np.isfinite(subject.path_mm) else shaft
    if subject.margin_mm > 0:
        _line(axes, capsule(outward, path, radius + subject.margin_mm, plane), 1.3, palette.NEEDLE_COLOUR, "--")
    if subject.region_ct is not None:
        _line(axes, ellipse(subject.region_ct, plane), 1.7, palette.REGION_COLOUR, rim=RIM)
    axes.fill(*capsule(outward, shaft, radius, plane).T, color=css(palette.NEEDLE_COLOUR), linewidth=0, zorder=2)
    if subject.bent_mm is not None:
        _bent(axes, subject, plane, subject.bent_mm)


def _bent(axes: Axes, subject: Subject, plane: Plane, bent_mm: Floats) -> None:
    """Draw where the bevel may take the needle: its line to both sides, or how far off the axis it may be there."""
    outward, off = subject.outward_ct, abs(float(bent_mm[-1, 1]))
    if abs(float(outward @ plane.normal)) > IN_PLANE:
        if off > 0:
            _line(axes, capsule(outward, subject.path_mm, off, plane), 1.3, palette.BENT_COLOUR)
        return
    along = plane.place(plane.at_ct + outward)
    for aside in (np.array([-along[1], along[0]]), np.array([along[1], -along[0]])):
        _line(axes, bent_mm @ np.stack([along, aside]), 1.7, palette.BENT_COLOUR)


def _directions(axes: Axes, subject: Subject, plane: Plane) -> None:
    """Write the body's direction beyond each edge; beside the needle where it leaves the picture there."""
    middle, far = PIXELS / 2, PIXELS - EDGE
    edges = (
        (far, middle, plane.right, "right", "center"),
        (EDGE, middle, -plane.right, "left", "center"),
        (middle, far, plane.up, "center", "top"),
        (middle, EDGE, -plane.up, "center", "bottom"),
    )
    shaft = np.zeros(3) if subject.pick is None else subject.case.needle.shaft_mm * subject.outward_ct
    needle = np.linspace(0, 1, PIXELS)[:, None] * plane.place(plane.at_ct + shaft)
    needle = ((needle - plane.centre) / plane.half_mm + 1) * middle  # pixels to the right and up
    for x, y, direction, ha, va in edges:
        at_side = va == "center"
        near = needle[np.linalg.norm(needle - (x, y), axis=1) < 2 * CLEAR]
        off = 0.0 if len(near) == 0 else float(near[:, int(at_side)].mean()) - middle
        shift = 0.0 if len(near) == 0 or abs(off) > CLEAR else off + (-CLEAR if off > 0 else CLEAR)
        at = (x, y + shift) if at_side else (x + shift, y)
        _write(axes, at, letters(subject.case.space, direction), LETTERS, ha=ha, va=va, weight="bold")


def _write(axes: Axes, at: tuple[float, float], text: str, size: float, **look: Any) -> None:
    """Write white text with a black rim at pixels to the right and up of the lower left corner."""
    axes.text(*at, text, fontsize=size, color="white", path_effects=LETTERS_RIM, transform=None, **look)


class Tone(NamedTuple):
    """A window of Hounsfield units: its middle is grey, its ends are black and white."""

    level: float
    width: float

    def grey(self, hu: Floats) -> NDArray[np.uint8]:
        """Grey values of Hounsfield units; where the image ends (NaN) black."""
        fraction = (np.nan_to_num(hu, nan=-1e6) - self.level) / self.width + 0.5
        return np.round(255 * np.clip(fraction, 0.0, 1.0)).astype(np.uint8)


TONES = {"abdomen": Tone(40, 400), "lung": Tone(-600, 1500), "bone": Tone(400, 1800), "brain": Tone(40, 80)}
"""Windows of the CT, as on the consoles of scanners."""

KNOTS_HU = (-1350.0, -160.0, 0.0, 80.0, 240.0, 1300.0)
KNOTS_BYTE = (0.0, 48.0, 96.0, 152.0, 208.0, 255.0)
"""Bytes of a picture that holds every window: most of them lie where soft tissue differs, below one HU and a half a
byte there."""


def stored(hu: Floats) -> NDArray[np.uint8]:
    """Bytes of Hounsfield units, from which a page makes any window."""
    return np.round(np.interp(np.nan_to_num(hu, nan=KNOTS_HU[0]), KNOTS_HU, KNOTS_BYTE)).astype(np.uint8)
