"""`import puncture_twin as pt`: light to import, and the same answers as the command line."""

import pickle
import shutil
import subprocess
import sys
import tomllib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from fractions import Fraction
from functools import partial

import numpy as np
import pyarrow.parquet as pq
import pytest
import tomlkit
from case_world import coarse_carton
from PIL import Image
from refusals import refused

import puncture_twin as pt
from puncture_twin.meshes import folder
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.base.processes import process_pool
from puncture_twin.planning.clearance.fast_engine import FastEngine
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.run_twin import main

HEAVY = ("numba", "pybullet", "matplotlib", "trimesh", "scipy", "ompl", "fcl", "pyarrow", "SimpleITK", "plotly")


@pytest.fixture(scope="module")
def context():
    return pt.prepare(folder() / "carton" / "case_m.toml", arm=False)


@pytest.fixture(scope="module")
def candidates(context):
    return pt.search(context)


def test_importing_it_loads_nothing_heavy_and_prints_nothing():
    """A notebook that only registers markers does not wait for a simulator."""
    code = f"import sys, puncture_twin as pt; pt.register; print([name for name in {HEAVY} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout.strip(), done.stderr) == ("[]", "")


def test_a_value_that_is_half_made_still_prints():
    half = object.__new__(TriangleMesh)
    assert "TriangleMesh object at" in repr(half)


def test_rerank_orders_the_safe_ones_alone(candidates):
    """Rejected candidates keep rank 0 whatever their cost, and no verdict changes."""
    mine = pt.rerank(candidates, -candidates.path.length)
    assert np.array_equal(mine.safe, candidates.safe)
    assert (mine.ranking.rank[~mine.safe] == 0).all()
    assert (np.diff(mine.path.length[mine.ranked]) <= 0).all()
    assert sorted(mine.ranking.rank[mine.safe]) == list(range(1, int(mine.safe.sum()) + 1))
    whole = np.ones(len(candidates))
    for cost, code in ((np.zeros(3), "wrong_shape"), (whole * np.nan, "wrong_shape"), (whole * 1j, "wrong_type")):
        with refused(code):
            pt.rerank(candidates, cost)


def test_register_takes_two_lists_and_no_case():
    """A rigid motion of four markers is found again; names decide, not their order."""
    ct = {"a": (0, 0, 0), "b": (100, 0, 0), "c": (0, 80, 0), "d": (10, 20, 60)}
    R = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    base = {name: R @ np.array(ct[name]) + (5, 6, 7) for name in reversed(ct)}
    found = pt.register(ct, base, target_ct=(10, 10, 10), fle_mm=0.5)
    assert np.allclose(found.T_base_ct[:3, :3], R)
    assert np.allclose(found.T_base_ct[:3, 3], (5, 6, 7))
    with refused("markers_missing"):
        pt.register(ct, {"a": (0, 0, 0), "b": (100, 0, 0), "x": (0, 80, 0)}, target_ct=(0, 0, 0))


def test_files_are_read_and_written_under_the_one_name(tmp_path):
    """Points go to a CSV and come back the same; a mesh states its unit; an unknown unit is one line."""
    points = {"A": (1.5, -2.0, 3.25), "B": (0.0, 10.0, -7.0)}
    pt.write_points(points, tmp_path / "points.csv")
    read = pt.read_points(tmp_path / "points.csv")
    assert read.names == ("A", "B")
    assert read.points.tolist() == [list(point) for point in points.values()]
    liver = folder() / "abdomen" / "liver.ply"
    assert np.array_equal(pt.read_mesh(liver, unit="cm").vertices, 10.0 * pt.read_mesh(liver).vertices)
    with refused("unknown_choice", "inch"):
        pt.read_mesh(liver, unit="inch")
    with refused("no_such_file"):
        pt.read_mesh(tmp_path / "none.stl")
    assert pt.check_folder(tmp_path) == ("manifest.json is missing",)


def same_candidates(one, other):
    """Whether two searches say the same of every direction, to the last bit."""
    groups = ("verdict", "path", "clearance", "arm", "ranking")
    values = [(getattr(getattr(one, group), name), getattr(getattr(other, group), name))
              for group in groups for name in vars(getattr(one, group))]  # fmt: skip
    return all(np.array_equal(a, b, equal_nan=np.asarray(a).dtype.kind == "f") for a, b in values)


def test_a_case_with_other_values_is_what_a_file_with_them_is(tmp_path):
    """Target, mount, needle and margins, one after another or at once; the case itself stays, and so does its file."""
    shutil.copytree(folder() / "carton", tmp_path / "carton")
    case = pt.load_case(tmp_path / "carton" / "case_m.toml")
    target = case.target_ct + (0.4, -0.3, -0.5)
    needle, mount = {"diameter_mm": 1.4}, {"position_mm": [500, 0, 100], "x_axis": [1, 0, 0], "z_axis": [0, 0, 1]}
    text = tomllib.loads((folder() / "carton" / "case_m.toml").read_text(encoding="utf-8"))
    text["target"] = {**{k: v for k, v in text["target"].items() if k != "points"}, "position_mm": target.tolist()}
    text["needle"] |= needle
    text["robot"] = {**text.get("robot", {}), "mount": mount}
    text.pop("registration", None)
    written = tmp_path / "carton" / "written.toml"
    written.write_text(tomlkit.dumps(text), encoding="utf-8")
    ours = case.replace(target_ct=target, needle=needle, mount=mount)
    one_by_one = case.replace(needle=needle).replace(mount=mount).replace(target_ct=target)
    theirs = pt.load_case(written)
    assert np.array_equal(ours.target_ct, theirs.target_ct) and np.array_equal(ours.T_ct_entry, theirs.T_ct_entry)
    assert ours.needle == theirs.needle == one_by_one.needle
    assert np.array_equal(ours.robot.T_base_ct_mount, theirs.robot.T_base_ct_mount)
    assert ours.registration is None and one_by_one.inputs == ours.inputs
    found = [pt.search(pt.prepare(one, arm=False)) for one in (ours, theirs, one_by_one)]
    assert same_candidates(found[0], found[1]) and same_candidates(found[0], found[2])
    assert not same_candidates(found[0], pt.search(pt.prepare(case, arm=False)))
    assert [one.role for one in case.inputs].count("options") == 0 and ours.inputs[1].role == "options"


def test_a_case_whose_files_have_changed_is_not_made_into_another(tmp_path):
    shutil.copytree(folder() / "carton", tmp_path / "carton")
    case = pt.load_case(tmp_path / "carton" / "case_m.toml")
    case.files.release()
    case = pickle.loads(pickle.dumps(case))  # holds no bytes
    with (tmp_path / "carton" / "markers_ct.csv").open("a", encoding="utf-8") as stream:
        stream.write("extra,1,2,3\n")
    with refused("input_changed", "markers_ct.csv"):
        case.replace(needle={"diameter_mm": 1.4})


def test_many_directions_are_what_the_search_says_of_each(context, candidates):
    """Verdict, path and clearance of every row; only rank, cone and window belong to the whole grid."""
    rows = np.random.default_rng(3).permutation(len(candidates))[:200]
    found = pt.check_many(context, candidates.theta_deg[rows], candidates.beta_deg[rows])
    assert np.array_equal(found.verdict.reason, candidates.verdict.reason[rows])
    assert np.allclose(found.clearance.by_structure, candidates.clearance.by_structure[rows], atol=1e-9)
    assert np.allclose(found.path.entry_ct, candidates.path.entry_ct[rows], atol=1e-9, equal_nan=True)
    assert found.grid is None and len(found) == 200


NAN, GOOD = float("nan"), {"a": (0, 0, 0), "b": (100, 0, 0), "c": (0, 80, 0)}
REFUSED = [
    ("register", {"method": "magic"}, "unknown_method magic"),
    ("register", {"markers_base": GOOD | {"c": (0, 0, "x")}}, "wrong_type"),
    ("register", {"markers_base": GOOD | {"c": (0, 0, NAN)}}, "not_finite"),
    ("register", {"target_ct": (0, 0)}, "wrong_shape target"),
    ("check", {"theta_deg": 400.0, "beta_deg": 10.0}, "out_of_range"),  # it would be explained as 40
    ("check", {"theta_deg": -1.0, "beta_deg": 0.0}, "out_of_range"),
    ("check", {"theta_deg": 10.0, "beta_deg": 361.0}, "out_of_range"),
    ("check", {"theta_deg": NAN, "beta_deg": 10.0}, "not_finite"),
    ("check_many", {"theta_deg": [10.0, 20.0], "beta_deg": [10.0]}, "wrong_shape"),
    ("check_many", {"theta_deg": [], "beta_deg": []}, "empty"),
    ("check_many", {"theta_deg": 10.0, "beta_deg": 10.0}, "wrong_shape"),
    ("check_many", {"theta_deg": [10.0, NAN], "beta_deg": [10.0, 10.0]}, "out_of_range"),
    ("check_many", {"theta_deg": [10.0 + 1j], "beta_deg": [10.0]}, "wrong_type"),
    ("check_many", {"theta_deg": [True], "beta_deg": [1.0]}, "wrong_type"),
    ("replace", {"nedle": {"length_mm": 150.0}}, "unknown_key"),
    ("replace", {"target_ct": (1.0, 2.0)}, "wrong_shape"),
    ("replace", {"target_ct": (1.0, 2.0, float("inf"))}, "not_finite"),
    ("replace", {"needle": {"length_mm": 1.0 + 2.0j}}, "bad_value"),
    ("replace", {"mount": {}}, "empty"),
    ("replace", {"needle": {"diameter_mm": 1.0}, "search": {}}, "empty"),
]


@pytest.mark.parametrize(("name", "arguments", "code"), REFUSED)
def test_what_is_none_is_refused_in_one_line(context, name, arguments, code):
    asked = {
        "register": partial(pt.register, markers_ct=GOOD, markers_base=GOOD, target_ct=(0, 0, 0)),
        "check": partial(pt.check, context),
        "check_many": partial(pt.check_many, context),
        "replace": context.case.replace,
    }
    with refused(*code.split()):
        asked[name](**arguments)


@pytest.fixture(scope="module")
def arm_context(tmp_path_factory):
    return pt.prepare(coarse_carton(tmp_path_factory.mktemp("arm") / "carton", 15.0))


@pytest.fixture(scope="module")
def reached(arm_context):
    return pt.search(arm_context)


@pytest.fixture(scope="module")
def planned(arm_context, reached):
    return pt.plan(arm_context, reached)


def test_a_direction_is_the_same_however_it_is_chosen(context, candidates):
    best = candidates.best
    angles = {"theta_deg": best.theta_deg, "beta_deg": best.beta_deg}
    entry = candidates.path.entry_ct[best.row]
    for choice in ({}, angles, {"candidate": best}, {"window": 1}, {"entry": entry}):
        found = pt.check(context, **choice)
        assert np.allclose([found.candidates.theta_deg[0], found.candidates.beta_deg[0]], list(angles.values())), choice
    other = candidates.pick(int(candidates.ranked[-1]))
    assert pt.check(context, candidate=other).candidates.at(0) == candidates.at(other.row)


def test_a_plan_is_of_what_was_chosen(arm_context, reached, planned):
    """Without a choice of the best that the arm can come to; a rejected direction has none."""
    other = reached.pick(int(reached.ranked[1]))
    mine = pt.plan(arm_context, candidate=other)
    assert np.allclose((mine.theta_deg, mine.beta_deg), (other.theta_deg, other.beta_deg))
    assert np.allclose((planned.theta_deg, planned.beta_deg), (reached.best.theta_deg, reached.best.beta_deg))
    rejected = reached.pick(int(np.flatnonzero(~reached.safe)[0]))
    with refused("direction_rejected", by=pt.NoAnswerError):
        pt.plan(arm_context, candidate=rejected)


def test_two_choices_or_an_arm_that_is_switched_off_are_refused(arm_context, reached, context, candidates):
    """The one because nobody knows which is meant; the other says what to do."""
    best = candidates.best
    for two in ({"window": 1, "candidate": best}, {"theta_deg": 1.0, "beta_deg": 2.0, "window": 1}):
        with refused("conflicting_options"):
            pt.check(context, **two)
    with refused("one_angle"):
        pt.plan(arm_context, theta_deg=10.0)
    with refused("out_of_range"):
        pt.plan(arm_context, reached, window=10_000)
    with refused("no_base"):
        pt.plan(context, candidate=best)
    with refused("no_base"):
        pt.touch(context, candidate=best)
    with refused("out_of_range"):
        candidates.pick(-1)


def test_a_context_goes_to_other_processes_and_is_used_by_threads(arm_context, reached):
    parts = np.array_split(np.random.default_rng(1).permutation(len(reached))[:16], 4)
    angles = [(reached.theta_deg[rows], reached.beta_deg[rows]) for rows in parts]
    expected = [pt.check_many(arm_context, *one) for one in angles]
    with ThreadPoolExecutor(4) as pool:
        threads = list(pool.map(lambda one: pt.check_many(arm_context, *one), angles))
    with process_pool(1, 1) as pool:
        sent = pool.submit(pt.check_many, arm_context, *angles[1]).result()
    assert all(same_candidates(a, b) for a, b in zip(expected, threads, strict=True))
    assert same_candidates(sent, expected[1])


def test_the_table_is_the_commands_table(candidates, tmp_path):
    """As a DataFrame, and as a file: what `run-twin search` writes, its provenance too."""
    assert main(["search", str(folder() / "carton" / "case_m.toml"), "--no-arm", "--no-pictures",
                 "--out", str(tmp_path / "command")]) == 0  # fmt: skip
    ours, theirs = candidates.write(tmp_path / "api"), tmp_path / "command" / "candidates.parquet"
    assert ours.read_bytes() == theirs.read_bytes()
    assert pt.check_folder(tmp_path / "api") == ()
    frame = candidates.to_pandas()
    assert frame.equals(pq.read_table(theirs).to_pandas())
    assert np.array_equal(frame["theta_deg"], candidates.theta_deg) and frame["theta_deg"].max() > np.pi
    for nowhere, code in ((3, "wrong_type"), (None, "wrong_type"), ("a\0b", "unwritable")):
        with refused(code):
            candidates.write(nowhere)


def test_windows_and_the_best_are_the_searchs(candidates):
    assert [window.number for window in candidates.windows] == list(range(1, len(candidates.windows) + 1))
    assert candidates.windows[0].best == candidates.best.row == candidates.ranked[0]
    assert sum(window.directions for window in candidates.windows) == candidates.safe.sum()
    assert pt.rerank(candidates, -candidates.ranking.cost).best.row == candidates.ranked[-1]


def test_the_map_is_a_picture(candidates, tmp_path):
    shown = candidates.plot_map()
    assert "<img" in shown._repr_html_()
    with Image.open(shown.write(tmp_path / "map.png")) as picture:
        assert picture.width == picture.height > 300


class OtherEngine(FastEngine):
    """Measures what `altered` makes of a distance."""

    def measure(self, target_ct, outward_ct, length, *, shown=True):
        axes = super().measure(target_ct, outward_ct, length, shown=shown)
        return replace(axes, distance=self.altered(axes.distance))


class WaryEngine(OtherEngine):
    """Measures 1 mm less than there is."""

    def altered(self, mm):
        return np.maximum(mm - 1.0, 0.0)


class HopefulEngine(OtherEngine):
    """Measures 5 mm more than there is."""

    def altered(self, mm):
        return mm + 5.0


class BlindEngine(OtherEngine):
    """Measures no number."""

    def altered(self, mm):
        return np.full_like(mm, np.nan)


def test_an_engine_of_ones_own_measures_everything(context):
    """The search by it is the search with margins that are as much wider; its context is sent with it."""
    case = context.case
    mine = pt.prepare(case, arm=False, engine=WaryEngine)
    found, wider = pt.search(mine), pt.search(pt.prepare(case.replace(margins={"add_mm": 1.0}), arm=False))
    bolts = np.isin(found.clearance.structures, ("bolt_l", "bolt_h"))
    assert np.array_equal(found.clearance.by_structure[:, bolts] < 2.0, wider.clearance.by_structure[:, bolts] < 3.0)
    assert same_candidates(pt.search(pickle.loads(pickle.dumps(mine))), found)
    for wrong in (int, "exact", FastEngine([])):
        with refused("wrong_type" if wrong != "exact" else "unknown_engine"):
            pt.prepare(case, arm=False, engine=wrong)


@pytest.mark.parametrize("engine", [HopefulEngine, BlindEngine])
def test_an_engine_that_finds_more_clearance_than_there_is_ends_with_an_error(context, engine):
    """Neither a search nor one direction says "safe" by it, and its context says the same elsewhere."""
    theirs = pt.prepare(context.case, arm=False, engine=engine)
    for ask in (pt.search, pt.check):
        with refused("engine_contradicted"):
            ask(theirs)
    with refused("engine_contradicted"):
        pt.check(pickle.loads(pickle.dumps(theirs)), 30.0, 100.0)


def test_a_path_of_another_case_is_not_taken_for_one_of_this(context, arm_context, candidates, tmp_path):
    """The angles of a candidate, or the clearances of a checked direction, are another path about another target."""
    case = context.case
    for change in ({"target_ct": case.target_ct + (0.4, 0.0, 0.0)}, {"needle": {"diameter_mm": 1.4}}):
        other = pt.prepare(case.replace(**change), arm=False)
        found = pt.search(other)
        explained = pt.check(other, candidate=found.best)
        for ask in (
            lambda found=found: pt.check(context, candidate=found.best),
            lambda found=found: pt.compare(context, found.best, pt.check(context)),
            lambda found=found: pt.compare(context, found.best, found.best, candidates=found),
            lambda found=found: pt.plan(arm_context, found),
            lambda found=found: pt.report(context, found, tmp_path / "page"),
            lambda explained=explained: pt.compare(context, explained, pt.check(context)),
            lambda explained=explained: pt.export(explained, "slicer", tmp_path / "slicer", context=context),
            lambda found=found: pt.export(found, "candidates-csv", tmp_path / "csv", context=context),
        ):
            with refused("input_changed"):
                ask()
        back = other.case.replace(target_ct=case.target_ct, needle={"diameter_mm": case.needle.diameter_mm})
        assert same_candidates(pt.search(pt.prepare(back, arm=False)), candidates)
    assert not list(tmp_path.iterdir())
    best = candidates.best
    for wrong, code in (((best.candidates, 10**9), "out_of_range"), (("x", 0), "wrong_type")):
        with refused(code):
            pt.check(context, candidate=type(best)(*wrong))


def test_what_is_planned_is_checked_anew(arm_context, reached):
    """Candidates whose verdicts were changed are an order of preference, and make no rejected direction safe."""
    rejected = np.flatnonzero(reached.verdict.reason == "too_close")[:1]
    reason, rank = reached.verdict.reason.copy(), np.zeros(len(reached), np.int32)
    reason[rejected], rank[rejected] = "", 1
    verdict, ranking = replace(reached.verdict, reason=reason), replace(reached.ranking, rank=rank)
    with pytest.raises(NoAnswerError):
        pt.plan(arm_context, replace(reached, verdict=verdict, ranking=ranking))


def test_a_plan_of_another_case_is_neither_rehearsed_nor_shown(arm_context, reached, planned, tmp_path):
    case, plan = arm_context.case, planned
    other = pt.prepare(case.replace(target_ct=case.target_ct + (0.4, 0.0, 0.0)))
    found = pt.search(other)
    checked = pt.check(other, candidate=found.best)
    for ask in (
        lambda: pt.rehearse(other, plan),
        lambda: pt.report(other, found, tmp_path / "page", plan=plan),
        lambda: pt.export(plan, "csv", tmp_path / "csv", context=other),
        lambda: pt.compare(other, plan, checked, candidates=found),
    ):
        with refused("input_changed"):
            ask()
    assert not (tmp_path / "page").exists() and not list(tmp_path.glob("csv/*.csv"))
    with refused("plan_contradicted"):
        pt.rehearse(arm_context, replace(plan, theta=plan.theta + 0.01))
    best = pt.check(arm_context, candidate=reached.best)
    assert pt.compare(arm_context, plan, best, candidates=reached).a.safe
    assert pt.export(plan, "csv", tmp_path / "csv", context=arm_context).path.is_file()


@pytest.mark.parametrize(
    "number",
    [np.float16, np.float32, np.longdouble, np.array, Fraction, np.int64, lambda value: np.array(value, np.int8)],
)
def test_an_angle_is_the_same_in_every_type_of_number(context, number):
    """Half a degree's digits are not lost where it becomes radians: 20 in half precision was 20.003."""
    found = pt.check(context, number(20), beta_deg=number(100))
    assert found.candidates.at(0) == {"theta_deg": 20.0, "beta_deg": 100.0}


def test_masked_values_are_no_numbers(context):
    """Under a mask any number may be; an array that masks nothing is an array."""
    masked, whole = (np.ma.array([30.0, 40.0], mask=mask) for mask in ([False, True], False))
    with refused("not_finite"):
        pt.check_many(context, masked, whole)
    with refused("wrong_type"):
        pt.check(context, np.ma.array(30.0, mask=True), 40.0)
    entry = np.ma.array(context.case.target_ct, mask=[False, True, False])
    for ask in (lambda: pt.check(context, entry=entry), lambda: context.case.replace(target_ct=entry)):
        with refused("not_finite"):
            ask()
    assert len(pt.check_many(context, whole, whole)) == 2
