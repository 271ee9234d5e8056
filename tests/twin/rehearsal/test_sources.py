"""Every declared source alone, and a needle that bends: what is predicted is what happens in rooms."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from uncertainty_world import ball

from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.case.tables import ErrorsSection
from puncture_twin.planning.search.context import prepare
from puncture_twin.planning.uncertainty.pose_error import Bend, _bend_covariance
from puncture_twin.twin.plant.true_needle import TrueNeedle
from puncture_twin.twin.rehearsal.distribution import rehearse_trials
from puncture_twin.twin.rehearsal.trials import bent

ROOMS = 1000
NOTHING = {
    "ct_in_plane_mm": 0.0, "ct_slice_mm": 0.0, "touch_mm": 0.05, "target_mm": 0.0, "link_mm": 0.0, "twist_deg": 0.0,
    "joint_deg": 0.0, "repeatability_deg": 0.0, "joint_drift_deg": 0.0, "tip_offset_mm": 0.0,
    "needle_direction_deg": 0.0, "surface_mm": 0.0,
}  # fmt: skip
"""A touch of .05 mm is left: readings without any error are refused."""

ALONE = {
    "ct_pixel_mm": {"ct_pixel_mm": 9.0, "ct_in_plane_mm": None},
    "ct_spacing_mm": {"ct_spacing_mm": 9.0, "ct_slice_mm": None},
    "ct_in_plane_mm": {"ct_in_plane_mm": 2.5},
    "ct_slice_mm": {"ct_slice_mm": 3.0},
    "bed_axis": {"ct_in_plane_mm": 0.8, "ct_slice_mm": 3.0, "bed_axis": [1.0, 0.0, 0.0]},
    "touch_mm": {"touch_mm": 2.0},
    "target_mm": {"target_mm": 1.0},
    "marker_noise": {"touch_mm": 1.0, "marker_noise": "found"},
    "arm": {"arm": "nominal", "link_mm": None, "twist_deg": None, "joint_deg": None},
    "link_mm": {"link_mm": 0.5},
    "twist_deg": {"twist_deg": 0.15},
    "joint_deg": {"joint_deg": 0.1},
    "repeatability_deg": {"repeatability_deg": 0.15},
    "joint_drift_deg": {"joint_drift_deg": 0.15},
    "jitter_deg": {"jitter_deg": 0.15},
    "tip_offset_mm": {"tip_offset_mm": 1.0},
    "needle_direction_deg": {"needle_direction_deg": 1.5},
    "surface_mm": {"surface_mm": 1.2},
}
"""What is declared beside `NOTHING`, so large that it decides."""
ALL_OF_IT = {**NOTHING, "touch_mm": 0.8, "needle_direction_deg": 0.5, "surface_mm": 0.9}


def lines(keys):
    said = {key: f'"{value}"' if isinstance(value, str) else value for key, value in keys.items() if value is not None}
    axis = {} if "bed_axis" in said else {"bed_axis": [0.0, 0.0, 1.0]}
    return "\n".join(f"{key} = {value}" for key, value in (said | axis).items())


def rehearsed(folder, keys, *, hit_radius=None, voxel_ct=None):
    """Rooms of a needle that passes a rib by two millimetres, into a lesion of 2.5 mm."""
    organ = trimesh.creation.icosphere(subdivisions=3, radius=2.5)
    path = ball(folder, errors=lines(keys), organ=organ, noise=2.0 if "marker_noise" in keys else 0.03)
    text = path.read_text().replace("theta_deg = [20, 20]", "theta_deg = [17, 17]").replace("[0, 80]", "[0, 0]")
    text = text.replace("margin_mm = 2.0", "margin_mm = 0.0")
    if hit_radius is not None:
        text = text.replace('structure = "organ"', f'structure = "organ"\nhit_radius_mm = {hit_radius}', 1)
    path.write_text(text)
    context = prepare(path)
    if voxel_ct is not None:
        structures = tuple(replace(one, voxel_ct=voxel_ct) for one in context.anatomy.structures)
        context = replace(context, anatomy=replace(context.anatomy, structures=structures))
    found = replace(context, chance=None).search()
    assert found.safe[0]
    return rehearse_trials(context, found.outward_ct[0], found.arm.q_insertion[0], ROOMS, 5)


def agrees(share, chance, more=0.005):
    """To four standard deviations of the rooms, and what line sampling errs by."""
    assert abs(share - chance) <= 4 * np.sqrt(chance * (1 - chance) / ROOMS) + more


def test_every_key_is_walked_over():
    assert set(ALONE) == set(ErrorsSection.model_fields)


@pytest.mark.parametrize("key", [*ALONE, "all"])
def test_what_a_source_alone_predicts_happens(tmp_path, key):
    keys = ALL_OF_IT if key == "all" else NOTHING | ALONE[key]
    done = rehearsed(tmp_path, keys, hit_radius=2.0 if key == "target_mm" else None)
    touched, hit = done.touched[:, 0].mean(), done.hit.mean()
    agrees(touched, done.p_touch[0])
    agrees(hit, done.p_hit)
    assert done.realised_rms_mm == pytest.approx(done.predicted_rms_mm, rel=0.06)
    assert touched > 0.01 or hit < 0.99, "the source decides nothing here"


def test_what_voxels_predict_happens(tmp_path):
    """Nothing is stated: slices of 9 mm let surfaces lie off by 2.7 mm along z, by less where the needle passes."""
    voxel_ct = np.diag([1.0, 1.0, 9.0])
    done = rehearsed(tmp_path, NOTHING | {"touch_mm": 0.4, "surface_mm": None}, voxel_ct=voxel_ct)
    agrees(done.touched[:, 0].mean(), done.p_touch[0])
    agrees(done.hit.mean(), done.p_hit, 0.02)
    assert done.p_touch[0] > 0.05 and done.p_hit < 0.95 and "errors of the meshes" in done.not_modelled


BEND, COUNT = Bend(2.5, 150.0), 100_000
Q = np.radians([20, -70, 90, -60, -80, 0])


def needles():
    T = flange_pose(ur_model("ur3"), Q)
    tips = np.broadcast_to(T[:3, 3] + 210 * T[:3, 2], (COUNT, 3))
    return TrueNeedle(tips, np.broadcast_to(T[:3, :3], (COUNT, 3, 3)))


def rotation_vectors(R):
    return 0.5 * np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)


def test_a_bent_needle_ends_where_its_bevel_took_it(rng):
    """Off by the deflection across itself; where it is held it stays, to second order."""
    straight = needles()
    found = bent(straight, BEND, rng.uniform(0, 2 * np.pi, COUNT))
    off = found.tip_base - straight.tip_base
    np.testing.assert_allclose(np.linalg.norm(off, axis=1), BEND.tip_mm)
    np.testing.assert_allclose(np.einsum("na,na->n", off, straight.R_base_needle[:, :, 2]), 0.0, atol=1e-12)
    held = [one.tip_base - BEND.clamped_mm * one.R_base_needle[:, :, 2] for one in (found, straight)]
    assert np.linalg.norm(held[0] - held[1], axis=1).max() < BEND.tip_mm**2 / BEND.clamped_mm
    squares = found.R_base_needle @ np.swapaxes(found.R_base_needle, 1, 2)
    assert np.abs(squares - np.eye(3)).max() < 1e-9


def test_what_is_believed_of_the_bend_is_what_the_rooms_show(rng):
    """All 36 entries of the covariance of tip and rotation."""
    straight = needles()
    found = bent(straight, BEND, rng.uniform(0, 2 * np.pi, COUNT))
    turned = rotation_vectors(found.R_base_needle @ np.swapaxes(straight.R_base_needle, 1, 2))
    errors = np.concatenate([found.tip_base - straight.tip_base, turned], axis=1)
    scale = np.repeat([BEND.tip_mm, BEND.tip_mm / BEND.clamped_mm], 3)
    realised, believed = np.cov((errors / scale).T), _bend_covariance(ur_model("ur3"), Q[None], BEND)[0]
    np.testing.assert_allclose(realised, believed / np.outer(scale, scale), atol=0.01)
    assert np.trace(believed[:3, :3]) == pytest.approx(BEND.tip_mm**2)
