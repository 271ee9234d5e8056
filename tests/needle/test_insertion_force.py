"""The force of an insertion, and where the arm's work goes."""

from dataclasses import replace

import numpy as np
import pytest

from puncture_twin.planning.needle.deflection import Layer, Tissue
from puncture_twin.planning.needle.insertion_force import insertion_force, pushed

SKIN = Tissue(0.1, cutting_n=0.6, friction_n_mm=0.01, capsule_n=4.0, capsule_mm=5.0)
FAT = Tissue(0.02, cutting_n=0.3, friction_n_mm=0.005)
LIVER = Tissue(0.1, cutting_n=0.9, friction_n_mm=0.02, capsule_n=2.0, capsule_mm=3.0)
PATH = [Layer(0.0, 8.0, SKIN), Layer(8.0, 25.0, FAT), Layer(25.0, 80.0, LIVER)]


def work_n_mm(found):
    return float(np.trapezoid(found.total_n, found.depth_mm))


def energies_n_mm(layers):
    """Work of rupture, cutting and friction: the integrals of the three in closed form."""
    pushes, rupture, cutting, friction, end = [], 0.0, 0.0, 0.0, layers[-1].end_mm
    for layer in layers:  # what lies within the reach of a capsule that ruptures goes with it
        tissue, start = layer.tissue, layer.start_mm
        if tissue.capsule_n > 0 and tissue.capsule_mm > 0 and start >= (pushes[-1][1] if pushes else 0.0):
            pushes.append((start, min(start + tissue.capsule_mm, end)))
            rupture += tissue.capsule_n * (pushes[-1][1] - start) ** 3 / (3 * tissue.capsule_mm**2)  # of P (x / d)^2
    for layer in layers:
        length = layer.end_mm - layer.start_mm
        friction += layer.tissue.friction_n_mm * (length**2 / 2 + length * (end - layer.end_mm))
        cutting += layer.tissue.cutting_n * length
        for first, last in pushes:  # nothing is cut, and the shaft inside does not grow
            low, reached = max(first, layer.start_mm), min(last, layer.end_mm)
            if reached > low:
                cutting -= layer.tissue.cutting_n * (reached - low)
                unfelt = (reached - low) ** 2 / 2 + (reached - low) * (last - reached)  # rising inside, then constant
                friction -= layer.tissue.friction_n_mm * unfelt
    return rupture, cutting, friction


def test_the_arms_work_goes_into_rupture_cutting_and_friction():
    """To 1 %: the sampled force integrated, beside the three integrals in closed form; and it converges."""
    found, finer, energies = insertion_force(PATH), insertion_force(PATH, 0.01), energies_n_mm(PATH)
    assert work_n_mm(found) == pytest.approx(sum(energies), rel=0.01)
    assert abs(work_n_mm(finer) - sum(energies)) < 0.2 * abs(work_n_mm(found) - sum(energies))
    for part, energy in zip((finer.capsule_n, finer.cutting_n, finer.friction_n), energies, strict=True):
        assert np.trapezoid(part, finer.depth_mm) == pytest.approx(energy, rel=0.01)


def test_layers_at_random_keep_the_balance(rng):
    """Thin ones, capsules that reach beyond their layer, and a target within a capsule's reach."""
    for _ in range(40):
        ends = np.cumsum(rng.uniform(0.5, 20.0, 5))
        layers, start = [], 0.0
        for end in ends:
            numbers = rng.uniform(0.1, 2.0, 2) * [1.0, 0.02]
            capsule = (rng.uniform(0.5, 5.0), rng.uniform(0.5, 8.0)) if rng.random() < 0.6 else (0.0, 0.0)
            layers.append(Layer(start, float(end), Tissue(0.1, *numbers, *capsule)))
            start = float(end)
        found = insertion_force(layers, 0.01)
        assert work_n_mm(found) == pytest.approx(sum(energies_n_mm(layers)), rel=0.01)


@pytest.mark.parametrize(
    ("tissue", "zero"),
    [
        (Tissue(0.1, 0.9, 0.02), "capsule_n"),
        (Tissue(0.1, 0.0, 0.02, 4.0, 5.0), "cutting_n"),
        (Tissue(0.1, 0.9, 0.0, 4.0, 5.0), "friction_n"),
    ],
)
def test_each_term_can_be_off(tissue, zero):
    found = insertion_force([Layer(0.0, 50.0, tissue)])
    parts = {name: getattr(found, name) for name in ("capsule_n", "cutting_n", "friction_n")}
    assert not parts.pop(zero).any()
    assert all(part.any() for part in parts.values())


def test_a_capsule_gives_way_at_its_force():
    found = insertion_force(PATH, 0.01)
    assert found.capsule_n.max() == pytest.approx(4.0)
    assert found.peak_n == pytest.approx(4.0)
    behind = (found.depth_mm > 5.01) & (found.depth_mm < 8.0)
    assert not found.capsule_n[behind].any() and np.all(found.cutting_n[behind] == 0.6)


def test_nothing_to_pass_needs_no_force():
    assert insertion_force([]).peak_n == 0.0


def test_a_held_tissue_is_pushed_by_its_own_forces_over_its_stiffness():
    """K s = cutting + friction over the length inside it, as a pencil has it; what is before it does not push."""
    skin, liver = Tissue(0.05, friction_n_mm=0.1, capsule_n=3.0, capsule_mm=4.0), Tissue(0.05, 0.5, 0.02, held_n_mm=0.8)
    layers = [Layer(0.0, 30.0, skin), Layer(30.0, 70.0, liver), Layer(70.0, 80.0, skin)]
    found = pushed(layers, 60.0)
    at = np.array([0.0, 20.0, 29.9, 30.1, 45.0, 60.0])
    by_hand = np.where(at < 30.0, 0.0, (0.5 + 0.02 * (at - 30.0)) / 0.8)
    np.testing.assert_allclose(found.at(at), by_hand, atol=1e-9)
    assert found.target_mm == 60.0 and found.at(90.0) == found.at(80.0)
    assert pushed([Layer(0.0, 30.0, liver), Layer(30.0, 70.0, skin)], 60.0) is None
    capsule = replace(liver, capsule_n=2.0, capsule_mm=5.0)
    rising = pushed([Layer(0.0, 30.0, skin), Layer(30.0, 70.0, capsule)], 60.0)
    assert rising.at(35.0) == pytest.approx(2.0 / 0.8) and rising.at(35.2) == pytest.approx((0.5 + 0.02 * 5.2) / 0.8)
