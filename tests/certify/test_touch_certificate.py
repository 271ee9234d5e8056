"""A certificate with a chance to touch: it holds in every configuration, and nothing unsafe is certified."""

from dataclasses import replace

import numpy as np
import pytest

from puncture_twin.meshes import folder
from puncture_twin.planning.arm.insertion import flange_poses
from puncture_twin.planning.arm.kinematics import inverse
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.certify.certificate import SAFE, parse_certificate, write_certificate
from puncture_twin.planning.certify.checker import verify
from puncture_twin.planning.certify.subdivision import certify
from puncture_twin.planning.search.context import prepare
from puncture_twin.planning.uncertainty.any_pose import any_pose

CASES = {"abdomen/case.toml": 0.05, "carton/case_m.toml": 0.4}
"""Each with its chance: three markers with 5 mm slices, 877 mm from the base, leave nothing proven below .3."""

DRAWN = 400


@pytest.fixture(scope="module", params=sorted(CASES))
def certified(request):
    """A case with its arm, its plain certificate, and the one that keeps the chance."""
    context = prepare(folder() / request.param)
    size = np.radians(1.0)
    plain = certify(context.case, context.anatomy, size=size)
    found = certify(context.case, context.anatomy, size=size, touch=CASES[request.param], error=context.pose_error)
    return context, plain, found


def inside(certificate, rng):
    """Directions (n, 3), CT, anywhere in the safe cells."""
    cells = certificate.leaves.take(certificate.verdict == SAFE)
    rows = rng.integers(0, len(cells), DRAWN)
    theta, beta = (rng.uniform(r[rows, 0], r[rows, 1]) for r in (cells.theta, cells.beta))
    local = np.column_stack([np.sin(theta) * np.cos(beta), np.sin(theta) * np.sin(beta), np.cos(theta)])
    return theta, beta, local @ certificate.question.R_ct_entry.T


def every_configuration(context, outward_ct):
    """Rows of directions and configurations (n, 6): all branches of six rolls that reach the target."""
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
    assert 1e-4 * found.question.touch < touch.max() <= found.question.touch  # and the bound is not idle


def test_the_search_finds_every_certified_direction_safe(certified, rng):
    """Its margins are never narrower, and what it certifies was certified without a chance too."""
    _, plain, found = certified
    theta, beta, _ = inside(found, rng)
    assert (found.question.margins >= plain.question.margins).all()
    assert (found.question.margins > plain.question.margins).any()
    assert 0 < found.areas[SAFE] < plain.areas[SAFE]
    assert "R" not in set(plain.at(theta, beta))


def test_the_checker_proves_it_and_refuses_another_chance(certified, tmp_path):
    """Written, read and proven; with another chance, or errors declared smaller, it was made for something else."""
    context, _, found = certified
    case, anatomy, error = context.case, context.anatomy, context.pose_error
    path = tmp_path / "certificate.json"
    write_certificate(found, path)
    again = parse_certificate(path.read_bytes(), path)
    assert again.question.touch == found.question.touch
    assert any("chance to touch" in text for text in again.summary()["certified"])
    if len(found.leaves) < 5000:
        verify(again, case, anatomy, error=error)
    for touch in (None, 0.01):
        with pytest.raises(InputError, match=r"its (margins|touch) is not that of the case"):
            verify(replace(again, question=replace(again.question, touch=touch)), case, anatomy, error=error)
    with pytest.raises(InputError, match="its margins is not that of the case"):
        verify(again, case, anatomy, error=replace(error, errors=error.errors.scaled(0.5)))
    with pytest.raises(InputError, match="cannot be certified"):
        verify(again, case, anatomy)


def test_no_configuration_errs_more_than_the_bound(certified, rng):
    """Of random directions in every branch, and of random gradients: the deviation is below, and not by far."""
    context, _, _ = certified
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
    """Above 0, and at most a half."""
    context, _, _ = certified
    with pytest.raises(InputError, match="chance to touch"):
        certify(context.case, context.anatomy, size=0.1, touch=touch, error=context.pose_error)
    with pytest.raises(InputError, match="cannot be certified"):
        certify(context.case, context.anatomy, size=0.1, touch=0.05)
