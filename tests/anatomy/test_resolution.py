"""What the grids of a case miss: thick slices, steps that do not fit, labels that nobody names."""

from types import SimpleNamespace

import numpy as np
import pytest
import SimpleITK
from case_world import write_case, write_labels
from refusals import refused

from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.evidence.checks import short_grid
from puncture_twin.planning.search.context import prepare


def warnings_of(path):
    return prepare(path, arm=False).anatomy.warnings


@pytest.mark.parametrize(("slices", "margin"), [(2.0, "3.0"), (20.0, "3.0"), (20.0, "0.0"), (2.0, "1.5")])
def test_slices_thicker_than_the_least_margin_are_a_warning(tmp_path, slices, margin):
    """The distance of two slices stands beside the least margin that the map must keep."""
    role = 'label = 3\nrole = "avoid"\nmargin_mm = '
    path = write_case(tmp_path, (f"{role}3.0", f"{role}{margin}"), spacing=(2.0, 2.0, slices))
    found = [warning for warning in warnings_of(path) if "slices" in warning]
    said = f"slices {slices:g} mm apart, but its smallest margin is {float(margin):g} mm (vessel)"
    assert [said in one for one in found] == [True] * (slices > float(margin))


@pytest.mark.parametrize(("spacing", "warned"), [(3.0, False), (8.0, True)])
def test_a_skin_from_thick_slices_is_a_warning(tmp_path, spacing, warned):
    """A CT whose slices are farther apart than the needle keeps from the skin."""
    z, y, x = np.meshgrid(*(np.arange(-117, 118, step) for step in (spacing, 3.0, 3.0)), indexing="ij")
    hu = np.where(x**2 + y**2 + z**2 < 90**2, 40, -1000).astype(np.int16)
    image = SimpleITK.GetImageFromArray(hu)
    image.SetSpacing((3.0, 3.0, spacing))
    image.SetOrigin((-117.0, -117.0, -117.0))
    SimpleITK.WriteImage(image, tmp_path / "ct.nii.gz")
    path = write_case(tmp_path, ('mesh = "skin.stl"\nunit = "mm"', 'ct = "ct.nii.gz"'))
    found = [warning for warning in warnings_of(path) if "ct.nii.gz: slices" in warning]
    assert len(found) == warned


@pytest.mark.parametrize(
    ("high", "step", "last"), [(90.0, 7.0, 84.0), (90.0, 0.7, 89.6), (90.0, 0.3, None), (0.0, 10.0, None)]
)
def test_a_step_that_does_not_divide_the_range_is_a_warning(tmp_path, high, step, last):
    """The last angle that is checked is named; of a whole case too."""
    search = SimpleNamespace(theta=(0.0, np.radians(high)), beta=(0.0, 0.0), step=np.radians(step))
    found = [one.sentence for one in short_grid(SimpleNamespace(search=search))]
    said = f"theta_deg [0, 90] is not a whole number of steps of {step:g}: the last angle checked is {last}"
    assert found == [f"search.{said.removesuffix('.0')}"] * (last is not None)
    if step == 7.0:
        path = write_case(tmp_path, ("[0, 10]", "[0, 90]\nbeta_deg = [0, 0]"), ("step_deg = 10.0", "step_deg = 7.0"))
        assert any(found[0] in one for one in warnings_of(path))


@pytest.mark.parametrize(("theta", "step"), [("[0, 10]", "45.0"), ("[0, 10]", "10.1")])
def test_a_step_larger_than_the_range_is_refused(tmp_path, theta, step):
    """Only one end of the range would be searched."""
    path = write_case(tmp_path, ("[0, 10]", theta), ("step_deg = 10.0", f"step_deg = {step}"))
    with refused("step_too_large", "step_deg", "theta_deg", "[0", "10]"):
        load_case(path)


@pytest.mark.parametrize(("x_axis", "wrong"), [("[1.0, 0.0, 0.01]", False), ("[1.0, 0.0, 0.2]", True)])
def test_the_axes_of_a_mount_stand_at_a_right_angle(tmp_path, x_axis, wrong):
    """Rounding is taken; 11 degrees off the right angle are wrong, and the angle is said."""
    mount = f"[robot.mount]\nposition_mm = [0, -500, 0]\nx_axis = {x_axis}\nz_axis = [0, 0, 1]"
    path = write_case(tmp_path, ('[registration]\nmarkers_ct = "markers_ct.csv"\nmarkers_base = "touch.csv"', mount))
    if wrong:
        with refused("axes_not_square", "78.7"):
            load_case(path)
    else:
        np.testing.assert_allclose(np.linalg.det(load_case(path).robot.T_base_ct_mount[:3, :3]), 1)


def test_labels_that_nobody_names_are_named(tmp_path):
    """Only where the map really holds others: their numbers are in the warning."""
    path = write_case(tmp_path)
    assert not [warning for warning in warnings_of(path) if "count as free" in warning]
    labels = np.zeros((100, 100, 100), np.uint8)
    labels[40:60, 67:69, 67:69] = 3
    for label in (*range(5, 17), 200):
        labels[40:60, 30, 30 + label % 20] = label
    write_labels(tmp_path / "labels.nrrd", labels)
    found = [warning for warning in warnings_of(path) if "count as free" in warning]
    shown = "5, 6, 7, 8, 9, 10, 11, 12 and 5 more"
    assert found == [f"labels.nrrd has labels that the case does not list; they count as free: {shown}"]
