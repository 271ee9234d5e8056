"""The page's tables, as `Markup`: text is escaped where it meets HTML, HTML is not."""

from __future__ import annotations

import math
import platform
import re
from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, requires, version
from typing import Any

import numpy as np
from markupsafe import Markup

from puncture_twin.planning.base.provenance import Input
from puncture_twin.planning.base.reasons import UNSEEN_AIR, Reason, css
from puncture_twin.planning.plan.plan import CLEARANCE_TEXT
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.windows import MOST_WINDOWS, find_windows
from puncture_twin.twin.report.numbers import (
    ReasonCount,
    arm_text,
    clearance_text,
    expected_text,
    nearest_structure,
    number,
    percent,
    reason_counts,
)

PROJECT = "puncture-twin"

BEST_COLUMNS = (
    "window",
    "rank",
    "θ °",
    "β °",
    "cost",
    "clearance mm",
    "nearest structure",
    "path mm",
    "skin angle °",
    "crossed tissue mm",
    "reach margin",
    "safe cone °",
    "window's area deg²",
    "on the skin cm²",
)

CONE_TEXT = {
    "grid": "by the directions of the search, to one step; a certificate proves it",
    "certificate": "proven by the certificate",
}
"""Where the safe cone comes from."""


def joined(template: str, items: Iterable[Sequence[str]]) -> Markup:
    """A piece of HTML, with ``{}`` for each part, written for every item; parts that are not `Markup` are escaped."""
    return Markup("").join(Markup(template).format(*item) for item in items)


def table(head: Sequence[str], rows: Iterable[Sequence[str]], *, kind: str = "") -> Markup:
    """A table; cells are text or `Markup`."""
    top = joined("<th>{}</th>", zip(head, strict=True))
    body = joined("<tr>{}</tr>", ((joined("<td>{}</td>", zip(row, strict=True)),) for row in rows))
    form = '<div class="wide" tabindex="0"><table class="{}"><thead><tr>{}</tr></thead><tbody>{}</tbody></table></div>'
    return Markup(form).format(kind, top, body)


def pairs(rows: Iterable[tuple[str, str]]) -> Markup:
    """A table of names and values; each is text or `Markup`."""
    body = joined("<tr><th>{}</th><td>{}</td></tr>", rows)
    return Markup('<div class="wide"><table class="pairs"><tbody>{}</tbody></table></div>').format(body)


def faint(text: str) -> Markup:
    """A line in small print."""
    return Markup('<p class="faint">{}</p>').format(text)


def listed(lines: Iterable[str]) -> Markup:
    """Lines that warn, as a list."""
    return Markup("<ul>{}</ul>").format(joined('<li class="bad">{}</li>', ((line,) for line in lines)))


def two(left: str, right: str) -> Markup:
    """Two pieces side by side."""
    return Markup('<div class="two"><div>{}</div><div>{}</div></div>').format(left, right)


def best_table(candidates: Candidates) -> Markup:
    """The best candidate of each window, with the window's size."""
    windows = find_windows(candidates).windows
    if not windows:
        return Markup("<p>No direction is safe, so there is nothing to rank.</p>")
    lines = []
    for window in windows[:MOST_WINDOWS]:
        row = window.best
        name, clearance = nearest_structure(candidates, row)
        lines.append(
            (
                Markup('<button type="button" class="pick" data-row="{}">{}</button>').format(row, window.number),
                str(candidates.ranking.rank[row]),
                f"{np.degrees(candidates.theta[row]):.4g}",
                f"{np.degrees(candidates.beta[row]):.4g}",
                number(float(candidates.ranking.cost[row]), 3),
                number(clearance, 1),
                name.replace("_", " ") or "–",
                number(float(candidates.path.length[row]), 1),
                number(float(np.degrees(candidates.path.skin_angle[row])), 1),
                number(float(candidates.path.tissue[row]), 1),
                number(float(candidates.arm.margin[row]), 2),
                number(float(np.degrees(candidates.safe_cone[row])), 1),
                number(window.square_deg, 0),
                number(window.entry_cm2, 1),
            )
        )
    return table(BEST_COLUMNS, lines, kind="numbers") + faint(_windows_text(candidates, len(windows)))


def _windows_text(candidates: Candidates, count: int) -> str:
    shown = f"{MOST_WINDOWS} of {count}" if count > MOST_WINDOWS else f"All {count}"
    text = f"{shown} windows (connected sets of safe directions); a number chooses the window's best below."
    if candidates.cone_source:
        source = CONE_TEXT[candidates.cone_source]
        text += f" Safe cone: off by so much in any direction a needle stays safe for the organs, {source}."
    return text


def counts_table(candidates: Candidates) -> Markup:
    """How many directions fell to which reason; also the map's legend."""
    rows = [
        (
            Markup('<span class="patch {}" style="background-color:{}"></span>{}').format(
                _hatches(line), css(line.colour), line.text
            ),
            percent(line.solid_angle),
            f"{line.count:,}",
            Markup("<code>{}</code>").format(line.code),
        )
        for line in reason_counts(candidates)
    ]
    text = faint(f"{arm_text(candidates)}.")
    return table(("verdict", "of solid angle", "directions", "code"), rows, kind="numbers") + text


def _hatches(line: ReasonCount) -> str:
    """The class of a patch with the lines that the map has over its colour."""
    if line.code != Reason.UNKNOWN_REGION.value:
        return ""
    return "hatched air" if line.colour == UNSEEN_AIR else "hatched"


TRE_TEXT = "expected TRE at the target (rms), markers alone"
TIP_ERROR_TEXT = "expected tip error (rms), in the plan's configuration of the arm"
"""Of the registration, and of the whole insertion with the arm's declared errors."""


def registration_section(registration: Mapping[str, Any] | None) -> Markup:
    """The registration's numbers from a mapping of plain values; absent ones are left out."""
    if not registration:
        return Markup("<p>The case has no markers: where the patient lies was stated, or is not known.</p>")
    names = (
        ("method", "method", "", 0),
        ("fre_mm", "FRE (rms residual; not the accuracy at the target)", "mm", 3),
        ("mean_error_mm", "mean residual (Chen 2019, Eq. 16)", "mm", 3),
        ("fle_mm", "assumed FLE", "mm", 3),
        ("fle_source", "FLE from", "", 0),
        ("spread_ratio", "marker spread s₂/s₁", "", 2),
        ("altitude_mm", "least altitude of the triangle", "mm", 1),
        ("leverage", "TRE(target)/FLE", "", 2),
    )
    expected = float(registration.get("expected_tre_target_mm", math.nan))
    rows: list[tuple[str, str]] = [(TRE_TEXT, _bold(number(expected, 2, "mm")))]
    for key, text, unit, digits in names:
        if registration.get(key) is not None:
            rows.append((text, _value(registration[key], unit, digits)))
    low, high = registration.get("fle_interval_mm") or (0.0, 0.0)
    if low < high:
        rows.append(("95 % interval of the FLE", f"{number(low, 2)} to {number(high, 2, 'mm')}"))
    flags = list(registration.get("flags") or ())
    rows.append(("weak points", listed(map(str, flags)) if flags else "no flag raised"))
    residuals = registration.get("residual_mm") or {}
    shown = table(("marker", "residual mm"), [(n, number(float(v), 3)) for n, v in residuals.items()], kind="numbers")
    return two(pairs(rows), shown if residuals else "")


def _bold(text: str) -> Markup:
    return Markup("<b>{}</b>").format(text)


def _value(value: Any, unit: str, digits: int) -> str:
    if isinstance(value, int | float):
        return number(float(value), digits, unit)
    return str(value)


NOT_REQUESTED = "this run searched only; the plan command plans the arm's motion"
"""Where no plan was made because nobody wanted one."""


def plan_section(
    plan: Any | None, at_patient: Iterable[tuple[str, str]] = (), refusal: str = "", *, declared: bool = False
) -> Markup:
    """The plan's numbers, or why there is none, and how its path, or that of the best direction, is found.

    Args:
        plan: The plan, or None.
        at_patient: Names and values for whoever stands at the patient.
        refusal: Why there is no plan although one was requested; "" where none was.
        declared: Whether the case declares the arm's errors, which a plan's expected error then counts.
    """
    if plan is None:
        best = (("path of the best direction", ""), *at_patient)
        why = listed([f"Planning failed: {refusal}"]) if refusal else faint(f"No plan was requested: {NOT_REQUESTED}.")
        return why + (pairs(best) if len(best) > 1 else "")
    rows = [
        ("direction", f"θ {np.degrees(plan.theta):g}°, β {np.degrees(plan.beta):g}°"),
        ("arm", str(plan.model.name)),
        ("roll about the needle", f"{np.degrees(plan.roll):.1f}°"),
        ("standoff (tip to target)", number(plan.standoff_mm, 1, "mm")),
        *at_patient,
        ("entry point, CT frame", _point(plan.entry_ct)),
        ("target, CT frame", _point(plan.target_ct)),
        ("approach", f"{plan.approach.times_s[-1]:.1f} s, {len(plan.approach.q)} waypoints"),
        ("insertion", f"{plan.insertion.times_s[-1]:.1f} s, {len(plan.insertion.q)} waypoints"),
        *((CLEARANCE_TEXT[phase], number(float(mm), 1, "mm")) for phase, mm in plan.clearance_mm.items()),
        (TIP_ERROR_TEXT if declared else TRE_TEXT, expected_text(plan.expected_target_error_mm)),
        ("seed", str(plan.seed)),
    ]
    return pairs(rows)


def rehearsal_section(rehearsal: Any | None, keep_away: frozenset[str], film: str | None = None) -> Markup:
    """The rehearsal's numbers; clearances of the structures that the needle must keep away from; a link to the film."""
    if rehearsal is None:
        return Markup("<p>Not rehearsed.</p>")
    depth = f"{number(abs(rehearsal.depth_mm), 2, 'mm')} too {'deep' if rehearsal.depth_mm >= 0 else 'shallow'}"
    touched = [
        f"{c.link} touches {c.body} at {c.time_s:.2f} s"
        f"{f' ({c.depth_mm:.2f} mm deep)' if math.isfinite(c.depth_mm) else ''}"
        for c in rehearsal.contacts
    ]
    fraction = np.max(rehearsal.max_joint_speed / rehearsal.speed_limits)
    rows = [
        ("tip error at the end", _bold(number(rehearsal.tip_error_mm, 2, "mm"))),
        *([] if rehearsal.standing is None else [("of all", rehearsal.standing.text)]),
        ("its lateral part", number(rehearsal.lateral_mm, 2, "mm")),
        ("its depth part", depth),
        ("expected by the plan (rms)", expected_text(rehearsal.predicted_error_mm)),
        ("contacts", listed(touched) if touched else "none"),
        ("insertion", rehearsal.followed_text),
        ("force", rehearsal.force_text),
        ("fastest joint", f"{100 * fraction:.0f} % of its limit{'' if fraction <= 1 else ' (too fast)'}"),
        ("joint speeds, °/s", ", ".join(f"{v:.0f}" for v in np.degrees(rehearsal.max_joint_speed))),
        ("their limits, °/s", ", ".join(f"{v:.0f}" for v in np.degrees(rehearsal.speed_limits))),
        ("truth", str(getattr(rehearsal, "truth_source", "–"))),
        ("seed", str(rehearsal.seed)),
        *([("film", Markup('<a href="{}">{}</a>').format(film, film))] if film else ()),
    ]
    least = sorted(
        ((name, float(np.min(mm))) for name, mm in rehearsal.clearance_mm.items() if name in keep_away and len(mm)),
        key=lambda item: item[1],
    )
    nearest = table(
        ("structure", "least clearance mm"),
        [(n.replace("_", " "), clearance_text(v)) for n, v in least[:12]],
        kind="numbers",
    )
    more = faint(f"The 12 nearest of {len(least)} structures to keep away from.") if len(least) > 12 else ""
    return two(pairs(rows), nearest + more)


def warnings_section(warnings: Sequence[str]) -> Markup:
    """What could not be known."""
    return listed(warnings) if warnings else Markup("<p>None.</p>")


def inputs_table(inputs: Iterable[Input]) -> Markup:
    """Every input with its role and hash."""
    rows = [(one.role, one.path, Markup("<code>{}</code>").format(one.sha256)) for one in inputs]
    return table(("role", "file", "SHA-256"), rows)


TIMES = Markup(
    '<p class="faint">When it ran, and how long each stage took: <a href="timings.json">timings.json</a>.</p>'
)


def origin_section(seed: int) -> Markup:
    """Versions and seed, and where the times are: they differ from run to run, and the page does not."""
    versions = [(name, _version(name)) for name in parts()]
    rows = [("seed", str(seed)), ("Python", platform.python_version()), *versions]
    return pairs(rows) + TIMES


def parts() -> list[str]:
    """The packages that stand behind a result: this one and what its metadata requires, extras apart."""
    try:
        stated = requires(PROJECT) or []
    except PackageNotFoundError:  # run from a checkout that nobody installed
        stated = []
    return [PROJECT, *sorted(re.split(r"[^\w.-]", line, maxsplit=1)[0] for line in stated if "extra ==" not in line)]


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed as a package"


def _point(point: Any) -> str:
    return "(" + ", ".join(f"{v:.1f}" for v in point) + ") mm"
