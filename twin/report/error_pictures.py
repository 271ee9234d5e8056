"""Pictures of errors: by source and after a change; of the tips of many trials; over the time of one rehearsal."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from scipy.special import chdtri

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.text import plural
from puncture_twin.planning.geometry.rigid import frame_about
from puncture_twin.planning.uncertainty.hit import hit_in_ball
from puncture_twin.twin.report.figures import png, write_png

WIDTH_INCHES, HEAD_INCHES, ROW_INCHES, DPI = 13.2, 1.6, 0.25, 110
LEAST_ROWS = 16  # of changes; more of them make the picture higher
ROOM_FOR_NUMBERS = 1.12  # beside the longest bar
ALONE, BETTER, WORSE = "#0072b2", "#009e73", "#d55e00"  # Okabe and Ito's; better and worse lie on two sides of a line
SHOWN_MM = 0.005
PANEL_INCHES = (3.0, 3.5)
MOST_STRUCTURES = 6  # curves of clearance: so many of the nearest structures; the table has the rest
NAMED_PHASE = 0.07  # fraction of the time that a phase must last to carry its name; shorter ones would overlap
CURVES = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00")  # Okabe and Ito's, one for each curve


def budget_figure(facts: Mapping[str, Any]) -> Figure:
    """The figure of an error budget: facts as ``register --json`` has them under ``budget``."""
    inches = (WIDTH_INCHES, HEAD_INCHES + ROW_INCHES * max(LEAST_ROWS, len(facts["changes"])))
    figure = Figure(figsize=inches, dpi=DPI, facecolor="white", layout="constrained")
    sources, what_if = figure.subplots(1, 2)
    _sources(sources, facts)
    _changes(what_if, facts)
    best, now = facts["best"], f"{facts['expected_mm']:.2f}"
    title = f"expected tip error {now} mm (rms); least with {best['text']}: {best['expected_mm']:.2f} mm"
    figure.suptitle(title, fontsize=11.5)
    return figure


def _sources(axes: Axes, facts: Mapping[str, Any]) -> None:
    rows = [one for one in facts["sources"] if one["alone_mm"] >= SHOWN_MM]
    axes.barh([one["text"] for one in rows], [one["alone_mm"] for one in rows], color=ALONE)
    for at, one in enumerate(rows):
        axes.text(one["alone_mm"], at, f" {one['alone_mm']:.2f}", va="center", fontsize=9)
    axes.invert_yaxis()
    axes.set_xlim(right=ROOM_FOR_NUMBERS * max(one["alone_mm"] for one in rows))
    axes.set_xlabel("tip error (rms) from this source alone, mm")
    axes.set_title("each source alone (their squares add up)", fontsize=10)
    _plain(axes)


def _changes(axes: Axes, facts: Mapping[str, Any]) -> None:
    now, rows = facts["expected_mm"], facts["changes"]
    left = [one["expected_mm"] for one in rows]
    colours = [BETTER if mm <= now else WORSE for mm in left]
    axes.hlines(range(len(rows)), now, left, color=colours, linewidth=2)
    axes.scatter(left, range(len(rows)), color=colours, zorder=3)
    axes.axvline(now, color="black", linewidth=1)
    axes.text(now, -0.9, " now", fontsize=9, va="center")
    axes.set_yticks(range(len(rows)), [one["text"] for one in rows])
    axes.set_ylim(len(rows) - 0.4, -1.4)
    axes.set_xlabel("tip error (rms) with this one change, mm")
    axes.set_title("one change, all else the same", fontsize=10)
    _plain(axes)


def _plain(axes: Axes) -> None:
    axes.set_xlim(left=0)
    axes.grid(axis="x", alpha=0.3)
    axes.tick_params(labelsize=9)
    axes.spines[["top", "right"]].set_visible(False)


FIGURE_INCHES, DISTRIBUTION_DPI = (17.2, 4.7), 110
EDGES = {"left": 0.036, "right": 0.994, "bottom": 0.175, "top": 0.865, "wspace": 0.19}
"""Edges of the four plots in the picture: measuring the space of their labels takes longer than drawing them."""

MOST_POINTS = 4000  # of a cloud: more hide one another
WITHIN, BEYOND, PREDICTED = "#0072b2", "#d55e00", "#000000"  # Okabe and Ito's; what lies beyond is a cross too
BINS = 40
REGION = 0.95
CROWDED = 0.6  # radii of the ellipse that stay free around it
LEVELS = np.linspace(0.05, 0.95, 19)  # chances at which rooms are counted: the tip is so near this often
TWO_SIDED = 1.96  # standard errors that hold 95 % of what chance alone does


def draw_distribution(trials: Any, path: Path) -> None:
    """Write the tip errors of trials, in the needle's frame: two axes across it, then depth."""
    R = frame_about(-trials.puncture.outward_ct).T
    error, cov = trials.error_ct @ R.T, R @ trials.cov_ct @ R.T
    figure = Figure(figsize=FIGURE_INCHES, dpi=DISTRIBUTION_DPI, facecolor="white")
    side, along, sizes, chances = figure.subplots(1, 4, gridspec_kw=dict(EDGES))
    _cloud(side, error, cov, trials.in_region, (0, 1), ("lateral x, mm", "lateral y, mm"))
    side.set_title("tip in the patient, seen along the needle", fontsize=10)
    _cloud(along, error, cov, trials.in_region, (0, 2), ("lateral x, mm", "depth, mm (down: too deep)"))
    along.invert_yaxis()
    along.set_title("seen from the side", fontsize=10)
    figure.legend(*along.get_legend_handles_labels(), fontsize=7.5, loc="lower left", ncols=4)
    _histogram(sizes, trials)
    _reliability(chances, trials)
    inside = f"{100 * trials.in_region.mean():.1f} % inside the predicted 95 % ellipsoid"
    rms = f"rms {trials.realised_rms_mm:.2f} mm, predicted {trials.predicted_rms_mm:.2f} mm"
    figure.suptitle(f"{plural(len(trials), 'trial')}, seed {trials.seed}: {inside}; {rms}", fontsize=11.5)
    write_png(figure, path)


def _cloud(axes: Axes, error: Floats, cov: Floats, within: Any, pair: tuple[int, int], names: tuple[str, str]) -> None:
    """The errors on two axes, and the shadow of the 95 % ellipsoid there."""
    shown = np.arange(len(error)) < MOST_POINTS
    for rows, colour, marker, text in (
        (shown & within, WITHIN, ".", "tip inside the ellipsoid"),
        (shown & ~within, BEYOND, "x", "outside it"),
    ):
        points = error[rows][:, list(pair)]
        axes.scatter(points[:, 0], points[:, 1], s=14, c=colour, marker=marker, linewidths=0.8, alpha=0.6, label=text)
    turns = np.linspace(0, 2 * np.pi, 241)
    values, vectors = np.linalg.eigh(cov[np.ix_(pair, pair)])
    ring = vectors @ (np.sqrt(chdtri(3, 1 - REGION) * np.maximum(values, 0))[:, None] * [np.cos(turns), np.sin(turns)])
    axes.plot(*ring, color=PREDICTED, lw=1.6, label="predicted 95 % ellipsoid")
    axes.plot([0], [0], marker="+", color=PREDICTED, ms=11, mew=1.6, ls="none", label="true target")
    reach = max((1 + CROWDED) * float(np.abs(ring).max()), float(np.abs(error[:, list(pair)]).max(initial=0.0)))
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", xlabel=names[0], ylabel=names[1])
    axes.grid(visible=True, color="0.9")
    axes.set_axisbelow(True)


def draw_clouds(
    rated: Sequence[tuple[Any, str, str]], outward_ct: Floats, path: Path, hit_mm: float | None = None, columns: int = 2
) -> None:
    """Write the error clouds of several guidances, all to one scale, in the plane of the needle where they are widest.

    Of each guidance its trials, a word, its colour; `outward_ct`: of the needle, (3,), unit; `hit_mm`: radius of a hit.
    """
    R, reach = frame_about(-outward_ct).T, 0.0
    widest = np.sum([R[:2] @ one.cov_ct @ R[:2].T for one, _, _ in rated], axis=0)
    R[:2] = np.linalg.eigh(widest)[1].T[::-1] @ R[:2]
    rows = -(-len(rated) // columns)  # two columns can still be read on a telephone
    size = (PANEL_INCHES[0] * columns, PANEL_INCHES[1] * rows)
    figure = Figure(figsize=size, dpi=DPI, facecolor="white", layout="compressed")
    panels = list(figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).flat)
    for axes, (one, word, colour) in zip(panels, rated, strict=False):
        _cloud(axes, one.error_ct @ R.T, R @ one.cov_ct @ R.T, one.in_region, (0, 2), ("", ""))
        reach = max(reach, axes.get_xlim()[1])
        if hit_mm is not None:
            axes.add_patch(Circle((0, 0), hit_mm, fill=False, linestyle=":", edgecolor="0.3"))
        end = f"{one.realised_rms_mm:.2f} mm rms, {100 * one.hit.mean():.1f} % hit" if len(one) else "none ended"
        axes.set_title(f"{one.guidance}: {word}\n{end}", fontsize=10, color=colour)
        axes.spines[:].set(color=colour, linewidth=2.0)
    panels[0].set(xlim=(-reach, reach), ylim=(reach, -reach))
    for axes in panels[len(rated) :]:
        axes.remove()
    figure.supxlabel("across the needle, where errors are widest, mm", fontsize=10)
    figure.supylabel("depth, mm (down: too deep)", fontsize=10)
    write_png(figure, path)


def _histogram(axes: Axes, trials: Any) -> None:
    sizes = trials.tip_error_mm
    top = 1.02 * max(float(sizes.max()), 2.5 * trials.predicted_rms_mm)
    edges = np.linspace(0, top, BINS + 1)
    axes.hist(sizes, bins=list(edges), color=WITHIN, alpha=0.55, label="trials")
    fine = np.linspace(0, top, 4 * BINS + 1)
    reached = np.array([hit_in_ball(trials.cov_ct[None], radius)[0] if radius > 0 else 0.0 for radius in fine.tolist()])
    density = np.diff(reached) * len(trials) * 4
    axes.plot((fine[1:] + fine[:-1]) / 2, density, color=PREDICTED, lw=1.6, label="predicted")
    median = float(np.median(sizes))
    axes.axvline(median, color=BEYOND, ls="--", lw=1.5, label=f"median {median:.2f} mm")
    axes.set(xlim=(0, top), xlabel="true tip to true target, mm", ylabel="trials")
    axes.set_title("tip error", fontsize=10)
    axes.legend(fontsize=8)


def _reliability(axes: Axes, trials: Any) -> None:
    """Plot observed fractions over predicted chances: the tip within a radius, the target hit, each touch."""
    sizes = np.sort(trials.tip_error_mm)
    radii = np.geomspace(0.02, 5.0, 400) * trials.predicted_rms_mm
    predicted = np.array([hit_in_ball(trials.cov_ct[None], radius)[0] for radius in radii.tolist()])
    within = np.searchsorted(sizes, np.interp(LEVELS, predicted, radii), side="right") / len(trials)
    fine = np.linspace(0, 1, 101)
    spread = TWO_SIDED * np.sqrt(fine * (1 - fine) / len(trials))
    axes.fill_between(fine, fine - spread, fine + spread, color="0.85", lw=0, label="95 % range of chance alone")
    axes.plot([0, 1], [0, 1], color=PREDICTED, lw=1.0)
    axes.scatter(LEVELS, within, s=16, c=WITHIN, label="tip within a radius", zorder=3)
    hits, touches = ([trials.p_hit], [trials.hit_share]), (trials.p_touch, trials.touched.mean(axis=0))
    axes.scatter(*hits, s=60, c=BEYOND, marker="*", label="target hit", zorder=4)
    axes.scatter(*touches, s=26, c=BEYOND, marker="x", label="a structure touched", zorder=4)
    axes.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02), aspect="equal")
    axes.set(xlabel="predicted chance", ylabel="observed fraction of trials")
    axes.set_title("predicted and observed chances", fontsize=10)
    axes.legend(fontsize=7.5, loc="upper left")


def rehearsal_png(rehearsal: Any, keep_away: frozenset[str]) -> bytes:
    """A PNG over time: the true tip to the true target, with the phases, and the true needle to true structures."""
    figure = Figure(figsize=(12.0, 3.6), dpi=DPI, facecolor="white", layout="constrained")
    distance, clearance = figure.subplots(1, 2)
    away = np.linalg.norm(rehearsal.tip_true_ct - rehearsal.target_true_ct, axis=1)
    distance.plot(rehearsal.times_s, away, color="#00684a")
    distance.set_ylabel("true tip to true target, mm")
    phase, times = rehearsal.phase, rehearsal.times_s
    first = np.concatenate([[0], np.flatnonzero(phase[1:] != phase[:-1]) + 1])
    for start, end, name in zip(times[first], np.append(times[first[1:]], times[-1]), phase[first], strict=True):
        distance.axvline(start, color="0.6", linestyle=":", linewidth=1)
        if end - start > NAMED_PHASE * times[-1]:
            distance.annotate(name, (start, 1.0), (3, -10), ("data", "axes fraction"), textcoords="offset points")
    names = [name for name in rehearsal.clearance_mm if name in keep_away]
    nearest = sorted(names, key=lambda n: float(np.min(rehearsal.clearance_mm[n], initial=np.inf)))
    for name, colour in zip(nearest, CURVES[:MOST_STRUCTURES], strict=False):
        label = name.replace("_", " ")
        clearance.plot(rehearsal.clearance_times_s, rehearsal.clearance_mm[name], color=colour, label=label)
    clearance.axhline(0, color="#d6001e", linewidth=1)
    clearance.set_ylabel("true needle to true structure, mm")
    if nearest:
        clearance.legend(fontsize=8)
    for axes in (distance, clearance):
        axes.set_xlabel("time, s")
        axes.grid(color="0.9")
    return png(figure)
