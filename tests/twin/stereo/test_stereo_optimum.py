"""The joint estimate of everything, against its own slopes, the Cramer-Rao bound, and the paper's chain."""

import numpy as np
import pytest
from refusals import refused
from servo_world import CASE, HELD, IMAGE_MM, simulate

from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.twin.guidance.stereo.joint.joint_model import Adjusted, JointModel, adjust, first_unknowns
from puncture_twin.twin.guidance.stereo.servo_law import ball_base

TARGET = CASE.targets.points[1]
DRAWS = 40


@pytest.fixture(scope="module")
def one():
    return simulate(0)


def test_slopes_are_those_of_the_residuals(one):
    """Thirty columns against central differences of the residuals, away from the nominal values."""
    model = JointModel(one.observed, one.guess)
    start = first_unknowns(one.observed, one.guess)
    x = start._replace(cameras=start.cameras + 0.5, arm=start.arm - 0.5, head=start.head + 1e-3, base=start.base - 1e-3)
    slopes = model.linearised(x).slopes
    scale = np.abs(slopes).max(axis=0)
    for column in np.random.default_rng(1).choice(slopes.shape[1], 30, replace=False):
        step = 1e-5 * np.eye(slopes.shape[1])[column]
        numeric = (model.linearised(x.moved(step)).residuals - model.linearised(x.moved(-step)).residuals) / 2e-5
        assert np.abs(numeric - slopes[:, column]).max() < 2e-5 * scale[column]


def bound(observed, guess, at):
    """The Cramer-Rao bound: Fisher's information at stated unknowns."""
    model = JointModel(observed, guess)
    return Adjusted(model, at, np.linalg.inv(model.linearised(at).information), 0.0, 0, 0)


def test_it_reaches_the_bound():
    """Over 40 drawn sessions the rms error of target minus ball is within 1.15 of the Cramer-Rao bound at the truth."""
    errors, bounds, chi2, freedom = [], [], [], 0
    for seed in range(DRAWS):
        session = simulate(seed)
        found = adjust(session.observed, session.guess)
        estimate = found.offset(-1, TARGET)
        errors.append(estimate.target_c - estimate.ball_c - (session.targets_c[1] - session.balls_c[-1]))
        bounds.append(bound(session.observed, session.guess, session.truth).offset(-1, TARGET).covariance)
        chi2.append(found.chi2)
        system = found.model.linearised(found.unknowns)
        freedom = system.slopes.shape[0] - system.slopes.shape[1]
    rms = np.sqrt(np.mean(np.sum(np.square(errors), axis=1)))
    floor = np.sqrt(np.mean(np.trace(bounds, axis1=1, axis2=2)))
    assert floor < IMAGE_MM
    assert 0.8 * floor < rms <= 1.15 * floor
    assert np.mean(chi2) == pytest.approx(freedom, abs=4 * np.sqrt(2 * freedom / DRAWS))


def test_more_pictures_and_better_ones_help(one):
    """The bound falls with a second stay's pictures for the ball, and with four frames each step."""
    few, many = (bound(s.observed, s.guess, s.truth) for s in (simulate(0, stays=1), simulate(0, stays=8)))
    four = one.observed.pixel_covariance / 4
    sharper = bound(type(one.observed)(**{**vars(one.observed), "pixel_covariance": four}), one.guess, one.truth)
    plain = bound(one.observed, one.guess, one.truth)
    ball = [np.trace(a.offset(12, TARGET).ball_covariance) for a in (few, many, plain, sharper)]
    assert ball[1] < ball[0]
    assert ball[3] < ball[2]


def test_the_offset_knows_that_ball_and_target_err_together(one):
    """What the cameras get wrong at both cancels: the covariance of the difference is not the sum."""
    found = adjust(one.observed, one.guess).offset(-1, TARGET)
    apart = found.ball_covariance + found.target_covariance
    assert np.trace(found.covariance) < np.trace(apart)
    assert found.rms_mm() == pytest.approx(np.sqrt(np.trace(found.covariance)))


def test_a_perfect_session_is_found_exactly(one):
    """Without errors in the pixels of a nominal room the adjustment returns the truth."""
    observed, cameras = one.observed, one.observed.planned
    x = first_unknowns(observed, one.guess)
    balls = apply(one.guess.T_c_base, ball_base(HELD, observed.q_command))
    markers = apply(one.guess.T_c_m, CASE.markers.points)
    exact = type(observed)(**{
        **vars(observed),
        "pixels": np.array([c.project(balls) for c in cameras]),
        "marker_pixels": np.array([c.project(markers) for c in cameras]),
        "measured_c": balls[:12],
        "markers_m": CASE.markers.points,
    })  # fmt: skip
    found = adjust(exact, one.guess)
    assert found.chi2 < 1e-9
    assert np.abs(found.unknowns.vector() - x._replace(balls_c=balls, markers_m=exact.markers_m).vector()).max() < 1e-4


def test_a_gross_error_is_refused(one):
    measured = one.observed.measured_c.copy()
    measured[3] = [0.0, 0.0, -5000.0]
    broken = type(one.observed)(**{**vars(one.observed), "measured_c": measured})
    with refused("not_settled", by=NoAnswerError):
        adjust(broken, one.guess)
