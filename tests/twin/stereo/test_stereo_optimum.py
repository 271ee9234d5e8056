"""The joint estimate against its slopes, the Cramer-Rao bound and the paper's chain; the needle's error by it."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused
from scipy.special import chdtrc
from servo_world import CASE, HELD, IMAGE_MM, NoContacts, simulate

from benchmarks.servo_rooms import DOUBTED, drawn_from, pixel_detector, room_outcome, told_of_pixels, varied
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.geometry.rigid import apply, log_rotation
from puncture_twin.twin.guidance.stereo import joint_model
from puncture_twin.twin.guidance.stereo.servo_law import ball_base
from puncture_twin.twin.rehearsal.stereo_session import run_session

TARGET = CASE.targets.points[1]
DRAWS = 30


@pytest.fixture(scope="module")
def one():
    return simulate(0)


def test_slopes_are_those_of_the_residuals(one):
    """Thirty columns against central differences of the residuals, away from the nominal values."""
    model = joint_model.JointModel(one.observed, one.guess)
    start = joint_model.first_unknowns(one.observed, one.guess)
    x = start._replace(cameras=start.cameras + 0.5, arm=start.arm - 0.5, head=start.head + 1e-3, base=start.base - 1e-3)
    slopes = model.linearised(x).slopes
    scale = np.abs(slopes).max(axis=0)
    for column in np.random.default_rng(1).choice(slopes.shape[1], 30, replace=False):
        step = 1e-5 * np.eye(slopes.shape[1])[column]
        numeric = (model.linearised(x.moved(step)).residuals - model.linearised(x.moved(-step)).residuals) / 2e-5
        assert np.abs(numeric - slopes[:, column]).max() < 2e-5 * scale[column]


def bound(observed, guess, at):
    """The Cramer-Rao bound: Fisher's information at stated unknowns."""
    model = joint_model.JointModel(observed, guess)
    return joint_model.Adjusted(model, at, np.linalg.inv(model.linearised(at).information), 0.0, 0)


def test_it_reaches_the_bound():
    """Over 30 drawn sessions the rms error of target minus ball is within 1.15 of the Cramer-Rao bound at the truth."""
    errors, bounds, chi2, freedom = [], [], [], 0
    for seed in range(DRAWS):
        session = simulate(seed)
        found = joint_model.adjust(session.observed, session.guess)
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
    found = joint_model.adjust(one.observed, one.guess).offset(-1, TARGET)
    apart = found.ball_covariance + found.target_covariance
    assert np.trace(found.covariance) < np.trace(apart)


def test_a_perfect_session_is_found_exactly(one):
    """Without errors in the pixels of a nominal room the adjustment returns the truth."""
    observed, cameras = one.observed, one.observed.planned
    x = joint_model.first_unknowns(observed, one.guess)
    balls = apply(one.guess.T_c_base, ball_base(HELD, observed.q_command))
    markers = apply(one.guess.T_c_m, CASE.markers.points)
    exact = type(observed)(**{
        **vars(observed),
        "pixels": np.array([c.project(balls) for c in cameras]),
        "marker_pixels": np.array([c.project(markers) for c in cameras]),
        "measured_c": balls[:12],
        "markers_m": CASE.markers.points,
    })  # fmt: skip
    found = joint_model.adjust(exact, one.guess)
    assert found.chi2 < 1e-9
    assert np.abs(found.unknowns.vector() - x._replace(balls_c=balls, markers_m=exact.markers_m).vector()).max() < 1e-4


def test_a_gross_error_is_refused(one):
    measured = one.observed.measured_c.copy()
    measured[3] = [0.0, 0.0, -5000.0]
    broken = type(one.observed)(**{**vars(one.observed), "measured_c": measured})
    with refused("not_settled", by=NoAnswerError):
        joint_model.adjust(broken, one.guess)


ROOMS, FEW_ROOMS = 40, 12
BOUND_OF = 60
"""Bounds are three standard errors of so many rooms: two and a half of those that are drawn."""
HERE = told_of_pixels(CASE)


@pytest.fixture(scope="module")
def rooms():
    return [room_outcome(HERE, seed) for seed in range(ROOMS)]


@pytest.fixture(scope="module")
def found():
    session = simulate(3)
    return joint_model.adjust(session.observed, session.guess)


def test_the_rods_slopes_are_differences():
    """All 26 columns, shift and turn, at an arm that errs, by central differences."""
    rng = np.random.default_rng(4)
    eta = 1e-3 * rng.normal(size=joint_model.N_ROD)
    q = np.array([[0.3, -1.2, 1.4, -1.7, -1.5, 0.4], [0.1, -1.0, 1.1, -1.6, -1.3, 0.2]])
    slopes = joint_model.rod_poses(HELD, eta, q).slopes
    for column, step in enumerate(1e-5 * np.eye(joint_model.N_ROD)):
        up, down = joint_model.rod_poses(HELD, eta + step, q), joint_model.rod_poses(HELD, eta - step, q)
        np.testing.assert_allclose((up.ball - down.ball) / 2e-5, slopes[:, :3, column], atol=1e-6)
        turn = log_rotation(up.R_base_flange @ down.R_base_flange.swapaxes(1, 2)) / 2e-5
        np.testing.assert_allclose(turn, slopes[:, 3:, column], atol=1e-8)


def unseen(found, target_m):
    """The needle where the last stay's command sends it, without its look."""
    return joint_model.open_loop_error(found, found.model.observed.q_command[-1], target_m)


def seen(found, target_m):
    return joint_model.servoed_error(found, -1, target_m)


@pytest.mark.parametrize("of", [unseen, seen])
def test_what_each_unknown_does_to_the_needle_is_a_difference(found, of):
    """With one unknown uncertain, Sigma6 grows by the outer product of the pose's central difference by it."""
    x, size = found.unknowns, len(found.covariance)
    target = CASE.targets.points[0] + of(found, CASE.targets.points[0]).offset_m  # where the tip is: no known offset
    blank = of(replace(found, covariance=np.zeros((size, size))), target).covariance
    for column in range(size):
        one = np.zeros((size, size))
        one[column, column] = 1.0
        grown = of(replace(found, covariance=one), target).covariance - blank
        h = 1e-5
        up, down = (of(replace(found, unknowns=x.moved(sign * h * np.eye(size)[column])), target) for sign in (1, -1))
        turn = log_rotation(up.R_m_needle @ down.R_m_needle.T)
        slope = np.concatenate([up.offset_m - down.offset_m, turn]) / (2 * h)
        scale = max(np.abs(slope).max(), 1e-3)
        np.testing.assert_allclose(grown, np.outer(slope, slope), atol=2e-4 * scale**2)


def test_the_servo_takes_the_arm_out_of_the_tip_but_not_out_of_the_direction():
    """An arm that is declared five times as bad leaves the tip as seen, and spoils tip unseen and direction."""
    session, target = simulate(3), CASE.targets.points[1]
    five = {key: 5 * getattr(CASE.errors, key) for key in ("link_mm", "joint_deg", "twist_deg")}
    exact_tip = session.observed.errors.model_copy(update={"tip_offset_mm": 0.0})
    worse = exact_tip.model_copy(update=five)
    good, bad = (
        joint_model.adjust(replace(session.observed, errors=errors), session.guess) for errors in (exact_tip, worse)
    )
    tips = [np.trace(way(fit, target).tip_covariance) for fit in (good, bad) for way in (seen, unseen)]
    assert tips[2] == pytest.approx(tips[0], rel=0.05)
    assert tips[0] < tips[1] < tips[3]
    assert seen(bad, target).direction_rms > 1.5 * seen(good, target).direction_rms


def test_what_no_camera_sees_stays(found):
    """Tip offset, needle direction, target reading and a head that moves add what they are."""
    target = found.unknowns.markers_m.mean(axis=0)  # about which the head turns
    errors = found.model.observed.errors.model_copy(update={"tip_offset_mm": 0.0, "needle_direction_deg": 0.0})

    def told(**keys):
        observed = replace(found.model.observed, errors=errors.model_copy(update=keys))
        return joint_model.servoed_error(replace(found, model=replace(found.model, observed=observed)), -1, target)

    plain = told()
    tip = told(tip_offset_mm=0.7).covariance - plain.covariance
    np.testing.assert_allclose(tip, np.diag([0.49] * 3 + [0.0] * 3), atol=1e-12)
    leaning = told(needle_direction_deg=np.degrees(0.01))
    assert leaning.direction_rms**2 - plain.direction_rms**2 == pytest.approx(2e-4)
    np.testing.assert_allclose(leaning.covariance[:3, :3], plain.covariance[:3, :3], atol=1e-12)
    moved = told(head_shift_mm=0.3, head_turn_deg=np.degrees(0.02)).covariance - plain.covariance
    np.testing.assert_allclose(moved, np.diag([0.09] * 3 + [4e-4] * 3), atol=1e-9)
    read = told(target_mm=0.4)
    np.testing.assert_allclose(read.tip_covariance - plain.tip_covariance, 0.16 * np.eye(3), atol=1e-12)


def test_of_an_arrival_an_image_of_the_ball_leaves_the_rotation_that_it_does_not_show(found):
    """With all else known: the joints' error at an arrival, given the ball's shift, by differences and Schur."""
    names = ("tip_offset_mm", "needle_direction_deg", "head_shift_mm", "head_turn_deg", "target_mm")
    observed = found.model.observed
    errors = observed.errors.model_copy(update=dict.fromkeys(names, 0.0))
    model, x = replace(found.model, observed=replace(observed, errors=errors)), found.unknowns
    known = replace(found, model=model, covariance=np.zeros_like(found.covariance))
    by_joint = []
    for step in 1e-4 * np.eye(6):
        up, down = (model.rod_at(x, (observed.q_command[-1] + sign * step)[None]) for sign in (1, -1))
        turned = log_rotation(up.R_base_flange[0] @ down.R_base_flange[0].T)
        by_joint.append(np.concatenate([up.ball[0] - down.ball[0], turned]) / 2e-4)
    J = np.kron(np.eye(2), (model.pose_of("head", x)[:3, :3].T @ model.pose_of("base", x)[:3, :3])) @ np.transpose(
        by_joint
    )
    cov = errors.arrival**2 * J @ J.T
    seen_ball = cov[:3, :3] + joint_model.FLOOR_MM**2 * np.eye(3)
    left = cov[3:, 3:] - cov[3:, :3] @ np.linalg.solve(seen_ball, cov[:3, 3:])
    told = seen(known, x.markers_m.mean(axis=0)).covariance
    assert np.trace(left) > 0.01 * np.trace(cov[3:, 3:]) > 0.0
    np.testing.assert_allclose(told[3:, 3:], left, atol=1e-4 * np.trace(left))
    np.testing.assert_allclose(told[:3], 0.0, atol=1e-15)


def test_without_errors_the_needle_is_where_it_is_believed():
    """A room of which everything is declared to be exact leaves some thousandths of a millimetre, and hits."""
    exact = CASE.errors.scaled(0.0).stated() | {"ball_px": 1e-3}
    outcome = room_outcome(varied(CASE, errors=exact), 0)
    assert outcome.servoed.predicted_rms_mm < 0.02
    assert outcome.servoed.realised_mm < 0.02
    assert outcome.servoed.p_hit == pytest.approx(1.0, abs=1e-6)
    assert outcome.servoed.realised_direction_deg < 0.01


def test_many_rooms_are_as_predicted(rooms):
    """Rooms drawn anew, true kinematics: rms (known to 6 %), regions and hits."""
    share = 3 * np.sqrt(0.05 * 0.95 / BOUND_OF)
    for way in ("open_loop", "servoed"):
        needles = [getattr(workcell, way) for workcell in rooms]
        realised, predicted = (
            np.mean([getattr(one, name) ** 2 for one in needles]) for name in ("realised_mm", "predicted_rms_mm")
        )
        assert np.sqrt(realised / predicted) == pytest.approx(1.0, abs=3 / np.sqrt(2 * 3 * BOUND_OF))
        assert np.mean([one.square for one in needles]) == pytest.approx(3.0, abs=3 * np.sqrt(6 / BOUND_OF))
        assert np.mean([one.square_of_pose for one in needles]) == pytest.approx(6.0, abs=3 * np.sqrt(12 / BOUND_OF))
        assert np.mean([one.in_region for one in needles]) == pytest.approx(0.95, abs=share)
        chances = np.array([one.p_hit for one in needles])
        spread = np.sqrt(np.mean(chances * (1 - chances)) / BOUND_OF)
        assert np.mean([one.hit for one in needles]) == pytest.approx(chances.mean(), abs=3 * spread)
    freedom = rooms[0].freedom
    assert np.mean([one.chi_squared for one in rooms]) == pytest.approx(
        freedom, abs=3 * np.sqrt(2 * freedom / BOUND_OF)
    )


def test_a_declaration_too_small_by_two_is_seen(rooms):
    """Rooms drawn twice as wide as believed: most leave the 95 % ellipsoid's size behind, and the residuals tell."""
    wide = [room_outcome(drawn_from(HERE, 2.0), seed) for seed in range(FEW_ROOMS)]
    assert np.mean([one.servoed.in_region for one in wide]) < 0.7
    doubted = [np.mean([chdtrc(one.freedom, one.chi_squared) < DOUBTED for one in some]) for some in (wide, rooms)]
    assert doubted[0] > 0.9 and doubted[1] < 0.1


def test_a_session_predicts_every_needle_that_it_saw():
    """Before and after the servo, by the chain; where the arm cannot start there is no prediction."""
    session = run_session(
        HERE, 1, targets=("T1", "T6"), empty=NoContacts(), detector_of=lambda plant: pixel_detector(plant, 0.03)
    )
    for one in session.trial.targets:
        seen, unseen = one.needle_servoed, one.needle_open_loop
        assert seen.predicted_rms_mm < unseen.predicted_rms_mm
        assert seen.offset_mm < HERE.file.servo.tolerance_mm + 0.1
        assert seen.square < 25
        assert 0.0 <= unseen.p_hit <= seen.p_hit <= 1.0
