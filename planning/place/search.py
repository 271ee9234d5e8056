"""The search for a placement of the arm, coarse to fine: it can end early, and says how far it came.

All sites are estimated, the best walk uphill, and those ends are checked as the batch search checks: in a few
directions each, then the leader in ever more, until it has been checked in all and leads still; then the others.
What ends it is the caller's: a count of directions gives the same answer each time, a clock may not.
Results: ``placements.csv`` as a table, ``place.json`` with everything.
"""

from __future__ import annotations

import csv
import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import fcl
import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.structure import Role
from puncture_twin.planning.anatomy.unseen import BEYOND_IMAGE
from puncture_twin.planning.arm.insertion import ReachRequest, flange_poses
from puncture_twin.planning.arm.tool import Box, Tool
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import user_cache
from puncture_twin.planning.base.errors import InputError, NoAnswerError
from puncture_twin.planning.base.files import atomic
from puncture_twin.planning.base.processes import working
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.base.text import Shown
from puncture_twin.planning.case.case import Case, bed_frame
from puncture_twin.planning.case.settings import mount_pose
from puncture_twin.planning.case.tables import MountSection
from puncture_twin.planning.collision import workcell
from puncture_twin.planning.collision.bodies import PATIENT, FclSkin, Solid, connected_parts
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.collision.fast_checker import FastChecker
from puncture_twin.planning.geometry.mesh import TriangleMesh, box_of, joined
from puncture_twin.planning.geometry.rigid import apply, pose
from puncture_twin.planning.place.estimate import Boxes, Estimator, ReachEstimate, SkinField, Surroundings
from puncture_twin.planning.place.mounts import (
    Site,
    WantedDirections,
    mount_lines,
    mount_section,
    regions,
    wanted_directions,
)
from puncture_twin.planning.reach.reach import ReachAnswer, assess_reach_all
from puncture_twin.planning.registration.marker_noise import reading_noise, touches
from puncture_twin.planning.registration.marker_pairs import MarkerPairs
from puncture_twin.planning.registration.placement import Placement, default_method
from puncture_twin.planning.registration.registration import Registration, register
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.uncertainty.pose_error import PoseError

GoesOn = Callable[[int, int | None], bool]
"""Called with how many directions were checked, summed over placements, of how many (None before the finalists are
known); False ends the search."""
COARSE_DIRECTIONS = 64
"""Directions that a site is estimated with at first."""
FINE_DIRECTIONS = 128
"""Directions that sites near the best are estimated with."""
SEEDS, OF_MOUNT = 12, 3
"""Sites that are refined; so many of each mount are among them: the best estimate is not always of the best site."""
HALVINGS = 3
"""How often the step is halved: from 150 mm to 19 mm, about as exactly as a base is set up."""
FIRST, SECOND = 64, 512
"""Directions, evenly spread, in which a placement is checked before it is checked in all."""
PIECE = 256
"""Directions checked in one piece: some tenths of a second to some seconds."""
FINALISTS = 10
"""Placements that are checked in all directions; each mount's best two are among them."""
FRACTION_DIGITS = 3
"""Fractions that agree to so many digits are equal; then the expected error decides, then the margin."""
ERROR_DIGITS = 2
"""Expected errors (mm) that agree to so many digits are equal."""


def placement_check(case: Case, anatomy: Anatomy, candidates: Candidates) -> PlacementCheck:
    """The case's workcell, with what moves with the patient apart from what moves with the arm, and its directions."""
    carried = {obstacle.name for obstacle in case.obstacles if obstacle.frame == "base"}
    boxes = workcell.case_boxes(case, np.eye(4))  # with the two frames in one place each box stands in its own
    return PlacementCheck(
        model=case.robot.model,
        tool=workcell.case_tool(case),
        skin=anatomy.skin.mesh,
        outside=workcell.outside_surface(anatomy),
        fixed=tuple(box for box in boxes if box.name not in carried),
        carried=tuple(box for box in boxes if box.name in carried),
        target_ct=case.target_ct,
        wanted=wanted_directions(case, candidates),
        home=workcell.home_configuration(case),
    )


@dataclass(frozen=True, eq=False)
class Verdict:
    """Exact reach from one placement, in the directions that were checked."""

    fraction: float
    """Of the wanted solid angle, 0..1; where not all were checked, each counts for those nearest to it."""
    reached: int
    count: int
    margin: float  # mean reach margin of the reached ones, 0..1; 0 for none
    reasons: Mapping[str, int]
    home_contact: str  # what the arm touches in its home configuration, or ""
    q_insertion: Floats  # shape (reached, 6), rad, the tip on the target
    answers: tuple[ReachAnswer, ...]
    """Of each checked direction; where all were checked, in the order of the candidates."""


class Checked(NamedTuple):
    """Directions checked from one placement: of each insertion the last state alone is kept."""

    answers: list[ReachAnswer]
    home_contact: str


@dataclass(frozen=True, eq=False)
class PlacementCheck:
    """Checks placements. Its values can be sent to another process."""

    model: UrModel
    tool: Tool
    skin: TriangleMesh
    outside: TriangleMesh | None
    """Surface of objects outside of the skin, or None; CT frame, as the skin."""
    fixed: tuple[Box, ...]
    """Boxes that stand with the patient; their ``T_base_box`` is in the CT frame."""
    carried: tuple[Box, ...]  # boxes that stand with the arm, base frame
    target_ct: Floats  # shape (3,), mm
    wanted: WantedDirections
    home: Floats  # shape (6,), rad

    def checked(self, piece: tuple[Floats, NDArray[np.int64]]) -> Checked:
        """Check some directions from a pose ``T_base_ct`` (4, 4); a base in the patient or the unseen reaches none."""
        T_base_ct, rows = piece
        try:
            checker = FastChecker(
                self.model,
                self.tool,
                (*(Box(box.name, T_base_ct @ box.T_base_box, box.size_mm) for box in self.fixed), *self.carried),
                self.skin.transformed(T_base_ct),
                outside=None if self.outside is None else self.outside.transformed(T_base_ct),
                padding_mm=workcell.ARM_PADDING_MM,
                cache=user_cache(),
            )
        except InputError as error:
            if not error.code.startswith("base_in"):
                raise
            return Checked([ReachAnswer.refused(Reason.ARM_COLLISION, None, str(error))] * len(rows), str(error))
        target = T_base_ct[:3, :3] @ self.target_ct + T_base_ct[:3, 3]
        requests = [
            ReachRequest(target, T_base_ct[:3, :3] @ outward, self.tool.needle_length_mm, float(standoff))
            for outward, standoff in zip(self.wanted.outward_ct[rows], self.wanted.standoff_mm[rows], strict=True)
        ]
        home = checker.contact(self.home, needle_may_touch_patient=False)
        answers = assess_reach_all(checker, requests)
        touched = "" if home is None else f"{home.body} touches {home.other}"
        return Checked([replace(one, insertion_q=one.insertion_q[-1:]) for one in answers], touched)


def expected_tip_error_mm(case: Case, placement: Placement | None, T_base_ct: Floats, q: Floats) -> float | None:
    """Root mean square over insertions (n, 6), rad, of sqrt(trace(Sigma_dd)); None without errors, markers or any.

    The arm is to stand at T_base_ct (4, 4), mm. How it will touch the markers from there nobody has said, so that its
    own errors do not cancel (2 J_f Sigma_eta J_f' stands for them); the residuals of the old touches say nothing of the
    new ones.
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


def needle_can_start(tool: Tool, skin: TriangleMesh, target_ct: Floats, wanted: WantedDirections) -> NDArray[np.bool_]:
    """Which directions (n,) leave the padded needle at standoff clear of the skin: no placement reaches others.

    Skin and target (3,), mm, CT frame.
    """
    start, end = tool.needle_span_mm
    radius, length = tool.needle_diameter_mm / 2 + workcell.ARM_PADDING_MM, end - start + 2 * workcell.ARM_PADDING_MM
    needle, half = Solid(partial(fcl.Cylinder, radius, length)), np.array([radius, radius, length / 2])
    patient = FclSkin(skin, PATIENT)
    # From the tip, at the standoff from the target, the needle's middle is half its body farther out.
    poses = flange_poses(target_ct, wanted.outward_ct, wanted.standoff_mm + (end - start) / 2)
    clear = np.empty(len(wanted), np.bool_)
    for row, T in enumerate(poses):
        needle.place(fcl.Transform(T[:3, :3], T[:3, 3]))
        clear[row] = not patient.touches(needle, np.array([-half, half]))
    return clear


@dataclass(frozen=True)
class RatedPlacement:
    """A placement, checked and rated."""

    site: Site | None  # position of the base; None for the case's own placement
    mount: MountSection
    estimate: ReachEstimate | None  # the estimate that it was chosen by; None for the case's own
    verdict: Verdict  # the result of the exact check, in some directions or all
    expected_mm: float | None
    """Expected (rms) error of the tip over its insertions, the markers touched anew from there; None where the case
    declares no errors, or has no markers."""

    @property
    def name(self) -> str:
        """Name in the tables."""
        return "as in the case" if self.site is None else self.site.region.name


@dataclass(frozen=True, eq=False, repr=False)
class PlaceSearch(Shown):
    """Result of a search for placements."""

    T_ct_bed: Floats  # shape (4, 4), mm: the frame of the sites
    coarse: tuple[tuple[Site, ReachEstimate], ...]
    refined: int  # how many more sites were estimated
    resolution_mm: float  # the step between sites at the end
    possible: float
    """Fraction of directions, 0..1, in which the needle may wait at its standoff: no placement reaches more."""
    directions: int
    checked: tuple[int, int | None]
    """Directions checked, summed over placements, and how many would have been in the end, if known."""
    rated: tuple[RatedPlacement, ...]  # best first; the case's own placement is not among them
    own: RatedPlacement | None
    """The case's own placement, checked; None where it has none, or the search ended before."""

    @property
    def every(self) -> tuple[RatedPlacement, ...]:
        """All rated placements, the case's own last."""
        return self.rated if self.own is None else (*self.rated, self.own)

    @property
    def complete(self) -> bool:
        """Whether the search came to its end."""
        return self.checked[1] is not None and self.checked[0] >= self.checked[1]


def search_placements(
    case: Case,
    anatomy: Anatomy,
    candidates: Candidates,
    placement: Placement | None,
    *,
    jobs: int = 1,
    goes_on: GoesOn = lambda done, total: True,
    first: Callable[[RatedPlacement], None] = lambda one: None,
) -> PlaceSearch:
    """Search for the placements from which the arm can reach most of the organ-safe directions.

    One placement at least is checked, in `FIRST` directions. The answer does not depend on ``jobs``.

    Raises InputError: Bounds that contradict the case, or an own arm or tool with a shape that hangs on nothing. Raises
    NoAnswerError: No direction is safe for the organs, or in none the needle could start.
    """
    if not candidates.safe.any():
        what = "no direction is safe for the organs: no placement can change that"
        raise NoAnswerError(what, counts=candidates.counts(), code="no_safe_direction")
    # 1. The workcell, and the directions in which the needle itself is clear at its standoff.
    T_ct_bed, step_mm = bed_frame(case), case.place.step_mm
    check = placement_check(case, anatomy, candidates)
    CellChecker(check.model, check.tool)  # refuses shapes that hang on nothing before minutes are spent
    near, beyond = _parted(anatomy)
    surroundings = Surroundings(
        SkinField.of(near), Boxes.of((*check.fixed, *beyond)), Boxes.of(check.carried), workcell.ARM_PADDING_MM
    )
    spread = check.wanted.spread(SECOND)
    starts = needle_can_start(check.tool, workcell.patient_surface(anatomy), case.target_ct, spread)
    if not starts.any():
        what = "in every organ-safe direction the needle would start too near the skin"
        raise NoAnswerError(what, code="standoff_in_skin")
    startable = spread.only(starts)
    # 2. All sites of a lattice, by bounding spheres (an estimate); the best of them checked in a few directions.
    estimator = Estimator(check.model, check.tool, surroundings, T_ct_bed, startable.spread(COARSE_DIRECTIONS))
    coarse = tuple(
        (site, estimator.estimate(site))
        for region in regions(case, T_ct_bed)
        for site in (Site(region, (float(x), float(y), float(z))) for x, y, z in region.lattice(step_mm))
    )
    seeds = _best_apart(coarse, 1.5 * step_mm, SEEDS, OF_MOUNT)
    race = _Race(case, T_ct_bed, check, goes_on)
    contenders = [race.contender(*pair) for pair in seeds[:1]]
    going = race.further(map, contenders, FIRST)
    for one in contenders:
        first(race.rated(one, placement))
    # 3. The best walk to better places, by ever shorter steps; 4. where they end is checked, the best further.
    fine = replace(estimator, wanted=startable.spread(FINE_DIRECTIONS))
    ends, estimated, last_mm = _walked(fine, seeds, step_mm, race.goes_on) if going else (seeds, 0, step_mm)
    best_ends = _best_apart(ends, step_mm / 2, SEEDS, OF_MOUNT)
    contenders += [race.contender(*end) for end in best_ends if end not in seeds[:1]]
    own = None if placement is None else race.own(placement)
    if going:
        race.run(contenders, own, jobs)
    rated = sorted((race.rated(one, placement) for one in contenders if one.answers), key=_worth)
    rated_own = None if own is None or not own.answers else race.rated(own, placement)
    possible, count = float(startable.weight.sum()), len(check.wanted)
    checked = (race.done, race.total)
    return PlaceSearch(T_ct_bed, coarse, estimated, last_mm, possible, count, checked, tuple(rated), rated_own)


def _worth(one: RatedPlacement) -> tuple[float, float, float]:
    """Sort key, less is better: most directions, then the least expected error, then the widest margin."""
    expected = 0.0 if one.expected_mm is None else round(one.expected_mm, ERROR_DIGITS)
    return -round(one.verdict.fraction, FRACTION_DIGITS), expected, -one.verdict.margin


BEYOND_MM = 1.0
"""What reaches farther beyond a face of the image was drawn on there."""


def _parted(anatomy: Anatomy) -> tuple[TriangleMesh, list[Box]]:
    """The surface inside the image, and boxes about what is drawn on beyond it, metres long; CT frame.

    For the estimate alone: the rough profile of a couch, drawn on, would be ten million places of the distance field.
    """
    view, skin = anatomy.skin.field_of_view, anatomy.skin.mesh
    unseen = [one for one in anatomy.surroundings if one.role is Role.UNKNOWN]
    T, imaged = np.eye(4), np.array([[-np.inf], [np.inf]]) * np.ones(3)
    if view is not None:
        T, imaged = view.T_ct_box, np.stack([np.zeros(3), view.size_mm])
    near, parts = [skin], [part for one in unseen if one.name == BEYOND_IMAGE for part in connected_parts(one.mesh)]
    drawn = [box_of((part - T[:3, 3]) @ T[:3, :3]) for part in parts]
    for mesh in (one.mesh for one in unseen if one.name != BEYOND_IMAGE):
        corners = ((mesh.vertices - T[:3, 3]) @ T[:3, :3])[mesh.faces]
        inside = np.ones(len(corners), np.bool_)
        for end, axis in np.ndindex(2, 3):
            past = ((corners[:, :, axis] - imaged[end, axis]) * (2 * end - 1) > BEYOND_MM).any(axis=1)
            if past.any():
                drawn.append(box_of(corners[past].reshape(-1, 3)))
                drawn[-1][1 - end, axis] = imaged[end, axis]
            inside &= ~past
        if inside.any():
            used, faces = np.unique(mesh.faces[inside], return_inverse=True)
            near.append(TriangleMesh(mesh.vertices[used], faces.reshape(-1, 3).astype(np.int32)))
    boxes = [
        Box(BEYOND_IMAGE, T @ pose(np.eye(3), (low + high) / 2), tuple((high - low).tolist())) for low, high in drawn
    ]
    return joined(near), boxes


@dataclass(eq=False)
class _Contender:
    site: Site | None
    mount: MountSection
    T_base_ct: Floats
    estimate: ReachEstimate | None
    answers: list[ReachAnswer] = field(default_factory=list)
    home_contact: str = ""


Work = Callable[..., Iterable[Checked]]
"""Maps a function over tasks, as ``map`` does."""


class _Race:
    """Exact checks of contenders, in the order that finds the best soonest."""

    def __init__(self, case: Case, T_ct_bed: Floats, check: PlacementCheck, goes_on: GoesOn) -> None:
        self._case, self._T_ct_bed, self._check, self._goes_on = case, T_ct_bed, check, goes_on
        self._order, self._all = check.wanted.order(SECOND), len(check.wanted)
        self.done = 0
        self.total: int | None = None  # directions that will be checked, summed over the contenders; as far as known

    def goes_on(self) -> bool:
        """Whether the search may go on."""
        return self._goes_on(self.done, self.total)

    def contender(self, site: Site, estimate: ReachEstimate) -> _Contender:
        """A site, its pose rounded as it is written."""
        mount = mount_section(self._T_ct_bed @ site.T_bed_base(), self._case.space)
        return _Contender(site, mount, mount_pose(mount, self._case.space, self._case.path), estimate)

    def own(self, placement: Placement) -> _Contender:
        """The case's own placement."""
        T_ct_base = np.asarray(np.linalg.inv(placement.T_base_ct), dtype=np.float64)
        return _Contender(None, mount_section(T_ct_base, self._case.space), placement.T_base_ct, None)

    def run(self, contenders: Sequence[_Contender], own: _Contender | None, jobs: int) -> None:
        """Check all in a few directions, then the finalists in all: who leads first, and the case's own after it."""
        others = [] if own is None else [own]
        everyone, few = [*contenders, *others], min(FIRST, self._all)
        with working(jobs, len(everyone)) as work:
            if not self.further(work, everyone, FIRST):
                return
            scores = [(one.site, self.verdict(one)) for one in contenders if one.site is not None]
            chosen = [site for site, _ in _best_apart(scores, 0.0, FINALISTS, 2)]
            left = [one for one in contenders if one.site in chosen]
            self.total = few * len(everyone) + (self._all - few) * (len(left) + len(others))
            while left or others:
                most = max((len(one.answers) for one in contenders), default=self._all)
                follows = others and (len(others[0].answers) < most or not left)
                one = others[0] if follows else max(left, key=lambda one: self.verdict(one).fraction)
                if not self.further(work, [one], SECOND if len(one.answers) < SECOND else self._all):
                    return
                left, others = ([one for one in some if len(one.answers) < self._all] for some in (left, others))

    def further(self, work: Work, contenders: Sequence[_Contender], count: int) -> bool:
        """Check contenders in so many directions each, as far as the search may go on; whether it may still."""
        count = min(count, self._all)
        begins = [(one, row) for one in contenders for row in range(len(one.answers), count, PIECE)]
        pieces = [(one, row, min(row + PIECE, count)) for one, row in begins]
        found = work(self._check.checked, [(one.T_base_ct, self._order[begin:end]) for one, begin, end in pieces])
        for (one, begin, end), piece in zip(pieces, found, strict=True):
            one.answers += piece.answers
            one.home_contact = piece.home_contact
            self.done += end - begin
            if not self.goes_on():
                return False
        return True

    def verdict(self, one: _Contender) -> Verdict:
        """What the checks of a contender say so far; each direction stands for all that are nearest to it."""
        rows, answers, wanted = self._order[: len(one.answers)], one.answers, self._check.wanted
        if len(rows) == self._all:
            weight, answers = wanted.weight, [answers[row] for row in np.argsort(rows)]
        else:
            weight = wanted.standing_for_all(rows).weight
        reached = np.array([answer.reachable for answer in answers], bool)
        margins = [answer.margin for answer in answers if answer.reachable]
        ends = [answer.insertion_q[-1] for answer in answers if answer.reachable]
        return Verdict(
            fraction=float(weight[reached].sum()),
            reached=int(reached.sum()),
            count=len(reached),
            margin=float(np.mean(margins)) if margins else 0.0,
            reasons=dict(Counter(answer.reason.value for answer in answers if not answer.reachable).most_common()),
            home_contact=one.home_contact,
            q_insertion=np.array(ends).reshape(-1, 6),
            answers=tuple(answers),
        )

    def rated(self, one: _Contender, placement: Placement | None) -> RatedPlacement:
        """A contender as a rated placement."""
        verdict = self.verdict(one)
        expected = expected_tip_error_mm(self._case, placement, one.T_base_ct, verdict.q_insertion)
        return RatedPlacement(one.site, one.mount, one.estimate, verdict, expected)


def _walked(
    estimator: Estimator, seeds: list[tuple[Site, ReachEstimate]], step_mm: float, goes_on: Callable[[], bool]
) -> tuple[list[tuple[Site, ReachEstimate]], int, float]:
    """The ends of walks uphill, by ever shorter steps, each once; how many sites were estimated, and the last step."""
    known: dict[Site, ReachEstimate] = {}
    pairs, halvings = seeds, 0
    while halvings < HALVINGS and goes_on():
        halvings += 1
        groups = []
        for end in dict(pairs):
            around = end.region.around(np.array(end.position), step_mm / 2**halvings)
            groups.append([end, *(Site(end.region, (float(x), float(y), float(z))) for x, y, z in around)])
        for site in (site for group in groups for site in group if site not in known):
            known[site] = estimator.estimate(site)
        pairs = [max(((site, known[site]) for site in group), key=lambda pair: _score(pair[1])) for group in groups]
    return list(dict(pairs).items()), len(known), step_mm / 2**halvings


Scored = TypeVar("Scored", ReachEstimate, Verdict)


def _score(estimate: ReachEstimate | Verdict) -> tuple[float, float]:
    return round(estimate.fraction, FRACTION_DIGITS), estimate.margin


def _best_apart(
    pairs: Sequence[tuple[Site, Scored]], distance_mm: float, count: int, of_mount: int
) -> list[tuple[Site, Scored]]:
    """The best of each mount, then the best of the others, as far as they reach any direction."""
    firsts: list[tuple[Site, Scored]] = []
    others: list[tuple[Site, Scored]] = []
    mounts: Counter[str] = Counter()
    reaching = [pair for pair in pairs if pair[1].fraction > 0.0]
    for pair in sorted(reaching, key=lambda pair: _score(pair[1]), reverse=True):
        mount = pair[0].region.mount
        chosen = firsts if mounts[mount] < of_mount else others
        same = [site for site, _ in firsts + others if site.region == pair[0].region]
        near = any(np.linalg.norm(np.subtract(pair[0].position, site.position)) < distance_mm for site in same)
        if (chosen is firsts or len(others) < count) and not near:
            chosen.append(pair)
            mounts[mount] += 1
    return firsts + others[: max(0, count - len(firsts))]


PLACE_VERSION = 2
"""Version of ``place.json``'s layout."""
COLUMNS = (
    *("rank", "placement", "along_mm", "across_mm", "height_mm", "share", "held", "asked", "margin", "home_contact"),
    *("base_x_mm", "base_y_mm", "base_z_mm"),
)
"""Columns of ``placements.csv``; the base's coordinates are in the case's space."""
EXPECTED = "expected_error_mm"
"""A further column where the case declares errors and has markers."""


def placement_rows(search: PlaceSearch) -> list[dict[str, Any]]:
    """One row a checked placement, best first, rank 1; the case's own comes last, without a rank."""
    rows = []
    for number, one in enumerate(search.every, start=1):
        rank, position = (number, one.site.position) if one.site is not None else (None, (None, None, None))
        verdict = one.verdict
        result = (verdict.fraction, verdict.reached, verdict.count, verdict.margin, verdict.home_contact)
        row = dict(zip(COLUMNS, (rank, one.name, *position, *result, *one.mount.position_mm), strict=True))
        rows.append(row if one.expected_mm is None else {**row, EXPECTED: round(one.expected_mm, 4)})
    return rows


def place_document(search: PlaceSearch, provenance: Mapping[str, Any]) -> dict[str, Any]:
    """The document of a search as plain values: mm; fractions and margins 0..1."""
    rows = placement_rows(search)
    for row, one in zip(rows, search.every, strict=True):
        row["mount"] = {key: list(value) for key, value in one.mount.model_dump().items()}
        row["reasons"] = dict(one.verdict.reasons)
        row["estimate"] = None
        if one.estimate is not None:
            row["estimate"] = dict(zip(("reach", "share", "margin"), one.estimate, strict=True))
    best = search.rated[0] if search.rated else None
    return {
        "version": PLACE_VERSION,
        **provenance,
        "T_ct_bed": np.asarray(search.T_ct_bed).tolist(),
        "sites": {"coarse": len(search.coarse), "refined": search.refined, "judged": len(search.rated)},
        "possible_share": search.possible,
        "search": {
            "complete": search.complete,
            "checked": search.checked[0],
            "to_check": search.checked[1],
            "directions": search.directions,
            "resolution_mm": search.resolution_mm,
        },
        "placements": rows,
        "mount_lines": None if best is None else mount_lines(best.mount),
    }


def write_placements(search: PlaceSearch, path: Path) -> None:
    """Write the table as CSV, whole or not at all."""
    with atomic(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as stream:
        rows = placement_rows(search)
        writer = csv.DictWriter(stream, (*COLUMNS, *([EXPECTED] if any(EXPECTED in row for row in rows) else [])))
        writer.writeheader()
        writer.writerows(rows)


def write_place_document(document: Mapping[str, Any], path: Path) -> None:
    """Write the document as JSON, whole or not at all."""
    with atomic(path) as temporary:
        temporary.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")
