"""Done, and the answer is no: one rule for each command, and where a rehearsal has it."""

import re
from collections import Counter
from pathlib import Path
from types import SimpleNamespace as Of

import numpy as np
import pytest
import typer

from puncture_twin.twin.jobs.exit_codes import ANSWER_IS_NO, PROGRAM_FAILED, RULES, finish
from puncture_twin.twin.jobs.patient.run import rehearsal_failures, trial_failures

ROOT = Path(__file__).parents[2]


def test_no_command_ends_by_another_rule():
    """Where commands are parsed, nothing else gives an exit code, and what is printed is what a rule is asked about."""
    for file in (ROOT / "run_twin.py", *(ROOT / "twin" / "jobs").rglob("*commands.py")):
        text = file.read_text(encoding="utf-8")
        assert re.findall(r"typer\.Exit\(|print_answer\(|ANSWER_IS_NO", text) == [], file


CASES = {
    "demo": (Of(failures=()), Of(failures=("missed",))),
    "rehearse": (Of(failures=()), Of(failures=("missed",))),
    "rehearse --sweep": (Of(whole=True), Of(whole=False)),
    "rehearse --guidance A,B": (Of(passed=True), Of(passed=False)),
    "search": tuple(Of(candidates=Of(safe=np.array(safe))) for safe in ([False, True], [False])),
    "check": (Of(safe=True), Of(safe=False)),
    "compare": (Of(safe=True), Of(safe=False)),
    "confirm": (Of(yes=True), Of(yes=False)),
    "touch": (Of(suffices=True), Of(suffices=False)),
    "pivot": tuple(Of(pivot=Of(large=large)) for large in (False, True)),
    "servo": (Of(passed=True), Of(passed=False)),
    "reproduce": (Of(passed=True), Of(passed=False)),
    "batch run": tuple(Of(whole=whole, ended=Counter({2: 1})) for whole in (True, False)),
    "batch merge": (Of(as_expected=True), Of(as_expected=False)),
}


@pytest.mark.parametrize("command", sorted(RULES))
def test_a_command_ends_with_the_code_of_its_rule(command, capsys):
    yes, no = CASES[command]
    finish(command, yes, {"a": 1}, "found", False)
    assert capsys.readouterr().out == "found\n"
    with pytest.raises(typer.Exit) as ended:
        finish(command, no, {"a": 1}, "found", True)
    assert ended.value.exit_code == ANSWER_IS_NO
    assert capsys.readouterr().out == '{"a": 1}\n'


def test_a_batch_in_which_the_program_failed_ends_with_3():
    counts = Of(whole=False, ended=Counter({PROGRAM_FAILED: 1}))
    with pytest.raises(typer.Exit) as ended:
        finish("batch run", counts, {}, "", True)
    assert ended.value.exit_code == PROGRAM_FAILED


def context(radius_mm=5.0, **limits):
    """A case whose target is a ball, with two structures that must not be touched and one that may."""
    settings = Of(min_hit=None, max_touch=None, max_touch_of={})
    vars(settings).update(limits)
    kinds = (("vessel", True), ("rib", True), ("fat", False))
    checked = [Of(name=name, demands_margin=demands) for name, demands in kinds]
    case = Of(hit_radius_mm=radius_mm, search=settings)
    return Of(case=case, anatomy=Of(checked=checked))


def room(off_mm=1.0, contacts=(), **clearance_mm):
    """A rehearsal that ended so far from its target, with the least clearances."""
    return Of(
        tip_true_ct=np.array([[9.0, 9.0, 9.0], [off_mm, 0.0, 0.0]]),
        target_true_ct=np.zeros(3),
        clearance_mm={name: np.array([20.0, mm]) for name, mm in clearance_mm.items()},
        contacts=contacts,
    )


def test_a_room_says_no_where_it_misses_or_touches():
    """The tip outside of the target, the needle in what must not be touched, the arm against anything."""
    assert rehearsal_failures(context(), room(vessel=0.1, fat=-3.0)) == ()
    assert rehearsal_failures(context(), room(5.1)) == ("the tip missed the target",)
    assert rehearsal_failures(context(), room(vessel=-0.1, rib=2.0)) == ("the needle touched vessel",)
    met = [Of(link="forearm", body="patient")] * 2
    assert rehearsal_failures(context(), room(contacts=met)) == ("the arm's forearm touched patient",)


class Trials(Of):
    """Some of many rooms."""

    def __len__(self):
        return len(self.hit)

    @property
    def hit_share(self):
        return float(np.mean(self.hit)) if len(self) else None


def test_trials_say_no_where_more_miss_or_touch_than_the_case_allows():
    """Without limits they say nothing; with them, a share above one does, a share at it does not."""
    touched = np.array([[True, False], [False, False], [False, True], [False, True]])
    found = Trials(hit=np.array([True, True, True, False]), structures=("vessel", "rib"), touched=touched)

    def failures(**limits):
        return len(list(trial_failures(context(**limits).case, found)))

    assert failures() == 0
    assert (failures(min_hit=0.75), failures(min_hit=0.76)) == (0, 1)
    assert (failures(max_touch=0.5), failures(max_touch=0.3), failures(max_touch=0.2)) == (0, 1, 2)
    assert failures(max_touch=0.2, max_touch_of={"rib": 0.6}) == 1
    assert len(list(trial_failures(context().case, Trials(hit=np.zeros(0))))) == 1
