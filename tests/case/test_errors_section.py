"""The table [errors]: defaults, aliases, and what contradicts itself."""

import numpy as np
import pytest
from pydantic import ValidationError
from refusals import refused

from puncture_twin.planning.case.errors import Cells, error_model
from puncture_twin.planning.case.tables import ErrorsSection
from puncture_twin.planning.geometry.spaces import Space


def model(space=Space.LPS, cells=None, fle_mm=None, **keys):
    return error_model(ErrorsSection(**keys), space=space, cells=cells, fle_mm=fle_mm)


def test_a_cell_makes_a_uniform_error():
    """Cell over root 12 in each axis: 1 and 5 mm give .29, .29, 1.44, across the slices along z."""
    found = model(ct_pixel_mm=1.0, ct_spacing_mm=5.0)
    np.testing.assert_allclose(np.sqrt(np.diag(found.marker_cov_ct)), [0.2887, 0.2887, 1.4434], atol=1e-4)
    np.testing.assert_array_equal(found.marker_cov_ct, found.target_cov_ct)
    assert found.anisotropic


def test_the_case_s_own_ct_gives_what_is_not_stated():
    found = model(cells=Cells(0.7, 3.0, np.array([0.0, 1.0, 0.0])))
    np.testing.assert_allclose(np.sqrt(np.diag(found.marker_cov_ct)), np.array([0.7, 3.0, 0.7]) / np.sqrt(12))
    assert not model().anisotropic
    np.testing.assert_allclose(model().marker_cov_ct, 0.25 * np.eye(3))


def test_a_bed_axis_turns_the_slices_and_ras_is_understood():
    for axis, space in (("left", Space.LPS), ((2.0, 0.0, 0.0), Space.LPS), ((-1.0, 0.0, 0.0), Space.RAS)):
        found = model(space, ct_in_plane_mm=0.3, ct_slice_mm=1.0, bed_axis=axis)
        np.testing.assert_allclose(np.diag(found.marker_cov_ct), [1.0, 0.09, 0.09])


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"space": Space.LOCAL, "ct_slice_mm": 1.0}, "local_space"),
        ({"space": Space.LOCAL, "ct_slice_mm": 1.0, "bed_axis": "head"}, "local_space"),
        ({"ct_slice_mm": 1.0, "bed_axis": (0.0, 0.0, 0.0)}, "zero_direction"),
        ({"fle_mm": 1.0, "touch_mm": 0.1}, "stated_twice"),
        ({"fle_mm": 1.0, "ct_pixel_mm": 0.1}, "stated_twice"),
    ],
)
def test_contradictions_are_refused(settings, told):
    with refused(told):
        model(**settings)


def test_cell_and_deviation_are_one_error():
    with pytest.raises(ValidationError, match="state the same error"):
        ErrorsSection(ct_pixel_mm=1.0, ct_in_plane_mm=0.3)


def test_the_short_form():
    """fle_mm^2/3 in each axis and no touch."""
    short = model(fle_mm=0.9)
    np.testing.assert_allclose(short.marker_cov_ct, 0.27 * np.eye(3))
    assert short.touch_mm == 0


def test_a_nominal_arm_errs_ten_times_as_much():
    found = model(arm="nominal", twist_deg=0.01)
    assert (found.arm.link_mm, found.arm.twist) == (0.5, np.radians(0.01))
    assert model().arm.link_mm == 0.05


def test_a_surface_is_known_by_its_own_voxels():
    """Uniform in its cell along every axis of an oblique map; of what slices exceed 3 mm by half, to all sides."""
    R = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    for sizes, off in (((0.7, 0.9, 3.0), (0.7, 0.9, 3.0)), ((0.7, 0.7, 5.0), np.hypot((0.7, 0.7, 5.0), 1.0))):
        S = model().surface_cov_ct(R * sizes)
        np.testing.assert_allclose(np.sqrt(np.diag(R.T @ S @ R)), np.array(off) / np.sqrt(12))
        np.testing.assert_allclose(model().scaled(3.0).surface_cov_ct(R * sizes), 9 * S)
    assert not model().surface_cov_ct(None).any()
    for voxel in (None, R):
        np.testing.assert_array_equal(model(surface_mm=0.4).surface_cov_ct(voxel), 0.4**2 * np.eye(3))


def test_scaling_scales_every_deviation():
    one, two = model(surface_mm=0.3), model(surface_mm=0.3).scaled(2.0)
    np.testing.assert_allclose(two.marker_cov_ct, 4 * one.marker_cov_ct)
    np.testing.assert_allclose(two.target_cov_ct, 4 * one.target_cov_ct)
    assert [two.touch_mm, two.surface_mm, two.arm.drift] == [2 * one.touch_mm, 0.6, 2 * one.arm.drift]
