"""A direction that is stated by itself is checked before anything is searched."""

import numpy as np
import pytest
from refusals import refused

from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.base.output.manifest import read_manifest
from puncture_twin.planning.base.output.output_set import writing
from puncture_twin.planning.search.choice import Choice
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.twin.jobs.patient import main_job
from puncture_twin.twin.jobs.patient.export_jobs import export_path


@pytest.fixture(scope="module")
def rejected(context):
    found = context.search()
    row = int(np.flatnonzero(~found.safe)[0])
    return Choice(angles=(found.theta[row], found.beta[row]))


@pytest.fixture
def unsearched(monkeypatch):

    def searched(_):
        raise AssertionError("searched for nothing")

    monkeypatch.setattr(CaseContext, "search", searched)
    monkeypatch.setattr(CaseContext, "require_arm", lambda _: None)


@pytest.mark.parametrize("job", [main_job.plan_case, main_job.rehearse_case], ids=["plan", "rehearse"])
def test_a_rejected_direction_is_told_at_once_and_an_older_plan_goes(job, context, rejected, unsearched, tmp_path):
    with writing(tmp_path, "plan") as draft:
        (draft.folder / "plan.json").write_text("{}")
    with refused("direction_rejected", by=NoAnswerError):
        job(context, tmp_path, choice=rejected)
    assert not (tmp_path / "plan.json").exists()
    assert "plan" not in read_manifest(tmp_path).entries


def test_an_entry_off_the_skin_is_told_at_once_and_the_old_set_stays(context, unsearched, tmp_path):
    with writing(tmp_path, "plan") as draft:
        (draft.folder / "plan.json").write_text("{}")
    with refused("entry_elsewhere"):
        main_job.plan_case(context, tmp_path, Choice(entry_mm=(0.0, 0.0, 40.0)))
    assert (tmp_path / "plan.json").exists()


def test_slicer_too(context, rejected, unsearched, tmp_path):
    with refused("direction_rejected", by=NoAnswerError):
        export_path(context, "slicer", tmp_path / "out", rejected)
    assert not (tmp_path / "out").exists()
