"""The shaft and the beam against closed forms; the bevel's path against the laws that it must keep."""

import numpy as np
import pytest

from puncture_twin.planning.needle.beam import Beam
from puncture_twin.planning.needle.bevel_path import bevel_path
from puncture_twin.planning.needle.deflection import deflection_bound
from puncture_twin.planning.needle.shaft import GAUGES, Shaft
from puncture_twin.planning.needle.tissue import Tissue

SOLID_18 = Shaft(200.0, 1.27)
TUBE_18 = Shaft(150.0, *GAUGES[18])


def straight(elements):
    """A foundation that rests on the axis."""
    return np.zeros(elements + 1)


def test_a_cantilever_bends_as_euler_says():
    """P L^3 / 3 EI at the tip, and P L^2 / 2 EI its slope: cubic elements hold it exactly."""
    beam = Beam(SOLID_18.bending_stiffness, 2.0, 100)
    found = beam.bent(np.zeros(100), straight(100), tip_load=0.5)
    assert found.deflection[-1] == pytest.approx(0.5 * 200**3 / (3 * beam.stiffness), rel=1e-6)
    assert found.slope[-1] == pytest.approx(0.5 * 200**2 / (2 * beam.stiffness), rel=1e-6)
    assert found.deflection[-1] == pytest.approx(0.5 / SOLID_18.tip_stiffness_n_mm, rel=1e-6)


@pytest.mark.parametrize("k", [0.01, 0.1, 0.4])
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
    """Displacement and load are one answer, read from either side."""
    beam, foundation = Beam(SOLID_18.bending_stiffness, 1.0, 120), np.linspace(0, 0.2, 120)
    rest = 0.5 * np.sin(np.linspace(0, 2, 121))
    loaded = beam.bent(foundation, rest, tip_load=0.3)
    held = beam.bent(foundation, rest, tip_mm=float(loaded.deflection[-1]))
    np.testing.assert_allclose(held.deflection, loaded.deflection, atol=1e-9)
    assert held.tip_force == pytest.approx(0.3, rel=1e-6)


def test_a_shaft_in_a_stiff_foundation_lies_where_the_foundation_rests():
    """Whatever line that is, if it leaves the holder straight."""
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
    """And a bore is less than its needle."""
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
    """Halving the step changes its end by less than 1.5 %, and less each time."""
    ends = [path(step=step).cut_mm[-1] for step in (2.0, 1.0, 0.5, 0.25)]
    changes = np.abs(np.diff(ends)) / ends[-1]
    assert changes.max() < 0.015
    assert changes[2] < changes[1] < changes[0]


@pytest.mark.parametrize("k", [0.05, 0.1, 0.4])
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
    one, three = path(1.0), path(3.0)
    np.testing.assert_allclose(three.cut_mm, 3 * one.cut_mm, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(three.tip_force_n, 3 * one.tip_force_n, rtol=1e-6, atol=1e-9)
    ends = [path(1.0, k).cut_mm[-1] for k in (0.01, 0.1, 0.4)]
    assert 3 < ends[0] < ends[1] < ends[2] < 8


def test_a_needle_without_a_bevel_goes_straight():
    """Every term off gives nothing."""
    straight_on = path(0.0)
    assert not straight_on.cut_mm.any() and not straight_on.needle_mm.any() and not straight_on.tip_force_n.any()


def test_a_needle_that_is_turned_comes_back():
    """By 180 degrees at 30 mm it ends on the other side, a little; the other way about it is the mirror image."""
    whole, turned = path(), path(turned_at=30)
    assert -0.3 * whole.cut_mm[-1] < turned.cut_mm[-1] < 0
    np.testing.assert_allclose(path(-3.0, turned_at=30).cut_mm, -turned.cut_mm, atol=1e-12)


def test_no_order_of_layers_goes_beyond_the_bound(rng):
    """Random layers no stiffer than the stiffest, a bevel that turns at random, depths up to the longest."""
    tissues = [Tissue(k) for k in (0.01, 0.05, 0.3)]
    bound = deflection_bound(TUBE_18, np.radians(1.0), tissues, 100.0)
    for _ in range(12):
        count = int(rng.integers(10, 101))
        cuts = np.sort(rng.integers(0, count, 4))
        k = np.array([0.01, 0.05, 0.3, 0.0, 0.01])[rng.permutation(5)][np.searchsorted(cuts, np.arange(count))]
        alpha = np.radians(1.0) * (np.ones(count) if rng.random() < 0.5 else rng.choice([-1.0, 1.0], count))
        found = bevel_path(TUBE_18, k, alpha)
        assert found.largest_mm[-1] <= bound.at(count) - bound.sag_mm
    worst = np.repeat([48.9, 0.0], [2, 15])  # the order that went nearly furthest beyond the stiffest tissue alone
    thin, alpha = Shaft(266.0, *GAUGES[24]), np.full(17, np.radians(1.0))
    limit = deflection_bound(thin, np.radians(1.0), [Tissue(48.9)], 17.0)
    alone = bevel_path(thin, np.full(17, 48.9), alpha).largest_mm[-1]
    assert 1.17 * alone < bevel_path(thin, worst, alpha).largest_mm[-1] <= limit.at(17.0) - limit.sag_mm
    assert bound.at(100.0) > bound.at(50.0) > bound.at(0.0) == bound.sag_mm
    assert bound.at(101.0) == np.inf and np.isnan(bound.at(np.nan))
