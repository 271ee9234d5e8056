"""The search for a placement of the arm: all regions coarsely, the best of each finely, the finalists exactly.

A finalist is checked as the batch search checks it: the arm for every organ-safe direction, the expected tip error with
the markers touched anew from there, and whether the needle can wait before the insertion at all.
Results: ``placements.csv`` as a table, ``place.json`` with everything.
"""

from __future__ import annotations

import csv
import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import fcl
import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.unseen import BEYOND_IMAGE
from puncture_twin.planning.arm.insertion import flange_poses
from puncture_twin.planning.arm.tool import Box, Tool
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import user_cache
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.base.files import atomic
from puncture_twin.planning.base.processes import map_all
from puncture_twin.planning.base.progress import Count
from puncture_twin.planning.base.text import Shown
from puncture_twin.planning.case.case import Case, bed_frame
from puncture_twin.planning.case.settings import mount_pose
from puncture_twin.planning.case.tables import MountSection
from puncture_twin.planning.collision.bodies import Solid, connected_parts
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.collision.fast_checker import FastChecker
from puncture_twin.planning.collision.patient import FclSkin
from puncture_twin.planning.collision.state_checker import PATIENT, Contact
from puncture_twin.planning.collision.workcell import (
    ARM_PADDING_MM,
    case_boxes,
    case_tool,
    home_configuration,
    outside_surface,
    patient_surface,
)
from puncture_twin.planning.geometry.mesh import TriangleMesh, box_of, joined
from puncture_twin.planning.geometry.rigid import apply, pose
from puncture_twin.planning.place.arm_spheres import Boxes, SkinField, Surroundings
from puncture_twin.planning.place.estimate import Estimator, ReachEstimate
from puncture_twin.planning.place.mounts import (
    Site,
    WantedDirections,
    mount_lines,
    mount_section,
    regions,
    wanted_directions,
)
from puncture_twin.planning.reach.reach import assess_reach_all
from puncture_twin.planning.reach.survey import ReachRequest
from puncture_twin.planning.registration.fit_uncertainty import reading_noise, touches
from puncture_twin.planning.registration.marker_pairs import MarkerPairs
from puncture_twin.planning.registration.placement import Placement, default_method
from puncture_twin.planning.registration.registration import Registration, register
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.uncertainty.pose_error import PoseError

Progress = Callable[[str, int, int], None]

COARSE_DIRECTIONS = 64
"""Directions that a site is estimated with at first."""

FINE_DIRECTIONS = 128
"""Directions that sites near the best are estimated with."""

SEEDS = 10
"""Sites that are refined; each mount's best is among them."""

HALVINGS = 3
"""How often the step is halved: from 150 mm to 19 mm, about as exactly as a base is set up."""

FINALISTS = 6
"""Sites that are checked exactly; each mount's best is among them."""

FRACTION_DIGITS = 3
"""Fractions that agree to so many digits are equal; then the expected error decides, then the margin."""

ERROR_DIGITS = 2
"""Expected errors (mm) that agree to so many digits are equal."""


@dataclass(frozen=True)
class RatedPlacement:
    """A placement, checked and rated.

    Attributes:
        site: Position of the base; None for the case's own placement.
        mount: The base's pose as a case states it.
        estimate: The estimate that it was chosen by; None for the case's own.
        verdict: The result of the exact check.
        expected_mm: Expected (rms) error of the tip over its insertions, the markers touched anew from there; None
            where the case declares no errors, or has no markers.
    """

    site: Site | None
    mount: MountSection
    estimate: ReachEstimate | None
    verdict: Verdict
    expected_mm: float | None

    @property
    def name(self) -> str:
        """Name in the tables."""
        return "as in the case" if self.site is None else self.site.region.name


@dataclass(frozen=True, eq=False, repr=False)
class PlaceSearch(Shown):
    """Result of a search for placements.

    Attributes:
        T_ct_bed: Shape (4, 4), mm: the frame of the sites.
        coarse: Every site of the first lattice with its estimate.
        refined: How many more sites were estimated.
        possible: Fraction of directions, 0..1, in which the needle may wait at its standoff: no placement reaches more.
        rated: Best first; the case's own placement is not among them.
        own: The case's own placement, checked; None where it has none.
    """

    T_ct_bed: Floats
    coarse: tuple[tuple[Site, ReachEstimate], ...]
    refined: int
    possible: float
    rated: tuple[RatedPlacement, ...]
    own: RatedPlacement | None


def search_placements(
    case: Case,
    anatomy: Anatomy,
    candidates: Candidates,
    placement: Placement | None,
    *,
    jobs: int = 1,
    progress: Progress = lambda stage, done, total: None,
) -> PlaceSearch:
    """Search for the placements from which the arm can reach most of the organ-safe directions.

    The answer does not depend on ``jobs``.

    Args:
        case: The validated case.
        anatomy: Its structures.
        candidates: Its directions, checked against the organs alone.
        placement: Where the case itself has the arm.
        jobs: Processes.
        progress: Called with (stage, done, total).

    Raises:
        InputError: Bounds that contradict the case, or an own arm or tool with a shape that hangs on nothing.
        NoAnswerError: No direction is safe for the organs, or in none the needle could start.
    """
    if not candidates.safe.any():
        what = "no direction is safe for the organs, so no placement can help"
        raise NoAnswerError(what, counts=candidates.counts(), code="no_safe_direction")
    # 1. The workcell, and the directions in which the needle itself is clear at its standoff.
    T_ct_bed = bed_frame(case)
    check = _placement_check(case, anatomy, candidates)
    CellChecker(check.model, check.tool)  # refuses shapes that hang on nothing before minutes are spent
    near, beyond = _parted(anatomy)
    surroundings = Surroundings(
        SkinField.of(patient_surface(near)), Boxes.of((*check.fixed, *beyond)), Boxes.of(check.carried), ARM_PADDING_MM
    )
    startable = check.wanted.only(
        needle_can_start(check.tool, check.patient, case.target_ct, check.wanted, ARM_PADDING_MM)
    )
    if not len(startable):
        what = "in every organ-safe direction the needle would start too near the skin"
        raise NoAnswerError(what, code="standoff_in_skin")
    # 2. All sites of a lattice, by bounding spheres (an estimate).
    coarse = Estimator(
        check.model, check.tool, surroundings, T_ct_bed, startable.spread(COARSE_DIRECTIONS), itself=False
    )
    fine = replace(coarse, wanted=startable.spread(FINE_DIRECTIONS))
    sites = [
        Site(region, (float(x), float(y), float(z)))
        for region in regions(case, T_ct_bed)
        for x, y, z in region.lattice(case.place.step_mm)
    ]
    estimates = map_all(coarse.estimate, sites, jobs=jobs, progress=partial(progress, "placements estimated"))
    first = tuple(zip(sites, estimates, strict=True))
    # 3. The best of them refined, by ever shorter steps; 4. the best of those checked exactly.
    seeds = [site for site, _ in _best_apart(first, 1.5 * case.place.step_mm, SEEDS)]
    refiner = _Refiner(fine, partial(progress, "placements refined"))
    finalists = _best_apart(refiner.refine(seeds, case.place.step_mm), case.place.step_mm / 2, FINALISTS)
    rated, own = _checked(case, check, T_ct_bed, finalists, placement, jobs, partial(progress, "placements checked"))
    return PlaceSearch(T_ct_bed, first, refiner.estimated, float(startable.weight.sum()), rated, own)


def _checked(
    case: Case,
    check: PlacementCheck,
    T_ct_bed: Floats,
    finalists: Sequence[tuple[Site, ReachEstimate]],
    placement: Placement | None,
    jobs: int,
    progress: Count,
) -> tuple[tuple[RatedPlacement, ...], RatedPlacement | None]:
    """The finalists checked exactly, best first, and the case's own placement, which is checked too."""
    mounts = [mount_section(T_ct_bed @ site.T_bed_base(), case.space) for site, _ in finalists]
    poses = [mount_pose(mount, case.space, case.path) for mount in mounts]
    if placement is not None:  # first: nobody chose it, and the directions that are not reached take longest
        poses.insert(0, placement.T_base_ct)
    verdicts = map_all(check.verdict, poses, jobs=jobs, progress=progress)
    own = None
    if placement is not None:
        T_ct_base = np.asarray(np.linalg.inv(placement.T_base_ct), dtype=np.float64)
        verdict, pose = verdicts.pop(0), poses.pop(0)
        expected = expected_tip_error_mm(case, placement, pose, verdict.q_insertion)
        own = RatedPlacement(None, mount_section(T_ct_base, case.space), None, verdict, expected)
    rated = [
        RatedPlacement(site, mount, guess, verdict, expected_tip_error_mm(case, placement, pose, verdict.q_insertion))
        for (site, guess), mount, pose, verdict in zip(finalists, mounts, poses, verdicts, strict=True)
    ]
    return tuple(sorted(rated, key=_worth)), own


def _worth(one: RatedPlacement) -> tuple[float, float, float]:
    """Sort key, less is better: most directions, then the least expected error, then the widest margin."""
    expected = 0.0 if one.expected_mm is None else round(one.expected_mm, ERROR_DIGITS)
    return -round(one.verdict.fraction, FRACTION_DIGITS), expected, -one.verdict.margin


def _parted(anatomy: Anatomy) -> tuple[Anatomy, list[Box]]:
    """The anatomy inside the image, and boxes, CT frame, about the body assumed beyond it, which is metres long."""
    view, solids = anatomy.skin.field_of_view, anatomy.surroundings
    T = np.eye(4) if view is None else view.T_ct_box
    parts = [part for one in solids if one.name == BEYOND_IMAGE for part in connected_parts(one.mesh)]
    boxes = []
    for part in parts:
        low, high = box_of((part - T[:3, 3]) @ T[:3, :3])
        boxes.append(Box(BEYOND_IMAGE, T @ pose(np.eye(3), (low + high) / 2), tuple((high - low).tolist())))
    return replace(anatomy, surroundings=tuple(one for one in solids if one.name != BEYOND_IMAGE)), boxes


def _placement_check(case: Case, anatomy: Anatomy, candidates: Candidates) -> PlacementCheck:
    """The case's workcell, with what moves with the patient apart from what moves with the arm, and its directions."""
    carried = {obstacle.name for obstacle in case.obstacles if obstacle.frame == "base"}
    boxes = case_boxes(case, np.eye(4))  # with the two frames in one place each box stands in its own
    return PlacementCheck(
        model=case.robot.model,
        tool=case_tool(case),
        skin=anatomy.skin.mesh,
        outside=outside_surface(anatomy),
        fixed=tuple(box for box in boxes if box.name not in carried),
        carried=tuple(box for box in boxes if box.name in carried),
        padding_mm=ARM_PADDING_MM,
        target_ct=case.target_ct,
        wanted=wanted_directions(case, candidates),
        home=home_configuration(case),
    )


class _Refiner:
    """Local search: from sites to better neighbours with ever shorter steps; no site is estimated twice.

    Whether the arm touches itself takes longest to compute, and can only lower a fraction. So it is computed for the
    leading site alone, until the leading site is one for which it is known.
    """

    def __init__(self, estimator: Estimator, progress: Count) -> None:
        self._quick = replace(estimator, itself=False)
        self._full = replace(estimator, itself=True)
        self._progress = progress
        self._upper: dict[Site, ReachEstimate] = {}  # without contacts of the arm with itself
        self._whole: dict[Site, ReachEstimate] = {}

    @property
    def estimated(self) -> int:
        """Number of estimated sites."""
        return len(self._upper)

    def refine(self, seeds: Sequence[Site], step_mm: float) -> list[tuple[Site, ReachEstimate]]:
        """End of each seed's walk, with its estimate; each end once."""
        ends = list(seeds)
        for halving in range(1, HALVINGS + 1):
            ends = self._leaders([[end, *_neighbours(end, step_mm / 2**halving)] for end in ends])
        return [(end, self._whole[end]) for end in dict.fromkeys(ends)]

    def _leaders(self, groups: Sequence[Sequence[Site]]) -> list[Site]:
        """The best site of each group."""
        self._estimate(self._quick, self._upper, [site for group in groups for site in group])
        while True:
            leaders = [
                max(group, key=lambda site: _score(self._whole.get(site, self._upper[site]))) for group in groups
            ]
            if all(leader in self._whole for leader in leaders):
                return leaders
            self._estimate(self._full, self._whole, leaders)

    def _estimate(self, estimator: Estimator, known: dict[Site, ReachEstimate], sites: Sequence[Site]) -> None:
        new = [site for site in dict.fromkeys(sites) if site not in known]
        # In this process: there are few of them, and a new process would have to build its arm first.
        known |= dict(zip(new, map_all(estimator.estimate, new, jobs=1, progress=self._progress), strict=True))


def _neighbours(site: Site, step_mm: float) -> list[Site]:
    around = site.region.around(np.array(site.position), step_mm)
    return [Site(site.region, (float(x), float(y), float(z))) for x, y, z in around]


def _score(estimate: ReachEstimate) -> tuple[float, float]:
    """Sort key of an estimate, more is better."""
    return round(estimate.fraction, FRACTION_DIGITS), estimate.margin


def _order(estimate: ReachEstimate) -> tuple[float, float]:
    fraction, margin = _score(estimate)
    return -fraction, -margin


def _best_apart(
    pairs: Sequence[tuple[Site, ReachEstimate]], distance_mm: float, count: int
) -> list[tuple[Site, ReachEstimate]]:
    """Each mount's best, then the best of the others, as far as they reach any direction.

    Args:
        pairs: Sites with their estimates.
        distance_mm: Two of the same region are at least so far apart.
        count: So many, or as many as there are mounts.
    """
    holding = [pair for pair in pairs if pair[1].fraction > 0.0]
    mounts = {site.region.mount for site, _ in holding}
    firsts: list[tuple[Site, ReachEstimate]] = []
    others: list[tuple[Site, ReachEstimate]] = []
    for pair in sorted(holding, key=lambda pair: _order(pair[1])):
        is_first = pair[0].region.mount not in {site.region.mount for site, _ in firsts}
        if is_first:
            firsts.append(pair)
        elif len(firsts) + len(others) < count and all(_far(pair[0], k, distance_mm) for k, _ in firsts + others):
            others.append(pair)
        if len(firsts) == len(mounts) and len(firsts) + len(others) >= count:
            break
    return firsts + others[: max(0, count - len(firsts))]


def _far(one: Site, other: Site, distance_mm: float) -> bool:
    apart = float(np.linalg.norm(np.subtract(one.position, other.position)))
    return one.region != other.region or apart >= distance_mm


@dataclass(frozen=True, eq=False)
class Verdict:
    """Exact reach from one placement.

    Attributes:
        fraction: Solid angle of the reached directions over that of all that are wanted, 0..1.
        reached: How many directions the arm can reach and insert along.
        count: How many directions are wanted.
        margin: Mean reach margin of the reached ones, 0..1; 0 for none.
        reasons: How many of the others fell to which reason.
        home_contact: What the arm touches in its home configuration, or "".
        q_insertion: Shape (reached, 6), rad, the tip on the target.
    """

    fraction: float
    reached: int
    count: int
    margin: float
    reasons: Mapping[str, int]
    home_contact: str
    q_insertion: Floats


@dataclass(frozen=True, eq=False)
class PlacementCheck:
    """Checks placements. Its values can be sent to another process.

    Attributes:
        model: The arm.
        tool: What its flange carries.
        skin: CT frame.
        outside: CT frame, what the CT shows outside of it, or None.
        fixed: Boxes that stand with the patient; their ``T_base_box`` is in the CT frame.
        carried: Boxes that stand with the arm, base frame.
        padding_mm: Of the arm.
        target_ct: Shape (3,), mm.
        wanted: The directions.
        home: Shape (6,), rad.
    """

    model: UrModel
    tool: Tool
    skin: TriangleMesh
    outside: TriangleMesh | None
    fixed: tuple[Box, ...]
    carried: tuple[Box, ...]
    padding_mm: float
    target_ct: Floats
    wanted: WantedDirections
    home: Floats

    @cached_property
    def patient(self) -> TriangleMesh:
        """Patient surface, CT frame: the skin, and what the CT shows outside of it."""
        return self.skin if self.outside is None else joined([self.skin, self.outside])

    def verdict(self, T_base_ct: Floats) -> Verdict:
        """Check every direction.

        Raises:
            InputError: The base stands in the patient.
        """
        checker = self._checker(T_base_ct)
        target = T_base_ct[:3, :3] @ self.target_ct + T_base_ct[:3, 3]
        requests = [
            ReachRequest(target, T_base_ct[:3, :3] @ outward, self.tool.needle_length_mm, float(standoff))
            for outward, standoff in zip(self.wanted.outward_ct, self.wanted.standoff_mm, strict=True)
        ]
        answers = assess_reach_all(checker, requests)
        reached = np.array([answer.reachable for answer in answers], bool)
        margins = [answer.margin for answer in answers if answer.reachable]
        ends = [answer.insertion_q[-1] for answer in answers if answer.reachable]
        return Verdict(
            fraction=float(self.wanted.weight[reached].sum()),
            reached=int(reached.sum()),
            count=len(reached),
            margin=float(np.mean(margins)) if margins else 0.0,
            reasons=dict(Counter(answer.reason.value for answer in answers if not answer.reachable).most_common()),
            home_contact=_contact_text(checker.contact(self.home, needle_may_touch_patient=False)),
            q_insertion=np.array(ends).reshape(-1, 6),
        )

    def _checker(self, T_base_ct: Floats) -> FastChecker:
        boxes = [Box(box.name, T_base_ct @ box.T_base_box, box.size_mm) for box in self.fixed]
        outside = None if self.outside is None else self.outside.transformed(T_base_ct)
        model, everything = self.model, (*boxes, *self.carried)
        skin, cache = self.skin.transformed(T_base_ct), user_cache()
        return FastChecker(model, self.tool, everything, skin, outside=outside, padding_mm=self.padding_mm, cache=cache)


def _contact_text(contact: Contact | None) -> str:
    return "" if contact is None else f"{contact.body} touches {contact.other}"


def expected_tip_error_mm(case: Case, placement: Placement | None, T_base_ct: Floats, q: Floats) -> float | None:
    """Root mean square over insertions (n, 6) of sqrt(trace(Sigma_dd)); None without declared errors, markers or q.

    How the arm will touch the markers from there nobody has said, so that the arm's own errors do not cancel (2 J_f
    Sigma_eta J_f' stands for them); the residuals of the old touches say nothing of the new ones.

    Args:
        case: Declares the errors.
        placement: Where the case has the arm; gives the markers.
        T_base_ct: Shape (4, 4), mm: where the arm is to stand.
        q: Joints (rad) with the tip on the target from there.
    """
    registration = None if placement is None else placement.registration
    if case.errors is None or registration is None or not len(q):
        return None
    covariance = pose_error_from(case, registration, T_base_ct).covariance(q)
    return float(np.sqrt(np.trace(covariance[:, :3, :3], axis1=1, axis2=2).mean()))


def pose_error_from(case: Case, registration: Registration, T_base_ct: Floats) -> PoseError:
    """The needle's pose error from another placement; arguments as above, the case with errors."""
    assert case.errors is not None  # the caller has looked
    errors, old = replace(case.errors, found=False), registration.markers
    markers = MarkerPairs(old.names, old.points_ct, apply(T_base_ct, old.points_ct))
    model, tip = case.robot.model, case.needle.length_mm
    noise = reading_noise(errors, model, tip, touches(case, markers), known=False)
    method = (None if case.registration is None else case.registration.method) or default_method(errors)
    fitted = register(markers, method=method, target_ct=case.target_ct, noise=noise)
    assert fitted.uncertainty is not None  # its markers have noise
    return PoseError(model, tip, apply(T_base_ct, case.target_ct), errors, fitted.uncertainty)


def needle_can_start(
    tool: Tool, skin: TriangleMesh, target_ct: Floats, wanted: WantedDirections, padding_mm: float
) -> NDArray[np.bool_]:
    """Whether the padded needle at standoff is clear of the skin: else no placement can reach the direction.

    Args:
        tool: With the needle.
        skin: CT frame.
        target_ct: Shape (3,), mm.
        wanted: n directions.
        padding_mm: What the arm's checker keeps from the patient.

    Returns:
        Shape (n,).
    """
    start, end = tool.needle_span_mm
    radius, length = tool.needle_diameter_mm / 2 + padding_mm, end - start + 2 * padding_mm
    needle, half = Solid(partial(fcl.Cylinder, radius, length)), np.array([radius, radius, length / 2])
    patient = FclSkin(skin, PATIENT)
    # From the tip, at the standoff from the target, the needle's middle is half its body farther out.
    poses = flange_poses(target_ct, wanted.outward_ct, wanted.standoff_mm + (end - start) / 2)
    clear = np.empty(len(wanted), np.bool_)
    for row, T in enumerate(poses):
        needle.place(fcl.Transform(T[:3, :3], T[:3, 3]))
        clear[row] = not patient.touches(needle, np.array([-half, half]))
    return clear


PLACE_VERSION = 1
"""Version of ``place.json``'s layout."""

COLUMNS = (
    *("rank", "placement", "along_mm", "across_mm", "height_mm", "share", "held", "asked", "margin", "home_contact"),
    *("base_x_mm", "base_y_mm", "base_z_mm"),
)
"""Columns of ``placements.csv``; the base's coordinates are in the case's space."""

EXPECTED = "expected_error_mm"
"""A further column where the case declares errors and has markers."""


def placement_rows(found: PlaceSearch) -> list[dict[str, Any]]:
    """One row a checked placement, best first, rank 1; the case's own comes last, without a rank."""
    rows = [_row(rank, one) for rank, one in enumerate(found.rated, start=1)]
    return rows if found.own is None else [*rows, _row(None, found.own)]


def _row(rank: int | None, one: RatedPlacement) -> dict[str, Any]:
    along, across, height = (None, None, None) if one.site is None else one.site.position
    values = (rank, one.name, along, across, height, one.verdict.fraction, one.verdict.reached, one.verdict.count)
    rest = (one.verdict.margin, one.verdict.home_contact, *one.mount.position_mm)
    row = dict(zip(COLUMNS, (*values, *rest), strict=True))
    return row if one.expected_mm is None else {**row, EXPECTED: round(one.expected_mm, 4)}


def _estimate(estimate: ReachEstimate) -> dict[str, float]:
    return {
        "reach": estimate.reach,
        "room": estimate.unobstructed,
        "share": estimate.fraction,
        "margin": estimate.margin,
    }


def place_document(found: PlaceSearch, provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Everything as plain values: mm; fractions and margins 0..1."""
    rows = placement_rows(found)
    for row, one in zip(rows, (*found.rated, *((found.own,) if found.own else ())), strict=True):
        row["mount"] = {key: list(value) for key, value in one.mount.model_dump().items()}
        row["reasons"] = dict(one.verdict.reasons)
        row["estimate"] = None if one.estimate is None else _estimate(one.estimate)
    best = found.rated[0] if found.rated else None
    return {
        "version": PLACE_VERSION,
        **provenance,
        "T_ct_bed": np.asarray(found.T_ct_bed).tolist(),
        "sites": {"coarse": len(found.coarse), "refined": found.refined, "judged": len(found.rated)},
        "possible_share": found.possible,
        "placements": rows,
        "mount_lines": None if best is None else mount_lines(best.mount),
    }


def write_placements(found: PlaceSearch, path: Path) -> None:
    """Write the table as CSV, whole or not at all."""
    with atomic(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as stream:
        rows = placement_rows(found)
        writer = csv.DictWriter(stream, (*COLUMNS, *([EXPECTED] if any(EXPECTED in row for row in rows) else [])))
        writer.writeheader()
        writer.writerows(rows)


def write_place_document(document: Mapping[str, Any], path: Path) -> None:
    """Write the document as JSON, whole or not at all."""
    with atomic(path) as temporary:
        temporary.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")
