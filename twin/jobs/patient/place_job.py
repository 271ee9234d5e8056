"""The job ``place``: the best position of the arm's base searched, written, and as text."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.base.output.output_set import withdraw
from puncture_twin.planning.base.text import plural
from puncture_twin.planning.place import search as place
from puncture_twin.planning.search.candidates import ARM_CHECKED, Candidates
from puncture_twin.planning.search.constraints import with_answers
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.search.ranking import ranked
from puncture_twin.planning.search.search import organ_candidates
from puncture_twin.twin.jobs.patient.run import case_draft
from puncture_twin.twin.report.numbers import direction_text, mounting_text
from puncture_twin.twin.report.present import Field, Section, Warn, footer, grid, text

Ranked = tuple[str, place.RatedPlacement]
QUICK_S = 30.0  # as long as a person waits
PICTURES_S = 2.0  # what drawing takes, about
HALF_A_DIGIT = 5e-4  # of a fraction that is printed in % with one digit


@dataclass(frozen=True, eq=False)
class PlaceRun:
    """Result of ``place``, and the files that it wrote."""

    context: CaseContext
    search: place.PlaceSearch
    document: dict[str, Any]
    files: tuple[Path, ...]

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON: mm; fractions 0..1."""
        seconds = {stage: round(spent, 3) for stage, spent in self.context.stages.seconds.items()}
        return {**self.document, "seconds": seconds, "files": [str(path) for path in self.files]}


class _Clock:
    """Whether the search goes on, and for how long still; its end is a `time.perf_counter`, or infinite."""

    def __init__(self, context: CaseContext, end: float) -> None:
        self._count, self._end = context.watcher.count, end
        self._began = time.perf_counter()
        self._last = self._since = (self._began, 0)

    def __call__(self, done: int, total: int | None) -> bool:
        """False where the next piece of work, as long as the last one, would end too late."""
        now = time.perf_counter()
        piece = now - self._last[0] if self._last[1] else 0.0  # what came before the first is no such piece
        self._last = now, done
        if total is None:
            self._since = now, done
        began, first = self._since
        if total is not None and now + (total - done) * (now - began) / max(1, done - first) < self._end:
            self._count("directions checked", done, total)
        elif now < self._end < np.inf:
            self._count("seconds", round(now - self._began), round(self._end - self._began))
        return now + piece < self._end


def place_case(
    context: CaseContext,
    out: Path,
    *,
    jobs: int = 1,
    pictures: bool = True,
    quick_s: float | None = QUICK_S,
    began: float | None = None,
) -> PlaceRun:
    """Search; write ``placements.csv``, ``place.json`` and, if wanted, the two pictures.

    It ends about `quick_s` seconds after `began`, a `time.perf_counter` (None: now), with what is known then; None
    searches to the end. Raises NoAnswerError: No direction is safe for the organs, or no placement reaches one; in the
    second case the files are written.
    """
    names = ("placements.csv", "place.json", *(("placements.png", "map_best_place.png") if pictures else ()))
    try:
        with case_draft(context, out, "place", names) as draft:
            until = np.inf if quick_s is None else quick_s + (time.perf_counter() if began is None else began)
            run = _placed(context, draft.folder, jobs, pictures, until)
    except NoAnswerError:
        withdraw(out, "place")
        raise
    refuse_unreached(run.search)
    return replace(run, files=draft.final(run.files))


def refuse_unreached(search: place.PlaceSearch) -> None:
    """Refuse a search in which no placement reaches a direction: its best is none."""
    if not any(one.verdict.reached for one in search.rated):
        what = f"the arm reaches no organ-safe direction from any placement ({plural(search.checked[0], 'check')})"
        if not search.complete:
            what += ", as far as was searched; to search to the end: --full, or quick_s=None in Python"
        raise NoAnswerError(what, code="no_placement")


class Places(NamedTuple):
    """The directions that the organs allow, and the search for a base that reaches them."""

    candidates: Candidates
    search: place.PlaceSearch


def find_places(context: CaseContext, jobs: int, until: float = np.inf) -> Places:
    """Search for the best position of the arm's base, until a `time.perf_counter`, or to its end if infinite."""
    case, stages = context.case, context.stages

    def tell(one: place.RatedPlacement) -> None:
        verdict, where = one.verdict, list(one.mount.position_mm)
        reached = f"it reaches {verdict.reached} of {plural(verdict.count, 'checked direction')}"
        fraction = f"about {100 * verdict.fraction:.0f} % of all"
        context.watcher.note(f"best so far: {one.name}, base at {where} mm: {reached}, {fraction}")

    with stages.time("organs"):
        candidates = organ_candidates(case, context.anatomy, context.engine, case.directions())
    with stages.time("placements"):
        goes_on, parts = _Clock(context, until), (case, context.anatomy, candidates, context.placement)
        search = place.search_placements(*parts, jobs=jobs, goes_on=goes_on, first=tell)
    return Places(candidates, search)


def _placed(context: CaseContext, out: Path, jobs: int, pictures: bool, until: float) -> PlaceRun:
    case, stages = context.case, context.stages
    candidates, search = find_places(context, jobs, until - PICTURES_S * pictures)
    document = place.place_document(search, context.provenance() | {"arm": ARM_CHECKED})
    if not search.complete:
        whole = sum(one.verdict.count == search.directions for one in search.rated)
        ended = (
            f"the time is over: {whole} of {plural(len(search.rated), 'placement')} were checked in all directions; "
            f"the fractions of the others are estimates. The search stopped at steps of {search.resolution_mm:.0f} mm. "
            "Another run may check more or fewer; --full searches to the end"
        )
        document["warnings"] = [*document["warnings"], ended]
    place.write_placements(search, out / "placements.csv")
    place.write_place_document(document, out / "place.json")
    files = [out / "placements.csv", out / "place.json"]
    if pictures:
        from puncture_twin.twin.report.map.placement_picture import draw_placements  # with matplotlib

        with stages.time("pictures"):
            draw_placements(search, case, context.anatomy.skin.mesh, out / "placements.png")
            files.append(out / "placements.png")
    best = search.rated[0].verdict if search.rated else None
    if pictures and best is not None and best.reached and best.count == search.directions:
        from puncture_twin.twin.report.map.map_picture import draw_map

        with stages.time("map"):
            reached = ranked(case, with_answers(case, candidates, best.answers))
            shown = replace(case, name=f"{case.name}, arm at the best place")
            draw_map(reached, shown, out / "map_best_place.png", scan=context.anatomy.scan)
            files.append(out / "map_best_place.png")
    return PlaceRun(context, search, document, tuple(files))


def place_text(run: PlaceRun) -> str:
    """The ranked placements, the case's own, the lines to paste, and the files."""
    case, search = run.context.case, run.search
    x, y, z = (direction_text(search.T_ct_bed[:3, axis], str(case.space)) for axis in range(3))
    frame = f"from the target, mm: along = toward {x}, across = toward {y}, height = toward {z}"
    ranked = [(str(rank), one) for rank, one in enumerate(search.rated, start=1)]
    own = [] if search.own is None else [("-", search.own)]
    best = Warn(tuple(str(run.document["mount_lines"] or "").splitlines()))
    truth = "this is a proposal: measure the real position of the base with markers ([registration])"
    return text([
        Section(
            f"case {case.name}: {search.directions:,} organ-safe directions; {len(search.coarse):,} + "
            f"{search.refined:,} placements were estimated; {len(search.rated)} were checked",
            [frame, *needle_line(search.possible), grid(_fields(run), [*ranked, *own])]),
        *([Section("the best, for the case (replaces its [registration] or [robot.mount]):", [best]),
           Section(truth, [])] if best.lines else []),
        *footer(run.files, run.document["warnings"], run.context.stages.seconds),
    ])  # fmt: skip


def _fields(run: PlaceRun) -> list[Field]:
    def at(axis: int) -> Callable[[Ranked], float | None]:
        return lambda ranked: None if ranked[1].site is None else ranked[1].site.position[axis]

    def mount(ranked: Ranked) -> str:
        one, home = ranked[1], ranked[1].verdict.home_contact
        space = str(run.context.case.space)
        name = one.name if one.site is None else mounting_text(one.site.region, run.search.T_ct_bed, space)
        return name + (f"; home: {home}" if home else "")

    return [
        Field("rank", lambda ranked: ranked[0]),
        Field("fraction", lambda ranked: 100 * ranked[1].verdict.fraction, 1, "%"),
        Field("which is", lambda ranked: "exact" if ranked[1].verdict.count == run.search.directions else "estimated"),
        Field("reached", lambda ranked: ranked[1].verdict.reached),
        Field("of checked", lambda ranked: ranked[1].verdict.count),
        Field("margin", lambda ranked: ranked[1].verdict.margin, 2),
        *(Field(name, at(axis), 0) for axis, name in enumerate(("along", "across", "height"))),
        Field("expected tip error", lambda ranked: ranked[1].expected_mm, 2, "mm"),
        Field("mount", mount),
    ]


def needle_line(possible: float) -> list[str]:
    """The limit that no placement can exceed, where there is one."""
    if possible > 1.0 - HALF_A_DIGIT:
        return []
    fraction = f"no placement reaches more than about {100 * possible:.1f} %"
    return [f"{fraction}: in the other directions the needle would start too near the skin"]
