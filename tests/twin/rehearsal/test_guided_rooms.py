"""Rooms under each way of guidance: what is realised is what was predicted, for the same patients."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused
from uncertainty_world import ball

from puncture_twin import api as pt
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.budget.guidance import corridor_mm, declared_ways, guided_error, lost_sight
from puncture_twin.planning.uncertainty.guided import WAYS
from puncture_twin.planning.uncertainty.hit import hit_in_ball
from puncture_twin.planning.uncertainty.pose_error import Bend
from puncture_twin.twin.jobs.patient.run import room_count
from puncture_twin.twin.rehearsal import distribution
from puncture_twin.twin.rehearsal.distribution import rehearse_trials
from puncture_twin.twin.rehearsal.guided_trials import guided_trials
from puncture_twin.twin.rehearsal.trials import draw_truths

ROOMS = 5000

DEVICES = "[motion]\ntarget_sd_mm = [0.4, 0.4, 1.0]\n[stereo]\n[ultrasound]\n"
BREATH = '[breathing]\namplitude_mm = 4.0\ndirection = [0.0, 0.6, 0.8]\ngate = 0.3\nweights = { "*" = 0.5 }\n'


@pytest.fixture(scope="module")
def insertion(tmp_path_factory):
    """A prepared case with all devices, and one direction that the arm reaches."""
    return prepared(tmp_path_factory.mktemp("ball"), DEVICES)


def prepared(folder, tables, nearest=False):
    """The round patient with more tables in its case, one direction, and the joints there."""
    file = ball(folder, errors="touch_mm = 0.2\n" + tables)
    context = pt.prepare(file)
    found = context.search()
    rows = np.flatnonzero(found.safe)
    row = (min if nearest else max)(
        rows, key=lambda row: corridor_mm(context.case, context.chance, found.outward_ct[row])
    )
    return context, found.outward_ct[row], found.arm.q_insertion[row]


@pytest.mark.parametrize("way", WAYS)
def test_every_way_errs_as_predicted(insertion, way):
    """Predicted over realised, the 95 % region, and the chance to be within radii, from rooms with nonlinear arms."""
    found = rehearse_trials(*insertion, ROOMS, 3, way)
    assert found.predicted_rms_mm / found.realised_rms_mm == pytest.approx(1.0, abs=0.03)
    assert found.in_region.mean() == pytest.approx(0.95, abs=0.0105)  # 0.94 to 0.96, the draws' own error beside it
    radii = (0.3, 0.5, 0.75, 1.0, 1.5, 2.0)
    off = [abs(hit_in_ball(found.cov_ct[None], mm)[0] - (found.tip_error_mm < mm).mean()) for mm in radii]
    assert np.mean(off) <= 0.01
    assert found.summary()["guidance"] == way and found.summary()["stopped"] == 0


def test_every_way_has_the_same_patients(insertion):
    """By a seed the truth is the same: target, motion, registration; without motion ct is the open loop, to the bit."""
    ct, us = (rehearse_trials(*insertion, 50, 3, way).trials for way in ("ct", "us"))
    for name in ("target_ct", "T_base_ct", "motion_ct", "chi_squared"):
        np.testing.assert_array_equal(getattr(ct, name), getattr(us, name))
    open_loop = rehearse_trials(*insertion, 50, 3).trials
    np.testing.assert_array_equal(ct.T_base_ct, open_loop.T_base_ct)
    np.testing.assert_allclose(ct.tip_ct + ct.motion_ct, open_loop.tip_ct, atol=1e-9)
    assert np.ptp(ct.motion_ct, axis=0).min() > 0.0 and not open_loop.motion_ct.any()


def test_rooms_that_breathe_err_as_predicted(tmp_path):
    """A phase of each room in the gate: markers and structures follow by their weights, the target wholly."""
    context, outward, q = prepared(tmp_path, DEVICES + BREATH)
    for way in ("ct", "ct+us"):
        found = rehearse_trials(context, outward, q, ROOMS, 3, way)
        assert found.predicted_rms_mm / found.realised_rms_mm == pytest.approx(1.0, abs=0.03), way
        assert "breathing" not in found.not_modelled
    resting, _, _ = prepared(tmp_path, DEVICES)
    still = rehearse_trials(resting, outward, q, 1, 3, "ct").predicted_rms_mm
    assert rehearse_trials(context, outward, q, 1, 3, "ct").predicted_rms_mm > still + 0.03


@pytest.mark.parametrize("way", ["stereo", "us+tip", "all"])
def test_a_needle_that_bends_is_seen_by_its_tip_alone(insertion, way):
    """Tissue bends what is in it: balls outside stay on the straight line, the picture shows the bent tip."""
    context, outward, q = insertion
    bend, query = Bend(1.5, 150.0), distribution._query(context, outward, q)
    believed, puncture = replace(query.believed, bend=bend), replace(query.puncture, bend=bend)
    one, moving = distribution._way(context, query._replace(believed=believed, puncture=puncture), way)
    truths = draw_truths(puncture, query.truth, ROOMS, np.random.default_rng(0), moving)
    found = guided_trials(puncture, truths, query.truth, one, np.random.default_rng(1)).trials
    realised = np.sqrt(np.mean(np.sum((found.tip_ct - found.target_ct) ** 2, axis=1)))
    predicted = np.sqrt(np.trace(guided_error(one.model, way).tip_covariance(q[None])[0]))
    assert predicted / realised == pytest.approx(1.0, abs=0.03)
    straight = guided_error(replace(one.model, error=query.believed), way).tip_covariance(q[None])[0]
    added = predicted**2 - np.trace(straight)
    assert added == pytest.approx(bend.tip_mm**2, rel=0.01) if way == "stereo" else added < 0.3 * bend.tip_mm**2


@pytest.mark.parametrize("way", ["ct", "us"])
def test_what_rests_while_the_target_breathes_is_touched_as_often_as_predicted(tmp_path, way):
    """A rib beside the needle, which a registration leaves there, and a picture leads away.

    The breath goes to one side: taken as a symmetric error, the picture's chance would be twice too large.
    """
    resting = BREATH.replace("4.0", "9.0").replace("0.5", "0.0").replace("[0.0, 0.6, 0.8]", "[-1.0, 0.0, 0.0]")
    context, outward, q = prepared(tmp_path, "arm = 'nominal'\n" + DEVICES + resting, nearest=True)
    query = distribution._query(context, outward, q)
    one, moving = distribution._way(context, query, way)
    truths = draw_truths(query.puncture, query.truth, ROOMS, np.random.default_rng(0), moving)
    done = guided_trials(
        query.puncture, truths, query.truth, replace(one, corridor_mm=np.inf), np.random.default_rng(1)
    )
    found = distribution._measured(context, query, done.trials, np.random.default_rng(2), 0, (one, done.stopped))
    assert found.touched.mean(axis=0) == pytest.approx(found.p_touch, abs=0.006)
    assert found.p_touch[0] > 0.01


def test_no_correction_leaves_the_corridor(insertion):
    """In a narrow one many trials are stopped; of what was executed nothing went farther from the plan."""
    context, outward, q = insertion
    query = distribution._query(context, outward, q)
    way, moving = distribution._way(context, query, "ct+us")
    narrow = replace(way, corridor_mm=0.8)
    truths = draw_truths(query.puncture, query.truth, 10_000, np.random.default_rng(0), moving)
    done = guided_trials(query.puncture, truths, query.truth, narrow, np.random.default_rng(1))
    assert np.linalg.norm(done.aside_base, axis=1).max() <= narrow.corridor_mm
    assert 0.2 < done.stopped.mean() < 1.0
    cameras = guided_trials(
        query.puncture, truths, query.truth, replace(narrow, name="stereo"), np.random.default_rng(1)
    )
    assert cameras.stopped.mean() < 0.05  # they correct what registration and arm had wrong, and go nowhere else


def test_what_is_hidden_is_missing_and_named(insertion):
    """Hidden balls leave the cameras blind for the needle, which is refused; all other devices go on without them."""
    context, outward, q = insertion
    way, _ = distribution._way(context, distribution._query(context, outward, q), "all")
    balls = dict.fromkeys(("ball 80 mm", "ball 160 mm"), "the arm is before it")
    model = replace(way.model, looks=tuple(look._replace(hidden={**look.hidden, **balls}) for look in way.model.looks))
    with pytest.raises(NoAnswerError) as caught:
        guided_error(model, "stereo")
    assert caught.value.code == "lost_sight"
    assert len(lost_sight(model, "all")) == 2 * len(model.looks) and lost_sight(model, "us") == ()
    seen = guided_error(way.model, "all").tip_covariance(q[None])[0]
    assert np.trace(guided_error(model, "all").tip_covariance(q[None])[0]) > np.trace(seen)


def test_a_way_needs_its_devices_and_trials(tmp_path):
    """Undeclared devices, unknown ways, physics, and no trials at all are refused."""
    context, outward, q = prepared(tmp_path, "[stereo]\n")
    assert declared_ways(context.case) == ("ct", "stereo", "ct+stereo")
    with refused("no_device"):
        rehearse_trials(context, outward, q, 1, 0, "ct+us")
    with refused("unknown_guidance"):
        room_count(10, 0, "by hand")
    for rooms, physics in ((None, 0), (10, 2)):
        with refused("conflicting_options"):
            room_count(rooms, physics, "ct")
