"""The needle in tissue: closed forms, the path of a bevel, the force and its work, what the search keeps."""

from __future__ import annotations

from time import process_time

import numpy as np

from benchmarks.experiment.row import Row
from puncture_twin.planning.needle.beam import Beam
from puncture_twin.planning.needle.bevel_path import bevel_path, step_for
from puncture_twin.planning.needle.deflection import ALLOWANCE, MOST_SLENDER, deflection_bound
from puncture_twin.planning.needle.insertion_force import insertion_force
from puncture_twin.planning.needle.shaft import GAUGES, Shaft
from puncture_twin.planning.needle.tissue import Layer, Tissue

SHAFT = Shaft(200.0, 1.27)
STIFFNESSES = (0.01, 0.1, 0.4)
"""N/mm^2: 1e4, 1e5, 4e5 N/m^2."""

LAYERS = (
    Layer(0.0, 8.0, Tissue(0.1, 0.6, 0.01, 4.0, 5.0)),
    Layer(8.0, 25.0, Tissue(0.02, 0.3, 0.005)),
    Layer(25.0, 80.0, Tissue(0.1, 0.9, 0.02, 2.0, 3.0)),
)


def rows() -> list[Row]:
    """All figures of the part."""
    return [*_beam(), *_shafts(), *_bevel(), *_orders(), *_force()]


def _beam() -> list[Row]:
    loaded = Beam(SHAFT.bending_stiffness, 2.0, 100).bent(np.zeros(100), np.zeros(101), tip_load=0.5)
    exact = 0.5 * 200**3 / (3 * SHAFT.bending_stiffness)
    found = [Row.at_most("cantilever against P L^3 / 3 EI, relative", abs(loaded.deflection[-1] / exact - 1), 1e-6)]
    for k in STIFFNESSES:
        long = Beam(SHAFT.bending_stiffness, 0.5, 1200).bent(np.full(1200, k), np.zeros(1201), tip_load=1.0)
        exact = 2 * (k / (4 * SHAFT.bending_stiffness)) ** 0.25 / k
        error = abs(long.deflection[-1] / exact - 1)
        found.append(Row.at_most(f"long beam, k {k:g} N/mm2, against 2 P l / k, relative", error, 1e-6))
    return found


def _shafts() -> list[Row]:
    return [
        Row("18G solid, 200 mm: EI, N m2", f"{SHAFT.bending_stiffness * 1e-6:.4f}", "", True),
        Row("... tip stiffness, N/m", f"{SHAFT.tip_stiffness_n_mm * 1e3:.1f}", "", True),
        Row("... sag held horizontally, mm", f"{SHAFT.sag_mm:.2f}", "", True),
        Row("... buckles, tip free, N", f"{SHAFT.buckling_n(pinned=False):.1f}", "", True),
        Row("... buckles, tip pinned, N", f"{SHAFT.buckling_n(pinned=True):.1f}", "", True),
    ]


def _path(k: float, degrees: float = 3.0, step: float = 1.0, turned_mm: float = np.inf) -> np.ndarray:
    count = round(100 / step)
    alpha = np.where(np.arange(count) * step < turned_mm, 1.0, -1.0) * np.radians(degrees)
    return bevel_path(SHAFT, np.full(count, k), alpha, step).cut_mm


def _bevel() -> list[Row]:
    found = []
    for k in STIFFNESSES:
        ends = [_path(k, step=step)[-1] for step in (2.0, 1.0, 0.5)]
        found.append(Row(f"18G at 100 mm, k {k:g} N/mm2: mm off per degree", f"{ends[1] / 3:.2f}", "", True))
        change = 100 * float(np.abs(np.diff(ends)).max()) / ends[-1]
        found.append(Row.at_most("... halving the step changes it by, %", change, 1.5))
    thin, depth = Shaft(150.0, *GAUGES[25]), 5.0
    count = int(np.ceil(depth / step_for(thin, 10.0)))
    ends = [
        bevel_path(thin, np.full(n, 10.0), np.full(n, np.radians(1.0)), depth / n).cut_mm[-1]
        for n in (count, 2 * count)
    ]
    what = f"25G, 5 mm deep in 10 N/mm2, {count} steps: halving them changes it by, %"
    found.append(Row.at_most(what, 100 * abs(ends[1] / ends[0] - 1), 1.5))
    long = bevel_path(Shaft(500.0, 1.27), np.full(400, 0.1), np.full(400, np.radians(1.0)), 1.0).cut_mm
    circle = 2 * (0.1 / (4 * SHAFT.bending_stiffness)) ** 0.25 * np.radians(1.0)
    curvature = float(np.diff(long[-60:], 2).mean()) / circle
    found.append(Row.between("curvature far from the holder over 2 l alpha", curvature, 0.99, 1.01))
    turned = f"{_path(0.1, turned_mm=30.0)[-1]:.2f}"
    found.append(Row("turned by 180 deg at 30 mm, 3 deg, k 0.1: mm off", turned, "", True))
    found.append(Row.at_most("without a bevel: mm off", float(np.abs(_path(0.1, 0.0)).max()), 0.0))
    start = process_time()
    for _ in range(5):
        _path(0.1)
    found.append(Row.at_most("one insertion, CPU ms", 200 * (process_time() - start), 50.0))
    tissues = [Tissue(k) for k in STIFFNESSES]
    bound = deflection_bound(SHAFT, np.radians(0.5), tissues, 150.0)
    found.append(Row("bound of 0.5 deg at 100 mm in the stiffest, mm", f"{float(bound.at(100.0)):.2f}", "", True))
    return found


def beyond(slenderness: float, depth: float = 12.0) -> float:
    """By which fraction a thin stiff layer before a gap takes the tip beyond the stiffest tissue alone, at most.

    Args:
        slenderness: lambda L.
        depth: Of the path, over 1 / lambda.
    """
    rate, count = slenderness / SHAFT.length_mm, int(16 * min(depth, slenderness))
    stiffest, alpha = 4 * SHAFT.bending_stiffness * rate**4, np.full(count, 0.01)
    alone = bevel_path(SHAFT, np.full(count, stiffest), alpha, 1 / 16 / rate).largest_mm[1:]
    worst = 0.0
    for thick in (5, 7, 10, 12, 14, 19):  # sixteenths of 1 / lambda
        k = np.where(np.arange(count) < thick, stiffest, 0.0)
        worst = max(worst, float((bevel_path(SHAFT, k, alpha, 1 / 16 / rate).largest_mm[1:] / alone).max()) - 1)
    return worst


def _orders() -> list[Row]:
    """Up to the most slender shaft that a case may declare."""
    what = "a thin stiff layer before a gap, beyond the stiffest alone, lambda L"
    found = [Row(f"{what} {one:g}, %", f"{100 * beyond(one):.1f}", "", True) for one in (20.0, 40.0, 80.0)]
    most = MOST_SLENDER
    return [*found, Row.at_most(f"{what} {most:g}, %", 100 * beyond(most), 100 * ALLOWANCE - 3, ".1f")]


def _force() -> list[Row]:
    found = insertion_force(LAYERS)
    lost = 100 * abs(found.work_n_mm / sum(found.energy_n_mm) - 1)
    return [
        Row("peak force through skin (4 N), fat and liver (2 N), N", f"{found.peak_n:.2f}", "", True),
        Row.at_most("work of the arm against rupture + cutting + friction, %", lost, 1.0),
    ]
