"""The line of an inserted needle, read from a scan: its verdict, structure by structure, and what to do next.

A planned direction starts in the target; a needle that is in the patient starts in its tip, and may be bent. Each piece
of its path is measured by the same engine, against the same structures and margins, from the piece's own end:

    clearance_j = min over pieces (distance of the piece from j) - needle radius
    safe: clearance_j - SURE sd_j >= margin_j for every j and piece,    sd_j^2 = g' Sigma6 g,  g = (n; s u x n)

with Sigma6 the covariance of the piece's end as it was read, s the depth from there. Nearer is not called safe.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from puncture_twin.planning.anatomy.skin import SkinPaths, skin_paths
from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.base.strict_json import or_null
from puncture_twin.planning.clearance.engine import MeasuredClearances, measure_clearances, normals_of
from puncture_twin.planning.registration.fits import carried_along
from puncture_twin.planning.search.constraints import first_broken
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.uncertainty.hit import hit_in_mesh, hit_model, mean_over_faces, proximity, touch_chance

SURE = 2.0
"""Standard deviations of the reading that a clearance must exceed its margin by: then the line is called safe."""
SAFE, UNCERTAIN = "safe", "uncertain"
"""A line that is safe by as much, and one that breaks no margin but might by what its reading may err."""
WANTED_HIT = 0.95
"""Chance to hit with which a needle is accepted, where the case states none."""
BETTER = 0.02
"""By which a chance must be larger for a needle to be moved again."""
TURN_SD = np.radians(0.5)
"""Standard deviation of a direction that is aimed anew at the skin, in each plane, rad."""
LEAST_MM = 0.5
"""A smaller step is none."""


class Clear(NamedTuple):
    """Clearance of the needle from one structure, mm."""

    name: str
    clearance_mm: float
    sd_mm: float
    """Of the clearance, by what the reading may err, of the piece that may come nearest; NaN where they intersect."""
    margin_mm: float  # NaN of what may be crossed
    depth_mm: float  # from the tip, along the needle, of the nearest point
    p_touch: float  # to first order, with what the surface itself may lie off; NaN where they intersect

    @property
    def sure(self) -> bool:
        """Whether the clearance exceeds the margin by as much as `SURE` demands."""
        return bool(np.isnan(self.margin_mm)) or self.clearance_mm - SURE * self.sd_mm >= self.margin_mm

    def document(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {name: value if isinstance(value, str) else or_null(value) for name, value in self._asdict().items()}


@dataclass(frozen=True, eq=False)
class LineCheck:
    """The verdict of an inserted needle's line."""

    verdict: str  # `SAFE`, `UNCERTAIN`, or a code of `Reason`
    structure: str  # which one decides; empty where none does
    each: tuple[Clear, ...]  # every structure, nearest to its margin first
    entry_ct: Floats  # shape (3,), where it enters the skin; NaN where it does not
    inserted_mm: float  # from there to the tip

    @property
    def safe(self) -> bool:
        """Whether it keeps every margin, the reading's error counted."""
        return self.verdict == SAFE


def check_line(context: CaseContext, path_ct: Floats, covs_ct: Floats) -> LineCheck:
    """Check an inserted needle along its line as read.

    Args:
        path_ct: Shape (m, 3), LPS mm, from the tip outward; beyond its last point it goes on straight.
        covs_ct: Shape (m, 6, 6), of each point and of the direction there, as rotation.
    """
    case, checked = context.case, context.anatomy.checked
    steps = np.diff(path_ct, axis=0)
    sizes = np.linalg.norm(steps, axis=1)
    starts = np.concatenate([[0.0], np.cumsum(sizes)[:-1]])
    outward = steps / sizes[:, None]
    best, violated = _nearest(context, path_ct, covs_ct, outward, starts, sizes)
    paths = _skin(context, path_ct, outward, starts, sizes)
    clearances = MeasuredClearances(best["clearance"][None], best["depth"][None], violated[None])
    broken = first_broken(paths, clearances, checked, needle=case.needle, max_skin_angle=np.pi)
    margins = [one.margin_mm if one.demands_margin else np.nan for one in checked]
    columns = zip(best["clearance"], best["sd"], margins, best["depth"], best["touch"], strict=True)
    each = [Clear(one.name, *map(float, column)) for one, column in zip(checked, columns, strict=True)]
    each.sort(key=lambda one: (np.isnan(one.margin_mm), one.clearance_mm - np.nan_to_num(one.margin_mm)))
    verdict, structure = str(broken.reason[0]), str(broken.structure[0])
    if not verdict:
        unsure = [one.name for one in each if not one.sure]
        verdict, structure = (UNCERTAIN, unsure[0]) if unsure else (SAFE, "")
    return LineCheck(verdict, structure, tuple(each), paths.entry_ct[0], float(paths.path_length[0]))


def _nearest(
    context: CaseContext, path_ct: Floats, covs_ct: Floats, outward_ct: Floats, starts: Floats, sizes: Floats
) -> tuple[dict[str, Floats], Bools]:
    """Of each structure least clearance of all pieces, depth, deviation and chance to touch; which is violated."""
    case, checked, engine = context.case, context.anatomy.checked, context.engine
    errors = context.pose_error or case.errors
    voxels = [one.voxel_ct for one in checked]
    surfaces = np.array([np.zeros((3, 3)) if errors is None else errors.surface_cov_ct(one) for one in voxels])
    k = len(checked)
    best = {name: np.full(k, np.inf) for name in ("clearance", "depth", "sure")} | {"touch": np.zeros(k)}
    violated = np.zeros(k, bool)
    for row, (begin, outward) in enumerate(zip(path_ct[:-1], outward_ct, strict=True)):
        last = row == len(sizes) - 1
        length = max(case.needle.length_mm - starts[row], sizes[row]) if last else sizes[row]
        axes = engine.measure(begin, outward[None], np.full((1, k), length), shown=False)
        own = measure_clearances(
            engine, checked, begin, outward[None], length=length, radius=case.needle.radius_mm, axes=axes
        )
        normal = normals_of(engine.triangles, begin, outward[None], axes)
        surface = np.sqrt(np.einsum("nka,kab,nkb->nk", np.nan_to_num(normal), surfaces, np.nan_to_num(normal)))
        bare, whole = (
            proximity(axes.distance, own.depth, normal, outward[None], covs_ct[row][None], off)
            for off in (0.0, surface)
        )
        nearer = own.clearance[0] < best["clearance"]
        best["depth"] = np.where(nearer, starts[row] + own.depth[0], best["depth"])
        best["clearance"] = np.minimum(own.clearance[0], best["clearance"])
        best["sure"] = np.minimum(best["sure"], own.clearance[0] - SURE * bare.deviation[0])
        best["touch"] = np.maximum(best["touch"], touch_chance(whole, case.needle.radius_mm)[0])
        violated |= own.violated[0]
    best["sd"] = (best["clearance"] - best.pop("sure")) / SURE
    return best, violated


def _skin(context: CaseContext, path_ct: Floats, outward: Floats, starts: Floats, sizes: Floats) -> SkinPaths:
    """The skin along a path of pieces; from the piece that leaves the body on it is straight."""
    for row, (begin, along) in enumerate(zip(path_ct[:-1], outward, strict=True)):
        rest = max(context.case.needle.length_mm - starts[row], 1.0)
        one = skin_paths(context.anatomy.skin, begin, along[None], rest)
        if np.fmin(one.path_length[0], one.unknown_depth[0]) <= sizes[row]:
            break
    depths = (starts[row] + depth for depth in (one.reentry_depth, one.unknown_depth))
    return SkinPaths(one.entry_ct, starts[row] + one.path_length, one.skin_angle, *depths)


class Aim(NamedTuple):
    """A next action on an inserted needle, and its expected result."""

    kind: str
    """``accept``, ``deeper`` (x mm; below 0 back), ``turn`` (to the skin and on by an angle) or ``withdraw``."""
    by_mm: float  # how much deeper, along the needle; of a turn how far back first
    turn_deg: float  # between the needle and the line from its entry to the target
    p_hit: float
    """The chance that the tip is in the target then, by what is known of the reading; NaN where unknown."""
    lateral_mm: float  # by which the tip, or its line, passes the target then
    verdict: str  # of the line that the needle takes then
    structure: str

    @property
    def allowed(self) -> bool:
        """Whether the line of this action is safe."""
        return self.verdict == SAFE

    def document(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {name: value if isinstance(value, str) else or_null(value) for name, value in self._asdict().items()}


def next_aims(context: CaseContext, path_ct: Floats, covs_ct: Floats, forward_ct: Floats, now: LineCheck) -> list[Aim]:
    """Next actions on an inserted needle, the best first.

    Args:
        path_ct: As for `check_line`, which gave ``now``; ``covs_ct`` too.
        forward_ct: Shape (3,), unit, the direction in which it goes on.
    """
    target, tip, cov_ct = context.case.target_ct, path_ct[0], covs_ct[0]
    to_target = target - tip
    deeper = float(to_target @ forward_ct)
    lateral = float(np.linalg.norm(to_target - deeper * forward_ct))
    aims = [Aim("accept", 0.0, 0.0, hit_chance(context, tip, cov_ct[:3, :3]), lateral, now.verdict, now.structure)]
    if abs(deeper) >= LEAST_MM:
        end = tip + deeper * forward_ct
        cov = carried_along(np.stack([tip, end]), cov_ct)[1]
        kept = (path_ct - end) @ forward_ct < -LEAST_MM
        ahead, covs = (np.concatenate([first[None], all_[kept]]) for first, all_ in ((end, path_ct), (cov, covs_ct)))
        then = check_line(context, ahead, covs) if kept.any() else now
        chance = hit_chance(context, end, cov[:3, :3])
        aims.append(Aim("deeper", deeper, 0.0, chance, lateral, then.verdict, then.structure))
    if np.isfinite(now.entry_ct).all():
        span = now.entry_ct - target
        depth = float(np.linalg.norm(span))
        outward = span / depth
        across = np.eye(3) - np.outer(outward, outward)
        cov = cov_ct.copy()
        cov[:3, :3] += (depth * TURN_SD) ** 2 * across
        cov[3:, 3:] += TURN_SD**2 * across
        path = np.stack([target, now.entry_ct])
        then = check_line(context, path, carried_along(path, cov))
        turn = float(np.degrees(np.arccos(np.clip(-forward_ct @ outward, -1.0, 1.0))))
        chance = hit_chance(context, target, cov[:3, :3])
        aims.append(Aim("turn", now.inserted_mm, turn, chance, 0.0, then.verdict, then.structure))
    allowed = [one for one in aims if one.allowed]
    if not allowed:
        out = Aim("withdraw", now.inserted_mm, 0.0, float("nan"), float("nan"), now.verdict, now.structure)
        return [out, *aims]
    # the least change first that hits as often as wanted, or else as often as any
    wanted, most = context.case.search.min_hit or WANTED_HIT, max(np.nan_to_num(one.p_hit) for one in allowed)
    first = next(one for one in allowed if np.nan_to_num(one.p_hit) >= min(wanted, most - BETTER))
    return [first, *(one for one in aims if one is not first)]


def hit_chance(context: CaseContext, tip_ct: Floats, cov_ct: Floats) -> float:
    """The chance that a tip (3,), read with a covariance (3, 3), is in the target; NaN of an open mesh."""
    case, target = context.case, context.anatomy.structure(context.case.target_structure)
    if case.hit_radius_mm is None and not target.mesh.closed:
        return float("nan")
    errors, surface = context.pose_error or case.errors, 0.0
    if case.errors is not None and case.hit_radius_mm is not None:
        cov_ct = cov_ct + case.errors.target_cov_ct
    elif errors is not None:
        surface = mean_over_faces(target.mesh, errors.surface_cov_ct(target.voxel_ct))
    rays = hit_model(case.hit_radius_mm, target.mesh, case.target_ct, tip_ct - case.target_ct).rays
    assert rays is not None
    return float(hit_in_mesh(rays, np.asarray(cov_ct)[None], None, surface)[0])
