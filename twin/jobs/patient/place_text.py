"""What ``place`` prints for a person."""

from __future__ import annotations

from puncture_twin.planning.place.search import RatedPlacement
from puncture_twin.twin.jobs.patient.place_job import PlaceRun
from puncture_twin.twin.report.mount_text import direction_text, mounting_text

HALF_A_DIGIT = 5e-4
"""Of a share that is printed in % with one digit."""


def place_text(run: PlaceRun) -> str:
    """The ranked placements, the case's own, the lines to paste, and the files."""
    case, found = run.context.case, run.found
    wanted = found.rated[0].verdict.count if found.rated else 0
    x, y, z = (direction_text(found.T_ct_bed[:3, axis], str(case.space)) for axis in range(3))
    lines = [
        f"case {case.name}: {wanted} organ-safe directions; {len(found.coarse)} + {found.refined} placements estimated,"
        f" {len(found.rated)} checked",
        f"  from the target, mm: along = toward {x}, across = toward {y}, height = toward {z}",
        *needle_line(found.possible),
        "rank  share %   held  margin  along  across  height  mount",
    ]
    lines += [_line(f"{rank:4d}", one, run) for rank, one in enumerate(found.rated, start=1)]
    if found.own is not None:
        lines.append(_line("   -", found.own, run))
    best = run.document["mount_lines"]
    if best:
        lines += ["the best, for the case (in place of its [registration] or [robot.mount]):", ""]
        lines += [f"  {line}" for line in str(best).splitlines()]
        lines += ["", "a proposal: where the arm then really stands, markers must say ([registration])"]
    lines += [f"warning: {warning}" for warning in run.document["warnings"]]
    seconds = ", ".join(f"{stage} {spent:.1f}" for stage, spent in run.context.stages.seconds.items())
    return "\n".join([*lines, f"seconds: {seconds}", "look at:", *(f"  {path}" for path in run.files)])


def needle_line(possible: float) -> list[str]:
    """What no placement can mend, where there is such a thing."""
    if possible > 1.0 - HALF_A_DIGIT:
        return []
    fraction = f"at most {100 * possible:.1f} % can be held from anywhere"
    return [f"  {fraction}: elsewhere the needle itself would start too near the skin"]


def _line(rank: str, one: RatedPlacement, run: PlaceRun) -> str:
    verdict, space = one.verdict, str(run.context.case.space)
    where = "     -       -       -" if one.site is None else "{:6.0f}  {:6.0f}  {:6.0f}".format(*one.site.position)
    name = one.name if one.site is None else mounting_text(one.site.region, run.found.T_ct_bed, space)
    home = f"; home: {verdict.home_contact}" if verdict.home_contact else ""
    expected = "" if one.expected_mm is None else f"; expected tip error {one.expected_mm:.2f} mm"
    worth = f"{rank}  {100 * verdict.fraction:7.1f}  {verdict.reached:5d}  {verdict.margin:6.2f}"
    return f"{worth}  {where}  {name}{expected}{home}"
