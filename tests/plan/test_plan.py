"""A plan: made on the carton, written, read back, and refused when anything about it changed."""

import json
from dataclasses import replace

import numpy as np
import pytest
from case_world import coarse_carton
from refusals import refused

from puncture_twin.meshes import folder
from puncture_twin.planning.arm.inverse_kinematics import inverse, nearest_within_limits
from puncture_twin.planning.arm.kinematics import SpeedLimits, flange_pose, tip_speeds
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.base.errors import InputError, NoAnswerError
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.plan import plan_check
from puncture_twin.planning.plan.plan import motion_contact
from puncture_twin.planning.plan.plan_check import _check_limits, check_plan
from puncture_twin.planning.plan.plan_document import read_plan, write_plan
from puncture_twin.planning.plan.planner import make_plan
from puncture_twin.planning.search.candidates import Ranking
from puncture_twin.planning.search.context import prepare


@pytest.fixture(scope="module")
def carton(tmp_path_factory):
    return prepare(coarse_carton(tmp_path_factory.mktemp("carton") / "carton"))


@pytest.fixture(scope="module")
def found(carton):
    return carton.search()


@pytest.fixture(scope="module")
def planned(carton, found):
    return make_plan(carton, found, seed=1)


@pytest.mark.parametrize("limit", [{"min_hit": 1.0}, {"max_touch": 0.0}])
def test_a_plan_whose_own_configuration_breaks_a_limit_is_refused(carton, planned, limit):
    _check_limits(planned.plan, carton, "plan.json")
    case = replace(carton.case, search=replace(carton.case.search, **limit))
    strict = replace(carton, case=case, chance=replace(carton.chance, case=case))
    with refused("limits_not_kept"):
        _check_limits(planned.plan, strict, "plan.json")


def test_plan_case_and_candidates_show_themselves(carton, found, planned):
    """As whole HTML with what a person asks first; a name cannot become a tag."""
    shown = {name: one._repr_html_() for name, one in (("plan", planned.plan), ("case", carton.case), ("all", found))}
    assert "Plan of carton-m" in shown["plan"]
    assert f"θ {np.degrees(planned.plan.theta):g}°" in shown["plan"]
    assert "bolt_m" in shown["case"]
    assert f"{len(found):,} candidates" in shown["all"]
    assert "data:image/png" in shown["all"]
    hostile = replace(planned.plan, case_name="<script>")._repr_html_()
    assert "<script>" not in hostile
    assert "&lt;script&gt;" in hostile
    assert replace(planned.plan, clearance_mm=None)._repr_html_().startswith("<pre>")


@pytest.fixture
def document(planned, tmp_path):
    path = tmp_path / "plan.json"
    write_plan(planned.plan, path)
    content = json.loads(path.read_text())

    def change(**keys):
        path.write_text(json.dumps(content | keys))
        return path

    return content, change


def test_the_plan_is_the_best_candidate_that_is_reached(carton, planned):
    found = planned.candidates
    assert found.safe.any()
    assert (found.arm.reachable[found.safe] == 1).all()
    refused = np.isin(found.verdict.reason, [Reason.UNREACHABLE, Reason.ARM_COLLISION, Reason.INSERTION_BLOCKED])
    assert refused.any()
    assert (found.arm.reachable[refused] == 0).all()
    assert (found.verdict.detail[refused] != "").all()
    assert np.isnan(found.arm.margin[found.arm.reachable == -1]).all()
    best = planned.candidates.ranked[0]
    assert planned.plan.theta == planned.candidates.theta[best]
    assert planned.plan.beta == planned.candidates.beta[best]
    plan, model = planned.plan, ur_model("ur3")
    target = plan.T_base_ct[:3, :3] @ plan.target_ct + plan.T_base_ct[:3, 3]
    outward = plan.T_base_ct[:3, :3] @ plan.outward_ct
    poses = flange_pose(model, plan.insertion.q)
    tips = poses[:, :3, 3] + plan.needle_length_mm * poses[:, :3, 2]
    along = (tips - target) @ outward
    np.testing.assert_allclose(along[[0, -1]], [plan.standoff_mm, 0], atol=1e-3)
    np.testing.assert_allclose(tips - target, along[:, None] * outward, atol=0.05)
    np.testing.assert_allclose(poses[:, :3, 2], np.broadcast_to(-outward, (len(poses), 3)), atol=1e-4)
    speeds = [
        tip_speeds(model, part.q, part.times_s, plan.needle_length_mm).max() for part in (plan.approach, plan.insertion)
    ]
    assert speeds[0] <= 250.0 and speeds[1] <= 40.0 * (1 + 1e-3)
    for part in (plan.approach, plan.insertion):
        assert (part.peaks().speed <= model.max_speeds + 1e-9).all()
    assert motion_contact(plan, carton.reach.checker) is None


def test_the_same_seed_gives_the_same_plan(carton, found, planned):
    again = make_plan(carton, found, seed=1).plan
    np.testing.assert_array_equal(again.approach.q, planned.plan.approach.q)
    np.testing.assert_array_equal(again.insertion.q, planned.plan.insertion.q)


def test_a_plan_reads_back_as_it_was_written(carton, planned, document):
    path = document[1]()
    back = read_plan(path)
    np.testing.assert_array_equal(back.approach.q, planned.plan.approach.q)
    np.testing.assert_array_equal(back.T_base_ct, planned.plan.T_base_ct)
    assert back.inputs == carton.case.inputs
    assert back.theta == pytest.approx(planned.plan.theta, abs=1e-12)
    assert check_plan(back, carton, path).safe[0]


def _moved(trajectory, row, joint, by):
    q = np.array(trajectory["q_rad"])
    q[row, joint] += by
    return {"times_s": trajectory["times_s"], "q_rad": q.tolist()}


def _phase(document, name, **keys):
    return {name: {**document[name], **keys}}


def _timed(document, name, factor):
    return _phase(document, name, times_s=[factor * t for t in document[name]["times_s"]])


def _dive(document, depth):
    """The insertion, and there and back: tips so far (mm) along the needle's outward direction, in small steps."""
    inserted = document["insertion"]["q_rad"]
    model, q = ur_model("ur3"), np.array(inserted[-1])
    outward = np.array(document["T_base_ct"])[:3, :3] @ np.array(document["outward_ct"])
    T_start, rows = flange_pose(model, q), list(inserted)
    for along in [*np.linspace(0, depth, 60)[1:], *np.linspace(depth, 0, 700)[1:]]:
        T = T_start.copy()
        T[:3, 3] += along * outward
        q = nearest_within_limits(model, nearest_branch(inverse(model, T[None])[0], q), q)
        rows.append(q.tolist())
    return {"insertion": {"times_s": [0.5 * i for i in range(len(rows))], "q_rad": rows}}


def nearest_branch(branches, q):
    gap = np.abs((branches - q + np.pi) % (2 * np.pi) - np.pi).sum(axis=1)
    return branches[np.nanargmin(gap)]


BROKEN = {
    "another version": (lambda d: {"version": 7}, "unknown_version"),
    "no T_base_ct": (lambda d: {"T_base_ct": None}, "wrong_type T_base_ct"),
    "a mirrored T_base_ct": (
        lambda d: {"T_base_ct": (np.diag([1, 1, -1, 1]) @ d["T_base_ct"]).tolist()},
        "mirrored T_base_ct",
    ),
    "a target elsewhere": (lambda d: {"target_ct_mm": [0, 0, 0]}, "not_straight"),
    "two coordinates": (lambda d: {"target_ct_mm": [0, 0]}, "bad_value"),
    "text for a number": (lambda d: {"standoff_mm": "150"}, "bad_value"),
    "another standoff": (lambda d: {"standoff_mm": d["standoff_mm"] + 1}, "plan_contradicted"),
    "a gap between the phases": (lambda d: {"approach": _moved(d["approach"], -1, 0, 0.01)}, "phases_not_joined"),
    "a joint off at the target": (lambda d: {"insertion": _moved(d["insertion"], -1, 1, 0.01)}, "not_straight"),
    "a detour on the way in": (lambda d: {"insertion": _moved(d["insertion"], 40, 1, 0.01)}, "not_straight"),
    "a dive past the target": (lambda d: _dive(d, -30.0), "not_straight 30"),
    "only the two ends of the insertion, straight in joint space": (
        lambda d: {
            "insertion": {"times_s": [0.0, 60.0], "q_rad": d["insertion"]["q_rad"][:: len(d["insertion"]["q_rad"]) - 1]}
        },
        "not_straight",
    ),
    "a thousand times as fast": (lambda d: _timed(d, "approach", 0.001), "tip_too_fast"),
    "a jolt on the way": (
        lambda d: {"approach": _moved(d["approach"], len(d["approach"]["q_rad"]) // 2, 2, 0.01)},
        "tip_too_fast",
    ),
    "an insertion at ten times the speed": (lambda d: _timed(d, "insertion", 0.1), "tip_too_fast"),
    "times that fall": (lambda d: _phase(d, "insertion", times_s=d["insertion"]["times_s"][::-1]), "times_not_rising"),
    "five joints": (lambda d: _phase(d, "insertion", q_rad=[row[:5] for row in d["insertion"]["q_rad"]]), "bad_value"),
    "a jerk that is not its own": (
        lambda d: _phase(d, "approach", peaks={**d["approach"]["peaks"], "jerk_rad_s3": [0.0] * 6}),
        "plan_contradicted",
    ),
    "other limits": (lambda d: {"limits": {**d["limits"], "speed_rad_s": [9.0] * 6}}, "plan_contradicted"),
    "an unknown arm": (lambda d: {"robot": "ur99"}, "unknown_robot ur99"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_plan_that_contradicts_itself_is_refused(name, document):
    change, message = BROKEN[name]
    content, write = document
    with refused(*message.split()):
        read_plan(write(**change(content)))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "file_size"),
        (b'{"version": 3', "not_json"),
        (b'{"version": 3}', "missing_key"),
        (b'{"version": 2}', "unknown_version"),
        (b'{"version": 1}', "unknown_version"),
        (b"[1, 2]", "unknown_version None"),
        (b'{"version": 3, "x": NaN}', "not_json"),
        (b'{"version": 3, "x": 1e999}', "not_json"),
        (b'{"version": 3, "seed": 1, "seed": 2}', "not_json seed"),
        (b"\xff\xfe\x00", "not_json"),
        (b"[" * 100_000, "not_json"),
    ],
)
def test_what_is_no_plan_is_refused(data, message, tmp_path):
    path = tmp_path / "plan.json"
    path.write_bytes(data)
    with refused(*message.split()):
        read_plan(path)


def test_a_plan_of_other_inputs_or_warnings_is_refused(carton, document):
    content, write = document
    changed = [one | {"sha256": "0" * 64} if one["path"] == "touch.csv" else one for one in content["inputs"]]
    path = write(inputs=changed)
    with refused("input_changed", "markers_base", "touch.csv"):
        check_plan(read_plan(path), carton, path)
    content, write = document
    stood = list(carton.anatomy.warnings)
    assert stood and content["warnings"] == stood
    for other in (stood[1:], [*stood, "another"]):
        assert "its warnings differ from the case's" in refusal(write(warnings=other), carton)
    for wrong in ("none", [1], None):
        with refused("bad_value"):
            read_plan(write(warnings=wrong))


def test_another_pose_an_unsafe_direction_and_a_motion_through_the_patient_are_refused(carton, planned):
    moved = np.array(planned.plan.T_base_ct)
    moved[0, 3] += 1e-6
    with refused("plan_of_another"):
        check_plan(replace(planned.plan, T_base_ct=moved), carton, "plan.json")
    theta, beta = np.radians(45), np.radians(270)
    outward_ct = carton.check(theta, beta).outward_ct[0]
    with refused("direction_rejected", "too_close", "bolt_h"):
        check_plan(replace(planned.plan, theta=theta, beta=beta, outward_ct=outward_ct), carton, "plan.json")
    plan = planned.plan
    dive = replace(plan, approach=plan.insertion)
    assert "approach is not free" in motion_contact(dive, carton.reach.checker)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("case_name", "another"),
        ("entry_ct", np.array([0.0, 0, 147])),
        ("expected_target_error_mm", 0.0),
        ("clearance_mm", {"needle": 99.0}),
        ("standoff_mm", 149.0),
        ("speeds", SpeedLimits(tip_speed_mm_s=400.0)),
    ],
)
def test_a_plan_that_flatters_itself_is_refused(carton, planned, key, value):
    with refused("plan_of_another"):
        check_plan(replace(planned.plan, **{key: value}), carton, "plan.json")


def leaves(value, path=()):
    if isinstance(value, dict):
        for key in value:
            yield from leaves(value[key], (*path, key))
    elif isinstance(value, list):
        some = range(len(value)) if len(value) <= 6 else [0, len(value) // 2, len(value) - 1]
        for at in some:
            yield from leaves(value[at], (*path, at))
    else:
        yield path


def changed(value):
    if isinstance(value, str):
        return value[:-1] + ("x" if value[-1:] != "x" else "y")
    if isinstance(value, int):
        return value + 1
    return 1.0 if value is None else value + 0.01


def parent(document, path):
    for step in path[:-1]:
        document = document[step]
    return document


def refusal(path, carton):
    try:
        check_plan(read_plan(path), carton, path, seed=1)
    except InputError as error:
        return str(error)
    return None


@pytest.fixture
def met_once(monkeypatch):
    """What a motion meets and how near it comes hangs on its joints alone: computed once for the same."""

    def once(compute):
        found = {}

        def known(plan, checker):
            joints = plan.approach.q.tobytes(), plan.insertion.q.tobytes()
            if joints not in found:
                found[joints] = compute(plan, checker)
            return found[joints]

        return known

    for name in ("motion_contact", "phase_clearances"):
        monkeypatch.setattr(plan_check, name, once(getattr(plan_check, name)))


@pytest.mark.usefixtures("met_once")
def test_every_leaf_of_a_plan_is_computed_again(carton, document):
    """Whatever number or text is edited, the plan is refused in a line that names it; unedited it is accepted.

    What the case file is called decides nothing, so its name alone may be another. Numbers change by 0.01 (mm, degrees,
    rad, s), which is more than any tolerance of the check. The joint angles of a motion are named by their phase.
    """
    content, write = document
    assert refusal(write(), carton) is None
    accepted, unnamed = [], []
    for path in leaves(content):
        holder, was = parent(content, path), parent(content, path)[path[-1]]
        holder[path[-1]] = changed(was)
        line = refusal(write(), carton)
        holder[path[-1]] = was
        if line is None:
            accepted.append(path)
        elif not any(step.removesuffix("_mm").removesuffix("s") in line for step in path if isinstance(step, str)):
            unnamed.append((path, line))
    case_files = [at for at, one in enumerate(content["inputs"]) if one["role"] == "case"]
    assert accepted == [("inputs", at, "path") for at in case_files]
    assert unnamed == []


@pytest.mark.usefixtures("met_once")
def test_keys_that_come_or_go_are_refused(carton, document):
    content, write = document
    tables = [(), ("inputs", 0), ("limits",), ("approach",), ("approach", "peaks"), ("insertion",), ("clearance_mm",)]
    for table in tables:
        names = list(parent(content, (*table, "")))
        for name in [*names, "extra"]:
            held = parent(content, (*table, ""))
            was = dict(held)
            held.pop(name) if name in held else held.update({name: 1.0})
            line = refusal(write(), carton)
            held.clear()
            held.update(was)
            assert line is not None, (table, name)
            assert name in line or str(table[-1]) in line, (table, name, line)


def test_no_safe_candidate_means_no_plan(carton, found):
    none = replace(
        found,
        verdict=replace(found.verdict, reason=np.full(len(found), Reason.TOO_CLOSE.value)),
        ranking=Ranking.none(len(found)),
    )
    with refused("no_safe_direction", by=NoAnswerError) as caught:
        make_plan(carton, none, seed=0)
    assert caught.value.counts == {"too_close": len(found)}


def test_a_ur3e_plans_to_the_abdomens_lesion(tmp_path):
    for file in (folder() / "abdomen").iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    touch = (tmp_path / "touch.csv").read_text(encoding="utf-8").splitlines()
    named = [",".join(line.split(",")[:4]) for line in touch]  # the joints of each touch are those of a UR3
    (tmp_path / "touch.csv").write_text("\n".join(named) + "\n", encoding="utf-8")
    case = tmp_path / "case.toml"
    text = case.read_text(encoding="utf-8").replace('model = "ur3"', 'model = "ur3e"\ninsertion_speed_mm_s = 40.0')
    case.write_text(text.replace("step_deg = 2.0", "step_deg = 15.0"), encoding="utf-8")
    context = prepare(case)
    plan = make_plan(context, context.search(), seed=1).plan
    assert plan.model.name == "ur3e" and check_plan(plan, context, tmp_path / "plan.json").safe.all()
    checker = context.reach.checker
    assert checker.model is ur_model("ur3e")
    for q in (plan.approach.q[0], *plan.approach.q[:: max(1, len(plan.approach.q) // 20)]):
        assert CellChecker.contact(checker, np.asarray(q), needle_may_touch_patient=False) is None
