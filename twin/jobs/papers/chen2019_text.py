"""What ``reproduce chen2019`` prints: the paper's numbers beside ours."""

from __future__ import annotations

from typing import Any

from puncture_twin.twin.jobs.papers.chen2019 import Chen2019Tables


def reproduction_text(result: Chen2019Tables) -> str:
    """The paper's numbers beside ours."""
    lines = [
        "table  what                                    paper                       ours                   differs"
    ]
    for row in result.rows:
        paper, ours = (" ".join(f"{x:8.2f}" for x in values) for values in (row.paper, row.ours))
        mark = "" if row.passed else "  DOES NOT HOLD"
        lines.append(f"{row.table:5s}  {row.what:36.36s} {paper:>27s} {ours:>27s} {row.difference_mm:8.4f}{mark}")
    reach = result.reach
    lines += [
        "",
        f"The worked pose puts the flange {reach.flange_from_shoulder_mm:.1f} mm from the shoulder of a UR3, "
        f"whose links span {reach.longest_span_mm:.1f} mm at most: "
        + ("it is out of reach." if reach.out_of_reach else "it is within reach."),
        "every number holds" if result.passed else "NOT every number holds",
    ]
    return "\n".join(lines)


def reproduction_summary(result: Chen2019Tables) -> dict[str, Any]:
    """A reproduction as plain values, mm, for ``--json``."""
    rows = [
        {"table": r.table, "what": r.what, "paper_mm": r.paper, "ours_mm": r.ours, "holds": r.passed}
        for r in result.rows
    ]
    return {
        "rows": rows,
        "flange_from_shoulder_mm": result.reach.flange_from_shoulder_mm,
        "longest_span_mm": result.reach.longest_span_mm,
        "out_of_reach": result.reach.out_of_reach,
        "holds": result.passed,
    }
