"""Directions of a body that breathes, against a plain oracle that moves every mesh and searches anew at each phase."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from case_world import ORGAN, SKIN, ball, case_text, structure, write_balls
from refusals import refused

from puncture_twin.meshes import folder
from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.skin import skin_paths
from puncture_twin.planning.breathing.breathing import Breathing
from puncture_twin.planning.case.settings import Obstacle
from puncture_twin.planning.certify.subdivision import certify
from puncture_twin.planning.clearance.fcl_engine import FclEngine
from puncture_twin.planning.collision.workcell import case_checker, with_surroundings
from puncture_twin.planning.formats.labels.naming import ByName
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.planning.search.constraints import ArmReach, with_reach
from puncture_twin.planning.search.context import prepare
from puncture_twin.planning.search.phases import with_breathing_reach
from puncture_twin.planning.search.search import organ_candidates
from puncture_twin.planning.search.table import to_table
from puncture_twin.run_twin import main
from puncture_twin.twin.jobs.patient.main_job import CertifyOptions, search_case

SEARCH = "theta_deg = [0, 80]\nstep_deg = 10.0\nmax_skin_angle_deg = 25.0"
WEIGHTS = {"skin": 0.4, "rib": 0.0, "vessel": 0.7, "dome": 1.4}


@pytest.fixture(scope="module")
def patient(tmp_path_factory):
    folder = tmp_path_factory.mktemp("breathing")
    write_balls(folder)
    ball(folder / "vessel.stl", 6.0, (-35, -25, 30))
    ball(folder / "dome.stl", 8.0, (5, -45, -35))
    names = ("rib", "vessel", "dome")
    avoided = [structure(name, "avoid", margin_mm=margin) for name, margin in zip(names, (3.0, 1.0, 2.0), strict=True)]
    (folder / "case.toml").write_text(case_text(SKIN, ORGAN, *avoided, search=SEARCH))
    return prepare(folder / "case.toml", arm=False, engine="fcl")


def breathing(**keys):
    direction = np.array([0.1, -0.2, -1.0])
    usual = {"amplitude_mm": 30.0, "direction_ct": direction / np.linalg.norm(direction), "weights": ByName(WEIGHTS)}
    return Breathing(**{**usual, "phases": 8, "exponent": 2, "scanned_at": 0.0, "gate": None, **keys})


def searched(patient, breath=None, case=None, anatomy=None):
    case, anatomy = replace(case or patient.case, breathing=breath), anatomy or patient.anatomy
    engine = FclEngine([one.mesh for one in anatomy.checked])
    return organ_candidates(case, anatomy, engine, case.directions())


@pytest.fixture(scope="module")
def static(patient):
    return searched(patient)


@pytest.fixture(scope="module")
def every(patient):
    return searched(patient, breathing())


def moved_body(patient, breath, s):
    def moved(mesh, weight):
        return mesh.transformed(pose(np.eye(3), breath.moved_ct(s, weight)))

    structures = tuple(
        replace(one, mesh=moved(one.mesh, 1.0 if one.name == "organ" else WEIGHTS[one.name]))
        for one in patient.anatomy.structures
    )
    skin = replace(patient.anatomy.skin, mesh=moved(patient.anatomy.skin.mesh, WEIGHTS["skin"]))
    case = replace(patient.case, target_ct=patient.case.target_ct + breath.moved_ct(s))
    return case, Anatomy(structures, skin, ())


@pytest.mark.parametrize(("gate", "scanned_at"), [(None, 0.0), (0.4, 0.6)])
def test_phases_are_those_of_a_body_that_is_moved_and_searched_anew(patient, static, gate, scanned_at):
    breath = breathing(gate=gate, scanned_at=scanned_at)
    found = searched(patient, breath)
    anew = [searched(patient, None, *moved_body(patient, breath, s)) for s in breath.positions]
    safe = np.array([one.safe for one in anew])
    window = breath.in_window
    np.testing.assert_array_equal(found.safe, static.safe & safe[window].all(axis=0))
    np.testing.assert_array_equal(found.breathing.safe_all_phases, static.safe & safe.all(axis=0))
    least = np.array([one.clearance.least for one in anew])[window][:, static.safe]
    np.testing.assert_allclose(found.breathing.clearance[static.safe], least.min(axis=0), atol=1e-9)
    excess = np.array([(one.clearance.by_structure - one.clearance.margins)[:, 1:].min(axis=1) for one in anew])[window]
    entered = found.safe
    worst = breath.positions[window][excess[:, entered].argmin(axis=0)]
    np.testing.assert_array_equal(found.breathing.worst_phase[entered], worst)
    assert np.isnan(found.breathing.clearance[~static.safe]).all()


def test_what_passes_the_needle_between_two_positions_is_found(patient, static):
    """Two positions 30 mm apart: what is safe is so at 61 between, what is not comes nearer than a tenth somewhere."""
    breath = breathing(phases=2)
    found = searched(patient, breath)
    between = np.linspace(0, 1, 61)
    anew = [searched(patient, None, *moved_body(patient, breath, s)) for s in between]
    safe = np.array([one.safe for one in anew])
    assert not np.any(found.safe & ~safe.all(axis=0))
    ends = static.safe & safe[0] & safe[-1]
    assert np.sum(ends & ~safe.all(axis=0)) > 0  # the example has some that only the way between rejects
    lost = ends & ~found.safe & safe.all(axis=0)
    excess = np.min([(one.clearance.by_structure - one.clearance.margins)[:, 1:].min(axis=1) for one in anew], axis=0)
    assert np.all(excess[lost] < 0.1 + 30.0 * 1.4 / 60 / 2)


def test_a_breath_only_takes_away_and_says_where_and_when(patient, static, every):
    gated = searched(patient, breathing(gate=0.4))
    assert 0 < every.safe.sum() < gated.safe.sum() < static.safe.sum()
    assert not np.any(every.safe & ~gated.safe) and not np.any(gated.safe & ~static.safe)
    np.testing.assert_array_equal(gated.breathing.safe_all_phases, every.safe)
    found = every
    new = static.safe & ~found.safe
    assert set(found.verdict.reason[new]) == {"unsafe_when_breathing"}
    hit = [row for row in np.flatnonzero(new) if "hits a structure" in found.verdict.detail[row]]
    assert hit and all(found.verdict.structure[row] in {"rib", "vessel", "dome"} for row in hit)
    margins = dict(zip(found.clearance.structures, found.clearance.margins, strict=True))
    for row in hit:
        assert found.verdict.detail[row].startswith("at s = ")
        assert not found.verdict.amount[row] >= margins[found.verdict.structure[row]]
    before = ~static.safe
    np.testing.assert_array_equal(found.verdict.reason[before], static.verdict.reason[before])
    assert every.safe_text.endswith("at each phase if inserted at that phase")
    assert gated.safe_text.endswith("when gated to this window (s <= 0.4)")
    assert "stay" not in every.safe_text


@pytest.mark.parametrize("breath", [breathing(amplitude_mm=0.0), breathing(phases=1), breathing(gate=0.0)])
def test_a_body_that_does_not_move_keeps_its_map(patient, static, breath):
    """No amplitude, one phase, or a gate at exhale, where the CT was taken: all of today's columns, to the last bit."""
    found = searched(patient, breath)
    today, moving = to_table(static), to_table(found)
    assert moving.select(today.column_names).equals(today)
    assert moving.column_names[len(today.column_names) :] == [
        "safe_all_phases",
        "worst_phase",
        "breathing_clearance_mm",
    ]


def test_a_weight_for_the_targets_own_structure_is_refused_unless_it_is_one(patient):
    with refused("breathing_weight"):
        searched(patient, breathing(weights=ByName({**WEIGHTS, "organ": 0.5})))
    rest = searched(patient, breathing(weights=ByName({"*": 0.0})))
    stated = searched(patient, breathing(weights=ByName({"*": 0.0, "organ": 1.0})))
    np.testing.assert_array_equal(rest.safe, stated.safe)


def test_a_breath_that_takes_the_target_out_of_the_skin_leaves_nothing_safe(patient):
    found = searched(patient, breathing(amplitude_mm=95.0, weights=ByName({"*": 0.0})))
    assert not found.safe.any()


def test_where_nothing_is_safe_before_the_breath_nothing_is_safe_with_it(patient, tmp_path, capfd):
    strict = replace(patient.case, needle=replace(patient.case.needle, shaft_mm=30.0))
    found = searched(patient, breathing(), case=strict)
    assert not found.safe.any() and np.array_equal(found.verdict.reason, searched(patient, case=strict).verdict.reason)
    assert np.isnan(found.breathing.clearance).all()
    folder = patient.case.path.parent
    weights = "".join(f'"{name}" = {weight}\n' for name, weight in WEIGHTS.items())
    text = (folder / "case.toml").read_text().replace("shaft_mm = 150.0", "shaft_mm = 30.0")
    path = folder / "strict.toml"
    path.write_text(f"{text}[breathing]\namplitude_mm = 30.0\n[breathing.weights]\n{weights}")
    assert main(["search", str(path), "--no-arm", "--no-pictures", "--out", str(tmp_path / "out")]) == 1
    assert "Traceback" not in capfd.readouterr().err


def test_a_certificate_refuses_a_body_that_moves_before_a_search(patient, tmp_path):
    with refused("not_certifiable"):
        certify(replace(patient.case, breathing=breathing()), patient.anatomy, size=0.1)
    context = replace(patient, case=replace(patient.case, breathing=breathing()))
    with refused("not_certifiable"):
        search_case(context, tmp_path / "out", certify=CertifyOptions(1.0, None))
    assert not (tmp_path / "out").exists()


def test_the_arm_is_checked_where_the_breath_puts_target_and_skin():
    context = prepare(folder() / "carton" / "case_m.toml")
    weights = ByName({"*": 0.5})
    breath = breathing(amplitude_mm=60.0, weights=weights, direction_ct=np.array([1.0, 0, 0]), phases=2)
    settings = replace(context.case.search, step=np.radians(15.0))
    case = replace(context.case, breathing=breath, search=settings)
    base = context.placement.T_base_ct
    organs = organ_candidates(case, context.anatomy, context.engine, case.directions())
    static = with_reach(case, organs, context.reach)
    found = with_breathing_reach(case, case.breathing, context.anatomy, static, context.reach)
    there = replace(case, target_ct=case.target_ct + breath.moved_ct(1.0), breathing=None)
    moved = pose(np.eye(3), breath.moved_ct(1.0, 0.5))
    skin = context.anatomy.skin
    body = replace(context.anatomy, skin=replace(skin, mesh=skin.mesh.transformed(moved)))
    paths = skin_paths(body.skin, there.target_ct, organs.outward_ct, case.needle.length_mm)
    path = replace(organs.path, length=paths.path_length, skin_angle=paths.skin_angle)
    oracle = with_reach(there, replace(static, path=path), ArmReach(partial(case_checker, there, body, base), base))
    np.testing.assert_array_equal(found.safe, static.safe & oracle.safe)
    assert 0 < found.safe.sum() < static.safe.sum()
    new = static.safe & ~found.safe
    assert set(found.verdict.reason[new]) == {"unsafe_when_breathing"}
    assert all("arm" in detail or "insertion" in detail for detail in found.verdict.detail[new])


@pytest.mark.parametrize("frame", ["ct", "base"])
def test_the_arm_is_checked_against_an_obstacle_where_its_stated_weight_puts_it(frame):
    context = prepare(folder() / "carton" / "case_m.toml")
    base, by = context.placement.T_base_ct, np.array([60.0, 0.0, 0.0])
    weights = ByName({"*": 1.0, "box": 2.0})
    breath = breathing(amplitude_mm=60.0, weights=weights, direction_ct=by / 60, phases=2)
    at = np.array([-150.0, 130.0, 400.0])
    center, shift = (at, 2 * by) if frame == "ct" else (base[:3, :3] @ at + base[:3, 3], 2 * base[:3, :3] @ by)
    box = Obstacle("box", frame, center, np.array([60.0, 200.0, 200.0]))
    search = replace(context.case.search, step=np.radians(15.0))
    bare = replace(context.case, breathing=breath, search=search)
    case = replace(bare, obstacles=(*bare.obstacles, box))
    anatomy = with_surroundings(replace(context.anatomy, surroundings=()), case, base)
    organs = organ_candidates(replace(bare, breathing=None), context.anatomy, context.engine, bare.directions())
    static = with_reach(case, organs, ArmReach(partial(case_checker, case, anatomy, base), base))
    found = with_breathing_reach(
        case, case.breathing, anatomy, static, ArmReach(partial(case_checker, case, anatomy, base), base)
    )
    skin = anatomy.skin
    body = replace(anatomy, skin=replace(skin, mesh=skin.mesh.transformed(pose(np.eye(3), by))))

    def with_box_at(center_mm):
        there = replace(case, target_ct=case.target_ct + by)
        there = replace(there, obstacles=(*bare.obstacles, replace(box, center_mm=center_mm)))
        return static.safe & with_reach(there, static, ArmReach(partial(case_checker, there, body, base), base)).safe

    np.testing.assert_array_equal(found.safe, with_box_at(center + shift))
    assert np.any(with_box_at(center) & ~found.safe)  # a box that stayed would have left them safe
    assert found.safe.any()
