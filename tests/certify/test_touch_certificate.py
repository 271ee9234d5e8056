"""A certificate with a chance to touch: it holds in every configuration, and nothing unsafe is certified."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused
from scipy.special import chdtri, ndtri, stdtrit

from puncture_twin.meshes import folder
from puncture_twin.planning.arm.insertion import flange_poses
from puncture_twin.planning.arm.inverse_kinematics import inverse
from puncture_twin.planning.certify.certificate import PROVED_SAFE, parse_certificate, write_certificate
from puncture_twin.planning.certify.checker import verify
from puncture_twin.planning.certify.subdivision import certify
from puncture_twin.planning.search.context import prepare
from puncture_twin.planning.uncertainty.pose_error import AnyPose, any_pose

CHANCE = 0.05

DRAWN = 400


@pytest.fixture(scope="module")
def certified():
    context = prepare(folder() / "abdomen")
    size = np.radians(3.0)
    plain = certify(context.case, context.anatomy, size=size)
    found = certify(context.case, context.anatomy, size=size, touch=CHANCE, error=context.pose_error)
    return context, plain, found


def inside(certificate, rng):
    cells = certificate.leaves.take(certificate.verdict == PROVED_SAFE)
    rows = rng.integers(0, len(cells), DRAWN)
    theta, beta = (rng.uniform(r[rows, 0], r[rows, 1]) for r in (cells.theta, cells.beta))
    local = np.column_stack([np.sin(theta) * np.cos(beta), np.sin(theta) * np.sin(beta), np.cos(theta)])
    return theta, beta, local @ certificate.question.R_ct_entry.T


def every_configuration(context, outward_ct):
    error, R = context.chance.error, context.placement.T_base_ct[:3, :3]
    rolls = np.radians(np.arange(0, 360, 60))
    rows, found = [], []
    for row, outward in enumerate(outward_ct):
        poses = flange_poses(error.target_base, R @ outward, error.tip_mm, rolls)
        q = inverse(error.model, poses).reshape(-1, 6)
        q = q[~np.isnan(q).any(axis=1)]
        rows += [row] * len(q)
        found.append(q)
    return np.array(rows), np.concatenate(found)


def test_no_configuration_touches_more_often(certified, rng):
    """p_touch, to first order, of directions drawn in certified cells: of all structures, rolls and branches."""
    context, _, found = certified
    _, _, outward = inside(found, rng)
    rows, q = every_configuration(context, outward)
    touch = context.chance.chances(outward[rows], q).touch
    assert len(rows) > DRAWN
    assert 0.0 < touch.max() <= found.question.touch


def test_certified_directions_are_safe_and_proven_for_their_chance(certified, rng, tmp_path):
    _, plain, found = certified
    theta, beta, _ = inside(found, rng)
    assert (found.question.margins >= plain.question.margins).all()
    assert (found.question.margins > plain.question.margins).any()
    assert 0 < found.areas[PROVED_SAFE] < plain.areas[PROVED_SAFE]
    assert "R" not in set(plain.at(theta, beta))
    context, _, found = certified
    case, anatomy, error = context.case, context.anatomy, context.pose_error
    path = tmp_path / "certificate.json"
    write_certificate(found, path)
    again = parse_certificate(path.read_bytes(), path)
    assert again.question.touch == found.question.touch
    assert any("chance to touch" in text for text in again.summary()["certified"])
    verify(again, case, anatomy, error=error)
    for touch in (None, 0.01):
        with refused("certificate_of_another"):
            verify(replace(again, question=replace(again.question, touch=touch)), case, anatomy, error=error)
    with refused("certificate_of_another"):
        verify(again, case, anatomy, error=replace(error, errors=error.errors.scaled(0.5)))
    with refused("not_certifiable"):
        verify(again, case, anatomy)


@pytest.fixture(scope="module")
def carton():
    """Three markers with 5 mm slices, 877 mm from the base: an error that leaves nothing to prove."""
    return prepare(folder() / "carton" / "case_m.toml")


def test_nothing_is_proven_where_the_error_is_too_large(carton):
    found = certify(carton.case, carton.anatomy, size=np.radians(8.0), touch=0.5, error=carton.pose_error)
    assert found.areas[PROVED_SAFE] == 0 and found.summary()["touch"] == 0.5


@pytest.mark.parametrize("name", ["certified", "carton"])
def test_no_configuration_errs_more_than_the_bound(name, request, rng):
    """Of random directions in every branch, and of random gradients: the deviation is below, and not by far."""
    found = request.getfixturevalue(name)
    context = found[0] if name == "certified" else found
    outward = rng.normal(size=(60, 3))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    _, q = every_configuration(context, outward)
    cov, bound = context.chance.error.covariance(q), any_pose(context.chance.error)
    for block, limit in ((cov[:, :3, :3], bound.deviation_mm), (cov[:, 3:, 3:], bound.deviation_rad)):
        largest = np.sqrt(np.linalg.eigvalsh(block)[:, -1].max())
        assert largest <= limit < 4.0 * largest
    unknown = replace(context.chance.error.fit, noise=replace(context.chance.error.fit.noise, touches_known=True))
    error = replace(context.chance.error, fit=unknown)
    known = any_pose(error)
    assert np.sqrt(np.linalg.eigvalsh(error.covariance(q)[:, :3, :3])[:, -1].max()) <= known.deviation_mm


@pytest.mark.parametrize("touch", [0.0, -0.1, 0.51, 1.0, np.nan, np.inf])
def test_a_chance_that_makes_no_sense_is_refused(certified, touch):
    context, _, _ = certified
    with refused("out_of_range"):
        certify(context.case, context.anatomy, size=0.1, touch=touch, error=context.pose_error)
    with refused("not_certifiable"):
        certify(context.case, context.anatomy, size=0.1, touch=0.05)


TUBE_MM, NEEDLE_MM, RADIUS_MM = 120.0, 150.0, 0.6
POSES = [(AnyPose(0.8, 0.004), 0.0), (AnyPose(0.8, 0.004), 0.5), (AnyPose(0.2, 0.02), 1.0), (AnyPose(1.0, 0.0), 0.0)]
"""And by how much the tube's surface lies off as a whole, mm."""
MANY = 100_000


def drawn_clearances(pose, surface_mm, freedom, rng):
    """How far needles come off the axis of a tube that ends at `TUBE_MM`, by exact rotations, (MANY,), mm.

    The pose errs as much as the bounds allow, and as badly: positions and directions go the same way. A line is
    farthest from the axis at an end: its tip, or where it leaves the tube.
    """
    scale = 1.0 if freedom is None else np.sqrt(freedom / rng.chisquare(freedom, MANY))[:, None]
    d = rng.normal(0.0, pose.deviation_mm, (MANY, 3))
    phi = rng.normal(0.0, pose.deviation_rad, (MANY, 2))
    if pose.deviation_mm and pose.deviation_rad:  # fully correlated: the tip goes where the needle leans
        phi = d[:, :2] * pose.deviation_rad / pose.deviation_mm
    d, phi = d * scale, phi * scale
    lean = np.linalg.norm(phi, axis=1, keepdims=True)
    side = phi / np.maximum(lean, 1e-300)
    depth = np.clip((TUBE_MM - d[:, 2:]) / np.cos(lean), 0.0, NEEDLE_MM)
    ends = d[:, :2], d[:, :2] + depth * np.sin(lean) * side
    most = np.max([np.linalg.norm(end, axis=1) for end in ends], axis=0)
    return most + np.abs(rng.normal(0.0, surface_mm, MANY) * (1.0 if freedom is None else scale[:, 0]))


@pytest.mark.parametrize("freedom", [None, 6])
@pytest.mark.parametrize(("pose", "surface_mm"), POSES)
def test_in_a_tube_no_needle_touches_more_often(pose, surface_mm, freedom, rng):
    """The worst shape, all around the needle, at exactly the clearance that is kept; a plane's quantile fails there."""
    corner = np.hypot(TUBE_MM, 10.0)
    far, length, surface = (np.array([mm]) for mm in (corner, NEEDLE_MM, surface_mm))
    off, deviation = drawn_clearances(pose, surface_mm, freedom, rng), pose.of_distance(TUBE_MM, surface_mm)
    for chance in (0.3, 0.05, 0.01):
        kept = pose.margin(chance, freedom, far, length, RADIUS_MM, surface)[0]
        assert np.mean(off > kept) <= chance + 4 * np.sqrt(chance / MANY)
        plane = (-ndtri(chance) if freedom is None else -stdtrit(freedom, chance)) * deviation
        assert np.mean(off > plane) > chance


def test_the_margin_grows_as_the_chance_falls():
    """And with the depth that counts; where the needle may lean by as much as it is long, the whole of it counts."""
    pose = AnyPose(0.8, 0.004)
    far, lengths, surface = np.array([80.0, 120.0]), np.full(2, 150.0), np.full(2, 0.3)
    margins = [pose.margin(p, None, far, lengths, 0.6, surface) for p in (0.4, 0.1, 0.01, 1e-6)]
    assert (np.diff(margins, axis=0) > 0).all() and (np.diff(margins, axis=1) > 0).all()
    wild = AnyPose(0.8, 0.5)
    assert np.allclose(
        wild.margin(0.05, None, np.array([1.0]), np.array([150.0]), 0.6, np.zeros(1)), np.sqrt(chdtri(5, 0.05)) * 75.8
    )
