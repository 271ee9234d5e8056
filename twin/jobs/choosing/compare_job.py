"""Two paths side by side, two choices of one case or two plans: numbers with their units, and why one is not safe."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.progress import Watcher
from puncture_twin.planning.base.provenance import Input, inputs_document
from puncture_twin.planning.base.text import Shown, first_few, plural
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.plan.plan_check import check_plan
from puncture_twin.planning.search.candidates import Candidates, nearest_row
from puncture_twin.planning.search.choice import Choice, explain_choice, parse_choice
from puncture_twin.planning.search.context import CaseContext, prepare
from puncture_twin.planning.search.explain import Explanation, decimals, finite, reason_text
from puncture_twin.twin.jobs.patient.main_job import is_plan, read_noted_plan
from puncture_twin.twin.jobs.patient.run import plan_summary
from puncture_twin.twin.report.present import NOTHING, Block, Field, Section, Table, facts, number, text

SAME_DIRECTION = 1e-9  # radians within which a direction is one of the grid: rounding of typed degrees
MOST_ROLES = 4  # of inputs that differ, so many are named
BEST_OF_ALL = Choice(rank=1)
Stated = tuple[list[float], list[float], list[int], list[int], list[str]]
GRID_KEYS = ("rank", "safe_cone_deg", "window", "window_square_deg", "window_entry_cm2")
NEAREST = 5  # structures of either side whose clearances stand beside each other
LEAST_CHANCE = 1e-4  # what is shown of a chance: a smaller one is no number that anybody can rely on
NOT_CHECKED = "values as the plans state them; --case CASE checks them again, with chances and windows"


def parse_two(
    theta_deg: list[float], beta_deg: list[float], rank: list[int], window: list[int], entry: list[str]
) -> tuple[Choice, Choice]:
    """Two choices from options that may be repeated, in their order in the help; of one the best stands beside it."""
    if len(theta_deg) != len(beta_deg):
        refuse("one angle alone gives no direction", "--theta, --beta", "as many of each", "one_angle")
    choices = [parse_choice(*pair, None, None, None) for pair in zip(theta_deg, beta_deg, strict=True)]
    choices += [parse_choice(None, None, one, None, None) for one in rank]
    choices += [parse_choice(None, None, None, one, None) for one in window]
    choices += [parse_choice(None, None, None, None, one) for one in entry]
    if len(choices) == 1:
        choices = [BEST_OF_ALL, *choices]
    if len(choices) == 2 and choices[0] == choices[1]:
        refuse("the same direction twice", "compare", "two directions, or one other than the best", "same_direction")
    if len(choices) != 2:
        allowed = "two, such as --rank 1 --window 2; or one, to compare with the best"
        refuse(plural(len(choices), "choice"), "compare", allowed, "wrong_count")
    return choices[0], choices[1]


def two_plans(source: Path, other: Path | None, case: Path | None, chosen: bool) -> tuple[Path, Path] | None:
    """The two plans to compare; None where two choices of a case are compared."""
    allowed = "PLAN_A PLAN_B [--case CASE], or CASE with one choice or two"
    if not is_plan(source):
        if other is not None or case is not None:
            refuse("a case and another file were given", "compare", allowed, "conflicting_options")
        return None
    if other is None or not is_plan(other) or chosen:
        refuse("a plan can only be compared with a plan", source, allowed, "conflicting_options")
    return source, other


def compare_source(
    source: Path, other: Path | None, case: Path | None, stated: Stated, arm: bool | None, watcher: Watcher
) -> Comparison:
    """Compared plans, or choices of a case; the arm must reach them, or with None where the case has its base."""
    plans = two_plans(source, other, case, any(stated))
    if plans is None:
        choices = parse_two(*stated)
        return compare_choices(prepare(source, arm=arm, watcher=watcher), choices)
    return compare_plans(plans, None if case is None else prepare(case, watcher=watcher), watcher.note)


def compare_choices(context: CaseContext, choices: tuple[Choice, Choice]) -> Comparison:
    """Comparison of two directions of a case, each checked, with their place in its search."""
    candidates, space = context.search(), context.case.space
    a, b = ((choice.text(space), explain_choice(context, choice, candidates)) for choice in choices)
    return compare_paths(context, candidates, a, b)


def compare_paths(context: CaseContext, candidates: Candidates, *paths: tuple[str, Explanation | Plan]) -> Comparison:
    """Comparison of two directions or plans of a case, each with its title, in its search; plans are checked again."""
    a, b = (_checked_side(context, candidates, title, path) for title, path in paths)
    read = [one for side in (a, b) if side.explained is not None for one in side.explained.read]
    return Comparison(context.case.name, (*read, *context.case.inputs), a, b, tuple(context.anatomy.warnings))


def compare_plans(paths: tuple[Path, Path], context: CaseContext | None, note: Callable[[str], None]) -> Comparison:
    """Comparison of two plans; with their case each is checked again."""
    read = [read_noted_plan(path, note) for path in paths]
    inputs = tuple(source for source, _ in read)
    plans = [plan for _, plan in read]
    if context is None:
        a, b = (Side(f"{path}", one.outward_ct, one.entry_ct, plan=one) for path, one in zip(paths, plans, strict=True))
        names = sorted({plan.case_name for plan in plans})
        ours, theirs = ({one.role: one.sha256 for one in plan.inputs} for plan in plans)
        roles = sorted(role for role in ours.keys() | theirs.keys() if ours.get(role) != theirs.get(role))
        files = f"the plans were made from different files ({first_few(roles, MOST_ROLES)}): are they of one case?"
        read_by_both = (*inputs, *plans[0].inputs, *plans[1].inputs)
        return Comparison(" and ".join(names), read_by_both, a, b, (files,) if roles else ())
    titled = zip(map(str, paths), plans, strict=True)
    compared = compare_paths(context, context.search(), *titled)
    return replace(compared, inputs=(*inputs, *compared.inputs))


def _checked_side(context: CaseContext, candidates: Candidates, title: str, path: Explanation | Plan) -> Side:
    """One side of a comparison; a plan is checked, and its chances are of the configuration in which it ends."""
    if isinstance(path, Plan):
        check_plan(path, context, Path(title))
        explained = context.explain(path.theta, path.beta)
        explained = replace(explained, breakdown=context.breakdown_at(path.outward_ct, path.insertion.q[-1]))
        grid = _on_grid(candidates, path.outward_ct, safe=True)
        return Side(title, path.outward_ct, path.entry_ct, explained, grid, path)
    row = path.candidates
    grid = _on_grid(candidates, row.outward_ct[0], safe=path.safe)
    return Side(title, row.outward_ct[0], row.path.entry_ct[0], path, grid)


def _on_grid(candidates: Candidates, outward_ct: Floats, *, safe: bool) -> dict[str, Any]:
    """A path's place in a search, plain values; one off the grid has neither rank nor cone."""
    document: dict[str, Any] = dict.fromkeys(GRID_KEYS)
    row = nearest_row(candidates, outward_ct)
    if row is None or not (safe and candidates.safe[row]):
        return document
    windows = candidates.windows
    window = windows.windows[int(windows.of_row[row]) - 1]
    document |= {"window": window.number, "window_square_deg": window.square_deg, "window_entry_cm2": window.entry_cm2}
    if np.linalg.norm(candidates.outward_ct[row] - outward_ct) > SAME_DIRECTION:
        return document
    cone_deg = finite(np.degrees(float(candidates.safe_cone[row])))
    return document | {"rank": int(candidates.ranking.rank[row]), "safe_cone_deg": cone_deg}


@dataclass(frozen=True, eq=False)
class Side:
    """One of two paths; `entry_ct`, (3,), mm, is NaN without a skin entry; of a plan alone nothing is explained."""

    title: str
    outward_ct: Floats
    entry_ct: Floats
    explained: Explanation | None = None
    grid: Mapping[str, Any] | None = None
    plan: Plan | None = None

    @property
    def safe(self) -> bool:
        """Whether the path is not rejected; a plan that was not checked again is what it was when it was made."""
        return self.explained is None or self.explained.safe

    def summary(self) -> dict[str, Any]:
        """Plain values: mm and degrees; null where there is no number."""
        own = ("case", "inputs", "warnings")
        checked = {} if self.explained is None else self.explained.summary()
        return {
            "title": self.title,
            "check": {key: value for key, value in checked.items() if key not in own} or None,
            "search": self.grid,
            "plan": None if self.plan is None else plan_summary(self.plan),
        }


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(Shown):
    """Two paths of a case, or of those that two plans name."""

    case_name: str
    inputs: tuple[Input, ...]
    a: Side
    b: Side
    warnings: tuple[str, ...] = ()

    @property
    def safe(self) -> bool:
        """Whether neither path is rejected."""
        return self.a.safe and self.b.safe

    @property
    def apart_deg(self) -> float:
        """Angle between the two directions, degrees."""
        u, v = self.a.outward_ct, self.b.outward_ct
        return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(u, v)), u @ v)))

    @property
    def entries_apart_mm(self) -> float:
        """Straight distance between the skin entries, mm; NaN without one."""
        return float(np.linalg.norm(self.a.entry_ct - self.b.entry_ct))

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "case": self.case_name,
            "inputs": inputs_document(self.inputs),
            "apart_deg": self.apart_deg,
            "entries_apart_mm": finite(self.entries_apart_mm),
            "a": self.a.summary(),
            "b": self.b.summary(),
            "warnings": list(self.warnings),
        }

    def text(self) -> str:
        """A table, then what takes a sentence."""
        entries = f", entries {self.entries_apart_mm:.0f} mm" if np.isfinite(self.entries_apart_mm) else ""
        head = f"case {self.case_name}: two paths {self.apart_deg:.1f}° apart{entries}"
        sides = [{**side.summary(), "spoken": _spoken(side)} for side in (self.a, self.b)]
        rows = [(one.name, *(one.of(side, unit=True) for side in sides)) for one in FIELDS]
        least: dict[str, float] = {}  # the nearest of either side that demand a margin, the nearest first
        sentences: list[Block] = []
        for letter, side in (("A", self.a), ("B", self.b)):
            if (explained := side.explained) is None:
                continue
            if not side.safe:
                sentences.append(f"{letter} is rejected: {reason_text(explained.candidates, 0)}")
            sentences.append(facts((f"{letter} {what}", value) for what, value in explained.facts.rows()))
            demanding = {one.name for one in explained.anatomy.checked if one.demands_margin}
            clearances = sorted(explained.clearances().items(), key=lambda item: item[1])
            for name, mm in [item for item in clearances if item[0] in demanding][:NEAREST]:
                least[name] = min(mm, least.get(name, np.inf))
        if self.a.explained is None:
            sentences.append(NOT_CHECKED)
        for name in sorted(least, key=least.__getitem__):
            rows.append((f"clearance to {name}", *(_clearance(side.explained, name) for side in (self.a, self.b))))
        table = Table(("", "A", "B"), tuple(row for row in rows if row[1:] != (NOTHING, NOTHING)))
        warned = (Section(f"warning: {one}", []) for one in self.warnings)
        return text([Section(head, [table, *sentences]), *warned])


def _clearance(explained: Explanation | None, name: str) -> str:
    if explained is None:
        return NOTHING
    digits = next(decimals(one) for one in explained.anatomy.checked if one.name == name)
    clearance = explained.clearances()[name]
    return "crossed" if clearance < 0 else number(clearance, digits, "mm")


def _spoken(side: Side) -> dict[str, Any]:
    row, explained = side.summary(), side.explained
    angles = "{theta_deg:.6g}, {beta_deg:.6g}".format(**(row["plan"] or row["check"]))
    if explained is None:
        return {"angles": angles, "verdict": "not checked"}
    check, chances = row["check"], row["check"].get("chances") or {}
    name, chance = ("", 0.0) if explained.breakdown is None else explained.breakdown.likeliest
    reached = {None: "not computed", False: "no", True: f"yes, margin {number(check['reach_margin'], 2)}"}
    return {
        "angles": angles,
        "verdict": str(explained.candidates.safe_text if side.safe else explained.verdict),
        **{key: _percent(chances[key]) for key in ("p_hit", "p_touch_any") if key in chances},
        "likeliest": f"{_percent(chance)}, {name}" if name else None,
        "reach": reached[check["reachable"]],
        "least": float(explained.candidates.least_clearance[0]),
    }


def _percent(chance: float) -> str:
    return f"{100 * chance:.2f}" if chance >= LEAST_CHANCE else "below 0.01"


FIELDS = (  # what stands in each row; rows that neither side has are left out
    Field("chosen by", "title"),
    Field("theta, beta, deg", "spoken.angles"),
    Field("verdict", "spoken.verdict"),
    Field("rank", "search.rank"),
    Field("window", "search.window"),
    Field("window's area, deg2", "search.window_square_deg", 0),
    Field("its entry on the skin, cm2", "search.window_entry_cm2", 1),
    Field("safe cone", "search.safe_cone_deg", 1, "deg"),
    Field("chance to hit, %", "spoken.p_hit"),
    Field("chance to touch anything, %", "spoken.p_touch_any"),
    Field("most likely touched, %", "spoken.likeliest"),
    Field("expected tip error (rms)", "check.chances.expected_rms_mm", 2, "mm"),
    Field("path length", "check.path_length_mm", 1, "mm"),
    Field("skin angle", "check.skin_angle_deg", 1, "deg"),
    Field("arm reaches it", "spoken.reach"),
    Field("standoff", "plan.standoff_mm", 1, "mm"),
    Field("approach", "plan.approach_s", 1, "s"),
    Field("insertion", "plan.insertion_s", 1, "s"),
    Field("expected tip error in the plan", "plan.expected_target_error_mm", 2, "mm"),
    Field("needle to the nearest structure", "plan.clearance_mm.needle", 2, "mm"),
    Field("arm on the approach", "plan.clearance_mm.approach", 2, "mm"),
    Field("arm on the insertion", "plan.clearance_mm.insertion", 2, "mm"),
    Field("least clearance", "spoken.least", 2, "mm"),
)
