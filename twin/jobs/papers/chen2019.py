"""The tables of Chen et al. 2019, recomputed: their printed numbers beside ours.

Chen G. et al., "Robot-Assisted Puncture Positioning Methods under CT Navigation", J. Xi'an Jiaotong Univ. 53(4),
2019, DOI 10.7652/xjtuxb201904013. The constants below and in `chen2019_tables` are what the paper prints (mm).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.entry import needle_pose, outward
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.fits import fit_affine, fit_triad
from puncture_twin.twin.experiment.chen2019 import TABLE_1, TABLE_2, TABLE_4, Point
from puncture_twin.twin.report.present import Field, Section, grid, text

TOLERANCE_MM = 0.01
"""The paper prints two decimals; so much may rounding its inputs and outputs differ."""

_ROUNDING = 1e-9
"""Binary against decimal fractions, when a difference is exactly the tolerance."""

TABLE_3: Mapping[str, tuple[Point, float]] = MappingProxyType(
    {
        "L": ((544.83, -338.12, 643.33), 2.99),
        "M": ((528.96, -325.92, 619.34), 2.94),
        "H": ((521.03, -319.82, 606.35), 2.99),
    }
)
"""Lesions by the triad A-B-C of setup 1, and their error."""

TABLE_5: Mapping[str, tuple[Point, float]] = MappingProxyType(
    {
        "ABC": ((555.87, -370.49, 619.19), 2.38),
        "ABE": ((555.81, -371.97, 617.94), 2.47),
        "ACD": ((560.82, -367.30, 617.43), 7.17),
    }
)
"""Lesion M by different triads of setup 2, and its error."""

TABLE_6: Mapping[str, float] = MappingProxyType({"ABC": 2.38, "ABCE": 3.55, "ABCDE": 2.48})
"""Error of lesion M in setup 2: triad for three markers, the paper's (affine) least squares for more."""

TABLE_7: Mapping[str, tuple[Point, float]] = MappingProxyType(
    {
        "A": ((417.33, -290.59, 535.40), 1.09),
        "B": ((557.55, -272.17, 535.38), 1.06),
        "C": ((424.00, -232.71, 602.44), 2.14),
    }
)
"""Markers by their own triad in setup 1, and their residuals."""

TABLE_7_MEAN = 1.43
"""Eq. 16 for setup 1."""

WORKED_THETA, WORKED_BETA = np.radians(10.0), np.radians(45.0)
WORKED_STANDOFF_MM, WORKED_LENGTH_MM = 150.0, 401.0
WORKED_TIP: Point = (554.75, -322.40, 471.62)
WORKED_TOP: Point = (623.69, -313.01, 76.70)
"""Section 3.3: setup 1, A-B-C, lesion M."""


@dataclass(frozen=True)
class Chen2019Row:
    """One printed quantity: a point (three numbers) or a distance (one), mm."""

    table: str
    what: str
    paper: tuple[float, ...]
    ours: tuple[float, ...]

    @property
    def difference_mm(self) -> float:
        """The largest difference of a number."""
        return float(np.max(np.abs(np.subtract(self.paper, self.ours))))

    @property
    def passed(self) -> bool:
        """Whether every number agrees to the paper's rounding."""
        return self.difference_mm <= TOLERANCE_MM + _ROUNDING


@dataclass(frozen=True)
class SetupReach:
    """The worked pose against a UR3: distance of the flange from the shoulder, and what the links can span; mm."""

    flange_from_shoulder_mm: float
    longest_span_mm: float

    @property
    def out_of_reach(self) -> bool:
        """Whether no configuration at all can bring the flange there."""
        return self.flange_from_shoulder_mm > self.longest_span_mm


@dataclass(frozen=True)
class Chen2019Tables:
    """All rows, and the finding about the worked pose."""

    rows: tuple[Chen2019Row, ...]
    reach: SetupReach

    @property
    def passed(self) -> bool:
        """Whether every number holds, and the finding too."""
        return all(row.passed for row in self.rows) and self.reach.out_of_reach


def reproduce() -> Chen2019Tables:
    """Recompute Tables 3, 5, 6, 7 and the worked example from Tables 1, 2 and 4."""
    rows: list[Chen2019Row] = []
    T = fit_triad(_points(TABLE_1, "ABC"), _points(TABLE_2, "ABC"))
    for name, (point, error) in TABLE_3.items():
        rows += _point_rows("3", f"{name} by A-B-C, setup 1", T, name, TABLE_2, point, error)
    for markers, (point, error) in TABLE_5.items():
        other = fit_triad(_points(TABLE_1, markers), _points(TABLE_4, markers))
        rows += _point_rows("5", f"M by {'-'.join(markers)}, setup 2", other, "M", TABLE_4, point, error)
    for markers, error in TABLE_6.items():
        fit = fit_triad if len(markers) == 3 else fit_affine
        other = fit(_points(TABLE_1, markers), _points(TABLE_4, markers))
        rows.append(Chen2019Row("6", f"error of M by {'-'.join(markers)}", (error,), (_error(other, "M", TABLE_4),)))
    for name, (point, error) in TABLE_7.items():
        rows += _point_rows("7", f"marker {name}, setup 1", T, name, TABLE_2, point, error)
    mean = float(np.mean([_error(T, name, TABLE_2) for name in TABLE_7]))
    rows.append(Chen2019Row("7", "mean error (Eq. 16)", (TABLE_7_MEAN,), (mean,)))
    rows += _worked_rows(T)
    return Chen2019Tables(tuple(rows), worked_reach(T))


def worked_reach(T_base_ct: Floats) -> SetupReach:
    """How far the worked pose's flange is from a UR3's shoulder, and how far the arm can span in any orientation.

    The span is an upper bound: all links and wrist offsets stretched in one plane, d4 at a right angle to it.
    """
    model = ur_model("ur3")
    shoulder = np.array([0.0, 0.0, model.d[0]])
    flange = apply(T_base_ct, _worked_pose()[1])
    stretched = np.sum(np.abs(model.a)) + abs(model.d[4]) + abs(model.d[5])
    return SetupReach(float(np.linalg.norm(flange - shoulder)), float(np.hypot(stretched, model.d[3])))


def _worked_pose() -> tuple[Floats, Floats]:
    u = outward(WORKED_THETA, WORKED_BETA)
    pose = needle_pose(np.array(TABLE_1["M"], float), u, standoff=WORKED_STANDOFF_MM, length=WORKED_LENGTH_MM)
    return pose.tip_ct, pose.top_ct


def _worked_rows(T_base_ct: Floats) -> list[Chen2019Row]:
    tip, top = (apply(T_base_ct, point) for point in _worked_pose())
    return [
        Chen2019Row("3.3", "needle tip, theta 10 beta 45 r 150", WORKED_TIP, _triple(tip)),
        Chen2019Row("3.3", "needle top, l 401", WORKED_TOP, _triple(top)),
    ]


def _point_rows(
    table: str, what: str, T: Floats, name: str, touched: Mapping[str, Point], point: Point, error: float
) -> list[Chen2019Row]:
    ours = _triple(apply(T, np.array(TABLE_1[name], float)))
    return [
        Chen2019Row(table, what, point, ours),
        Chen2019Row(table, f"error of {what}", (error,), (_error(T, name, touched),)),
    ]


def _points(table: Mapping[str, Point], names: str) -> Floats:
    return np.array([table[name] for name in names], dtype=float)


def _error(T: Floats, name: str, touched: Mapping[str, Point]) -> float:
    return float(np.linalg.norm(apply(T, np.array(TABLE_1[name], float)) - np.array(touched[name])))


def _triple(point: Floats) -> Point:
    x, y, z = (float(value) for value in point)
    return x, y, z


FIELDS = (
    Field("table", "table"),
    Field("what", "what"),
    Field("paper, mm", lambda row: "  ".join(f"{mm:.2f}" for mm in row["paper_mm"])),
    Field("ours, mm", lambda row: "  ".join(f"{mm:.2f}" for mm in row["ours_mm"])),
    Field(
        "differs", lambda row: max(abs(a - b) for a, b in zip(row["paper_mm"], row["ours_mm"], strict=True)), 4, "mm"
    ),
    Field("", lambda row: "" if row["holds"] else "DOES NOT HOLD"),
)


def reproduction_text(found: Mapping[str, Any]) -> str:
    """The paper's numbers beside ours."""
    reach = (
        "the worked example puts the flange {flange_from_shoulder_mm:.1f} mm from the shoulder of a UR3, whose links "
        "span "
        "{longest_span_mm:.1f} mm at most: it is "
    ).format(**found) + ("out of reach" if found["out_of_reach"] else "within reach")
    verdict = "all within their limits" if found["holds"] else "NOT all within their limits"
    return text([Section("Chen et al. 2019, and ours", [grid(FIELDS, found["rows"]), reach]), Section(verdict, [])])


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
