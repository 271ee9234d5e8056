"""Sides, order and Hounsfield units that names promise."""

from dataclasses import replace

import numpy as np
import pytest
from placed_trunk import moved, write_trunk

from puncture_twin.planning.anatomy.structure import Role, Structure
from puncture_twin.planning.base.errors import Severity
from puncture_twin.planning.evidence.named_places import TISSUES, densities, order_of_organs
from puncture_twin.planning.search.context import prepare


@pytest.fixture(scope="module")
def trunk(tmp_path_factory):
    return prepare(write_trunk(tmp_path_factory.mktemp("trunk"), np.eye(4)), arm=False)


def mirrored(context, axis):
    """Its anatomy with all structures mirrored along an LPS axis, the CT where it was."""
    flip = np.eye(4)
    flip[axis, axis] = -1.0
    structures = tuple(replace(one, mesh=one.mesh.transformed(flip)) for one in context.anatomy.structures)
    return replace(context.anatomy, structures=structures)


def test_organs_in_order_say_nothing(trunk):
    assert list(order_of_organs(trunk.case, trunk.anatomy)) == []


@pytest.mark.parametrize(("axis", "pairs"), [(0, 2), (1, 2)])
def test_a_mirror_image_is_refused(trunk, axis, pairs):
    """Left and right exchanged, or front and back: every pair contradicts."""
    found = list(order_of_organs(trunk.case, mirrored(trunk, axis)))
    assert [one.severity for one in found] == [Severity.REFUSAL]
    assert found[0].code == "organs_out_of_order"
    assert found[0].numbers["wrong"] == found[0].numbers["pairs"] >= pairs


def test_one_pair_of_several_is_a_warning(trunk):
    """Two kidneys whose names are exchanged, in a body whose liver lies right: names, no mirror image."""
    names = {"kidney_left": "kidney_right", "kidney_right": "kidney_left"}
    renamed = tuple(replace(one, name=names.get(one.name, one.name)) for one in trunk.anatomy.structures)
    found = list(order_of_organs(trunk.case, replace(trunk.anatomy, structures=renamed)))
    assert [one.severity for one in found] == [Severity.WARNING]


@pytest.mark.parametrize(
    "places",
    [
        {"femoral_artery_right": (40, 0, 0), "femoral_artery_left": (-40, 0, 0), "femoral_vein_right": (44, 0, 9),
         "femoral_vein_left": (-44, 0, 9), "tibia_right": (50, 0, 30), "tibia_left": (-50, 0, 30)},
        {"femur_right": (-40, -60, 60), "femur_left": (40, -60, 60), "hip_right": (-40, 0, 0), "hip_left": (40, 0, 0)},
    ],
    ids=["crossed", "drawn up"],
)  # fmt: skip
def test_legs_are_one_witness(trunk, places):
    """Crossed or drawn up they take bones, arteries and veins of both sides along: doubted, and not refused."""
    ball = next(one for one in trunk.anatomy.structures if one.name == "kidney_left")
    middle = ball.mesh.bounds.mean(axis=0)
    legs = tuple(
        replace(ball, name=name, mesh=ball.mesh.transformed(moved(*(np.array(place) - middle))))
        for name, place in places.items()
    )
    found = list(order_of_organs(trunk.case, replace(trunk.anatomy, structures=legs)))
    assert [one.severity for one in found] == [Severity.WARNING]


def test_bones_that_are_none_are_doubted(trunk):
    """The vertebrae 40 mm in front of where the CT shows them; in place, nothing is said."""
    assert list(densities(trunk.case, trunk.anatomy, on_edges=False)) == []
    off = tuple(
        replace(one, mesh=one.mesh.transformed(moved(0.0, -40.0, 0.0))) if one.name == "vertebrae" else one
        for one in trunk.anatomy.structures
    )
    anatomy = replace(trunk.anatomy, structures=off)
    found = list(densities(trunk.case, anatomy, on_edges=False))
    assert [(one.code, one.severity) for one in found] == [("densities", Severity.WARNING)]
    assert [one.severity for one in densities(trunk.case, anatomy, on_edges=True)] == [Severity.NOTE]
    phantom = replace(trunk.case, region="phantom")
    assert list(densities(phantom, anatomy, on_edges=False)) == []
    assert found[0].numbers["within"] < 0.5


@pytest.mark.parametrize(
    ("name", "tissue"),
    [
        ("rib_left_7", "bone"), ("vertebrae_L1", "bone"), ("Left Lung", "lung"), ("lung_upper_lobe_left", "lung"),
        ("lung_nodule", None), ("lung_vessels", None), ("liver", "solid organs"), ("liver_vessels", None),
    ],
)  # fmt: skip
def test_a_tissue_is_told_by_the_whole_name(name, tissue):
    """A part of a name is not enough: the vessels of a lung are no air."""
    assert next((one.name for one in TISSUES if one.has(name)), None) == tissue


def test_things_of_a_phantom_have_no_side(trunk):
    """Rods named as who looks at them sees them: a phantom is no patient."""
    phantom = replace(trunk.case, region="phantom")
    assert list(order_of_organs(phantom, mirrored(trunk, 0))) == []


def test_one_organ_beside_many_levels_is_one_fact(trunk, ball):
    """A neck on a pillow: an aorta behind five vertebrae is warned of, not refused, and only at their height."""
    spine = [Structure(f"vertebrae_C{n}", Role.AVOID, 1.0, ball(8, (0, -20, 20 * n)), "v") for n in range(1, 6)]
    aorta = Structure("aorta", Role.AVOID, 1.0, ball(60, (0, 20, 60)), "a")
    found = list(order_of_organs(trunk.case, replace(trunk.anatomy, structures=(*spine, aorta))))
    assert [one.severity for one in found] == [Severity.WARNING]
    below = replace(aorta, mesh=ball(10, (0, 20, -200)))
    assert list(order_of_organs(trunk.case, replace(trunk.anatomy, structures=(*spine, below)))) == []
