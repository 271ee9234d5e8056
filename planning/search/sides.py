"""Open sides of the body around a target: from where a needle can come, and which of them the case's grid covers."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from puncture_twin.planning.anatomy.anatomy import ATTACHED_LIMB, OUTSIDE_BODY, Anatomy
from puncture_twin.planning.anatomy.skin import SkinPaths, skin_paths
from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.entry import ANATOMICAL_LPS, GRID_SLACK, angles, grid
from puncture_twin.planning.geometry.containment import crossings
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.planning.search.explain import finite

STEP = np.radians(10.0)
"""rad between the directions that are tested: each side has about a hundred of them."""
LEAST_OPEN = 0.1
"""Open fraction of a side's solid angle below which it is no side to puncture from."""
LEAST_SEARCHED = 0.4
"""Fraction of a side's directions from which on a grid covers it: a grid about the front holds half of what is to the
right and to the left."""
ROUND_ABOUT = ("front", "back", "right", "left")
"""The sides that are reported; through feet and head no image shows skin."""
NOT_SHOWN = "is where the image does not show the body"
"""Reason for the closed back of a patient without a CT, while the front is open."""
AXES = {"front": "anterior", "back": "posterior", "right": "right", "left": "left", "feet": "feet", "head": "head"}
FRONT, BACK, WHOLE = '"bed"', '{ z = "posterior", x = "head" }', (0.0, 180.0)


class Side(NamedTuple):
    """The open directions nearest to one axis of the body, seen from the target."""

    name: str
    open: float
    """Fraction of its solid angle from where a needle can come, whatever organs are in its path."""
    searched: float  # the fraction that the case's grid holds
    nearest_mm: float  # the shortest path to its skin; NaN where none is known
    why: str  # what closes most of it; "" where it is open

    @property
    def is_open(self) -> bool:
        """Whether a needle can reach the target from this side."""
        return self.open >= LEAST_OPEN

    def document(self) -> dict[str, Any]:
        """The side as one entry of ``sides`` in ``--json``."""
        return {**self._asdict(), "nearest_mm": finite(self.nearest_mm)}


class Grid(NamedTuple):
    """The directions that are searched: range of theta, degrees, and the entry frame as TOML writes it."""

    theta_deg: tuple[float, float]
    frame: str


def sides_of(case: Case, anatomy: Anatomy) -> tuple[Side, ...]:
    """The sides of the body by skin, what lies outside of it and the needle's length; organs do not count."""
    if case.space is Space.LOCAL:
        return ()
    around = grid((0.0, np.pi), (0.0, 2.0 * np.pi), STEP, np.eye(3))
    assert around.grid is not None
    cell, outward = around.grid.solid_angle(), around.outward_ct
    nearest = (outward @ np.array([ANATOMICAL_LPS[axis] for axis in AXES.values()]).T).argmax(axis=1)
    paths, within = skin_paths(anatomy.skin, case.target_ct, outward, case.needle.length_mm), _within(case, outward)
    closed = _closed(case, anatomy, paths, outward)
    free = ~np.any([rows for _, rows in closed], axis=0)  # open for every reason
    sides = []
    for number, name in enumerate(AXES):
        side = nearest == number
        whole, most = cell[side].sum(), max(closed, key=lambda one: float(cell[side & one[1]].sum()))
        is_open, searched = (float(cell[side & some].sum() / whole) for some in (free, within))
        near = float(np.fmin.reduce(paths.path_length[side]))
        sides.append(Side(name, is_open, searched, near, "" if is_open >= LEAST_OPEN else most[0]))
    front, back, *rest = sides
    known = anatomy.scan is not None or case.ct.table == "none" or case.region == "phantom"
    if front.is_open and not known:
        back = back._replace(open=0.0, why=NOT_SHOWN)
    return (front, back, *rest)


def _closed(case: Case, anatomy: Anatomy, paths: SkinPaths, outward_ct: Floats) -> list[tuple[str, Bools]]:
    """Reasons that close directions whatever organs are there, and the directions that each closes."""
    length, needle = paths.path_length, case.needle
    unseen = np.isnan(length) | ~np.isnan(paths.unknown_depth)
    table = "lies on the table" if anatomy.couch is not None else "is near the end of the image"
    closed = [("is beyond the end of the image", np.asarray(unseen))]
    for name, why in ((OUTSIDE_BODY, table), (ATTACHED_LIMB, "is at a probable limb")):
        for mesh in (one.mesh for one in anatomy.checked if one.name == name):
            count = crossings(mesh, case.target_ct, outward_ct, needle.length_mm).count
            closed.append((why, ~unseen & (count > 0)))
    return [
        *closed,
        (f"is farther than the needle's longest path, {needle.longest_path_mm:g} mm", length > needle.longest_path_mm),
        ("is met too obliquely", paths.skin_angle > case.search.max_skin_angle),
        ("would be left and re-entered", ~np.isnan(paths.reentry_depth)),
    ]


def _within(case: Case, outward_ct: Floats) -> Bools:
    theta, beta = angles(outward_ct @ case.T_ct_entry[:3, :3])
    (low, high), (first, last), slack = case.search.theta, case.search.beta, GRID_SLACK
    within_beta = (first - slack <= beta) & (beta <= last + slack)
    return np.asarray((low - slack <= theta) & (theta <= high + slack) & (within_beta | (np.sin(theta) < slack)))


def grid_of(sides: Sequence[Side]) -> Grid:
    """The grid that covers the sides that are open: front or back with its neighbours, or all around."""
    is_open = {side.name: side.is_open for side in sides}
    if is_open["back"] and not is_open["front"]:
        return Grid((0.0, 90.0), BACK)
    sideways = not is_open["front"] and (is_open["left"] or is_open["right"])
    return Grid(WHOLE if is_open["back"] or sideways else (0.0, 90.0), FRONT)


def sides_text(sides: Sequence[Side], *, searched: bool = False) -> str:
    """The open sides in words, and why the others are closed."""
    reported = [side for side in sides if side.name in ROUND_ABOUT]
    here = [side.name for side in reported if side.is_open and (not searched or side.searched >= LEAST_SEARCHED)]
    parts = [_listed(here) or "no side"]
    for why in dict.fromkeys(side.why for side in reported if not side.is_open):
        names = [side.name for side in reported if side.why == why]
        are = why.replace("is ", "are ", 1).replace("lies ", "lie ", 1)
        parts.append(f"the {_listed(names)} {why if len(names) == 1 else are}")
    missed = [side for side in reported if searched and side.is_open and side.name not in here]
    parts += [f"not the {side.name}, where the skin is {side.nearest_mm:.0f} mm away" for side in missed]
    return "; ".join(parts)


def _listed(names: Sequence[str]) -> str:
    """Names as a list in a sentence, right and left together as "sides".

    >>> _listed(["front", "right", "left"])
    'front and sides'
    """
    both = {"right", "left"} <= set(names)
    names = [*(one for one in names if not (both and one in {"right", "left"})), *(["sides"] if both else [])]
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
