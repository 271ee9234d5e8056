"""The experiment drawn anew: which declaration of its errors the paper's own points allow."""

from itertools import combinations

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from typer.testing import CliRunner

from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.fits import fit_rigid
from puncture_twin.run_twin import app
from puncture_twin.twin.experiment.chen2019 import (
    AS_FOUND,
    AS_STATED,
    NAMES,
    POINTS,
    READ,
    SETUPS,
    STRAINS,
    Declaration,
    chi_squared,
    find_skew,
    measured,
    paper_strains,
    printed_errors,
    rigid_residuals,
    rows_of,
    run_draws,
    several_triads,
    spread_of,
)

PRINTED = {
    "L by A-B-C, setup 1": 2.99,
    "M by A-B-C, setup 1": 2.94,
    "H by A-B-C, setup 1": 2.99,
    "mean residual of A-B-C, setup 1": 1.43,
    "M by A-B-C, setup 2": 2.38,
    "M by A-B-E, setup 2": 2.47,
    "M by A-C-D, setup 2": 7.17,
    "M by A-B-C-E (affine), setup 2": 3.55,
    "M by A-B-C-D-E (affine), setup 2": 2.48,
}
"""Chen 2019, Tables 3, 5, 6 and 7, mm."""


def test_the_paper_s_points_give_its_printed_errors():
    """To the two decimals that it prints."""
    found = {name: float(value[0]) for name, value in printed_errors(measured()).items()}
    assert found == pytest.approx(PRINTED, abs=0.0101)


def test_the_stated_errors_are_rejected_and_those_found_are_not():
    """All printed errors lie within either's range: only all points together tell the two apart."""
    stated, found = (run_draws(one, 1000, np.random.default_rng(4)) for one in (AS_STATED, AS_FOUND))
    assert all(row.within((5, 95)) for row in stated.printed)
    assert stated.rejected and not found.rejected and found.agrees


def test_several_triads_are_what_one_after_the_other_gives():
    """A plain loop over experiments and triads; a triad by Chen's equations 1 to 9, written out."""
    touched = READ + np.random.default_rng(0).normal(0.0, 0.5, (20, 8, 3))
    found, lesion = several_triads(touched), NAMES.index("M")
    for row, points in enumerate(touched):
        images = {}
        for names in combinations("ABCDE", 3):
            ct, base = (axes_of(side[rows_of("".join(names))]) for side in (READ, points))
            rows = rows_of("".join(names))
            R = base @ ct.T
            images["-".join(names)] = R @ READ[lesion] + np.mean(points[rows] - READ[rows] @ R.T, axis=0)
        off = {name: np.linalg.norm(image - points[lesion]) for name, image in images.items()}
        assert found["one of all 10 triads, rms"][row] == pytest.approx(np.sqrt(np.mean(np.square([*off.values()]))))
        mean = np.mean([*images.values()], axis=0)
        assert found["mean of the points of all triads"][row] == pytest.approx(np.linalg.norm(mean - points[lesion]))
        for name in ("best", "worst"):
            key = next(one for one in found if one.startswith(f"the {name}"))
            assert found[key][row] == pytest.approx(off[key.split(", ")[1]])


def axes_of(points):
    first = points[1] - points[0]
    third = np.cross(first, points[2] - points[0])
    e1, e3 = first / np.linalg.norm(first), third / np.linalg.norm(third)
    return np.column_stack([e1, np.cross(e3, e1), e3])


def test_all_markers_are_worth_more_than_any_triad():
    """Of touches that err alike: the rigid fit as its law says, below the best triad, the mean, and one of them."""
    touched = READ + np.random.default_rng(1).normal(0.0, 0.5, (20_000, 8, 3))
    rms = {name.split(",")[0]: np.sqrt(np.mean(off**2)) for name, off in several_triads(touched).items()}
    law = 0.5 * np.hypot(spread_of(READ[rows_of("ABCDE")], READ[rows_of("M")]), np.sqrt(3.0))  # and the lesion's touch
    every = rms.pop("rigid fit of all five markers")
    assert every == pytest.approx(law, rel=0.02)
    assert every < min(rms.values()) and rms.pop("the worst-placed triad") > 2.0 * max(rms.values())


@pytest.mark.parametrize("touch_mm", [0.1, 0.35, 1.0])
def test_no_touch_noise_saves_the_slices(touch_mm):
    """Marginals hold for any of them, and the joint statistics for none."""
    found = run_draws(Declaration("slices", 5.0, 1.0, touch_mm=touch_mm), 1000, np.random.default_rng(4))
    assert not found.agrees


def test_chi_squared_follows_its_law_where_the_declaration_is_right():
    """Of normal errors: mean 24, variance 48."""
    normal = Declaration("normal", reading_mm=0.5, skew=np.radians(2.0), touch_mm=0.35)
    rng = np.random.default_rng(9)
    carton = normal.draw_carton(READ, 4000, rng)
    drawn = chi_squared(rigid_residuals(tuple(normal.draw_touches(carton, rng) for _ in SETUPS)), normal)
    assert drawn.mean() == pytest.approx(24.0, abs=4 * np.sqrt(48 / len(drawn)))
    assert drawn.var() == pytest.approx(48.0, rel=0.15)


def test_strains_by_a_search_that_fits_anew():
    """The linear gain against one over k with a rigid fit at every step."""
    for name, gain in paper_strains().items():
        moved, along = STRAINS[name]
        best = minimize_scalar(_squares, args=(moved, along), bounds=(-0.2, 0.2), method="bounded").fun
        assert gain == pytest.approx(1 - best / _squares(0.0, 0, 0), abs=0.003), name


def _squares(k, moved, along):
    total = 0.0
    for names, touched in zip(POINTS, SETUPS, strict=True):
        read = READ[rows_of(names)].copy()
        read[:, moved] += k * READ[rows_of(names)][:, along]
        base = np.array([touched[name] for name in names])
        total += np.sum((apply(fit_rigid(read, base), read) - base) ** 2)
    return total


def test_the_skew_of_setup_2_s_markers_brings_setup_1_s_lesions_nearer():
    """Markers that never saw these lesions: 2.99, 2.94 and 2.99 mm become 1.28, 1.39 and 1.67."""
    found = find_skew()
    assert np.degrees(found.angle) == pytest.approx(1.84, abs=0.01)
    first = np.array(list(found.lesions.values())[:3])
    assert first == pytest.approx(np.transpose([[2.99, 2.94, 2.99], [1.28, 1.39, 1.67]]), abs=0.01)


def test_the_command_prints_the_finding_and_knows_one_experiment():
    """Exit 0 where the declarations come out as they should; other papers are refused in one line."""
    done = CliRunner().invoke(app, ["reproduce", "chen2019", "--experiment", "--seeds", "200"])
    assert done.exit_code == 0 and "REJECTED" in done.stdout and "2.99 -> 1.28 mm" in done.stdout
    refused = CliRunner().invoke(app, ["reproduce", "liu2007", "--experiment"])
    assert "has no experiment" in str(refused.exception)
