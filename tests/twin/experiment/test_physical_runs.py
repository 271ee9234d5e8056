"""Physical runs: which are refused, and what a person reads of them."""

from contextlib import nullcontext
from types import SimpleNamespace

import pytest
from refusals import refused

from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.twin.jobs.experiment import touch_job as module
from puncture_twin.twin.plant.touching import ExecutedTouches

STAGES = SimpleNamespace(time=lambda _: nullcontext())
CONTEXT = SimpleNamespace(watcher=SimpleNamespace(count=lambda *_: None), stages=STAGES)
TOUR = SimpleNamespace(plan=SimpleNamespace(expected_mm=1.8), outward_ct=None, q_insertion=None)


def one_run(context, tour, seed):
    if seed == 2:
        raise NoAnswerError("marker A was not felt", code="no_touch")
    return {"seed": seed, "tip_error_mm": 3.0 + seed, "seconds_per_touch": 14.0 + 2 * seed, "off_path_mm": 0.02}


def test_the_rms_is_over_the_runs_that_ended_and_refusals_are_named(monkeypatch):
    """Errors of 3 and 4 mm; drawn truths of which one in four does not register are beside them."""
    monkeypatch.setattr(module, "plan_tour", lambda *_, **__: TOUR)
    monkeypatch.setattr(module, "physical_run", one_run)
    drawn = lambda context, tour, seed: "no" if seed % 4 == 1 else SimpleNamespace(tip_error_mm=2.0)  # noqa: E731
    monkeypatch.setattr(module, "use_without_physics", drawn)
    facts = module.physical_runs(CONTEXT, 3)
    assert facts["realised_mm"] == pytest.approx(12.5**0.5)
    assert facts["refused"] == {2: "marker A was not felt"}
    assert facts["drawn"] == {"realised_mm": 2.0, "draws": 400, "realised_in_the_same_truths_mm": 2.0}
    text = module.physical_text(facts)
    assert "2 physical runs (15.0 s per touch): the tip misses the target by 3.54 mm rms" in text
    assert "give 2.00 mm, all 400 trials 2.00 (known to 3.5 %)" in text
    assert "at most 0.020 mm off its commanded path" in text
    assert "seed 2: marker A was not felt" in text


def test_runs_none_of_which_ended_give_no_figure(monkeypatch):
    """No mean of nothing, and the reason."""
    monkeypatch.setattr(module, "plan_tour", lambda *_, **__: TOUR)
    monkeypatch.setattr(module, "physical_run", lambda *_: one_run(None, None, 2))
    monkeypatch.setattr(module, "use_without_physics", lambda *_: SimpleNamespace(tip_error_mm=2.0))
    facts = module.physical_runs(CONTEXT, 1)
    assert facts["realised_mm"] is None and facts["seconds_per_touch"] is None
    assert "none of 1 physical run ended" in module.physical_text(facts)


def test_a_contact_on_the_way_to_the_target_refuses_its_run(monkeypatch):
    """It is named."""
    touched, use = SimpleNamespace(failed={}), SimpleNamespace(registration=None)
    contact = SimpleNamespace(link="holder", body="patient")
    monkeypatch.setattr(module, "touch_once", lambda *_: (touched, use))
    for name in ("plan_puncture", "true_touches", "true_at_target"):
        monkeypatch.setattr(module, name, lambda *_: None)
    monkeypatch.setattr(module, "rehearse_touched", lambda *_: SimpleNamespace(contacts=(contact,)))
    with refused("motion_touches", "holder touches patient", by=NoAnswerError):
        module.physical_run(CONTEXT, TOUR, 7)


def test_a_marker_that_is_not_touched_refuses_its_run(monkeypatch):
    """The prediction is of all markers."""
    touched = ExecutedTouches((), {"A": "no contact"}, 1.0, {})
    monkeypatch.setattr(module, "touch_once", lambda *_: (touched, "2 of 3 markers were touched"))
    with refused("no_touch", "marker A: no contact", by=NoAnswerError):
        module.physical_run(CONTEXT, None, 7)
