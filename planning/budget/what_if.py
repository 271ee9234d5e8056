"""Cost of each error source alone, and what other slices, markers, touches or another arm would leave of the error."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from puncture_twin.planning.arm.inverse_kinematics import inverse, nearest_within_limits
from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.base.text import plural
from puncture_twin.planning.breathing.breathing import fraction_within
from puncture_twin.planning.budget.chain import GATES, Chain, other_gauges
from puncture_twin.planning.case.errors import ARM_KINDS, UNIFORM
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.marker_pairs import MIN_MARKERS
from puncture_twin.planning.uncertainty.pose_error import choose_touches, error_budget

SPACINGS_MM = (1.0, 2.0, 3.0, 5.0)
MOST_MARKERS = 10
CANDIDATES = 40
"""Places on the skin that are tried for each further marker."""
APART_MM = 20.0
"""One more marker is no nearer than this to another."""
PIVOTED_MM = 0.05
"""What a pivot calibration with 20 poses leaves of the tip's offset, per axis."""


@dataclass(frozen=True)
class SourceCost:
    """One source of the expected error."""

    source: str
    alone_mm: float  # the tip's rms error, were there no other
    without_mm: float  # expected error with all sources but this one; the registration's weights stay


@dataclass(frozen=True, eq=False)
class Change:
    """One change of the chain, and the error that it would leave."""

    group: str  # slices, markers, touches, arm, tip, needle, breath or body
    what: str
    rms_mm: float
    point_ct: Floats | None = None  # shape (3,), mm, where the last of further markers sits; None for other changes


def source_costs(chain: Chain) -> tuple[SourceCost, ...]:
    """Cost of every source, the largest first; only the squares add up to the whole's."""
    outward_base = -flange_pose(chain.model, chain.q_insertion)[:3, 2]
    budget = error_budget(chain.pose_error(), chain.q_insertion, outward_base)
    squares = {source: budget.rms_mm**2 * part for source, part in budget.fraction.items()}
    squares |= {source: float(np.trace(square)) for source, square in chain.body_mean_squares().items()}
    whole = sum(squares.values())
    rest = {source: float(np.sqrt(max(whole - square, 0.0))) for source, square in squares.items()}
    costs = [SourceCost(source, float(np.sqrt(square)), rest[source]) for source, square in squares.items()]
    return tuple(sorted(costs, key=lambda one: -one.alone_mm))


def changes(chain: Chain, skin_points_ct: Floats, bed_ct: Floats | None) -> tuple[Change, ...]:
    """The changes of a chain, each alone; further markers could sit at skin points (n, 3), mm.

    ``bed_ct`` (3,), unit, is across the CT's slices; None where it is not stated, and slices are left out.
    """
    return (
        *([] if bed_ct is None else _slices(chain, bed_ct)),
        *_touches(chain),
        *_arms(chain),
        *_needles(chain),
        *_body(chain),
        *_fewer_markers(chain),
        *_more_markers(chain, skin_points_ct),
    )


def best_change(options: tuple[Change, ...]) -> Change:
    """The one that leaves the least error."""
    return min(options, key=lambda one: one.rms_mm)


def _slices(chain: Chain, bed_ct: Floats) -> Iterator[Change]:
    cov = chain.errors.marker_cov_ct
    across = np.outer(bed_ct, bed_ct)
    for spacing in SPACINGS_MM:
        reading = cov + ((chain.scale * UNIFORM * spacing) ** 2 - bed_ct @ cov @ bed_ct) * across
        # the target is read in other slices too, unless it was declared by itself
        alike = np.array_equal(chain.errors.target_cov_ct, cov)
        errors = replace(chain.errors, marker_cov_ct=reading)
        errors = replace(errors, target_cov_ct=reading) if alike else errors
        yield Change("slices", f"slices of {spacing:g} mm", chain.with_errors(errors).expected_mm())


def _touches(chain: Chain) -> Iterator[Change]:
    try:
        q_touch = choose_touches(chain.pose_error(), apply(chain.T_base_ct, chain.points_ct), chain.q_insertion)
    except NoAnswerError:
        return
    planned = replace(chain, q_touch=q_touch).expected_mm()
    yield Change("touches", "markers touched in the best poses", planned)
    fresh = replace(chain.errors, arm=replace(chain.errors.arm, drift=0.0))
    yield Change("touches", "markers touched just before the insertion", chain.with_errors(fresh).expected_mm())


def _arms(chain: Chain) -> Iterator[Change]:
    arm = chain.errors.arm
    for name, kind in ARM_KINDS.items():
        twist, joint = np.radians([kind.twist_deg, kind.joint_deg]) * chain.scale
        of_kind = replace(arm, link_mm=chain.scale * kind.link_mm, twist=float(twist), joint=float(joint))
        yield Change("arm", f"a {name} arm", chain.with_errors(replace(chain.errors, arm=of_kind)).expected_mm())
    pivoted = replace(chain.errors, arm=replace(arm, tip_offset_mm=chain.scale * PIVOTED_MM))
    yield Change("tip", f"a tip known to {PIVOTED_MM:g} mm", chain.with_errors(pivoted).expected_mm())


def _needles(chain: Chain) -> Iterator[Change]:
    path = chain.path
    if path is None:
        return
    for number, shaft in other_gauges(path.bending.shaft).items():
        other = replace(path, bending=replace(path.bending, shaft=shaft))
        bends = f"bends by {other.bend.tip_mm:.1f} mm"
        yield Change("needle", f"a {number}G needle ({bends})", replace(chain, path=other).expected_mm())
    if path.bending.alpha > 0:
        symmetric = replace(path, bending=replace(path.bending, alpha=0.0))
        yield Change("needle", "a needle without a bevel", replace(chain, path=symmetric).expected_mm())


def _body(chain: Chain) -> Iterator[Change]:
    declared = chain.breathing
    for gate in GATES:
        if declared is None or gate == declared.gate:
            continue
        when = "at any phase"
        if gate is not None:
            when = f"at s <= {gate:g} ({100 * fraction_within(gate, declared.exponent):.0f} % of the time)"
        gated = replace(chain, breathing=replace(declared, gate=gate))
        yield Change("breath", f"inserted {when}", gated.expected_mm())
    if chain.motion_base is not None:
        fixed = replace(chain, motion_base=None)
        yield Change("body", "a body that is fixed as it was scanned", fixed.expected_mm())


def _fewer_markers(chain: Chain) -> Iterator[Change]:
    changes = []
    while len(chain.points_ct) > MIN_MARKERS:
        every = np.arange(len(chain.points_ct))
        remaining = [np.delete(every, row) for row in every]
        rest = [replace(chain, points_ct=chain.points_ct[rows], q_touch=chain.q_touch[rows]) for rows in remaining]
        chain = min(rest, key=lambda one: one.expected_mm())
        changes.append(Change("markers", f"only {plural(len(chain.points_ct), 'marker')}", chain.expected_mm()))
    yield from reversed(changes)


def _more_markers(chain: Chain, skin_points_ct: Floats) -> Iterator[Change]:
    points = skin_points_ct[:: max(1, len(skin_points_ct) // CANDIDATES)]
    # joints (n, 6) that touch the points in the insertion's orientation, nearest to it; NaN where none do
    R, poses = flange_pose(chain.model, chain.q_insertion)[:3, :3], np.tile(np.eye(4), (len(points), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = R, apply(chain.T_base_ct, points) - chain.tip_mm * R[:, 2]
    every = nearest_within_limits(chain.model, inverse(chain.model, poses), chain.q_insertion)
    far = np.abs(every - chain.q_insertion).max(axis=2)
    q = every[np.arange(len(every)), np.where(np.isnan(far), np.inf, far).argmin(axis=1)]
    points, q = points[~np.isnan(q).any(axis=1)], q[~np.isnan(q).any(axis=1)]
    while len(chain.points_ct) < MOST_MARKERS:
        gaps = np.linalg.norm(points[:, None] - chain.points_ct, axis=2).min(axis=1, initial=np.inf)
        method = "rigid" if chain.method == "triad" else chain.method  # a triad takes three
        grown = []
        for row in np.flatnonzero(gaps >= APART_MM):
            more = np.vstack([chain.points_ct, points[row]]), np.vstack([chain.q_touch, q[row]])
            grown.append(replace(chain, points_ct=more[0], q_touch=more[1], method=method).with_errors(chain.errors))
        if not grown:
            return
        chain = min(grown, key=lambda one: one.expected_mm())
        yield Change("markers", f"{plural(len(chain.points_ct), 'marker')}", chain.expected_mm(), chain.points_ct[-1])
