"""The safe map of a target: a verdict a direction, and which structure blocks it; no distances.

It says what the margins of the structures allow. Where the needle enters the skin, at which angle, how it bends and
moves with the breath, what the arm reaches and what errors do is not tested here: `CaseContext.check` does.

Of many points of a lesion, which one has the widest window: one map a point, with the skin.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from puncture_twin.planning.anatomy.structure import Structure
from puncture_twin.planning.base.arrays import Bools, Floats, Ints32
from puncture_twin.planning.base.errors import InputError, NoAnswerError, refuse
from puncture_twin.planning.base.text import Facts, Shown, brief, plural
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.entry import Directions
from puncture_twin.planning.formats.guard import guard_points, points_array
from puncture_twin.planning.geometry.containment import contains
from puncture_twin.planning.geometry.parts import voxels_inside
from puncture_twin.planning.geometry.rigid import apply, pose
from puncture_twin.planning.search.candidates import SQUARE_DEGREES, connected
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.search.search import first_blocking

NOT_TESTED_OF_WINDOWS = "bending, breathing, arm, chances"
NOT_TESTED = f"skin entry and angle, {NOT_TESTED_OF_WINDOWS}"


@dataclass(frozen=True, eq=False)
class SafeMap(Shown):
    """Which directions the margins of the structures block."""

    target_ct: Floats  # shape (3,), mm, LPS
    directions: Directions
    structures: tuple[str, ...]
    """Names of all that is checked; ``structure`` are places in it."""
    blocked: Bools  # shape (n,), whether the needle comes nearer to some structure than its margin
    structure: Ints32
    """Shape (n,), the first in the case's order that blocks the direction; -1 where none does."""

    @property
    def theta_deg(self) -> Floats:
        """Puncture angle of each direction, shape (n,)."""
        return np.degrees(self.directions.theta)

    @property
    def beta_deg(self) -> Floats:
        """Azimuth of each direction, shape (n,)."""
        return np.degrees(self.directions.beta)

    def _title(self) -> str:
        return "Safe map"

    def _facts(self) -> Facts:
        x, y, z = self.target_ct
        yield "target", f"({x:.1f}, {y:.1f}, {z:.1f}) mm"
        yield "directions", f"{len(self.blocked):,}, of which {int((~self.blocked).sum()):,} are not blocked"
        for row in np.unique(self.structure[self.blocked]):
            yield f"first blocked by {self.structures[row]}", f"{int((self.structure == row).sum()):,}"
        yield "not tested", NOT_TESTED

    @brief
    def __repr__(self) -> str:
        return f"{int((~self.blocked).sum()):,} of {plural(len(self.blocked), 'direction')} not blocked"


def safe_map(context: CaseContext) -> SafeMap:
    """The safe map of a context's target, over the case's grid."""
    case, anatomy, directions = context.case, context.anatomy, context.case.directions()
    structure = first_blocking(case, anatomy, context.engine, directions).structure
    return SafeMap(case.target_ct, directions, tuple(one.name for one in anatomy.checked), structure >= 0, structure)


@dataclass(frozen=True, eq=False)
class BestTarget(Shown):
    """The point, of many, with the widest window: the largest connected solid angle of open directions."""

    points_ct: Floats
    """Shape (n, 3), mm, LPS; the context's own target is the first."""
    window_deg2: Floats
    """Shape (n,), the widest window of each, square degrees, in the anatomy of the context."""
    best: int
    """Row of the point with the widest window, of those that the case could have as its target."""
    context: CaseContext
    best_deg2: float

    @property
    def target_ct(self) -> Floats:
        """The best point, shape (3,), mm."""
        return self.points_ct[self.best]

    def _title(self) -> str:
        return "Best target"

    def _facts(self) -> Facts:
        x, y, z = self.target_ct
        yield "target", f"({x:.1f}, {y:.1f}, {z:.1f}) mm"
        yield "its window", f"{self.best_deg2:.0f} deg²; of the context's own target {self.window_deg2[0]:.0f} deg²"
        yield "points", f"{len(self.points_ct):,}, of which {int((self.window_deg2 > 0).sum()):,} have a window"
        yield "not tested", NOT_TESTED_OF_WINDOWS

    @brief
    def __repr__(self) -> str:
        return f"{self.best_deg2:.0f} deg² at point {self.best} of {plural(len(self.points_ct), 'point')}"


def best_target(context: CaseContext, points: int | ArrayLike) -> BestTarget:
    """Find the point with the widest window.

    All points are ranked in the context's anatomy; the best are then checked in the contexts of their own, since what
    the CT shows beyond the target's part of the body may be another structure there.

    Args:
        points: Shape (n, 3), mm, LPS; or how many, evenly in the target's structure.

    Raises:
        InputError: No points, or an open structure that is to be filled with some.
        NoAnswerError: No point has a window.
    """
    case, own = context.case, context.case.target_ct[None]
    if isinstance(points, int):
        given = points_inside(context.anatomy.structure(case.target_structure), points)
    else:
        given = points_array(points, (), what="point", where="best_target: points")
        given = guard_points(given, [f"{row}" for row in range(len(given))], where="best_target: points")
    points_ct, directions = np.concatenate([own, given]), case.directions()
    mesh, wide = context.anatomy.structure(case.target_structure).mesh, np.zeros(len(points_ct))
    for row, point in enumerate(points_ct):
        if row == 0 or case.own_target or not mesh.closed or contains(mesh, point):
            wide[row] = _widest(replace(case, target_ct=point), context, directions)
    best: BestTarget | None = None
    for row in np.argsort(-wide, kind="stable").tolist():
        if wide[row] == 0.0 or (best is not None and wide[row] <= best.best_deg2):
            break
        try:
            there = context if row == 0 else context.at(points_ct[row])
        except InputError:  # a point that the case could not have as its target
            continue
        width = _widest(there.case, there, directions)
        if width > (0.0 if best is None else best.best_deg2):
            best = BestTarget(points_ct, wide, row, there, width)
    if best is None:
        raise NoAnswerError("no point has an open direction", code="nothing_safe")
    return best


def _widest(case: Case, context: CaseContext, directions: Directions) -> float:
    """Solid angle of the largest connected set of open directions at a case's target, square degrees."""
    grid, open_ = directions.grid, first_blocking(case, context.anatomy, context.engine, directions).open
    assert grid is not None  # a case's directions have one
    label = connected(grid, open_)
    return float(np.bincount(label[open_], grid.solid_angle()[open_], minlength=1).max()) * SQUARE_DEGREES


def points_inside(structure: Structure, count: int) -> Floats:
    """About so many points of a grid inside a closed structure, shape (m, 3), mm; none where it is that thin."""
    mesh = structure.mesh
    if not mesh.closed:
        refuse(f"structure '{structure.name}' is open", "best_target", "points, or a closed mesh", "open_mesh")
    step, (low, high) = float(np.cbrt(abs(mesh.volume) / count)), mesh.bounds
    shape = tuple(np.ceil((high - low) / step).astype(int))
    T_ct_index = pose(step * np.eye(3), (low + high - step * (np.array(shape) - 1)) / 2)
    return apply(T_ct_index, np.argwhere(voxels_inside(mesh, T_ct_index, shape)).astype(np.float64))
