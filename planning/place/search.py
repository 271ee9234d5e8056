"""The search for a place to stand the arm: all regions coarsely, the best of each finely, the finalists exactly."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.beyond_image import BEYOND_IMAGE
from puncture_twin.planning.arm.tool import Box
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.base.processes import map_all
from puncture_twin.planning.base.progress import Count
from puncture_twin.planning.case.bed import bed_frame
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.mount import mount_pose
from puncture_twin.planning.case.tables.robot_section import MountSection
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.collision.loose_parts import connected_parts
from puncture_twin.planning.collision.surroundings import case_boxes
from puncture_twin.planning.collision.workcell import (
    ARM_PADDING_MM,
    case_tool,
    home_configuration,
    outside_surface,
    patient_surface,
)
from puncture_twin.planning.geometry.mesh import box_of
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.planning.place.arm_spheres import Surroundings
from puncture_twin.planning.place.directions import wanted_directions
from puncture_twin.planning.place.estimate import Estimator, ReachEstimate
from puncture_twin.planning.place.evaluate import PlacementCheck, Verdict
from puncture_twin.planning.place.expected_error import expected_tip_error_mm
from puncture_twin.planning.place.mounts import Site, mount_section, regions
from puncture_twin.planning.place.needle_start import needle_can_start
from puncture_twin.planning.place.obstacle_field import Boxes, SkinField
from puncture_twin.planning.registration.placement import Placement
from puncture_twin.planning.search.candidates import Candidates

Progress = Callable[[str, int, int], None]

COARSE_DIRECTIONS = 64
"""Directions that a site is estimated with at first."""

FINE_DIRECTIONS = 128
"""And those near the best."""

SEEDS = 10
"""Sites that are refined; each mount's best is among them."""

HALVINGS = 3
"""The step is halved so often: 150 mm to 19 mm, about what a base is stood to."""

FINALISTS = 6
"""Sites that are checked exactly; each mount's best is among them."""

FRACTION_DIGITS = 3
"""Shares that agree to so many digits are equal; then the expected error decides, then the margin."""

ERROR_DIGITS = 2
"""Expected errors (mm) that agree to so many digits are equal."""


@dataclass(frozen=True)
class RatedPlacement:
    """A placement and its worth.

    Attributes:
        site: Where the base stands; None for where the case itself has it.
        mount: The base's pose as a case states it.
        estimate: What it was chosen by; None for the case's own.
        verdict: The exact answer.
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
        """What the tables call it."""
        return "as in the case" if self.site is None else self.site.region.name


@dataclass(frozen=True, eq=False)
class PlaceSearch:
    """What was found.

    Attributes:
        T_ct_bed: Shape (4, 4), mm: the frame of the sites.
        coarse: Every site of the first lattice with its estimate.
        refined: How many more were estimated.
        possible: Share of the directions, 0..1, in which the needle itself may stand at standoff; none can hold more.
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
    found: Candidates,
    placement: Placement | None,
    *,
    jobs: int = 1,
    progress: Progress = lambda stage, done, total: None,
) -> PlaceSearch:
    """Look for the placements from which the arm can reach most of the organ-safe directions.

    The answer does not depend on ``jobs``.

    Args:
        case: The validated case.
        anatomy: Its structures.
        found: Its directions, checked against the organs alone.
        placement: Where the case itself has the arm.
        jobs: Processes.
        progress: Called with (stage, done, total).

    Raises:
        InputError: Bounds that contradict the case, or an own arm or tool with a shape that hangs on nothing.
        NoAnswerError: No direction is safe for the organs, or in none the needle could start.
    """
    if not found.safe.any():
        raise NoAnswerError("no direction is safe for the organs, so no placement can help", counts=found.counts())
    T_ct_bed = bed_frame(case)
    check = _placement_check(case, anatomy, found)
    CellChecker(check.model, check.tool)  # refuses shapes that hang on nothing before minutes are spent
    near, beyond = _parted(anatomy)
    surroundings = Surroundings(
        SkinField.of(patient_surface(near)), Boxes.of((*check.fixed, *beyond)), Boxes.of(check.carried), ARM_PADDING_MM
    )
    startable = check.wanted.only(
        needle_can_start(check.tool, check.patient, case.target_ct, check.wanted, ARM_PADDING_MM)
    )
    if not len(startable):
        raise NoAnswerError("in every organ-safe direction the needle would start too near the skin")
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
    """The finalists as they would be written, best first, and the case's own placement."""
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
        RatedPlacement(site, mount, hoped, verdict, expected_tip_error_mm(case, placement, pose, verdict.q_insertion))
        for (site, hoped), mount, pose, verdict in zip(finalists, mounts, poses, verdicts, strict=True)
    ]
    return tuple(sorted(rated, key=_worth)), own


def _worth(one: RatedPlacement) -> tuple[float, float, float]:
    """Less is better: most directions, then the least expected error, then the widest margin."""
    expected = 0.0 if one.expected_mm is None else round(one.expected_mm, ERROR_DIGITS)
    return -round(one.verdict.fraction, FRACTION_DIGITS), expected, -one.verdict.margin


def _parted(anatomy: Anatomy) -> tuple[Anatomy, list[Box]]:
    """The anatomy near the image, and boxes about what goes on beyond it for metres, CT frame."""
    view, solids = anatomy.skin.field_of_view, anatomy.surroundings
    T = np.eye(4) if view is None else view.T_ct_box
    parts = [part for one in solids if one.name == BEYOND_IMAGE for part in connected_parts(one.mesh)]
    boxes = []
    for part in parts:
        low, high = box_of((part - T[:3, 3]) @ T[:3, :3])
        boxes.append(Box(BEYOND_IMAGE, T @ pose(np.eye(3), (low + high) / 2), tuple((high - low).tolist())))
    return replace(anatomy, surroundings=tuple(one for one in solids if one.name != BEYOND_IMAGE)), boxes


def _placement_check(case: Case, anatomy: Anatomy, found: Candidates) -> PlacementCheck:
    """The case's workcell, patient-fixed and arm-fixed apart, and its directions."""
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
        wanted=wanted_directions(case, found),
        home=home_configuration(case),
    )


class _Refiner:
    """Walks from sites to better ones with ever shorter steps; estimates no site twice.

    Whether the arm touches itself takes longest and can only lower a fraction: that is computed for the leading
    site alone, until the leading site is one for which it is known.
    """

    def __init__(self, estimator: Estimator, progress: Count) -> None:
        self._quick = replace(estimator, itself=False)
        self._full = replace(estimator, itself=True)
        self._progress = progress
        self._hoped: dict[Site, ReachEstimate] = {}
        self._sure: dict[Site, ReachEstimate] = {}

    @property
    def estimated(self) -> int:
        """How many sites were estimated."""
        return len(self._hoped)

    def refine(self, seeds: Sequence[Site], step_mm: float) -> list[tuple[Site, ReachEstimate]]:
        """Where each seed ends, with its estimate; each end once."""
        ends = list(seeds)
        for halving in range(1, HALVINGS + 1):
            ends = self._leaders([[end, *_neighbours(end, step_mm / 2**halving)] for end in ends])
        return [(end, self._sure[end]) for end in dict.fromkeys(ends)]

    def _leaders(self, groups: Sequence[Sequence[Site]]) -> list[Site]:
        """The best site of each group."""
        self._estimate(self._quick, self._hoped, [site for group in groups for site in group])
        while True:
            leaders = [max(group, key=lambda site: _score(self._sure.get(site, self._hoped[site]))) for group in groups]
            if all(leader in self._sure for leader in leaders):
                return leaders
            self._estimate(self._full, self._sure, leaders)

    def _estimate(self, estimator: Estimator, known: dict[Site, ReachEstimate], sites: Sequence[Site]) -> None:
        new = [site for site in dict.fromkeys(sites) if site not in known]
        # In this process: there are few of them, and a new process would have to build its arm first.
        known |= dict(zip(new, map_all(estimator.estimate, new, jobs=1, progress=self._progress), strict=True))


def _neighbours(site: Site, step_mm: float) -> list[Site]:
    around = site.region.around(np.array(site.position), step_mm)
    return [Site(site.region, (float(x), float(y), float(z))) for x, y, z in around]


def _score(estimate: ReachEstimate) -> tuple[float, float]:
    """More is better."""
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
