"""The page's tables, as HTML. Every word that comes from a file is escaped."""

from __future__ import annotations

import html
import math
import platform
from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from puncture_twin.planning.base.provenance import Input
from puncture_twin.planning.base.reasons import css
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.twin.report.numbers import arm_words, nearest_structure, number, percent, reason_counts

PARTS = ("puncture-twin", "numpy", "python-fcl", "embreex", "ompl", "pybullet", "trimesh", "plotly")
"""The packages whose version a result depends on."""

BEST_COLUMNS = (
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
    "Pareto",
)


def escape(value: object) -> str:
    """Text made safe for HTML."""
    return html.escape(str(value), quote=True)


def table(head: Sequence[str], rows: Iterable[Sequence[str]], *, kind: str = "") -> str:
    """A table; the cells are HTML already."""
    top = "".join(f"<th>{cell}</th>" for cell in head)
    body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="wide"><table class="{kind}"><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'


def pairs(rows: Iterable[tuple[str, str]]) -> str:
    """A table of names and values; the values are HTML already."""
    body = "".join(f"<tr><th>{escape(name)}</th><td>{value}</td></tr>" for name, value in rows)
    return f'<div class="wide"><table class="pairs"><tbody>{body}</tbody></table></div>'


def best_table(candidates: Candidates) -> str:
    """The ten best candidates."""
    rows = candidates.ranked[:10]
    if len(rows) == 0:
        return "<p>No direction is safe, so there is nothing to rank.</p>"
    lines = []
    for row in rows:
        name, clearance = nearest_structure(candidates, int(row))
        lines.append(
            (
                str(candidates.ranking.rank[row]),
                f"{np.degrees(candidates.theta[row]):g}",
                f"{np.degrees(candidates.beta[row]):g}",
                number(float(candidates.ranking.cost[row]), 3),
                number(clearance, 1),
                escape(name.replace("_", " ") or "–"),
                number(float(candidates.path.length[row]), 1),
                number(float(np.degrees(candidates.path.skin_angle[row])), 1),
                number(float(candidates.path.tissue[row]), 1),
                number(float(candidates.arm.margin[row]), 2),
                "yes" if candidates.ranking.pareto[row] else "",
            )
        )
    return table(BEST_COLUMNS, lines, kind="numbers")


def counts_table(candidates: Candidates) -> str:
    """How many directions fell to which reason; also the map's legend."""
    rows = [
        (
            f'<span class="patch" style="background:{css(line.colour)}"></span>{escape(line.words)}',
            f"<code>{escape(line.code)}</code>",
            f"{line.count:,}",
            escape(percent(line.share)),
            escape(percent(line.solid_angle)),
        )
        for line in reason_counts(candidates)
    ]
    words = f'<p class="faint">{escape(arm_words(candidates))}.</p>'
    return table(("verdict", "code", "directions", "of grid", "of solid angle"), rows, kind="numbers") + words


def registration_section(registration: Mapping[str, Any] | None, plan: Any | None) -> str:
    """The registration's numbers from a mapping of plain values; absent ones are left out."""
    if not registration:
        return "<p>The case has no markers: where the patient lies was stated, or is not known.</p>"
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
    rows = [("expected error (TRE, rms) at the target", f"<b>{number(_tre(registration, plan), 2, 'mm')}</b>")]
    for key, words, unit, digits in names:
        if registration.get(key) is not None:
            rows.append((words, _value(registration[key], unit, digits)))
    low, high = registration.get("fle_interval_mm") or (0.0, 0.0)
    if low < high:
        rows.append(("95 % interval of the FLE", f"{number(low, 2)} to {number(high, 2, 'mm')}"))
    flags = list(registration.get("flags") or ())
    warned = "".join(f'<li class="bad">{escape(flag)}</li>' for flag in flags)
    rows.append(("weak points", f"<ul>{warned}</ul>" if flags else "no flag raised"))
    residuals = registration.get("residual_mm") or {}
    shown = table(
        ("marker", "residual mm"), [(escape(n), number(float(v), 3)) for n, v in residuals.items()], kind="numbers"
    )
    return f'<div class="two"><div>{pairs(rows)}</div><div>{shown if residuals else ""}</div></div>'


def _tre(registration: Mapping[str, Any], plan: Any | None) -> float:
    if registration.get("expected_tre_target_mm") is not None:
        return float(registration["expected_tre_target_mm"])
    if registration.get("fle_mm") is not None and registration.get("leverage") is not None:
        return float(registration["fle_mm"]) * float(registration["leverage"])
    return math.nan if plan is None else float(plan.expected_target_error_mm)


def _value(value: Any, unit: str, digits: int) -> str:
    if isinstance(value, int | float):
        return escape(number(float(value), digits, unit))
    return escape(value)


def plan_section(plan: Any | None) -> str:
    """The plan's numbers."""
    if plan is None:
        return "<p>No plan was made.</p>"
    rows = [
        ("direction", f"θ {np.degrees(plan.theta):g}°, β {np.degrees(plan.beta):g}°"),
        ("arm", escape(plan.model)),
        ("roll about the needle", f"{np.degrees(plan.roll):.1f}°"),
        ("standoff (tip to target)", number(plan.standoff_mm, 1, "mm")),
        ("entry point, CT frame", _point(plan.entry_ct)),
        ("target, CT frame", _point(plan.target_ct)),
        ("approach", f"{plan.approach.times_s[-1]:.1f} s, {len(plan.approach.q)} waypoints"),
        ("insertion", f"{plan.insertion.times_s[-1]:.1f} s, {len(plan.insertion.q)} waypoints"),
        *((f"least clearance: {phase}", number(float(mm), 1, "mm")) for phase, mm in plan.clearance_mm.items()),
        ("expected error at the target (rms)", number(plan.expected_target_error_mm, 2, "mm")),
        ("seed", str(plan.seed)),
    ]
    return pairs(rows)


def rehearsal_section(rehearsal: Any | None, keep_away: frozenset[str], film: str | None = None) -> str:
    """The rehearsal's numbers; clearances of the structures that the needle must keep away from; a link to the film."""
    if rehearsal is None:
        return "<p>Not rehearsed.</p>"
    depth = f"{number(abs(rehearsal.depth_mm), 2, 'mm')} too {'deep' if rehearsal.depth_mm >= 0 else 'shallow'}"
    touched = "".join(
        f'<li class="bad">{escape(c.link)} touches {escape(c.body)} at {c.time_s:.2f} s'
        f"{f' ({c.depth_mm:.2f} mm deep)' if math.isfinite(c.depth_mm) else ''}</li>"
        for c in rehearsal.contacts
    )
    share = np.max(rehearsal.max_joint_speed / rehearsal.speed_limits)
    rows = [
        ("tip error at the end", f"<b>{number(rehearsal.tip_error_mm, 2, 'mm')}</b>"),
        ("its lateral part", number(rehearsal.lateral_mm, 2, "mm")),
        ("its depth part", depth),
        ("expected beforehand (rms)", number(rehearsal.predicted_error_mm, 2, "mm")),
        ("contacts", f"<ul>{touched}</ul>" if touched else "none"),
        ("fastest joint", f"{100 * share:.0f} % of its limit{'' if share <= 1 else ' (too fast)'}"),
        ("joint speeds, °/s", ", ".join(f"{v:.0f}" for v in np.degrees(rehearsal.max_joint_speed))),
        ("their limits, °/s", ", ".join(f"{v:.0f}" for v in np.degrees(rehearsal.speed_limits))),
        ("truth", escape(getattr(rehearsal, "truth_source", "–"))),
        ("seed", str(rehearsal.seed)),
        *([("film", f'<a href="{escape(film)}">{escape(film)}</a>')] if film else ()),
    ]
    least = sorted(
        ((name, float(np.min(mm))) for name, mm in rehearsal.clearance_mm.items() if name in keep_away and len(mm)),
        key=lambda item: item[1],
    )
    nearest = table(
        ("structure", "least clearance mm"),
        [(escape(n.replace("_", " ")), number(v, 1)) for n, v in least[:12]],
        kind="numbers",
    )
    more = (
        f'<p class="faint">The 12 nearest of {len(least)} structures to keep away from.</p>' if len(least) > 12 else ""
    )
    return f'<div class="two"><div>{pairs(rows)}</div><div>{nearest}{more}</div></div>'


def warnings_section(warnings: Sequence[str]) -> str:
    """What could not be known."""
    if not warnings:
        return "<p>None.</p>"
    return "<ul>" + "".join(f'<li class="bad">{escape(warning)}</li>' for warning in warnings) + "</ul>"


def inputs_table(inputs: Iterable[Input]) -> str:
    """Every input with its role and hash."""
    rows = [(escape(one.role), escape(one.path), f"<code>{escape(one.sha256)}</code>") for one in inputs]
    return table(("role", "file", "SHA-256"), rows)


TIMES = '<p class="faint">When it ran, and how long each stage took: <a href="timings.json">timings.json</a>.</p>'


def origin_section(seed: int) -> str:
    """Versions and seed, and where the times are: they differ from run to run, and the page does not."""
    versions = [(name, escape(_version(name))) for name in PARTS]
    rows = [("seed", str(seed)), ("Python", escape(platform.python_version())), *versions]
    return f"{pairs(rows)}{TIMES}"


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed as a package"


def _point(point: Any) -> str:
    return "(" + ", ".join(f"{v:.1f}" for v in point) + ") mm"
