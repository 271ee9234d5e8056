"""The shaft and the beam against closed forms; the bevel's path against the laws that it must keep."""

from itertools import product

import numpy as np
import pytest

from puncture_twin.planning.needle.deflection import (
    ALLOWANCE,
    GAUGES,
    MOST_SLENDER,
    Beam,
    Shaft,
    Tissue,
    bevel_path,
    deflection_bound,
    step_for,
    stiffest_resolved,
)

SOLID_18 = Shaft(200.0, 1.27)
TUBE_18 = Shaft(150.0, *GAUGES[18])


def beyond(slenderness, depth=12.0):
    """By which fraction a thin stiff layer before a gap takes the tip beyond the stiffest tissue alone, at most."""
    rate, count = slenderness / SOLID_18.length_mm, int(16 * min(depth, slenderness))
    stiffest, alpha = 4 * SOLID_18.bending_stiffness * rate**4, np.full(count, 0.01)
    alone = bevel_path(SOLID_18, np.full(count, stiffest), alpha, 1 / 16 / rate).largest_mm[1:]
    worst = 0.0
    for thick in (5, 7, 10, 12, 14, 19):  # sixteenths of 1 / lambda
        k = np.where(np.arange(count) < thick, stiffest, 0.0)
        worst = max(worst, float((bevel_path(SOLID_18, k, alpha, 1 / 16 / rate).largest_mm[1:] / alone).max()) - 1)
    return worst


def in_every_order(shaft, tissues, layers, longest):
    """The greatest deflection in any order of equally thick layers over the stiffest tissue's alone, at any depth."""
    count = layers * int(np.ceil(longest / layers / step_for(shaft, max(tissues))))
    alpha, step = np.full(count, 0.01), longest / count
    alone = bevel_path(shaft, np.full(count, max(tissues)), alpha, step).largest_mm[1:]
    orders = (np.repeat(order, count // layers) for order in product(tissues, repeat=layers))
    return max(float((bevel_path(shaft, k, alpha, step).largest_mm[1:] / alone).max()) for k in orders)


def proven(shaft, alpha, stiffest, longest):
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


def straight(elements):
    return np.zeros(elements + 1)


def test_a_cantilever_bends_as_euler_says():
    """P L^3 / 3 EI at the tip, and P L^2 / 2 EI its slope: cubic elements hold it exactly."""
    beam = Beam(SOLID_18.bending_stiffness, 2.0, 100)
    found = beam.bent(np.zeros(100), straight(100), tip_load=0.5)
    assert found.deflection[-1] == pytest.approx(0.5 * 200**3 / (3 * beam.stiffness), rel=1e-6)
    assert found.slope[-1] == pytest.approx(0.5 * 200**2 / (2 * beam.stiffness), rel=1e-6)


@pytest.mark.parametrize("k", [0.01, 0.4])
def test_a_long_beam_in_a_foundation_bends_as_hetenyi_says(k):
    """2 P l / k under a load at the free end, l = (k / 4 EI)^(1/4); and exp(-l x) cos(l x) behind it."""
    beam = Beam(SOLID_18.bending_stiffness, 0.5, 1200)
    found = beam.bent(np.full(1200, k), straight(1200), tip_load=1.0)
    rate = (k / (4 * beam.stiffness)) ** 0.25
    assert found.deflection[-1] == pytest.approx(2 * rate / k, rel=1e-6)
    behind = 0.5 * np.arange(200)
    whole = 2 * rate / k * np.exp(-rate * behind) * np.cos(rate * behind)
    np.testing.assert_allclose(found.deflection[::-1][:200], whole, atol=1e-6 * 2 * rate / k)


def test_a_tip_that_is_held_needs_the_force_that_brings_it_there():
    beam, foundation = Beam(SOLID_18.bending_stiffness, 1.0, 120), np.linspace(0, 0.2, 120)
    rest = 0.5 * np.sin(np.linspace(0, 2, 121))
    loaded = beam.bent(foundation, rest, tip_load=0.3)
    held = beam.bent(foundation, rest, tip_mm=float(loaded.deflection[-1]))
    np.testing.assert_allclose(held.deflection, loaded.deflection, atol=1e-9)
    assert held.tip_force == pytest.approx(0.3, rel=1e-6)


def test_a_shaft_in_a_stiff_foundation_lies_where_the_foundation_rests():
    x = np.linspace(0, 1, 151)
    rest = 3.0 * x**3
    found = Beam(TUBE_18.bending_stiffness, 1.0, 150).bent(np.full(150, 1e6), rest, tip_mm=3.0)
    np.testing.assert_allclose(found.deflection, rest, atol=2e-3)


@pytest.mark.parametrize(
    ("shaft", "stiffness", "sag", "free", "pinned"),
    [
        (Shaft(150.0, 1.27), 0.0255, 0.24, 2.8, 23),
        (Shaft(200.0, 1.27), 0.0255, 0.77, 1.6, 13),
        (Shaft(150.0, 1.27, 0.84), 0.0207, 0.17, 2.3, 18),
        (Shaft(250.0, 2.0), 0.157, 0.76, 6.2, 51),
    ],
)
def test_shafts_have_the_numbers_of_the_handbook(shaft, stiffness, sag, free, pinned):
    """EI in N m^2, sag in mm, Euler's loads in N."""
    assert shaft.bending_stiffness * 1e-6 == pytest.approx(stiffness, rel=5e-3)
    assert shaft.sag_mm == pytest.approx(sag, abs=6e-3)
    assert shaft.buckling_n(pinned=False) == pytest.approx(free, abs=0.06)
    assert shaft.buckling_n(pinned=True) == pytest.approx(pinned, abs=0.6)


def test_gauges_descend():
    outer = [gauge.outer_mm for gauge in GAUGES.values()]
    assert outer == sorted(outer, reverse=True)
    assert all(0 < gauge.inner_mm < gauge.outer_mm for gauge in GAUGES.values())


def path(alpha_deg=3.0, k=0.1, step=1.0, depth=100, turned_at=None, shaft=SOLID_18):
    """An insertion of 100 mm."""
    alpha = np.full(round(depth / step), np.radians(alpha_deg))
    if turned_at is not None:
        alpha[round(turned_at / step) :] *= -1
    return bevel_path(shaft, np.full(len(alpha), k), alpha, step)


def test_the_path_converges():
    ends = [path(step=step).cut_mm[-1] for step in (2.0, 1.0, 0.5, 0.25)]
    changes = np.abs(np.diff(ends)) / ends[-1]
    assert changes.max() < 0.015
    assert changes[2] < changes[1] < changes[0]


def needle_and_tissue(rng):
    """A shaft and a stiffness of what a case may declare, log-uniform, in no more than 300 steps."""
    while True:
        length, outer, modulus, k = np.exp(rng.uniform(np.log([10, 0.1, 20, 1e-4]), np.log([400, 4, 250, 100])))
        shaft = Shaft(float(length), float(outer), float(outer * rng.choice([0.0, 0.7])), float(modulus))
        count = int(np.ceil(length * rng.uniform(0.05, 1.0) / step_for(shaft, k)))
        if count <= 300 and k <= stiffest_resolved(shaft):
            return shaft, float(k), count


def test_halving_the_step_changes_little_whatever_is_declared(rng):
    """From any shaft to any tissue that it is not too thin for, also in layers: see `OF_BENDING`."""
    for one in range(24):
        shaft, stiffest, count = needle_and_tissue(rng)
        k = layers(rng, stiffest, count) if one % 2 else np.full(count, stiffest)
        alpha, step = np.full(count, np.radians(1.0)), step_for(shaft, stiffest)
        found = bevel_path(shaft, k, alpha, step)
        finer = bevel_path(shaft, np.repeat(k, 2), np.repeat(alpha, 2), step / 2)
        changed = np.abs(finer.cut_mm[2::2] - found.cut_mm[1:]) / finer.cut_mm[2::2]
        assert changed[16:].max(initial=0.0) < 0.015 and changed.max() < 0.03
        assert found.largest_mm[-1] == pytest.approx(finer.largest_mm[-1], rel=0.015)


def test_the_step_shortens_for_thin_needles_in_stiff_tissue_alone():
    """An 18G in tissue keeps 1 mm; a 25G in what is as stiff as rubber does not, nor a short one."""
    assert step_for(TUBE_18, 0.3) == step_for(TUBE_18, 0.0) == 1.0
    thin = Shaft(150.0, *GAUGES[25])
    assert step_for(thin, 10.0) == pytest.approx((4 * thin.bending_stiffness / 10.0) ** 0.25 / 16)
    assert step_for(thin, 10.0) < 0.3
    assert step_for(Shaft(10.0, 4.0), 1e-3) == pytest.approx(10 / 64)


def test_a_very_slender_shaft_needs_the_first_steps_most():
    """150 times as long as it bends over: 1.5 % would not hold in the first steps, and does from the sixteenth on."""
    shaft = Shaft(750.0, 0.3)
    k, alpha = np.full(64, stiffest_resolved(shaft)), np.full(64, np.radians(1.0))
    step = step_for(shaft, k[0])
    coarse = bevel_path(shaft, k, alpha, step).cut_mm[1:]
    finer = bevel_path(shaft, np.repeat(k, 2), np.repeat(alpha, 2), step / 2).cut_mm[2::2]
    changed = np.abs(finer - coarse) / finer
    assert changed.max() > 0.015 and changed.max() < 0.03 and changed[16:].max() < 0.015


@pytest.mark.parametrize("k", [0.05, 0.4])
def test_a_bevel_steers_a_long_needle_along_a_circle(k):
    """Far from the holder the path's curvature is 2 l alpha: l = (k / 4 EI)^(1/4), a tip that is held, without moment.

    With u = w - c in the shaft behind the tip, u = B exp(-l x) sin(l x), u''(0) = -kappa, alpha = u'(0) = kappa / 2 l.
    """
    shaft = Shaft(500.0, 1.27)
    found = path(1.0, k, depth=400, shaft=shaft).cut_mm
    rate = (k / (4 * shaft.bending_stiffness)) ** 0.25
    curvature = np.diff(found[-60:], 2).mean()
    assert curvature == pytest.approx(2 * rate * np.radians(1.0), rel=5e-3)


def test_the_path_is_linear_in_the_angle():
    """And a degree takes an 18G off by millimetres in 100 mm, the more the stiffer the tissue is."""
    none, one, three = path(0.0), path(1.0), path(3.0)
    assert not none.cut_mm.any() and not none.needle_mm.any()
    np.testing.assert_allclose(three.cut_mm, 3 * one.cut_mm, rtol=1e-9, atol=1e-12)
    ends = [path(1.0, k).cut_mm[-1] for k in (0.01, 0.1, 0.4)]
    assert 3 < ends[0] < ends[1] < ends[2] < 8


def test_a_needle_that_is_turned_comes_back():
    """By 180 degrees at 30 mm it ends on the other side, a little; the other way about it is the mirror image."""
    whole, turned = path(), path(turned_at=30)
    assert -0.3 * whole.cut_mm[-1] < turned.cut_mm[-1] < 0
    np.testing.assert_allclose(path(-3.0, turned_at=30).cut_mm, -turned.cut_mm, atol=1e-12)


def layers(rng, stiffest, count):
    """k of each step: the stiffest in one of five layers, a gap in another."""
    cuts = np.sort(rng.integers(0, count, 4))
    return stiffest * np.array([1.0, 0.0, 0.1, 0.5, 0.01])[rng.permutation(5)][np.searchsorted(cuts, np.arange(count))]


def test_a_needle_of_other_size_in_the_same_layers_goes_the_same_way(rng):
    """With lengths over 1 / rate and deflections over alpha / rate, neither EI nor k is left in the equations."""
    one, other = Shaft(120.0, 1.2), Shaft(300.0, 0.8, 0.4, 120.0)
    size = other.length_mm / one.length_mm
    k = layers(rng, 0.3, 60)
    scaled = k * other.bending_stiffness / one.bending_stiffness / size**4
    found = bevel_path(one, k, np.full(60, 0.01), 1.0)
    larger = bevel_path(other, scaled, np.full(60, 0.03), size)
    np.testing.assert_allclose(larger.cut_mm, 3 * size * found.cut_mm, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(larger.largest_mm, 3 * size * found.largest_mm, rtol=1e-6, atol=1e-9)


def test_in_given_layers_a_bevel_that_never_turns_goes_furthest(rng):
    """The path is linear in alpha, and what a bevel does at one depth alone never takes the tip to the other side."""
    shaft = Shaft(100.0, 1.0)
    for one in range(8):
        rate, count = np.exp(rng.uniform(np.log(0.01), np.log(0.4))), int(rng.integers(8, 33))
        stiffest, step = 4 * shaft.bending_stiffness * rate**4, min(0.125 / rate, 100.0 / count)
        k = layers(rng, stiffest, count) if one % 2 else np.full(count, stiffest)
        alone = np.array([bevel_path(shaft, k, alpha, step).cut_mm for alpha in np.eye(count)])
        assert alone.min() >= 0.0
        alpha = rng.uniform(-1, 1, count)
        np.testing.assert_allclose(alpha @ alone, bevel_path(shaft, k, alpha, step).cut_mm, atol=1e-6)


def test_no_order_of_layers_goes_beyond_the_bound(rng):
    """Random layers no stiffer than the stiffest, a bevel that turns at random, depths up to the longest."""
    tissues = [Tissue(k) for k in (0.01, 0.05, 0.3)]
    bound = deflection_bound(TUBE_18, np.radians(1.0), tissues, 100.0)
    for _ in range(12):
        count = int(rng.integers(10, 101))
        cuts = np.sort(rng.integers(0, count, 4))
        k = np.array([0.01, 0.05, 0.3, 0.0, 0.01])[rng.permutation(5)][np.searchsorted(cuts, np.arange(count))]
        alpha = np.radians(1.0) * (np.ones(count) if rng.random() < 0.5 else rng.choice([-1.0, 1.0], count))
        found = bevel_path(TUBE_18, k, alpha, step_for(TUBE_18, 0.3))
        assert found.largest_mm[-1] <= bound.at(count) - bound.sag_mm
    thin, per_mm = Shaft(266.0, *GAUGES[24]), 8  # the order that went nearly furthest beyond the stiffest tissue alone
    worst, alpha = np.repeat([48.9, 0.0], [2 * per_mm, 15 * per_mm]), np.full(17 * per_mm, np.radians(1.0))
    assert 1 / per_mm <= step_for(thin, 48.9)
    limit = deflection_bound(thin, np.radians(1.0), [Tissue(48.9)], 17.0)
    alone = bevel_path(thin, np.full(len(alpha), 48.9), alpha, 1 / per_mm).largest_mm[-1]
    furthest = bevel_path(thin, worst, alpha, 1 / per_mm).largest_mm[-1]
    assert 1.14 * alone < furthest <= limit.at(17.0) - limit.sag_mm
    most = beyond(MOST_SLENDER, 10.0)
    assert 0.18 < most < ALLOWANCE - 0.03  # the step's
    assert 0.0 < beyond(20.0, 3.0) < 0.02
    assert bound.at(100.0) > bound.at(50.0) > bound.at(0.0) == bound.sag_mm
    assert bound.at(101.0) == np.inf and np.isnan(bound.at(np.nan))


def energy_and_moment(shaft, k, path, step):
    """Of shaft and foundation once all of a path is cut, N mm, and the bending moment at the clamp, N mm."""
    elements, done = round(shaft.length_mm / step), len(k)
    foundation, rest = np.zeros(elements), np.zeros(elements + 1)
    foundation[elements - done :], rest[elements - done :] = k, path
    shape = Beam(shaft.bending_stiffness, step, elements).bent(foundation, rest, tip_mm=float(path[-1]))
    ends = np.stack([shape.deflection[:-1], shape.slope[:-1], shape.deflection[1:], shape.slope[1:]], axis=1)
    nodes, weights = np.polynomial.legendre.leggauss(4)
    t, h = (nodes + 1) / 2, step
    values = np.stack([1 - 3 * t**2 + 2 * t**3, h * (t - 2 * t**2 + t**3), 3 * t**2 - 2 * t**3, h * (t**3 - t**2)])
    curved = np.stack([12 * t - 6, h * (6 * t - 4), 6 - 12 * t, h * (6 * t - 2)]) / h**2
    off = ends @ values - rest[:-1, None] * (1 - t) - rest[1:, None] * t
    bent = shaft.bending_stiffness * (ends @ curved) ** 2
    stored = 0.5 * (h / 2 * weights * (bent + foundation[:, None] * off**2)).sum()
    start = np.array([-6.0, -4.0 * h, 6.0, -2.0 * h]) / h**2
    return float(stored), shaft.bending_stiffness * float(ends[0] @ start), shape.tip_force


def test_bevel_and_clamp_do_the_work_that_bends_a_needle(rng):
    """dW/ds = alpha F + M^2 / 2 EI in layers, the bevel turning: what the bound by energy rests on."""
    for step, near in ((1.0, 0.02), (0.5, 0.01)):
        count = round(90 / step)
        k = np.repeat([0.3, 0.0, 0.05], count // 3)
        alpha = np.radians(2.0) * np.where(np.arange(count) * step < 60.0, 1.0, -1.0)
        cut = bevel_path(TUBE_18, k, alpha, step).cut_mm
        each = [energy_and_moment(TUBE_18, k[:done], cut[: done + 1], step) for done in range(1, count + 1)]
        stored, moment, force = np.array(each).T
        work = step * np.cumsum(alpha * force + moment**2 / (2 * TUBE_18.bending_stiffness))
        assert stored[-1] > 0.05
        np.testing.assert_allclose(stored, work, atol=near * stored.max())


def test_every_order_of_layers_is_within_what_is_kept_and_within_what_is_proven(gauge=22, stiffest=0.1):
    """All 81 orders of three tissues in four layers, in 80 mm; the bound by energy holds, and is too wide to keep."""
    shaft, tissues = Shaft(150.0, *GAUGES[gauge]), (0.0, stiffest / 10, stiffest)
    most = in_every_order(shaft, tissues, 4, 80.0)
    assert 1.0 <= most < 1.0 + ALLOWANCE - 0.03
    count = int(np.ceil(80.0 / step_for(shaft, stiffest)))
    alone = bevel_path(shaft, np.full(count, stiffest), np.full(count, 0.01), 80.0 / count).largest_mm
    width = proven(shaft, 0.01, stiffest, 80.0)[1:] / alone[1:]
    assert width.min() > most
    assert 3.0 < width[-1] < 30.0
