"""What the functions of the public API take and give: everything shows itself, nothing foreign is raised."""

import inspect
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from case_world import changed, coarse_carton
from cohort_world import write_cohort
from hand_eye_world import hand_eye_problem, write_pairs
from refusals import refused
from whole_html import Whole

import puncture_twin as pt
from puncture_twin.meshes import folder
from puncture_twin.planning.place.search import PlaceSearch
from puncture_twin.twin.guidance.ultrasound.recording_file import write_recording
from puncture_twin.twin.jobs.patient import place_job
from puncture_twin.twin.plant.simulated_recording import simulate_recording

FUNCTIONS = {name: getattr(pt, name) for name in pt.__all__ if inspect.isfunction(getattr(pt, name))}
CARTON = folder() / "carton"
TARGET = (50.0, 130.0, 63.0)


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    tmp = tmp_path_factory.mktemp("values")
    write_recording(simulate_recording(np.random.default_rng(1), 24)[0], tmp / "recording.csv")
    write_pairs(tmp / "pairs.csv", hand_eye_problem(np.random.default_rng(1), 8)[0])
    carton = coarse_carton(tmp / "carton")
    carton.write_text(changed(carton.read_text(), ("[end]", "[stereo]\n[ultrasound]\n[end]")))
    context, armed = pt.prepare(carton, arm=False), pt.prepare(carton)
    candidates, found = pt.search(context), pt.search(armed)
    plan = pt.plan(armed, found)
    pt.write_plan(plan, tmp / "plan.json")
    certificate = pt.certify(context, size_deg=10.0)
    markers = [pt.read_points(CARTON / name) for name in ("markers_ct.csv", "touch.csv")]
    return {
        "tmp": tmp, "armed": armed, "context": context, "candidates": candidates, "found": found,
        "plan": plan,
        "certificate": certificate, "markers_ct": markers[0], "markers_base": markers[1], "points": markers[0],
        "recording": pt.read_recording(tmp), "pairs": pt.read_pose_pairs(tmp / "pairs.csv"),
        "calibration": pt.calibrate(pt.read_recording(tmp)),
        "case": CARTON / "case_m.toml", "cost": candidates.path.length,
        "theta_deg": 10.0, "beta_deg": 20.0, "one": candidates.best, "other": candidates.pick(0),
        "target_ct": TARGET, "format_name": "csv", "source": plan, "folder": tmp / "folder", "path": tmp / "nothing",
        "cohort": tmp / "no_cohort", "target": TARGET, "scan": tmp / "no_scan",
    }  # fmt: skip


@pytest.fixture(scope="module")
def values(given):
    tmp, armed, context, candidates, found, plan = (
        given[name] for name in ("tmp", "armed", "context", "candidates", "found", "plan")
    )
    rehearsal = pt.rehearse(armed, plan, seeds=3)
    return {
        "init_case": context.case,
        "load_case": context.case,
        "prepare": armed,
        "search": candidates,
        "check": pt.check(context, candidate=candidates.best),
        "check_many": pt.check_many(context, [10.0], [20.0]),
        "safe_map": pt.safe_map(context),
        "best_target": pt.best_target(context, 2),
        "rerank": pt.rerank(candidates, given["cost"]),
        "plan": plan,
        "read_plan": pt.read_plan(tmp / "plan.json", armed),
        "register": pt.register(given["markers_ct"], given["markers_base"], target_ct=TARGET, method="triad"),
        "certify": given["certificate"],
        "verify": pt.verify(given["certificate"], context),
        "rehearse": rehearsal,
        "place": PlaceSearch(np.eye(4), (), 0, 1.0, 1.0, 0, (0, 0), (), None),
        "touch": pt.touch(armed, candidate=found.best),
        "camera_view": pt.camera_view(armed, plan),
        "probe_view": pt.probe_view(armed, plan),
        "compare": pt.compare(context, candidates.best, candidates.pick(0), candidates=candidates),
        "export": pt.export(plan, "csv", tmp / "export"),
        "batch": pt.batch(write_cohort(tmp / "cohort"), tmp / "results"),
        "read_points": given["points"],
        "read_mesh": pt.read_mesh(CARTON / "skin.ply"),
        "read_recording": given["recording"],
        "calibrate": given["calibration"],
        "read_pose_pairs": given["pairs"],
        "calibrate_hand_eye": pt.calibrate_hand_eye(given["pairs"]),
        "shot_by_shot": pt.shot_by_shot(given["calibration"]).with_shot(given["recording"].subset(slice(0, 1))),
        "report": pt.report(armed, found, tmp / "report", plan=plan, rehearsal=rehearsal),
        "check_folder": pt.check_folder(tmp / "report"),
        "windows": candidates.windows,
        "window": candidates.windows[0],
        "of a table": pt.export(candidates, "candidates-json", tmp / "table"),
    }


WITHOUT = {"write_plan", "write_points", "read_certificate", "read_volume", "confirm", "markers", "calibrate_dynamics"}
"""They return nothing, or what another one of the list returns; a volume is shown below, a confirmation where one
is made (test_confirm.py), markers with their command, dynamics where they are identified (test_dynamics.py)."""


def test_everything_that_a_function_returns_shows_itself(values):
    """In a notebook: HTML that needs nothing from outside, with at least one fact; at a prompt: one short line."""
    assert set(FUNCTIONS) - set(values) == WITHOUT
    for name, value in values.items():
        if isinstance(value, Path | tuple):
            continue
        shown = value._repr_html_()
        assert "<td" in shown and "<pre>" not in shown, f"{name}: {shown[:200]}"
        Whole(shown)
        assert len(repr(value)) < 1600 and len(repr(value).splitlines()) == 1, name
        assert repr(value).startswith(f"<{type(value).__name__}: "), repr(value)[:80]


def test_what_they_return_is_what_the_commands_make(values, given):
    """The rehearsal has its rooms, the cohort a row a case, the page and its set are whole, the readings register."""
    assert len(values["rehearse"].distribution) == 3
    frame = values["batch"].to_pandas()
    assert list(frame["exit_code"]) == [0, 0, 2] and values["batch"].summary()["refused"] == 1
    assert values["report"].name == "report.html" and values["check_folder"] == ()
    assert values["export"].path.read_text().startswith("#")
    assert set(values["touch"].points.names) == {"A", "B", "C"}
    assert values["compare"].safe == bool(given["candidates"].safe[0])
    assert values["verify"].safe == given["certificate"].summary()["safe_cells"]


def test_where_the_arm_should_stand_goes_into_a_case(given, monkeypatch):
    """What `place` finds is a mount as `replace` takes it; the search itself is tested with the planner."""
    armed = given["armed"]
    seen, one = [], SimpleNamespace(verdict=SimpleNamespace(reached=1))
    found = SimpleNamespace(rated=[one], checked=(1, 1), complete=True)
    monkeypatch.setattr(place_job.place, "search_placements", lambda *_, **keys: seen.append(keys["jobs"]) or found)
    assert pt.place(armed, jobs=1) is found and seen == [1]
    one.verdict.reached = 0
    with refused("no_placement", by=pt.NoAnswerError):
        pt.place(armed)


def test_an_export_that_is_not_of_its_source_is_refused(given):
    wrong = ((given["plan"], "candidates-csv"), (given["candidates"], "urscript"), (given["plan"], "slicer"))
    for source, name in wrong:
        with refused("wrong_type"):
            pt.export(source, name, given["folder"], context=given["armed"])
    with refused("missing_option"):
        pt.export(given["plan"], "moveit", given["folder"])
    with refused("unknown_format"):
        pt.export(given["plan"], "gcode", given["folder"])
    assert not given["folder"].exists()


HOSTILE = {
    "nan": float("nan"),
    "inf": float("inf"),
    "complex": 1.0 + 2.0j,
    "negative": -1,
    "huge": 10**30,
    "text": "x",
    "null": "a\0b",
    "surrogate": "\ud800",
    "long": 5000 * "a",
    "bytes": b"x",
    "list": [],
    "dict": {},
    "ragged": [[1], [1, 2]],
    "object": object(),
    "array": np.zeros((2, 2)),
    "nan array": np.full(3, np.nan),
    "complex array": np.zeros(3, complex),
    "texts": np.array(["a", "b", "c"]),
    "truth": True,
    "none": None,
    "type": int,
    "points": {"a": "b"},
    "keys": {1: (0, 0, 0)},
}


def answered(call, what):
    """An answer, or one line; never an error of NumPy's or Python's."""
    try:
        call()
    except pt.PlanningError as error:
        assert str(error).isprintable() and len(str(error)) < 1600, what
    except Exception as error:
        pytest.fail(f"{what}: {type(error).__name__}: {error}")


@pytest.mark.parametrize("name", sorted(FUNCTIONS))
def test_no_foreign_exception_leaves_a_function(name, given, tmp_path, monkeypatch):
    """Whatever one argument is, beside good ones."""
    monkeypatch.chdir(tmp_path)  # a text is a folder too
    function, parameters = FUNCTIONS[name], inspect.signature(FUNCTIONS[name]).parameters
    context = (
        given["armed"] if name in ("touch", "rehearse", "read_plan", "camera_view", "probe_view") else given["context"]
    )
    good = given | {"context": context, **({"theta_deg": [10.0], "beta_deg": [20.0]} if name == "check_many" else {})}
    required = {key: good[key] for key, one in parameters.items() if one.default is inspect.Parameter.empty}
    for key, one in parameters.items():
        for label, value in HOSTILE.items():
            if value is not one.default:
                answered(partial(function, **{**required, key: value}), f"{name}({key}={label})")


@pytest.mark.parametrize("label", HOSTILE)
def test_no_foreign_exception_leaves_a_case_or_its_candidates(label, given):
    value, case, candidates = HOSTILE[label], given["context"].case, given["candidates"]
    calls = [partial(case.replace, **{key: value}) for key in ("target_ct", "target", "mount", "needle", "search", "x")]
    calls += [partial(case.replace, needle={"length_mm": value}), partial(candidates.pick, value)]
    calls += [] if isinstance(value, str) and label == "text" else [partial(candidates.write, value)]
    for call in calls:
        answered(call, call)
