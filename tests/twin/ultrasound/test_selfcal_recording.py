"""Recordings: what is refused, and that the CSV keeps every digit."""

import numpy as np
import pytest
from refusals import refused

from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording
from puncture_twin.twin.guidance.ultrasound.recording_file import read_recording, write_recording
from puncture_twin.twin.plant.simulated_recording import simulate_recording


@pytest.fixture
def recording(rng):
    return simulate_recording(rng, 6)[0]


@pytest.mark.parametrize("kind", ["2-D directions", "3-D directions", "no directions", "pixels", "shaft"])
def test_the_csv_keeps_every_digit(recording, tmp_path, kind):
    v = {"2-D directions": recording.v, "no directions": None}.get(
        kind, np.column_stack([recording.v, np.full(6, 0.1)])
    )
    shaft = np.linspace(9.1, 40.3, 6) if kind in ("shaft", "pixels") else None
    names = ("a", "b", "c", "d", "e", "f")
    written = Recording(recording.A, recording.B, recording.P, v, names, kind == "pixels", shaft_mm=shaft)
    write_recording(written, tmp_path / "recording.csv")
    for path in (tmp_path, tmp_path / "recording.csv"):
        read = read_recording(path)
        assert read.names == written.names
        assert read.pixels == written.pixels
        for key in (*"ABPv", "shaft_mm"):
            np.testing.assert_array_equal(getattr(read, key), getattr(written, key))


def test_arrays_are_read_only_and_directions_unit(recording):
    """Nobody changes a recording by accident; a direction of any length becomes a unit vector."""
    doubled = Recording(recording.A, recording.B, recording.P, 2 * recording.v)
    np.testing.assert_allclose(np.linalg.norm(doubled.v, axis=1), 1, rtol=1e-15)
    with pytest.raises(ValueError, match="read-only"):
        doubled.P[0] = 0


def test_a_shafts_length_needs_a_direction_and_is_one(recording):
    """Without directions, or with a length that shows none, the recording is bad input that says so."""
    parts = (recording.A, recording.B, recording.P)
    with refused("missing_column"):
        Recording(*parts, shaft_mm=np.full(6, 20.0))
    for wrong, code in ((0.5, "out_of_range"), (-3.0, "out_of_range"), (np.nan, "not_finite"), (np.inf, "not_finite")):
        with refused(code, "shaft_mm"):
            Recording(*parts, recording.v, shaft_mm=np.append(wrong, np.full(5, 20.0)))


@pytest.mark.parametrize(
    ("key", "change", "says"),
    [
        ("A", lambda a: a[:, :3], "wrong_shape"),
        ("A", lambda a: np.where(np.arange(6)[:, None, None] == 2, np.nan, a), "not_finite A pose 3"),
        ("B", lambda a: a * [1, 1, -1, 1], "not_rigid B pose 1"),
        ("B", lambda a: a * [1.001, 1, 1, 1], "not_rigid"),
        ("A", lambda a: np.where(np.arange(96).reshape(6, 4, 4) == 12, 1.0, a), "not_rigid A pose 1"),
        ("P", lambda a: a[:, :1], "wrong_shape"),
        ("v", lambda a: a * 0, "zero_direction"),
        ("v", lambda a: np.column_stack([a * 0.1, np.ones(6)]), "out_of_image"),
    ],
)
def test_a_broken_recording_is_refused(recording, key, change, says):
    parts = {name: np.array(getattr(recording, name)) for name in "ABPv"}
    parts[key] = change(parts[key])
    with refused(*says.split()):
        Recording(**parts)


def test_names_must_be_unique(recording):
    with refused("duplicate_name"):
        Recording(recording.A, recording.B, recording.P, names=("a",) * 6)


@pytest.mark.parametrize(
    ("edit", "says"),
    [
        (lambda text: text.replace("A_x_mm", "A_x_m"), "wrong_columns A_r11"),
        (lambda text: text.replace("P_v_mm,", ""), "wrong_columns"),
        (lambda text: text.splitlines()[0] + "\n", "empty"),
        (lambda text: text.rsplit(",", 1)[0] + "\n", "ragged_row 28 29"),
        (lambda text: text.rsplit(",", 1)[0] + ",nan\n", "not_finite v_y nan"),
        (lambda text: text.replace("\n1,", "\n1,9", 1), "not_rigid"),
        (lambda text: text.replace("\n2,", "\n1,", 1), "duplicate_name"),
    ],
)
def test_a_broken_file_is_refused(recording, tmp_path, edit, says):
    path = tmp_path / "recording.csv"
    write_recording(recording, path)
    path.write_text(edit(path.read_text()))
    with refused(*says.split(), "recording.csv"):
        read_recording(path)


def test_a_missing_file_is_refused(tmp_path):
    with refused("no_such_file"):
        read_recording(tmp_path)
