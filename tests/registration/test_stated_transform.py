"""CT to robot from a transform file of ITK or Slicer in place of markers: which way it goes is never guessed."""

import numpy as np
import pytest
import SimpleITK
from case_world import CASE, changed, registration_section, write_case
from refusals import refused

from puncture_twin.planning.anatomy.anatomy import load_skin
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.formats.itk_transform import transform_text
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, inverse, left_jacobian, pose
from puncture_twin.planning.registration.checks.checked_placement import placement_findings
from puncture_twin.planning.registration.checks.markers import Surroundings
from puncture_twin.planning.registration.placement import load_placement
from puncture_twin.twin.jobs.patient.answers import registration_report

TURN = np.array([0.4, -1.1, 2.0])
T_BASE_CT = pose(exp_rotation(TURN), left_jacobian(TURN) @ [310.0, -120.0, 240.0])
FLIP = np.diag([-1.0, -1.0, 1.0, 1.0])
POINTS = np.array([[0.0, 0.0, 80.0], [50.0, 0.0, 75.0], [0.0, 60.0, 70.0], [-40.0, -30.0, 72.0]])
TOLERANCE_MM = 1e-9


def itk_file(folder, T, center=(0.0, 0.0, 0.0), name="ct_to_robot.tfm"):
    affine = SimpleITK.AffineTransform(3)
    affine.SetCenter(center)
    affine.SetMatrix(T[:3, :3].ravel().tolist())
    affine.SetTranslation((T[:3, 3] - center + T[:3, :3] @ center).tolist())
    SimpleITK.WriteTransform(affine, str(folder / name))
    return affine


def slicer_file(folder, T_parent_node_ras):
    """A file as Slicer writes a transform node: the way from its parent, between coordinates in LPS."""
    return itk_file(folder, FLIP @ inverse(T_parent_node_ras) @ FLIP)


def stating(folder, maps="ct_to_base", axes="LPS", file="ct_to_robot.tfm", *more):
    keys = [f'transform = "{file}"', maps and f'transform_maps = "{maps}"', axes and f'base_axes = "{axes}"', *more]
    section = "\n".join(["[registration]", *filter(None, keys), ""])
    write_case(folder, text=changed(CASE, (registration_section(), section)))
    return folder


@pytest.mark.parametrize("maps", ["ct_to_base", "base_to_ct"])
@pytest.mark.parametrize("center", [(0.0, 0.0, 0.0), (10.0, -20.0, 30.0)])
def test_a_file_does_to_points_what_itk_does(tmp_path, maps, center):
    """Whichever way it goes, base coordinates are those that SimpleITK's TransformPoint goes to or comes from."""
    affine = itk_file(tmp_path, T_BASE_CT if maps == "ct_to_base" else inverse(T_BASE_CT), center)
    found = load_placement(load_case(stating(tmp_path, maps)))
    in_base = apply(found.T_base_ct, POINTS)
    pairs = zip(POINTS, in_base, strict=True) if maps == "ct_to_base" else zip(in_base, POINTS, strict=True)
    for start, end in pairs:
        assert affine.TransformPoint(start.tolist()) == pytest.approx(end, abs=TOLERANCE_MM)
    assert in_base == pytest.approx(apply(T_BASE_CT, POINTS), abs=TOLERANCE_MM)


def test_a_transform_that_slicer_registered(tmp_path):
    """Markers of the CT onto points that were typed as the robot shows them, in Slicer's RAS: saved from its parent."""
    T_base_ras = T_BASE_CT @ FLIP
    slicer_file(tmp_path, T_base_ras)
    found = load_placement(load_case(stating(tmp_path, "base_to_ct", "RAS")))
    assert found.T_base_ct == pytest.approx(T_BASE_CT, abs=TOLERANCE_MM)


def test_it_is_an_input_and_says_that_nothing_is_known_of_its_error(tmp_path):
    """Hashed; no residuals, no expected error; told in every result and by register, which has nothing to show."""
    itk_file(tmp_path, T_BASE_CT)
    case = load_case(stating(tmp_path))
    assert ("transform", "ct_to_robot.tfm") in [(one.role, one.path) for one in case.inputs]
    said = "stated transform ct_to_robot.tfm: no residuals, expected error unknown"
    (found,) = placement_findings(case, Surroundings(load_skin(case), None), load_placement(case))
    line = found.sentence
    assert line.startswith(f"registration: {said} (markers_ct and markers_base with it would check it)")
    placement = load_placement(case)
    assert placement.registration is None and np.isnan(placement.target_error_mm)
    with refused("no_markers", said):
        registration_report(tmp_path)


GOOD = transform_text(T_BASE_CT)
MIRRORED = transform_text(T_BASE_CT @ np.diag([-1.0, 1.0, 1.0, 1.0]))
BENT = transform_text(T_BASE_CT @ np.diag([1.001, 1.0, 1.0, 1.0]))
TWICE = GOOD + "\n".join(GOOD.splitlines()[1:]) + "\n"


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("a.tfm", MIRRORED, "mirrored"),
        ("a.tfm", BENT, "not_rigid"),
        ("a.tfm", TWICE, "several_transforms"),
        ("a.tfm", GOOD.replace("#Insight", "#Insight Out"), "wrong_format"),
        ("a.tfm", GOOD.replace("AffineTransform", "BSplineTransform"), "unknown_type BSpline"),
        ("a.tfm", GOOD.replace("\nParameters: ", "\nParameters: 1 "), "wrong_count 13"),
        ("a.tfm", GOOD.replace("\nParameters: ", "\nParameters: a"), "not_a_number"),
        ("a.tfm", GOOD.replace("FixedParameters: 0", "FixedParameters: nan"), "not_finite"),
        ("a.tfm", GOOD.splitlines()[0], "no_linear_transform"),
        ("a.tfm", GOOD.replace("Transform: Aff", "Transform:\nAff"), "unknown_line"),
        ("a.tfm", GOOD.replace("\nFixed", "\vFixed"), "not_a_number"),
        ("a.tfm", GOOD.replace("FixedParameters: 0", "FixedParameters: \uff11"), "not_a_number"),
        ("a.tfm", GOOD.replace("FixedParameters: 0", "FixedParameters: 1_0"), "not_a_number"),
        ("a.mat", GOOD, "unknown_format"),
    ],
)
def test_a_file_that_cannot_be_trusted_is_refused(tmp_path, name, text, says):
    """Mirrored, stretched, several, of another kind, cut: one line, and nothing is repaired."""
    (tmp_path / name).write_text(text)
    with refused(*says.split()):
        load_case(stating(tmp_path, file=name))


BOTH_LISTS = 'markers_ct = "markers_ct.csv"\nmarkers_base = "touch.csv"'


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ((None, "LPS"), "missing_key transform_maps base_to_ct"),
        (("ct_to_base", None), "missing_key base_axes RAS"),
        (("inward", "LPS"), "bad_value transform_maps"),
        (("ct_to_base", "LPS", "ct_to_robot.tfm", 'markers_ct = "markers_ct.csv"'), "missing_key markers_base"),
        (("ct_to_base", "LPS", "ct_to_robot.tfm", BOTH_LISTS, 'method = "rigid"'), "key_not_of_it"),
        (("ct_to_base", "LPS", "ct_to_robot.tfm", "fle_mm = 1.0"), "key_not_of_it fle_mm"),
    ],
)
def test_silence_and_contradiction_are_refused(tmp_path, keys, says):
    """Which way a transform goes, and what the robot's axes are, the case says."""
    itk_file(tmp_path, T_BASE_CT)
    with refused(*says.split()):
        load_case(stating(tmp_path, *keys))


def test_keys_of_a_transform_need_one(tmp_path):
    """A key of a transform without one is refused."""
    write_case(tmp_path, text=changed(CASE, (registration_section(), registration_section('base_axes = "LPS"'))))
    with refused("key_not_of_it"):
        load_case(tmp_path)
