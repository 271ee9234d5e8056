"""Physical runs: what is kept, what is done again, and what a person reads of them."""

import math
from contextlib import nullcontext
from types import SimpleNamespace

import pytest

from puncture_twin.twin.jobs.experiment import physical_runs as module
from puncture_twin.twin.jobs.experiment.physical_runs import FOLDER, DrawnRuns, PhysicalRun, PhysicalRuns, physical_runs
from puncture_twin.twin.jobs.experiment.touch_job import TouchedOnce
from puncture_twin.twin.rehearsal.touching import Touched


class Context:
    """Of what runs ask of a context; nothing is simulated here."""

    watcher = SimpleNamespace(count=lambda *_: None)


DRAWN = DrawnRuns(3.5, 1.9, 400)


@pytest.fixture
def done(monkeypatch):
    """The seeds that were really run; seed 2 stops with a reason."""
    seeds = []

    def run(context, tour, seed):
        seeds.append(seed)
        if seed == 2:
            return PhysicalRun(seed, *4 * (math.nan,), "marker A was not felt")
        return PhysicalRun(seed, 1.0 + seed, 0.5, 12.0, 0.1)

    tour = type("Tour", (), {"plan": type("Plan", (), {"expected_mm": 1.8})})
    monkeypatch.setattr(module, "plan_tour", lambda *_, **__: tour)
    monkeypatch.setattr(module, "_key", lambda *_: "a")
    monkeypatch.setattr(module, "_run", run)
    monkeypatch.setattr(module, "drawn_runs", lambda *_: DRAWN)
    return seeds


def test_what_was_interrupted_goes_on(done, tmp_path, monkeypatch):
    """Each run once; a refused one again; all of them where something that decides has changed."""
    physical_runs(Context, tmp_path, 2)
    found = physical_runs(Context, tmp_path, 4)
    assert done == [0, 1, 2, 3]
    assert found.kept == 2
    (tmp_path / FOLDER / "1.json").write_text("{", encoding="utf-8")
    again = physical_runs(Context, tmp_path, 4)
    assert done == [0, 1, 2, 3, 1, 2]
    assert [run.tip_error_mm for run in again.runs if not run.refused] == [1.0, 2.0, 4.0]
    monkeypatch.setattr(module, "_key", lambda *_: "b")
    assert physical_runs(Context, tmp_path, 2).kept == 0


def test_the_rms_is_over_the_runs_that_ended_and_refusals_are_named():
    """With few runs it says how well it is known."""
    ended = (PhysicalRun(0, 3.0, 1.0, 14.0, 0.02), PhysicalRun(1, 4.0, 1.0, 16.0, 0.01))
    runs = PhysicalRuns(1.8, (*ended, PhysicalRun(2, *4 * (math.nan,), "stopped")), 0, DRAWN)
    assert runs.realised_mm == pytest.approx(math.sqrt(12.5))
    assert "2 physical runs (15.0 s per touch): the tip misses the target by 3.54 mm rms" in runs.text()
    assert "without physics, the same 2 trials give 3.50 mm, all 400 trials 1.90 (known to 3.5 %)" in runs.text()
    assert "at most 0.020 mm off its commanded path" in runs.text()
    assert "seed 2: stopped" in runs.text()
    assert runs.summary()["refused"] == {2: "stopped"}


def test_a_contact_on_the_way_to_the_target_refuses_its_run_alone(monkeypatch):
    """It is named."""
    context = SimpleNamespace(stages=SimpleNamespace(time=lambda _: nullcontext()))
    touched, use = SimpleNamespace(failed={}), SimpleNamespace(registration=None)
    contact = SimpleNamespace(link="holder", body="patient")
    monkeypatch.setattr(module, "touch_once", lambda *_: (touched, use))
    for name in ("plan_puncture", "true_touches", "true_at_target"):
        monkeypatch.setattr(module, name, lambda *_: None)
    monkeypatch.setattr(module, "rehearse_touched", lambda *_: SimpleNamespace(contacts=(contact,)))
    run = module._run(context, SimpleNamespace(outward_ct=None, q_insertion=None), 7)
    assert run.refused == "the arm stopped before the target: holder touches patient"


def test_a_marker_that_is_not_touched_refuses_its_run_alone(monkeypatch):
    """The prediction is of all markers; the others go on."""
    touched = Touched((), {"A": "no contact"}, 1.0)
    monkeypatch.setattr(module, "touch_once", lambda *_: TouchedOnce(touched, "2 of 3 markers were touched"))
    run = module._run(Context, None, 7)
    assert (run.seed, run.refused) == (7, "marker A: no contact")
