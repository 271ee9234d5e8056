"""The words and the page of a servo session, from plain numbers."""

import json
import re

import numpy as np
import pytest
from PIL import Image
from refusals import refused
from servo_world import CASE

from benchmarks.servo_rooms import varied
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.twin.jobs.papers.liu2007 import paper_sections, reproduction_facts
from puncture_twin.twin.jobs.servo.job import Sessions
from puncture_twin.twin.jobs.servo.report import Pictures, servo_facts, servo_text, write_servo_page
from puncture_twin.twin.rehearsal.stereo_session import (
    DeclarationTest,
    NeedleOutcome,
    ServoTrial,
    TargetRow,
    needle_statistics,
    statistics,
)


def needle(predicted, realised, square, hit):
    """A needle's outcome, of which the rest does not matter here."""
    return NeedleOutcome(
        predicted, 0.05, (0.5, 0.4, 0.3), 0.2, 0.1, 0.2, 0.9, realised, 0.15, square, 5.0, hit, square < 7
    )


def trials():
    """Two seeds of two targets, one not confirmed; a third seed that could not be held."""
    rows = [
        TargetRow(1, "T1", 0.30, 0.25, 0.9, 0.31, 0.05, 1, "converged", needle(0.9, 1.2, 9.0, False),
                  needle(0.3, 0.4, 2.0, True)),
        TargetRow(1, "T2", 0.20, 0.25, 1.1, 0.25, 0.15, 10, "tolerance_not_reached"),
        TargetRow(2, "T1", 0.10, 0.25, 0.7, 0.12, 0.04, 2, "converged"),
        TargetRow(2, "T2", 0.40, 0.25, 0.5, 0.32, 0.08, 1, "converged"),
    ]  # fmt: skip
    rod = [ServoTrial(seed, (0.01, 0.03), (0.02, 0.03), 0.4, 0.2, tuple(r for r in rows if r.seed == seed), None,
                        DeclarationTest(300.0, 200) if seed == 1 else None) for seed in (1, 2)]  # fmt: skip
    return [*rod, ServoTrial(3, refused="calibration, point 4: camera 1: few_inliers")]


def test_statistics_are_those_of_the_rows():
    ours = statistics(trials())
    by_hand = {"seeds": 3, "targets": 4, "refused": 1, "mapping_mean": 0.25, "before_mean": 0.8, "after_mean": 0.25,
               "after_over_mapping": 1.0, "servo_only_max": 0.15, "median_steps": 1.5, "not_confirmed": 0.25,
               "mapping_rms": np.sqrt((0.09 + 0.04 + 0.01 + 0.16) / 4), "stereo_mean": 0.02,
               "stereo_max": 0.03}  # fmt: skip
    assert {key: ours[key] for key in by_hand} == pytest.approx(by_hand)
    with refused("no_session", "few_inliers", by=NoAnswerError):
        statistics(trials()[2:])


def test_the_words_say_what_was_not_reached():
    """A target that was not confirmed and a session that was not held are both said."""
    facts = servo_facts(CASE, trials(), statistics(trials()))
    text = servo_text({**facts, "files": ["out/servo.html"]})
    assert "tolerance not reached" in text
    assert "not possible: 1 session" in text
    assert re.search(r"not confirmed +25.0 %", text)
    assert facts["sessions"][2]["refused"].endswith("few_inliers")
    assert facts["stops"] == {"converged": 3, "tolerance_not_reached": 1}


def test_needles_are_told_beside_what_was_predicted():
    """Rms, share in the ellipsoid, hits and the declaration's test, against the rows; a wrong belief is said first."""
    rows = [row for one in trials() for row in one.targets]
    ours = needle_statistics([row.needle_servoed for row in rows])
    assert [ours[key] for key in ("needles", "realised_rms_mm", "coverage_95", "hit_share")] == [1, 0.4, 1.0, 1.0]
    assert needle_statistics([row.needle_open_loop for row in rows])["coverage_95"] == 0.0
    assert needle_statistics([None]) is None
    facts = servo_facts(CASE, trials(), statistics(trials()))
    text = servo_text({**facts, "files": []})
    assert "WARNING: residuals 300 for 200 degrees of freedom, p = 0.000" in text
    assert re.search(r"T2 +unknown", text)
    assert "wrong by design" not in text
    assert facts["needle"]["p_touch"] is None
    assert facts["needle"]["declared"]["joint_deg"] == pytest.approx(0.05)
    assert facts["sessions"][0]["targets"][0]["needle_servoed"]["in_region"]
    json.dumps(facts, allow_nan=False)
    wrong = varied(CASE, rehearsal={"errors": CASE.errors.scaled(2.0).stated()})
    assert "wrong by design" in servo_text({**servo_facts(wrong, trials(), statistics(trials())), "files": []})


def test_the_page_needs_no_network_and_shows_every_number(tmp_path):
    """Pictures are embedded, nothing is loaded, and what the terminal shows is there too, with the paper's columns."""
    picture, page = tmp_path / "one.png", tmp_path / "servo.html"
    Image.new("RGB", (4, 4)).save(picture)
    sessions = Sessions(CASE, None, tuple(trials()), statistics(trials()))
    facts = reproduction_facts(sessions, sessions)
    paper = paper_sections(facts)
    write_servo_page(CASE, facts, Pictures(picture, [picture, picture]), page, paper)
    text = page.read_text(encoding="utf-8")
    assert "http" not in re.sub(r"http-equiv", "", text)
    assert text.count("data:image/png;base64,") == 3
    assert "{{" not in text
    for words in ("25.0 %", "Chance to touch: not computed: the case has no structures.", "tolerance not reached",
                  "1.47 / 2.41 (differs from the rows)", "1.479 / 2.41", "1.200 / 0.900"):  # fmt: skip
        assert words in text and words in servo_text({**facts, "files": []}, paper)
    without = servo_facts(CASE, trials(), statistics(trials()))
    assert "Liu et al." not in write_servo_page(CASE, without, Pictures(picture, [picture]), page).read_text()
