"""A stereo session in a folder: what is recorded is read again, and what is wrong in a folder is said."""

import shutil

import cv2
import numpy as np
import pytest
from refusals import refused
from servo_world import CASE, NoContacts

from puncture_twin.planning.base.files import new_folder
from puncture_twin.twin.jobs.servo.job import follow_recording
from puncture_twin.twin.rehearsal.stereo_session import run_session, statistics


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recorded") / "session"
    with new_folder(folder) as kept:
        session = run_session(CASE, 3, targets=("T2",), empty=NoContacts(), record=kept)
    return session, folder


def test_in_a_good_room_the_servo_ends_within_what_it_may(recorded):
    """Edges, a tenth of a millimetre: stereo, servo-only and the confirmation, from rendered pictures."""
    ours = statistics([recorded[0].trial])
    assert ours["stereo_max"] < 0.1
    assert ours["servo_only_max"] < 0.2
    assert ours["not_confirmed"] == 0.0


def test_a_recorded_session_is_estimated_as_when_it_ran(recorded):
    """Calibration, mapping, every look and the needle are those of the session, from tables and pictures alone."""
    session, folder = recorded
    facts = follow_recording(CASE.path, folder).summary
    np.testing.assert_allclose(facts["T_base_c"], session.calibration.T_base_c, atol=1e-9)
    np.testing.assert_allclose(facts["calibration_rms_px"], session.calibration.rms_px, atol=1e-9)
    assert facts["fre_mm"] == pytest.approx(session.mapping.fre_mm, abs=1e-9)
    (reached,) = session.reached
    np.testing.assert_allclose([one["error_mm"] for one in facts["looks"]], reached.servoed.errors_mm, atol=1e-9)
    assert facts["looks"][-1]["needle_rms_mm"] == pytest.approx(reached.row.needle_servoed.predicted_rms_mm, abs=1e-9)
    commands = [visit.q_command for visit in reached.servoed.visits]
    np.testing.assert_allclose(np.radians([one["joints_deg"] for one in facts["looks"]]), commands, atol=1e-12)
    sent = [np.radians(one["next_joints_deg"]) for one in facts["looks"][:-1]]
    np.testing.assert_allclose(sent, commands[1:], atol=1e-9)
    assert facts["converged"] == (reached.row.stop == "converged")


def edited(table, old, new):
    def change(folder):
        path = folder / table
        text = path.read_text(encoding="utf-8")
        assert old in text
        path.write_text(text.replace(old, new, 1), encoding="utf-8")

    return change


def other_picture(change):
    """On the first picture: its bytes."""

    def apply(folder):
        path = folder / "points_001_1_1.png"
        path.write_bytes(change(path.read_bytes()))

    return apply


def of_cells(*shape):
    return other_picture(lambda _: cv2.imencode(".png", np.zeros(shape, np.uint8))[1].tobytes())


WRONG = {
    "no table": (lambda folder: (folder / "stops.csv").unlink(), "no_such_file"),
    "other columns": (edited("points.csv", "q1_deg", "q1_rad"), "wrong_columns"),
    "no number": (edited("stops.csv", "T2,", "T2,x"), "not_a_number"),
    "joints that no arm has": (edited("stops.csv", "T2,", "T2,9999"), "joints_beyond"),
    "another target": (edited("stops.csv", "T2,", "T99,"), "no_target"),
    "another marker": (edited("markers.csv", CASE.markers.names[0], "Q"), "no_marker"),
    "other names": (edited("markers_image.csv", CASE.markers.names[0], "Q"), "names_differ"),
    "no picture": (lambda folder: (folder / "points_004_2_1.png").unlink(), "no_such_file"),
    "a picture in colour": (of_cells(960, 1280, 3), "not_grey"),
    "a picture of another size": (of_cells(480, 640), "wrong_size"),
    "a marker twice": (edited("markers.csv", CASE.markers.names[1], CASE.markers.names[0]), "duplicate_name"),
    "no picture at all": (other_picture(lambda _: b"\x89PNG"), "wrong_format"),
    "a picture without its lower half": (other_picture(lambda data: data[: len(data) // 2]), "file_cut"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_what_is_wrong_in_a_folder_is_said(recorded, tmp_path, wrong):
    change, code = WRONG[wrong]
    shutil.copytree(recorded[1], tmp_path / "session")
    change(tmp_path / "session")
    with refused(code):
        follow_recording(CASE.path, tmp_path / "session")


def test_a_folder_that_is_there_is_not_written_over(tmp_path):
    """Nothing is touched; and one that fails half way does not appear."""
    (tmp_path / "there").mkdir()
    with refused("output_exists"), new_folder(tmp_path / "there"):
        pass
    with pytest.raises(RuntimeError), new_folder(tmp_path / "new") as kept:
        (kept / "a.csv").write_text("x", encoding="utf-8")
        raise RuntimeError
    assert sorted(path.name for path in tmp_path.iterdir()) == ["there"]
