"""What a servo case declares of errors: defaults, and a truth that is drawn from it."""

import numpy as np
import pytest
from refusals import refused
from servo_world import CASE

from benchmarks.servo_rooms import varied
from puncture_twin.meshes import folder
from puncture_twin.planning.geometry.rigid import log_rotation
from puncture_twin.twin.guidance.stereo.declared_errors import ServoErrors
from puncture_twin.twin.guidance.stereo.planned import planned_cameras
from puncture_twin.twin.guidance.stereo.servo_case import load_servo_case
from puncture_twin.twin.plant.stereo_workcell import draw_workcell

HEAD = folder() / "head"
TEXT = (HEAD / "servo.toml").read_text(encoding="utf-8")
ROOMS = 400


def read(tmp_path, text):
    for name in ("head.ply", "markers.csv", "targets.csv"):
        (tmp_path / name).symlink_to(HEAD / name)
    (tmp_path / "servo.toml").write_text(text, encoding="utf-8")
    return load_servo_case(tmp_path)


def without_errors():
    start = TEXT.index("[errors]")
    return TEXT[:start] + TEXT[TEXT.index("[servo]") :]


def test_a_case_that_declares_nothing_has_the_defaults(tmp_path):
    errors = read(tmp_path, without_errors()).errors
    assert errors == ServoErrors()
    assert (errors.link_mm, errors.tip_offset_mm, errors.marker_mm, errors.target_mm) == (0.05, 0.3, 0.3, 0.3)
    assert np.degrees(errors.twist) == pytest.approx(0.005)
    assert errors.ball_px is None
    assert ServoErrors(arm="nominal").link_mm == 0.5
    assert ServoErrors(arm="nominal", joint_deg=0.2, marker_mm=0.7).target_mm == 0.7


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        ('model = "ur3"', 'model = "ur3"\nlink_mm = 0.3', "unknown_key link_mm"),
        ("[errors]", "[rehearsal.errors]", "missing_errors"),
        ("ball_offset_mm", "ball_ofset_mm", "unknown_key ball_offset_mm"),
        ("tip_offset_mm = 0.1", 'arm = ["nominal"]', "bad_value errors.arm"),
        ("hit_radius_mm = 0.5", "hit_radius_mm = 0", "bad_value target.hit_radius_mm"),
    ],
)
def test_what_contradicts_itself_is_refused(tmp_path, old, new, what):
    """An error outside of its table, a truth beside no belief, an unknown key, a negative deviation."""
    assert old in TEXT
    with refused(*what.split()):
        read(tmp_path, TEXT.replace(old, new, 1))


def test_what_is_stated_is_read_back():
    again = ServoErrors.model_validate(CASE.errors.stated())
    assert again.arm_deviations() == pytest.approx(CASE.errors.arm_deviations())
    assert again.camera_deviations() == pytest.approx(CASE.errors.camera_deviations())
    assert again.scaled(2.0).head_turn == pytest.approx(2 * again.head_turn)
    assert again.scaled(2.0).camera_deviations() == pytest.approx(2 * again.camera_deviations())


def test_the_truth_is_drawn_from_the_declaration():
    """Over 400 rooms arm, cameras, lenses, tool and head scatter as declared: each within 4 standard errors."""
    keys = {"head_shift_mm": 0.4, "head_turn_deg": 0.2, "tip_offset_mm": 0.5, "needle_direction_deg": 0.3}
    case = varied(CASE, errors=keys)
    rooms = [draw_workcell(case, np.random.default_rng(seed)) for seed in range(ROOMS)]
    errors, plan = case.errors, planned_cameras(case)[0]
    moved = np.array([np.linalg.inv(workcell.T_c_m) @ workcell.T_c_m_after for workcell in rooms])
    scatter = {
        "ball": (np.array([workcell.tool.ball_offset for workcell in rooms]), errors.ball_offset_mm),
        "tip": (np.array([workcell.tool.tip_offset for workcell in rooms]), errors.tip_offset_mm),
        "lean": (np.array([workcell.tool.lean[:2] for workcell in rooms]), errors.needle_direction),
        "links": (np.array([workcell.arm.true.a - workcell.arm.nominal.a for workcell in rooms]), errors.link_mm),
        "zeros": (np.array([one.arm.true.zeros for one in rooms]), errors.joint),
        "axis": (np.array([one.cameras[0].cx - plan.cx for one in rooms]), errors.camera_axis_px),
        "k1": (np.array([one.cameras[1].distortion[0] - plan.distortion[0] for one in rooms]), errors.lens[0]),
        "turn": (log_rotation(moved[:, :3, :3]), errors.head_turn),
    }
    for name, (drawn, deviation) in scatter.items():
        rms = np.sqrt(np.mean(drawn**2))
        assert rms == pytest.approx(deviation, rel=4 / np.sqrt(2 * drawn.size)), name


def test_another_truth_leaves_the_belief_alone():
    """``[rehearsal.errors]`` changes what is drawn, is said to be a wrong belief, and guidance believes as before."""
    wrong = varied(CASE, rehearsal={"errors": CASE.errors.scaled(3.0).stated()})
    assert wrong.wrong_belief
    assert not CASE.wrong_belief
    assert wrong.errors == CASE.errors
    one, other = (draw_workcell(case, np.random.default_rng(1)) for case in (CASE, wrong))
    np.testing.assert_allclose(other.tool.tip_offset, 3 * one.tool.tip_offset)
    np.testing.assert_allclose(other.arm.true.zeros, 3 * one.arm.true.zeros)
