"""Touches of least error: better than those that turn least, and than those farthest from singular."""

from dataclasses import replace

import numpy as np
import pytest
from uncertainty_world import NO_ARM, SLICES, declared, world

from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.fit_uncertainty import reading_noise
from puncture_twin.planning.uncertainty.touch_choice import choose_touches

ARM = {"arm": "nominal", "tip_offset_mm": 0.0, "needle_direction_deg": 0.0, "joint_drift_deg": 0.0}


def tip_rms(w, q_touch):
    noise = reading_noise(w.errors, w.error.model, w.error.tip_mm, q_touch, known=True)
    error = replace(w.error, fit=replace(w.error.fit, noise=noise))
    return np.sqrt(np.trace(error.covariance(w.puncture.q_insertion[None])[0, :3, :3]))


@pytest.mark.parametrize(
    ("case", "method", "keys"), [("abdomen/case.toml", "rigid", ARM), ("carton/case_m.toml", "weighted", ARM | SLICES)]
)
def test_the_choice_leaves_least(case, method, keys):
    """Below touching like the insertion, far below touching far from singular; tips on the markers."""
    w = world(case, method, declared(**keys))
    there = apply(w.puncture.T_base_ct, w.puncture.points_ct)
    q = choose_touches(w.error, there, w.puncture.q_insertion)
    like = world(case, method, declared(**keys), touch_like_insertion=True).puncture.q_touch
    chosen, alike, apart = (tip_rms(w, touches) for touches in (q, like, w.puncture.q_touch))
    assert chosen <= alike + 1e-9
    assert chosen < 0.7 * apart
    T = flange_pose(w.error.model, q)
    np.testing.assert_allclose(T[:, :3, 3] + w.error.tip_mm * T[:, :3, 2], there, atol=1e-6)


def test_without_an_arm_s_errors_any_touch_will_do():
    w = world("abdomen/case.toml", "rigid", declared(**NO_ARM))
    there = apply(w.puncture.T_base_ct, w.puncture.points_ct)
    q = choose_touches(w.error, there, w.puncture.q_insertion)
    assert tip_rms(w, q) == pytest.approx(tip_rms(w, w.puncture.q_touch))
