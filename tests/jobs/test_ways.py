"""Several ways of guidance on one page: the numbers of the single runs, the worse one readable as worse."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from refusals import refused_command
from uncertainty_world import ball

from puncture_twin import api as pt
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.budget.guidance import sight_of
from puncture_twin.run_twin import main
from puncture_twin.twin.jobs.exit_codes import OK
from puncture_twin.twin.jobs.patient import guidance_job as ways
from puncture_twin.twin.jobs.patient.main_job import checked_plan
from puncture_twin.twin.jobs.patient.rehearsed import case_distribution
from puncture_twin.twin.jobs.patient.run import trial_count
from puncture_twin.twin.rehearsal.distribution import rehearse_trials
from puncture_twin.twin.report import patient

DEVICES = "touch_mm = 0.2\n[motion]\ntarget_sd_mm = [0.4, 0.4, 1.0]\n[stereo]\n[ultrasound]\n"
SEEDS = 300
LIST = "us,ct,ct+us"


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """The command's object and folder, of a round patient with all devices whose target moves."""
    case = ball(tmp_path_factory.mktemp("ball"), errors=DEVICES)
    out = tmp_path_factory.mktemp("out")
    assert main(["rehearse", str(case), "--guidance", LIST, "--seeds", str(SEEDS), "--out", str(out)]) == OK
    return json.loads((out / "ways.json").read_text()), out, case


@pytest.fixture(scope="module")
def plan(compared):
    context = pt.prepare(compared[2])
    return context, checked_plan(context, compared[1] / "plan.json")[1]


def test_each_way_has_the_numbers_of_its_own_run(compared, plan):
    """Same seed, same plan, alone: the same distribution, to rounding; and the looks of three depths."""
    context, one_plan = plan
    for row in compared[0]["ways"]:
        way = row["guidance"]
        sight = sight_of(context, one_plan, way)
        alone = rehearse_trials(context, one_plan.outward_ct, one_plan.insertion.q[-1], SEEDS, row["seed"], way, sight)
        for name, value in alone.summary().items():
            close = isinstance(value, float)
            assert row[name] == (pytest.approx(value, rel=1e-9, abs=1e-12) if close else value), (way, name)
        assert row["looks"] == {
            "touches": 6 * ("ct" in way),
            "camera_pairs": 0,
            "pictures": 3 * ("us" in way),
            "scans": 0,
        }
        moving = one_plan.approach.duration_s + one_plan.insertion.duration_s
        assert row["seconds"] == pytest.approx(moving + 30.0 * row["looks"]["pictures"])


def test_the_page_shows_them_best_first(compared):
    """The order is that of the errors; what is worse says so, in the cards and in the table, with its factor."""
    document, out, _ = compared
    page, rows = (out / "ways.html").read_text(), document["ways"]
    assert [row["rating"] for row in rows] == ["best", "worse", "worse"] and rows[0]["guidance"] == "ct+us"
    errors = [row["realised_rms_mm"] for row in rows]
    assert errors == sorted(errors)
    cards = re.findall(r'<div class="card( bad)?">\s*<p class="name">([^<]*)', page)
    assert [(name, bool(bad)) for bad, name in cards] == [
        (f"{row['guidance']}: {row['rating']}", row["rating"] == "worse") for row in rows
    ]
    for row in rows[1:]:
        assert f"worse: error ×{row['realised_rms_mm'] / errors[0]:.2f}" in page
    for row in rows:
        shown = (row["realised_rms_mm"], row["predicted_rms_mm"])
        cells = "".join(f"<td>{value:.2f}</td>" for value in shown)
        assert re.search(rf"<td>{re.escape(row['guidance'])}</td><td>[^/]*(?:</b>)?</td>{cells}", page)
    assert all(name in page for name in ("PubMed 36863276", "10.1007/s11548-015-1286-y", "assumed, not measured"))
    assert (out / "ways.png").read_bytes().startswith(b"\x89PNG")
    assert {"ways.html", "ways.png", "ways.json", "plan.json", "report.html"} <= set(document["files"])


def test_sources_add_up(compared, plan):
    document, _, _ = compared
    for row in document["ways"]:
        assert sum(row["predicted_share"].values()) == pytest.approx(1.0)
    context, one_plan = plan
    done, _ = ways._rehearsed(context, one_plan, ("ct", "us"), 20)
    *parts, whole = ways.Compared(context, one_plan, done, {}, ())._sources().rows
    for column, one in enumerate(done, start=1):
        assert float(whole[column]) == pytest.approx(one.distribution.predicted_rms_mm, abs=0.006)
        assert sum(float(row[column]) ** 2 for row in parts) == pytest.approx(float(whole[column]) ** 2, rel=0.05)


def test_a_plan_is_compared_too_and_blind_ways_say_why(compared, plan, tmp_path, run, monkeypatch):
    """Of plan.json the same numbers, as one object; a way that sees too little has its reason in place of them."""
    _, out, case = compared

    def sight(context, plan, *names):
        return replace(sight_of(context, plan, *names), no_cameras="no place for cameras")

    monkeypatch.setattr(ways, "sight_of", sight)
    arguments = ["rehearse", out / "plan.json", "--case", case, "--guidance", "stereo,ct", "--seeds", SEEDS]
    code, told = run(*arguments, "--out", tmp_path)
    ct, stereo = told["ways"]
    assert code == OK
    before = next(row for row in compared[0]["ways"] if row["guidance"] == "ct")
    assert ct["realised_rms_mm"] == pytest.approx(before["realised_rms_mm"]) and ct["rating"] == "best"
    assert stereo["guidance"] == "stereo" and "no place for cameras" in stereo["no_answer"]
    assert "no place for cameras" in (tmp_path / "ways.html").read_text()
    with pytest.raises(NoAnswerError) as caught:
        ways._rehearsed(*plan, ("stereo",), 5)
    assert caught.value.code == "lost_sight"


def test_failing_is_worse_than_erring(plan, tmp_path):
    """A way that stops most trials has the smallest errors of the rest, and stands last; equal ones are as good."""
    context, one_plan = plan
    (one, *_), _ = ways._rehearsed(context, one_plan, ("ct",), 200)
    kept = np.arange(200) < 60
    found = one.distribution
    of_kept = {name: getattr(found, name)[kept] for name in ("hit", "touched", "in_region")}
    few = replace(found, stopped=140, trials=found.trials.of(kept), **of_kept)
    small = replace(few, trials=few.trials._replace(tip_ct=few.trials.target_ct + 0.01))
    first, second, last = ways.rated([small, found, found])
    assert (first.rating, second.rating, last.rating) == ("best", "as good", "worse")
    assert last.why == "more trials fail" and last.failed >= 0.7 and last.distribution.stopped == 140
    rest = np.zeros(60, bool)
    of_rest = {name: getattr(few, name)[rest] for name in ("hit", "touched", "in_region")}
    none = replace(few, stopped=200, trials=few.trials.of(rest), **of_rest)
    last = ways.rated([none, found])[1]
    assert (last.rating, last.why, last.failed) == ("worse", "more trials fail", 1.0)
    ways.Compared(context, one_plan, ways.rated([none, found]), {}, ()).write(tmp_path)
    assert "ct: worse" in (tmp_path / "ways.html").read_text()


def test_a_plan_is_rehearsed_in_steps(plan):
    """Error, passes, dose and minutes beside the open loop, in the object and in the table of page and terminal."""
    found = case_distribution(*plan, trial_count(50, 0, "ct", 2)).summary()
    assert (found["steps"], found["passes"], found["scans"], found["dose_msv"]) == (2, 2.0, 2.0, 1.8)
    assert 4.0 < found["minutes"] == pytest.approx(4.0 + found["open_loop"]["minutes"])
    assert found["realised_rms_mm"] < found["open_loop"]["realised_rms_mm"]
    shown = {row[0]: row[1] for row in patient.trials(found)[0].rows}
    assert shown["open loop: tip error, rms, mm"] == f"{found['open_loop']['realised_rms_mm']:.3f}"
    assert shown["control scans, and their dose, mSv"] == "2.00: 1.80"


TEN, STEPS = ["--seeds", 10], ["--seeds", 10, "--steps", 3]


@pytest.mark.parametrize(
    ("guidance", "options", "code", "named"),
    [
        (["--guidance", "ct,by hand"], TEN, "unknown_guidance", "by hand"),
        (["--guidance", "ct,us,ct"], TEN, "stated_twice", "'ct'"),
        (["--guidance", "ct,"], TEN, "unknown_guidance", "''"),
        (["--guidance", "ct,us"], [], "conflicting_options", "--seeds"),
        (["--guidance", "us"], STEPS, "conflicting_options", "--steps"),
        (["--guidance", "ct,us"], STEPS, "conflicting_options", "--steps"),
        ([], STEPS, "conflicting_options", "--steps"),
    ],
)
def test_a_list_or_steps_of_another_way_are_refused_in_one_line(tmp_path, capfd, guidance, options, code, named):
    case = ball(tmp_path, errors="touch_mm = 0.2\n")
    refused_command(["rehearse", case, *guidance, *options, "--out", tmp_path / "out"], capfd, code, named)
    assert not (tmp_path / "out").exists()
