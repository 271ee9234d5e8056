"""The job ``place``: search for a place to stand the arm, and the files that show it.

What ``place`` prints for a person.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.base.output.output_set import withdraw, writing
from puncture_twin.planning.case.settings import mount_pose
from puncture_twin.planning.collision.workcell import case_checker
from puncture_twin.planning.place.search import (
    PlaceSearch,
    RatedPlacement,
    place_document,
    search_placements,
    write_place_document,
    write_placements,
)
from puncture_twin.planning.search.candidates import ARM_CHECKED, Candidates
from puncture_twin.planning.search.constraints import ArmReach, with_reach
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.search.ranking import ranked
from puncture_twin.planning.search.search import organ_candidates
from puncture_twin.twin.report.numbers import direction_text, mounting_text
from puncture_twin.twin.report.present import Field, Section, Warn, footer, grid, text

Ranked = tuple[str, RatedPlacement]


@dataclass(frozen=True, eq=False)
class PlaceRun:
    """What ``place`` has found, and the files that it wrote."""

    context: CaseContext
    found: PlaceSearch
    document: dict[str, Any]
    files: tuple[Path, ...]
    directions: int
    """That the organs allow."""

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON: mm; shares 0..1."""
        seconds = {stage: round(spent, 3) for stage, spent in self.context.stages.seconds.items()}
        return {**self.document, "seconds": seconds, "files": [str(path) for path in self.files]}


def place_case(context: CaseContext, out: Path, *, jobs: int, pictures: bool = True) -> PlaceRun:
    """Search; write ``placements.csv``, ``place.json`` and, if wanted, the two pictures.

    Raises:
        InputError: Bounds that contradict the case.
        NoAnswerError: No direction is safe for the organs, or no placement holds one; the files are written in the
            second case.
    """
    names = ("placements.csv", "place.json", *(("placements.png", "map_best_place.png") if pictures else ()))
    try:
        with writing(
            out,
            "place",
            inputs=context.case.inputs,
            seconds=context.stages.seconds,
            names=names,
            note=context.watcher.note,
        ) as draft:
            run = _placed(context, draft.folder, jobs, pictures)
    except NoAnswerError:
        withdraw(out, "place")
        raise
    if not any(one.verdict.reached for one in run.found.rated):
        what = f"no placement holds any of the {run.directions} organ-safe directions"
        raise NoAnswerError(what, code="no_placement")
    return replace(run, files=draft.final(run.files))


class Places(NamedTuple):
    """The directions that the organs allow, and where the arm should stand to reach them."""

    candidates: Candidates
    found: PlaceSearch


def find_places(context: CaseContext, jobs: int) -> Places:
    """Search for a place to stand the arm.

    Raises:
        InputError: Bounds that contradict the case.
        NoAnswerError: No direction is safe for the organs.
    """
    case, stages = context.case, context.stages
    with stages.time("organs"):
        candidates = organ_candidates(case, context.anatomy, context.engine, case.directions())
    with stages.time("placements"):
        found = search_placements(
            case,
            context.anatomy,
            candidates,
            context.placement,
            jobs=jobs,
            progress=context.watcher.count,
        )
    return Places(candidates, found)


def _placed(context: CaseContext, out: Path, jobs: int, pictures: bool) -> PlaceRun:
    """Search, and write everything into a folder."""
    case, stages = context.case, context.stages
    candidates, found = find_places(context, jobs)
    document = place_document(found, context.provenance() | {"arm": ARM_CHECKED})
    write_placements(found, out / "placements.csv")
    write_place_document(document, out / "place.json")
    files = [out / "placements.csv", out / "place.json"]
    if pictures:
        from puncture_twin.twin.report.map.placement_picture import draw_placements  # with matplotlib

        with stages.time("pictures"):
            draw_placements(found, case, context.anatomy.skin.mesh, out / "placements.png")
            files.append(out / "placements.png")
    if pictures and any(one.verdict.reached for one in found.rated):
        from puncture_twin.twin.report.map.map_picture import draw_map

        T_base_ct = mount_pose(found.rated[0].mount, case.space, case.path)
        with stages.time("map"):
            reach = ArmReach(case_checker(case, context.anatomy, T_base_ct), np.asarray(T_base_ct))
            reached = ranked(case, with_reach(case, candidates, reach))
            draw_map(reached, replace(case, name=f"{case.name}, arm at the best place"), out / "map_best_place.png")
            files.append(out / "map_best_place.png")
    return PlaceRun(context, found, document, tuple(files), int(candidates.safe.sum()))


HALF_A_DIGIT = 5e-4
"""Of a share that is printed in % with one digit."""


def place_text(run: PlaceRun) -> str:
    """The ranked placements, the case's own, the lines to paste, and the files."""
    case, found = run.context.case, run.found
    wanted = found.rated[0].verdict.count if found.rated else 0
    x, y, z = (direction_text(found.T_ct_bed[:3, axis], str(case.space)) for axis in range(3))
    frame = f"from the target, mm: along = toward {x}, across = toward {y}, height = toward {z}"
    ranked = [(str(rank), one) for rank, one in enumerate(found.rated, start=1)]
    own = [] if found.own is None else [("-", found.own)]
    best = Warn(tuple(str(run.document["mount_lines"] or "").splitlines()))
    truth = "a proposal: where the arm then really stands, markers must say ([registration])"
    return text([
        Section(
            f"case {case.name}: {wanted} organ-safe directions; {len(found.coarse)} + {found.refined} placements "
            f"estimated, {len(found.rated)} checked",
            [frame, *needle_line(found.possible), grid(_fields(run), [*ranked, *own])]),
        *([Section("the best, for the case (in place of its [registration] or [robot.mount]):", [best]),
           Section(truth, [])] if best.lines else []),
        *footer(run.files, run.document["warnings"], run.context.stages.seconds),
    ])  # fmt: skip


def _fields(run: PlaceRun) -> list[Field]:
    """Of a rank and its placement."""

    def at(axis: int) -> Callable[[Ranked], float | None]:
        return lambda ranked: None if ranked[1].site is None else ranked[1].site.position[axis]

    def mount(ranked: Ranked) -> str:
        one, home = ranked[1], ranked[1].verdict.home_contact
        space = str(run.context.case.space)
        name = one.name if one.site is None else mounting_text(one.site.region, run.found.T_ct_bed, space)
        return name + (f"; home: {home}" if home else "")

    return [
        Field("rank", lambda ranked: ranked[0]),
        Field("share", lambda ranked: 100 * ranked[1].verdict.fraction, 1, "%"),
        Field("held", lambda ranked: ranked[1].verdict.reached),
        Field("margin", lambda ranked: ranked[1].verdict.margin, 2),
        *(Field(name, at(axis), 0) for axis, name in enumerate(("along", "across", "height"))),
        Field("expected tip error", lambda ranked: ranked[1].expected_mm, 2, "mm"),
        Field("mount", mount),
    ]


def needle_line(possible: float) -> list[str]:
    """What no placement can mend, where there is such a thing."""
    if possible > 1.0 - HALF_A_DIGIT:
        return []
    fraction = f"at most {100 * possible:.1f} % can be held from anywhere"
    return [f"{fraction}: elsewhere the needle itself would start too near the skin"]
