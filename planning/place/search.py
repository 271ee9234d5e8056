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
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.structure import Role
from puncture_twin.planning.anatomy.unseen import BEYOND_IMAGE
from puncture_twin.planning.arm.tool import Box
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.base.files import atomic
from puncture_twin.planning.base.processes import working
from puncture_twin.planning.base.text import Shown
from puncture_twin.planning.case.case import Case, bed_frame
from puncture_twin.planning.case.settings import mount_pose
from puncture_twin.planning.case.tables import MountSection
from puncture_twin.planning.collision.bodies import connected_parts
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.collision.workcell import ARM_PADDING_MM, patient_surface
from puncture_twin.planning.geometry.mesh import TriangleMesh, box_of, joined
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.planning.place.check import (
    Checked,
    PlacementCheck,
    Verdict,
    expected_tip_error_mm,
    needle_can_start,
    placement_check,
)
from puncture_twin.planning.place.estimate import Boxes, Estimator, ReachEstimate, SkinField, Surroundings
from puncture_twin.planning.place.mounts import Site, mount_lines, mount_section, regions
from puncture_twin.planning.reach.survey import ReachAnswer
from puncture_twin.planning.registration.placement import Placement
from puncture_twin.planning.search.candidates import Candidates

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


@dataclass(frozen=True)
class RatedPlacement:
    """A placement, checked and rated."""

    site: Site | None
    """Position of the base; None for the case's own placement."""
    mount: MountSection
    estimate: ReachEstimate | None
    """The estimate that it was chosen by; None for the case's own."""
    verdict: Verdict
    """The result of the exact check, in some directions or all."""
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
    refined: int
    """How many more sites were estimated."""
    resolution_mm: float
    """The step between sites at the end."""
    possible: float
    """Fraction of directions, 0..1, in which the needle may wait at its standoff: no placement reaches more."""
    directions: int
    checked: tuple[int, int | None]
    """Directions checked, summed over placements, and how many would have been in the end, if known."""
    rated: tuple[RatedPlacement, ...]
    """Best first; the case's own placement is not among them."""
    own: RatedPlacement | None
    """The case's own placement, checked; None where it has none, or the search ended before."""

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

    Raises:
        InputError: Bounds that contradict the case, or an own arm or tool with a shape that hangs on nothing.
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
        SkinField.of(near), Boxes.of((*check.fixed, *beyond)), Boxes.of(check.carried), ARM_PADDING_MM
    )
    spread = check.wanted.spread(SECOND)
    starts = needle_can_start(check.tool, patient_surface(anatomy), case.target_ct, spread, ARM_PADDING_MM)
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
    walk = _walked(fine, seeds, step_mm, race.goes_on) if going else _Walk(seeds, 0, step_mm)
    ends = [end for end in _best_apart(walk.ends, step_mm / 2, SEEDS, OF_MOUNT) if end not in seeds[:1]]
    contenders += [race.contender(*end) for end in ends]
    own = None if placement is None else race.own(placement)
    if going:
        race.run(contenders, own, jobs)
    rated = sorted((race.rated(one, placement) for one in contenders if one.answers), key=_worth)
    rated_own = None if own is None or not own.answers else race.rated(own, placement)
    possible, count = float(startable.weight.sum()), len(check.wanted)
    walked = (coarse, walk.estimated, walk.step_mm, possible, count)
    return PlaceSearch(T_ct_bed, *walked, (race.done, race.total), tuple(rated), rated_own)


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
"""As ``map`` does it."""


class _Race:
    """Exact checks of contenders, in the order that finds the best soonest."""

    def __init__(self, case: Case, T_ct_bed: Floats, check: PlacementCheck, goes_on: GoesOn) -> None:
        self._case, self._T_ct_bed, self._check, self._goes_on = case, T_ct_bed, check, goes_on
        self._order, self._all = check.wanted.order(SECOND), len(check.wanted)
        self.done = 0
        self.total: int | None = None  # directions that will be checked, summed over the contenders; as far as known

    def goes_on(self) -> bool:
        """Whether the search may."""
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
                one = others[0] if follows else max(left, key=self.fraction)
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

    def fraction(self, one: _Contender) -> float:
        """What a contender reaches by its checks so far."""
        return self.verdict(one).fraction

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
        """A contender with what it is worth."""
        verdict = self.verdict(one)
        expected = expected_tip_error_mm(self._case, placement, one.T_base_ct, verdict.q_insertion)
        return RatedPlacement(one.site, one.mount, one.estimate, verdict, expected)


class _Walk(NamedTuple):
    ends: Sequence[tuple[Site, ReachEstimate]]
    estimated: int
    step_mm: float


def _walked(
    estimator: Estimator, seeds: Sequence[tuple[Site, ReachEstimate]], step_mm: float, goes_on: Callable[[], bool]
) -> _Walk:
    """The ends of walks uphill, by ever shorter steps, each end once; no site is estimated twice."""
    known: dict[Site, ReachEstimate] = {}
    pairs, halvings = list(seeds), 0
    while halvings < HALVINGS and goes_on():
        halvings += 1
        groups = []
        for end in dict(pairs):
            around = end.region.around(np.array(end.position), step_mm / 2**halvings)
            groups.append([end, *(Site(end.region, (float(x), float(y), float(z))) for x, y, z in around)])
        for site in (site for group in groups for site in group if site not in known):
            known[site] = estimator.estimate(site)
        pairs = [max(((site, known[site]) for site in group), key=lambda pair: _score(pair[1])) for group in groups]
    return _Walk(list(dict(pairs).items()), len(known), step_mm / 2**halvings)


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
        if (chosen is firsts or len(others) < count) and all(_far(pair[0], k, distance_mm) for k, _ in firsts + others):
            chosen.append(pair)
            mounts[mount] += 1
    return firsts + others[: max(0, count - len(firsts))]


def _far(one: Site, other: Site, distance_mm: float) -> bool:
    apart = float(np.linalg.norm(np.subtract(one.position, other.position)))
    return one.region != other.region or apart >= distance_mm


PLACE_VERSION = 2
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


def place_document(found: PlaceSearch, provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Everything as plain values: mm; fractions and margins 0..1."""
    rows = placement_rows(found)
    for row, one in zip(rows, (*found.rated, *((found.own,) if found.own else ())), strict=True):
        row["mount"] = {key: list(value) for key, value in one.mount.model_dump().items()}
        row["reasons"] = dict(one.verdict.reasons)
        row["estimate"] = None
        if one.estimate is not None:
            row["estimate"] = dict(zip(("reach", "share", "margin"), one.estimate, strict=True))
    best = found.rated[0] if found.rated else None
    return {
        "version": PLACE_VERSION,
        **provenance,
        "T_ct_bed": np.asarray(found.T_ct_bed).tolist(),
        "sites": {"coarse": len(found.coarse), "refined": found.refined, "judged": len(found.rated)},
        "possible_share": found.possible,
        "search": {
            "complete": found.complete,
            "checked": found.checked[0],
            "to_check": found.checked[1],
            "directions": found.directions,
            "resolution_mm": found.resolution_mm,
        },
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
