"""The reproduction: it tells what holds and what does not, and is wired to its name."""

import json
from pathlib import Path

import numpy as np
import pytest

from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import SPEC_NOISE
from puncture_twin.twin.guidance.ultrasound.pose_choice import expected_tre_mm
from puncture_twin.twin.jobs.papers import axp_ybq
from puncture_twin.twin.jobs.papers.axp_ybq import COMPARED_WITH, reproduction_text, summary, truth_estimate, widened
from puncture_twin.twin.jobs.papers.papers import PAPERS
from puncture_twin.twin.plant.simulated_recording import simulate_recording


@pytest.fixture(scope="module")
def result():
    """Few runs: enough to see every row, not to judge the last percent."""
    return PAPERS["axp-ybq"](Path("unused"), 4)


def test_every_row_is_there(result):
    """Four methods at four counts, steps, direction, outliers, pixel sizes, and the exact case.

    From 20 poses on every error is within half and double the known one, which is what four runs can tell. The patent
    prints no figure: text and summary name the specification, and say that few runs widen the limits.
    """
    rows, text = result.summary["rows"], result.text
    assert len(rows) == 1 + 16 + 3 + 1 + 3 + 4
    assert rows[0]["ours"] < 1e-6 and result.summary["runs"] == 4
    assert json.loads(json.dumps(result.summary)) == result.summary
    assert all(np.isfinite(row["ours"]) for row in rows)
    assert max(row["ours"] for row in rows if row["unit"] == "steps") <= 10
    for row in rows:
        if row["known"] is not None and not row["what"].startswith("16"):
            assert row["known"] / 2 < row["ours"] < row["known"] * 2, row["what"]
    assert text.startswith("compared with this project's specification")
    assert "the patent application states no figure" in text and "widened for the chance" in text
    assert result.summary["compared_with"] == COMPARED_WITH


def test_the_bound_is_the_known_one():
    """The Cramer-Rao bound needs no noise: over 40 recordings it is within 5 % of the known numbers."""
    for n, known in ((20, 0.273), (30, 0.211), (50, 0.157)):
        bounds = []
        for seed in range(40):
            rng = np.random.default_rng([n, seed])
            recording, truth = simulate_recording(rng, n, noise=None)
            held, _ = simulate_recording(rng, 100, truth, noise=None)
            bounds.append(expected_tre_mm(recording, SPEC_NOISE, truth_estimate(truth), held) ** 2)
        assert np.sqrt(np.mean(bounds)) == pytest.approx(known, rel=0.05)


def test_a_number_beyond_its_limit_does_not_hold(monkeypatch):
    monkeypatch.setattr(axp_ybq, "SCALE_LIMIT_MM", 0.01)
    bad = summary(axp_ybq._scales(2)[:2], 2)
    assert not bad["holds"]
    assert [row["holds"] for row in bad["rows"]] == [True, False]
    text = reproduction_text(bad)
    assert text.count("DOES NOT HOLD") == 1
    assert "NOT all within their limits" in text


def test_limits_widen_with_few_runs_alone():
    """Four runs allow tens of percent more, 200 nothing."""
    rng = np.random.default_rng(3)
    assert widened(rng.chisquare(3, 200)) == 1.0
    assert 1.1 < widened(rng.chisquare(3, 4)) < 2.0
