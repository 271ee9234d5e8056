"""The needle in tissue: closed forms, the path of a bevel, the force and its work, what the search keeps."""

from __future__ import annotations

from itertools import product
from time import process_time

import numpy as np

from benchmarks.experiment.row import Row
from puncture_twin.planning.needle.deflection import (
    ALLOWANCE,
    GAUGES,
    MOST_SLENDER,
    Beam,
    Layer,
    Shaft,
    Tissue,
    bevel_path,
    deflection_bound,
    step_for,
)
from puncture_twin.planning.needle.insertion_force import insertion_force

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


def in_every_order(shaft: Shaft, tissues: tuple[float, ...], layers: int, longest: float) -> float:
    """The greatest deflection in any order of equally thick layers over the stiffest tissue's alone, at any depth.

    Args:
        shaft: The needle's.
        tissues: k of each tissue, N/mm^2; a layer is one of them.
        layers: Their number.
        longest: Depth of the path, mm.
    """
    count = layers * int(np.ceil(longest / layers / step_for(shaft, max(tissues))))
    alpha, step = np.full(count, 0.01), longest / count
    alone = bevel_path(shaft, np.full(count, max(tissues)), alpha, step).largest_mm[1:]
    orders = (np.repeat(order, count // layers) for order in product(tissues, repeat=layers))
    return max(float((bevel_path(shaft, k, alpha, step).largest_mm[1:] / alone).max()) for k in orders)


def proven(shaft: Shaft, alpha: float, stiffest: float, longest: float) -> np.ndarray:
    """A bound that is proven for every order of layers, and bevels that turn: what `docs` call the bound by energy.

    With W the energy of shaft and foundation, F the tip's lateral force, M the clamp's moment, a step of the insertion
    adds dW/ds = alpha F + M^2 / 2 EI (the envelope theorem: the rest of the shape is a minimum). W is quadratic in the
    tip's place and in the clamp's angle, so F^2 <= 2 K W and M^2 <= 2 R W, with K and R the stiffnesses there; both
    grow with k, so those of the stiffest tissue bound them. Then with q^2 = W

        q' <= alpha sqrt(K / 2) + q R / 2 EI,    |w| <= q sqrt(2 L^3 / 3 EI)

    since no cantilever bends by w at less energy than 3 EI w^2 / 2 L^3.

    Args:
        shaft: The needle's.
        alpha: The bevel's angle, rad.
        stiffest: The largest k, N/mm^2.
        longest: Depth of the path, mm.

    Returns:
        At depths of whole steps from 0 on, mm; at most `step_for` apart.
    """
    stiffness, step = shaft.bending_stiffness, step_for(shaft, stiffest)
    elements, growth, bound = round(shaft.length_mm / step), 0.0, [0.0]
    beam, rotated = Beam(stiffness, step, elements), -step * np.arange(elements + 1.0)
    for inserted in range(1, int(np.ceil(longest / step)) + 1):
        foundation = np.where(np.arange(elements) >= elements - inserted, stiffest, 0.0)
        held = beam.bent(foundation, 0.0 * rotated, tip_mm=1.0)
        turned = beam.bent(foundation, rotated, tip_mm=float(rotated[-1]))  # the clamp by 1, seen from its tangent
        moment = 6.0 * turned.deflection[1] / step**2 - 2.0 * turned.slope[1] / step  # over EI, at the clamp
        rate = abs(moment) / 2.0
        growth = growth * np.exp(rate * step) + alpha * np.sqrt(held.tip_force / 2.0) * np.expm1(rate * step) / rate
        bound.append(growth * np.sqrt(2.0 * shaft.length_mm**3 / (3.0 * stiffness)))
    return np.array(bound)


def _orders() -> list[Row]:
    """Up to the most slender shaft that a case may declare."""
    what = "a thin stiff layer before a gap, beyond the stiffest alone, lambda L"
    found = [Row(f"{what} {one:g}, %", f"{100 * beyond(one):.1f}", "", True) for one in (20.0, 40.0, 80.0)]
    tube, slender = Shaft(150.0, *GAUGES[18]), Shaft(200.0, *GAUGES[22])
    for name, shaft, k in (("18G of 150 mm, k 0.1", tube, 0.1), ("22G of 200 mm, k 0.4", slender, 0.4)):
        excess = 100 * (in_every_order(shaft, (0.0, k / 10, k), 6, 100.0) - 1)
        orders = f"{name}: all 729 orders of three tissues in six layers, beyond the stiffest alone, %"
        found.append(Row.at_most(orders, excess, 100 * ALLOWANCE, ".1f"))
        count = int(np.ceil(100.0 / step_for(shaft, k)))
        alone = bevel_path(shaft, np.full(count, k), np.full(count, 0.01), 100.0 / count).largest_mm
        wide = f"{proven(shaft, 0.01, k, 100.0)[-1] / alone[-1]:.1f}"
        found.append(Row("... the bound by energy at 100 mm, over the stiffest alone", wide, "", True))
    most = MOST_SLENDER
    return [*found, Row.at_most(f"{what} {most:g}, %", 100 * beyond(most), 100 * ALLOWANCE - 3, ".1f")]


def _force() -> list[Row]:
    found = insertion_force(LAYERS)
    lost = 100 * abs(found.work_n_mm / sum(found.energy_n_mm) - 1)
    return [
        Row("peak force through skin (4 N), fat and liver (2 N), N", f"{found.peak_n:.2f}", "", True),
        Row.at_most("work of the arm against rupture + cutting + friction, %", lost, 1.0),
    ]
