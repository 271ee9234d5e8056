"""Recordings: what is refused, and that the CSV keeps every digit."""

import numpy as np
import pytest
from refusals import refused

from puncture_twin.planning.base.errors import InputError
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording
from puncture_twin.twin.guidance.ultrasound.recording_file import read_recording, write_recording
from puncture_twin.twin.guidance.ultrasound.simulate import simulate_recording


@pytest.fixture
def recording(rng):
    """Six noisy poses with directions."""
    return simulate_recording(rng, 6)[0]


@pytest.mark.parametrize("kind", ["2-D directions", "3-D directions", "no directions", "pixels", "shaft"])
def test_the_csv_keeps_every_digit(recording, tmp_path, kind):
    """Writing and reading gives the same numbers, names and units."""
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
    for wrong in (0.5, -3.0, np.nan, np.inf):
        with pytest.raises(InputError, match="shaft_mm of pose 1 is"):
            Recording(*parts, recording.v, shaft_mm=np.append(wrong, np.full(5, 20.0)))


@pytest.mark.parametrize(
    ("key", "change", "says"),
    [
        ("A", lambda a: a[:, :3], r"A has shape \(6, 3, 4\); allowed: \(6, 4, 4\)"),
        ("A", lambda a: np.where(np.arange(6)[:, None, None] == 2, np.nan, a), "A of pose 3 is not finite"),
        ("B", lambda a: a * [1, 1, -1, 1], "B of pose 1 is not a rigid motion"),
        ("B", lambda a: a * [1.001, 1, 1, 1], "B of pose 1 is not a rigid motion"),
        ("A", lambda a: a + [[0, 0, 0, 0]] * 3 + [[1, 0, 0, 0]], "A has shape|A of pose 1 is not a rigid motion"),
        ("P", lambda a: a[:, :1], r"P has shape \(6, 1\)"),
        ("P", lambda a: a * np.inf, "P of pose 1 is not finite"),
        ("v", lambda a: a * 0, "v of pose 1 has no length"),
        ("v", lambda a: np.column_stack([a * 0.1, np.ones(6)]), "v of pose 1 points out of the image"),
        ("v", lambda a: a[:3], r"v has shape \(3, 2\)"),
    ],
)
def test_a_broken_recording_is_refused(recording, key, change, says):
    """Every broken array is bad input that names the pose."""
    parts = {name: np.array(getattr(recording, name)) for name in "ABPv"}
    if says.startswith("A has shape|"):
        parts["A"][0, 3, 0] = 1.0
    else:
        parts[key] = change(parts[key])
    with pytest.raises(InputError, match=says):
        Recording(**parts)


def test_names_must_be_unique(recording):
    """Two poses of one name could not be told apart in a report."""
    with refused("duplicate_name"):
        Recording(recording.A, recording.B, recording.P, names=("a",) * 6)


@pytest.mark.parametrize(
    ("edit", "says"),
    [
        (lambda text: text.replace("A_x_mm", "A_x_m"), "header: columns name, A_r11"),
        (lambda text: text.replace("P_v_mm,", ""), "header: columns"),
        (lambda text: text.splitlines()[0] + "\n", "no pose"),
        (lambda text: text.rsplit(",", 1)[0] + "\n", "row 7: 28 fields; allowed: 29 fields"),
        (lambda text: text.rsplit(",", 1)[0] + ",nan\n", "row 7, v_y: 'nan' is not finite"),
        (lambda text: text.rsplit(",", 1)[0] + ",left\n", "row 7, v_y: 'left' is not a number"),
        (lambda text: text.replace("\n1,", "\n1,9", 1), "A of pose 1 is not a rigid motion"),
        (lambda text: text.replace("\n2,", "\n1,", 1), "one name per pose"),
    ],
)
def test_a_broken_file_is_refused(recording, tmp_path, edit, says):
    """Every broken file is bad input that names the file and the place in it."""
    path = tmp_path / "recording.csv"
    write_recording(recording, path)
    path.write_text(edit(path.read_text()))
    with pytest.raises(InputError, match=f"recording.csv.*{says}"):
        read_recording(path)


def test_a_missing_file_is_refused(tmp_path):
    """A folder without a recording says which file it lacks."""
    with refused("no_such_file"):
        read_recording(tmp_path)


def test_recordings_join_and_divide(recording):
    """A subset and the rest make the whole again; different columns do not join."""
    whole = recording.subset(np.arange(2)).joined(recording.subset(slice(2, 6)))
    for key in "ABPv":
        np.testing.assert_array_equal(getattr(whole, key), getattr(recording, key))
    with refused("tables_differ"):
        recording.joined(Recording(recording.A, recording.B, recording.P))
