"""Tissue that presses on a needle: the declared force over depth, friction at rest, the moment on the holder."""

import numpy as np
import pytest

from puncture_twin.planning.needle.deflection import Beam, Layer, Shaft, Tissue, bevel_path
from puncture_twin.planning.needle.insertion_force import insertion_force
from puncture_twin.planning.search.bending import Insertion
from puncture_twin.twin.plant.true_needle import SHIFT_MM, TrueTissue
from puncture_twin.twin.world.control import Tip

SHAFT = Shaft(150.0, 1.27, 0.84)
LAYERS = (Layer(0.0, 8.0, Tissue(0.1, 0.6, 0.01, 4.0, 5.0)), Layer(8.0, 60.0, Tissue(0.1, 0.9, 0.02, 2.0, 3.0)))
ENTRY, INTO = np.array([400.0, -50.0, 300.0]), np.array([0.6, 0.0, -0.8])
SIDE = 0.7
X, Y = np.array([0.8, 0.0, 0.6]), np.array([0.0, 1.0, 0.0])


def insertion():
    path = bevel_path(SHAFT, np.full(60, 0.1), np.full(60, 0.02), 1.0)
    return Insertion(path, insertion_force(LAYERS), np.inf, np.inf)


def tip(depth):
    R = np.column_stack([X, np.cross(INTO, X), INTO])
    return Tip((ENTRY + depth * INTO)[None] / 1e3, R[None], np.zeros((1, 6, 6)))


def pressed(tissue, depth):
    """The force (3,) and its moment about where the shaft is held, N and N mm."""
    pushes, held = tissue(tip(depth)), ENTRY + (depth - SHAFT.length_mm) * INTO
    force = sum(push.force_n for push in pushes)
    return force, sum(np.cross(1e3 * push.point_m - held, push.force_n) for push in pushes)


def tissue():
    return TrueTissue(insertion(), ENTRY, INTO, SIDE, SHAFT.length_mm)


def test_on_the_way_in_it_is_the_declared_force():
    """At every depth, capsules that rupture among them; nothing before the skin."""
    declared, new = insertion().force, tissue()
    assert not np.any(pressed(new, -3.0)[0])
    depths = np.linspace(0.0, 60.0, 1201)
    felt = np.array([-pressed(new, depth)[0] @ INTO for depth in depths])
    past = depths > SHIFT_MM
    np.testing.assert_allclose(felt[past], np.interp(depths, declared.depth_mm, declared.total_n)[past], atol=1e-9)
    assert new.greatest.along_n == pytest.approx(declared.peak_n, rel=1e-3)


def test_friction_holds_at_rest_and_turns_with_the_motion():
    """Nothing changes while nothing moves; back by two shifts, cutting is gone and friction pulls the other way."""
    new = tissue()
    for depth in np.arange(0.0, 30.05, 0.05):
        inward = pressed(new, depth)[0] @ INTO
    assert pressed(new, depth)[0] @ INTO == inward
    friction = np.interp(depth, insertion().force.depth_mm, insertion().force.friction_n)
    assert pressed(new, depth - 2 * SHIFT_MM)[0] @ INTO == pytest.approx(friction, rel=1e-6)
    assert inward == pytest.approx(-friction - 0.9, rel=1e-6)


def test_a_ruptured_capsule_stays_so():
    """Back out over its place, and in again: no second rupture."""
    new = tissue()
    for depth in (*np.arange(0.0, 7.0, 0.1), *np.arange(7.0, 1.0, -0.1)):
        pressed(new, depth)
    again = max(-pressed(new, depth)[0] @ INTO for depth in np.arange(1.0, 7.0, 0.1))
    assert again < 1.0


def test_across_it_is_what_the_beams_clamp_bears():
    """Force and moment, to the side of the bevel; nothing along it, nothing to the other side."""
    path, side = insertion().path, np.cos(SIDE) * X + np.sin(SIDE) * np.cross(INTO, X)
    for depth in (5.0, 30.0, 60.0):
        force, moment = pressed(tissue(), depth)
        assert force @ side == pytest.approx(path.holder_n[round(depth)])
        assert moment @ np.cross(INTO, side) == pytest.approx(path.holder_n_mm[round(depth)])
        assert force @ np.cross(INTO, side) == pytest.approx(0.0, abs=1e-12)
        assert moment @ side == pytest.approx(0.0, abs=1e-9)


def test_the_beams_clamp_bears_what_presses_on_it():
    """A cantilever's load and its moment; in a foundation the sum of what each length of it presses, by quadrature."""
    loaded = Beam(SHAFT.bending_stiffness, 1.0, 150).bent(np.zeros(150), np.zeros(151), tip_load=0.3)
    assert loaded.clamp_force == pytest.approx(0.3) and loaded.clamp_moment == pytest.approx(0.3 * 150)
    x, foundation = np.linspace(0.0, 150.0, 601), np.repeat([0.0, 0.08], [360, 240])
    rest = 2.0 * (x / 150.0) ** 3
    found = Beam(SHAFT.bending_stiffness, 0.25, 600).bent(foundation, rest, tip_mm=2.1)
    inside = slice(360, None)
    load = 0.08 * (rest - found.deflection)[inside]
    assert found.clamp_force == pytest.approx(np.trapezoid(load, x[inside]) + found.tip_force, abs=1e-5)
    whole = np.trapezoid(load * x[inside], x[inside]) + 150.0 * found.tip_force
    assert found.clamp_moment == pytest.approx(whole, abs=1e-3)
