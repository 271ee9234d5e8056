"""Directions of a needle that bends: what is rejected, and by how much; the tissues along a path."""

from dataclasses import replace

import numpy as np
import pytest
from case_world import ORGAN, SKIN, ball, case_text, structure, write_balls
from refusals import refused

from puncture_twin.planning.breathing.breathing import Breathing
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.certify.subdivision import certify
from puncture_twin.planning.clearance.fcl_engine import FclEngine
from puncture_twin.planning.formats.labels.naming import ByName
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.planning.search.bending import path_layers
from puncture_twin.planning.search.context import prepare
from puncture_twin.planning.search.search import organ_candidates
from puncture_twin.planning.search.table import to_table

NEEDLE = "length_mm = 210.0\nshaft_mm = 150.0\ndiameter_mm = 1.27\n"
BENT = NEEDLE + "gauge = 18\nbevel_deg = 2.0"
TISSUE = """[tissue."*"]
stiffness_n_mm2 = 0.05
cutting_n = 0.5
friction_n_mm = 0.01
capsule_n = 3.0
capsule_mm = 4.0
[tissue.organ]
stiffness_n_mm2 = 0.2
cutting_n = 0.9
friction_n_mm = 0.02
capsule_n = 1.0
capsule_mm = 2.0
"""


def written(folder, needle=BENT, tissue=TISSUE):
    write_balls(folder)
    ball(folder / "vessel.stl", 6.0, (-35, -25, 30))
    avoided = [structure("rib", "avoid", margin_mm=3.0), structure("vessel", "avoid", margin_mm=1.0)]
    search = "theta_deg = [0, 80]\nstep_deg = 5.0"
    (folder / "case.toml").write_text(case_text(tissue, SKIN, ORGAN, *avoided, needle=needle, search=search))
    return folder / "case.toml"


@pytest.fixture(scope="module")
def patient(tmp_path_factory):
    return prepare(written(tmp_path_factory.mktemp("bending")), arm=False, engine="fcl")


def searched(patient, **changes):
    case = replace(patient.case, **changes)
    return organ_candidates(case, patient.anatomy, patient.engine, case.directions())


def test_what_lacks_the_clearance_to_bend_is_rejected_and_nothing_else(patient):
    """The bound of each path's length beside every margin; today's columns but the verdict's stay."""
    straight, bent = searched(patient, bending=None), searched(patient)
    bound = patient.case.bending.bound(150.0)
    excess = (straight.clearance.by_structure - straight.clearance.margins)[:, 1:].min(axis=1)
    np.testing.assert_array_equal(bent.safe, straight.safe & (excess >= bound.at(straight.path.length)))
    assert 0 < bent.safe.sum() < straight.safe.sum()
    new = straight.safe & ~bent.safe
    assert set(bent.verdict.reason[new]) == {"needle_bends"}
    row = np.flatnonzero(new)[0]
    assert bent.verdict.amount[row] == straight.clearance.by_structure[row, 1:].min()
    assert f"{bent.deflection[row]:.2f} mm" in bent.verdict.detail[row]
    today, with_tissue = to_table(straight), to_table(bent)
    assert with_tissue.column_names == [*today.column_names, "deflection_bound_mm"]
    changed = {"verdict", "reason", "reason_structure", "reason_amount", "reason_detail", "window"}
    same = [name for name in today.column_names if name not in changed]
    assert with_tissue.select(same).equals(today.select(same))


def test_a_needle_that_bends_little_or_further_than_anything_is_clear_of(patient):
    bending = replace(patient.case.bending, alpha=0.0)
    found = searched(patient, bending=bending)
    known = np.isfinite(found.deflection)
    assert np.all(found.deflection[known] == bending.shaft.sag_mm)
    found = searched(patient, bending=replace(patient.case.bending, alpha=np.radians(30.0)))
    assert not found.safe.any() and "needle_bends" in found.verdict.reason
    with refused("not_certifiable"):
        certify(patient.case, patient.anatomy, size=0.1)


def test_a_body_that_breathes_is_checked_with_a_needle_that_bends(patient):
    weights = {"skin": 0.4, "rib": 0.0, "vessel": 0.5}
    breath = Breathing(25.0, np.array([0.0, 0.0, -1.0]), ByName(weights), 4, 2, 0.0, None)
    found = searched(patient, breathing=breath)
    safe = []
    for s in breath.positions:

        def moved(mesh, weight, s=s):
            return mesh.transformed(pose(np.eye(3), breath.moved_ct(s, weight)))

        structures = tuple(replace(o, mesh=moved(o.mesh, weights.get(o.name, 1.0))) for o in patient.anatomy.structures)
        skin = replace(patient.anatomy.skin, mesh=moved(patient.anatomy.skin.mesh, 0.4))
        case = replace(patient.case, target_ct=patient.case.target_ct + breath.moved_ct(s))
        anatomy = replace(patient.anatomy, structures=structures, skin=skin)
        engine = FclEngine([one.mesh for one in structures])
        safe.append(organ_candidates(case, anatomy, engine, case.directions()).safe)
    at_phases = np.all(safe, axis=0)
    assert not np.any(found.safe & ~at_phases)
    assert np.sum(at_phases & ~found.safe) < 0.01 * len(found)  # what passes between two of them
    assert 0 < found.safe.sum() < safe[0].sum()


def test_layers_are_those_of_the_path_and_a_check_says_how_far_it_bends(patient):
    outward = np.array([0.0, -1.0, 0.0])
    rest, organ = path_layers(patient.case.bending, patient.anatomy, np.zeros(3), outward, 90.0)
    assert (rest.start_mm, rest.end_mm) == (0.0, organ.start_mm) and organ.end_mm == 90.0
    assert organ.start_mm == pytest.approx(70.0, abs=1.0)
    assert (rest.tissue.capsule_n, organ.tissue.capsule_n) == (3.0, 1.0)
    explained = patient.explain(0.0, 0.0)
    told = explained.summary()["bending"]
    assert 0 < told["deflection_mm"] < told["deflection_bound_mm"]
    assert told["peak_force_n"] >= 3.0
    assert "are added to the margins" in explained.text() and "buckles at" in explained.text()


@pytest.mark.parametrize(
    ("needle", "tissue", "message"),
    [
        (BENT, "", "no_tissue"),
        (NEEDLE + "gauge = 18", TISSUE, "no_bevel"),
        (BENT, TISSUE.replace('"*"', "fat"), "no_tissue"),
        (BENT.replace("1.27", "1.2"), TISSUE, "gauge_contradicted 1.27"),
        (BENT.replace("gauge = 18", "gauge = 99"), TISSUE, "unknown_gauge"),
        (BENT.replace("gauge = 18", "solid = true"), TISSUE, "key_not_of_it"),
        (BENT.replace("2.0", "-2.0"), TISSUE, "bad_value bevel_deg"),
        (BENT, TISSUE.replace("capsule_mm = 4.0", "capsule_mm = 0.0"), "keys_together"),
        (BENT, TISSUE.replace("0.05", "-0.05"), "bad_value stiffness_n_mm2"),
        (BENT, TISSUE.replace("0.05", "1e9"), "bad_value stiffness_n_mm2"),
    ],
)
def test_half_a_declaration_is_refused(tmp_path, needle, tissue, message):
    with refused(*message.split()):
        load_case(written(tmp_path, needle, tissue))


def test_a_tissue_that_is_nowhere_is_refused(tmp_path):
    path = written(tmp_path, tissue=TISSUE.replace("tissue.organ", "tissue.orgn"))
    with refused("no_match", "orgn"):
        prepare(path, arm=False, engine="fcl")


def test_a_solid_shaft_of_the_stated_diameter_stands_for_a_gauge(tmp_path):
    """Where none is stated; and a solid gauge bends less than its tube."""
    plain = load_case(written(tmp_path, BENT.replace("gauge = 18\n", ""))).bending.shaft
    solid = load_case(written(tmp_path, BENT + "\nsolid = true\nmodulus_gpa = 193.0")).bending.shaft
    tube = load_case(written(tmp_path)).bending.shaft
    assert (plain.outer_mm, plain.inner_mm, plain.length_mm) == (1.27, 0.0, 150.0)
    assert solid.bending_stiffness / 193.0 == pytest.approx(plain.bending_stiffness / 200.0)
    assert tube.bending_stiffness < plain.bending_stiffness


def test_a_tissue_too_stiff_for_so_thin_a_shaft_is_refused(tmp_path):
    """It bends the shaft within a few steps of an insertion: no bound of its bending is known."""
    stiff = TISSUE.replace("stiffness_n_mm2 = 0.2", "stiffness_n_mm2 = 60.0")
    prepare(written(tmp_path, tissue=stiff), arm=False)
    thin = NEEDLE.replace("1.27", "0.3") + "bevel_deg = 2.0"
    with refused("tissue_too_stiff", "tissue.organ", "60", "2.5", "8.14"):
        prepare(written(tmp_path, needle=thin, tissue=stiff), arm=False)
