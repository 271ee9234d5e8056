"""The error budget: what each source costs against rooms drawn with it alone, and what changes must obey."""

from dataclasses import fields, replace

import numpy as np
import pytest
from budget_world import chain, drawn_trials
from places import ROOT
from refusals import refused_command

from puncture_twin.planning.anatomy.anatomy import load_skin
from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.base.cache.array_cache import user_cache
from puncture_twin.planning.budget.what_if import MOST_MARKERS, best_change, changes, source_costs
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.case.errors import ArmUncertainty
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.uncertainty.sources import reading_parts
from puncture_twin.run_twin import main

ABDOMEN_CASE, CARTON_CASE = "abdomen/case.toml", "carton/case_m_setup2.toml"
BEDS = {ABDOMEN_CASE: (0.0, 0.0, 1.0), CARTON_CASE: (1.0, 0.0, 0.0)}
"""Of each case, the direction across its slices."""
ABDOMEN = ROOT / "meshes" / "abdomen"
NOTHING = ArmUncertainty(**{field.name: 0.0 for field in fields(ArmUncertainty)})


@pytest.fixture(scope="module", params=BEDS)
def found(request):
    case = load_case(ROOT / "meshes" / request.param)
    skin = load_skin(case, user_cache()).mesh.vertices[::50]
    return chain(request.param), changes(chain(request.param), skin, np.array(BEDS[request.param]))


@pytest.mark.parametrize("name", BEDS)
def test_an_insertion_puts_the_tip_on_the_target(name):
    one = chain(name)
    flange = flange_pose(one.model, one.q_insertion)
    tip = flange[:3, 3] + one.tip_mm * flange[:3, 2]
    assert tip == pytest.approx(apply(one.T_base_ct, one.target_ct), abs=1e-6)


@pytest.mark.parametrize("name", BEDS)
def test_squares_of_the_sources_add_up(name):
    one = chain(name)
    costs = source_costs(one)
    assert sum(cost.alone_mm**2 for cost in costs) == pytest.approx(one.expected_mm() ** 2)
    assert all(np.hypot(cost.alone_mm, cost.without_mm) == pytest.approx(one.expected_mm()) for cost in costs)


def _alone(errors, source):
    nothing = replace(errors, marker_cov_ct=np.zeros((3, 3)), touch_mm=0.0, target_cov_ct=np.zeros((3, 3)), arm=NOTHING)
    if source in ("ct_slice", "ct_in_plane"):
        return replace(nothing, marker_cov_ct=reading_parts(errors.marker_cov_ct)[source])
    if source == "touch":
        return replace(nothing, touch_mm=errors.touch_mm)
    if source == "target":
        return replace(nothing, target_cov_ct=errors.target_cov_ct)
    name = f"{source}_mm" if source in ("link", "tip_offset") else source
    return replace(nothing, arm=replace(NOTHING, **{name: getattr(errors.arm, name)}))


SOURCES = ["ct_slice", "touch", "target", "link", "drift"]


@pytest.mark.parametrize(("name", "source"), [*((ABDOMEN_CASE, one) for one in SOURCES), (CARTON_CASE, "ct_slice")])
def test_rooms_drawn_with_one_source_err_as_it_costs(name, source):
    """Whole nonlinear chains, 4,000 of them: their rms is known to 1 %."""
    one = chain(name)
    rooms = drawn_trials(one, _alone(one.errors, source), 4000, np.random.default_rng(6))
    realised = np.sqrt(np.mean(np.sum((rooms.tip_ct - rooms.target_ct) ** 2, axis=1)))
    predicted = {cost.source: cost.alone_mm for cost in source_costs(one)}[source]
    assert realised == pytest.approx(predicted, rel=0.03)


def test_changes_obey_what_is_known_of_them(found):
    one, all_changes = found
    now, of = one.expected_mm(), {}
    for change in all_changes:
        of.setdefault(change.group, []).append(change.rms_mm)
    assert of["slices"] == sorted(of["slices"])
    assert of["arm"] == sorted(of["arm"])
    assert max(of["touches"]) <= now + 1e-9
    assert min(of["tip"]) <= now + 1e-9
    assert of["markers"][-1] < of["markers"][0]
    assert best_change(all_changes).rms_mm < now
    one, all_changes = found
    counts = [int(c.what.removeprefix("only ").split()[0]) for c in all_changes if c.group == "markers"]
    assert counts == [n for n in range(3, MOST_MARKERS + 1) if n != len(one.points_ct)]


def test_slices_as_they_are_change_nothing():
    """The carton's second setup has slices of 5 mm: the change to them is none, scaled as all errors are."""
    one = chain("carton/case_m_setup2.toml")
    same = [c for c in changes(one, np.empty((0, 3)), np.array([1.0, 0.0, 0.0])) if c.what == "slices of 5 mm"]
    assert same[0].rms_mm == pytest.approx(one.expected_mm())


def test_register_prints_the_budget_and_draws_it(tmp_path, run, capfd):
    """Each source, each change, and what wins most; a name that is no PNG's is refused in one line."""
    budget = run("register", ABDOMEN, "--picture", tmp_path / "budget.png")[1]["budget"]
    assert (tmp_path / "budget.png").read_bytes().startswith(b"\x89PNG")
    assert sum(one["alone_mm"] ** 2 for one in budget["sources"]) == pytest.approx(budget["expected_mm"] ** 2)
    across, along = budget["expected_lateral_mm"], budget["expected_depth_mm"]
    assert across**2 + along**2 == pytest.approx(budget["expected_mm"] ** 2) and 0 < along < across
    assert budget["best"]["expected_mm"] == min(one["expected_mm"] for one in budget["changes"])
    assert main(["register", str(ABDOMEN)]) == 0 and "mm would be gained by" in capfd.readouterr().out
    line = refused_command(["register", ABDOMEN, "--picture", tmp_path / "budget.txt"], capfd, "bad_file_name")
    assert "not the name of a PNG file" in line
