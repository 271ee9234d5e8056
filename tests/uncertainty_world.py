"""Punctures for tests: the embedded markers, a UR3 that touches them, and one direction to the target."""

from dataclasses import dataclass

import numpy as np
from case_world import ball as write_ball, case_text, points_file, structure
from places import ROOT

from puncture_twin.planning.arm.insertion import flange_poses
from puncture_twin.planning.arm.inverse_kinematics import inverse
from puncture_twin.planning.arm.kinematics import farthest_from_singular
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.case.errors import error_model
from puncture_twin.planning.case.tables import ErrorsSection
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.planning.registration.fits import fit_rigid
from puncture_twin.planning.registration.marker_noise import reading_noise, touching_configuration
from puncture_twin.planning.registration.marker_pairs import MarkerPairs
from puncture_twin.planning.registration.placement import aim_at, aimed, load_placement
from puncture_twin.planning.registration.registration import register
from puncture_twin.planning.uncertainty.pose_error import PoseError
from puncture_twin.twin.rehearsal.trials import Puncture

NO_ARM = {
    "link_mm": 0.0,
    "twist_deg": 0.0,
    "joint_deg": 0.0,
    "repeatability_deg": 0.0,
    "joint_drift_deg": 0.0,
    "tip_offset_mm": 0.0,
    "needle_direction_deg": 0.0,
}
SLICES = {"ct_pixel_mm": 1.0, "ct_spacing_mm": 5.0, "bed_axis": (1.0, 0.0, 0.0)}
"""Of the carton (Chen 2019): pixels of 1 mm, slices of 5 mm."""
DIRECTIONS = {"abdomen/case.toml": (62.0, 96.0), "carton/case_m.toml": (18.0, 232.0)}
"""Of each case, one that a UR3 reaches, degrees."""


def declared(**keys):
    return error_model(ErrorsSection(**keys), space=Space.LOCAL)


@dataclass(frozen=True)
class World:
    """Errors, what is believed of the pose, and what every room repeats."""

    errors: object
    error: PoseError
    puncture: Puncture


def world(case_file, method, errors, *, touch_like_insertion=False, moved=None):
    """A puncture of an embedded case, whose patient lies where its markers say.

    Args:
        case_file: Below the embedded meshes.
        method: Of the registration, or ``corrected``: the joint one, corrected for the direction.
        errors: As declared.
        touch_like_insertion: Whether markers are touched with the insertion's own orientation and branch.
        moved: T_base_base, by which the patient is moved for the arm.
    """
    case = load_case(ROOT / "meshes" / case_file)
    found = load_placement(case).registration.markers
    model, tip = case.robot.model, case.needle.length_mm
    T = fit_rigid(found.points_ct, found.points_base)
    T = T if moved is None else moved @ T
    outward_ct = _direction(case, *DIRECTIONS[case_file])
    target, outward = apply(T, case.target_ct), T[:3, :3] @ outward_ct
    q = _insertion(model, target, outward, tip)
    there = apply(T, found.points_ct)
    if touch_like_insertion:
        q_touch = np.array([_nearest(model, point, outward, tip, q) for point in there])
    else:
        down = -(T[:3, :3] @ case.T_ct_entry[:3, 2])
        q_touch = np.array([touching_configuration(model, tip, point, down) for point in there])
    noise = reading_noise(errors, model, tip, q_touch, known=True)
    markers = MarkerPairs(found.names, found.points_ct, there)
    fit = "joint" if method == "corrected" else method
    fitted = register(markers, method=fit, target_ct=case.target_ct, noise=noise)
    if method == "corrected":
        fitted = aimed(fitted, aim_at(model, tip, case.target_ct, q))
    error = PoseError(model, tip, target, errors, fitted.uncertainty)
    puncture = Puncture(
        model, tip, fit, noise, found.points_ct, q_touch, fitted.T_base_ct, case.target_ct, outward_ct, q,
        aim=fitted.aim,
    )  # fmt: skip
    return World(errors, error, puncture)


def _direction(case, theta_deg, beta_deg):
    theta, beta = np.radians([theta_deg, beta_deg])
    local = np.array([np.sin(theta) * np.cos(beta), np.sin(theta) * np.sin(beta), np.cos(theta)])
    return case.T_ct_entry[:3, :3] @ local


def _insertion(model, target, outward, tip):
    """The configuration farthest from singular over all rolls and branches."""
    rolls = np.radians(np.arange(0, 360, 30))
    q = inverse(model, flange_poses(target, outward, tip, rolls)).reshape(-1, 6)
    return farthest_from_singular(model, q, outward)


def _nearest(model, point, outward, tip, q_near):
    """The configuration that touches a point with the needle along a direction, and turns least from another."""
    rolls = np.radians(np.arange(0, 360, 2))
    q = inverse(model, flange_poses(point, outward, tip, rolls)).reshape(-1, 6)
    q = q[~np.isnan(q).any(axis=1)]
    turns = (q - q_near + np.pi) % (2 * np.pi) - np.pi
    return q_near + turns[np.abs(turns).max(axis=1).argmin()]


MARKERS = '[registration]\nmarkers_ct = "markers_ct.csv"\nmarkers_base = "touch.csv"\n'
MOUNT = "[robot.mount]\nposition_mm = [0.0, 380.0, -60.0]\nx_axis = [1.0, 0.0, 0.0]\nz_axis = [0.0, 0.0, 1.0]\n"
TO_BASE = np.array([0.0, -380.0, 60.0])
SIDES = np.array([[0.3, 0.2, 1], [-0.5, 0.3, 0.9], [0.1, -0.7, 0.8], [0.8, 0.1, 0.6], [-0.3, -0.5, 1], [0.2, 0.9, 0.5]])


SEARCH = "theta_deg = [20, 20]\nbeta_deg = [0, 80]\nstep_deg = 20.0\n"
BALLS = {"skin": (75.0, (0, 0, 0)), "organ": (6.0, (0, 0, 0)), "rib": (5.0, (20, 0, 40))}
"""Radius and centre of each mesh, mm."""
STRUCTURES = [
    structure(name, role, {"mesh": f"{name}.ply", "unit": "mm"}, **keys)
    for name, role, keys in (("skin", "skin", {}), ("organ", "target", {}), ("rib", "avoid", {"margin_mm": 2.0}))
]


def ball(folder, *, search="", errors="", base=MARKERS, noise=0.3, organ=None):
    """A round patient in front of a UR3, with six markers on its skin; returns the case's file."""
    for name, shape in BALLS.items():
        write_ball(folder / f"{name}.ply", *shape)
    if organ is not None:
        organ.export(folder / "organ.ply")
    points = 75.0 * SIDES / np.linalg.norm(SIDES, axis=1)[:, None]
    off = noise * np.random.default_rng(1).normal(size=points.shape)
    (folder / "markers_ct.csv").write_text(points_file(points))
    (folder / "touch.csv").write_text(points_file(points + TO_BASE + off))
    sections = f"[errors]\n{errors}\n", f'[robot]\nmodel = "ur3"\n{base}\n', *STRUCTURES
    text = case_text(*sections, name="ball", region="phantom", space="local", search=SEARCH + search)
    (folder / "case.toml").write_text(text)
    return folder / "case.toml"
