"""`import puncture_twin as pt`: a dozen names, light to import, and the same answers as the command line."""

import subprocess
import sys

import numpy as np
import pytest
from refusals import refused

import puncture_twin as pt
from puncture_twin.meshes import folder
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.search.context import prepare

HEAVY = ("numba", "pybullet", "matplotlib", "trimesh", "scipy", "ompl", "fcl", "pyarrow", "SimpleITK", "plotly")


@pytest.fixture(scope="module")
def context():
    """The carton, organs alone."""
    return pt.prepare(folder() / "carton" / "case_m.toml", arm=False)


def test_every_name_is_there_with_a_docstring():
    """And the list is short enough to be read."""
    assert 12 <= len(pt.__all__) <= 24
    for name in pt.__all__:
        assert getattr(pt, name).__doc__, name


def test_importing_it_loads_nothing_heavy_and_prints_nothing():
    """A notebook that only registers markers does not wait for a simulator."""
    code = f"import sys, puncture_twin as pt; pt.register; print([name for name in {HEAVY} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout.strip(), done.stderr) == ("[]", "")


def test_search_gives_what_the_context_gives(context):
    """No second way to an answer."""
    ours, theirs = pt.search(context), prepare(folder() / "carton" / "case_m.toml", arm=False).search()
    assert np.array_equal(ours.verdict.reason, theirs.verdict.reason)
    assert np.array_equal(ours.ranking.cost, theirs.ranking.cost, equal_nan=True)


def test_check_takes_degrees(context):
    """And gives the verdict of the same row of the search."""
    candidates = pt.search(context)
    for row in (0, len(candidates) // 2):
        explained = pt.check(context, np.degrees(candidates.theta[row]), np.degrees(candidates.beta[row]))
        assert explained.safe == candidates.safe[row]


def test_what_it_returns_prints_as_one_line(context):
    """A prompt is not flooded with arrays: the name of the type, and what is in it."""
    candidates, marker = pt.search(context), folder() / "carton" / "markers_ct.csv"
    rejected = int(np.flatnonzero(~candidates.safe)[0])
    checked = pt.check(context, *np.degrees((candidates.theta[rejected], candidates.beta[rejected])))
    values = {
        "<CaseContext: case carton-m, ": context,
        "<Case: carton-m, ": context.case,
        f"<Candidates: {len(candidates):,} directions, ": candidates,
        "<Explanation: case carton-m, theta ": checked,
        "<Certificate: case carton-m, ": pt.certify(context, size_deg=10.0),
        "<NamedPoints: 3 points, ": pt.read_points(marker),
        "<TriangleMesh: ": context.anatomy.skin.mesh,
    }
    for begins, value in values.items():
        assert repr(value) == str(value) and len(repr(value).splitlines()) == 1
        assert repr(value).startswith(begins) and repr(value).endswith(">") and len(repr(value)) < 400, repr(value)
        assert "array(" not in repr(value)
    assert ": rejected because " in repr(checked)


def test_a_value_that_is_half_made_still_prints():
    """A debugger must not fail over it."""
    half = object.__new__(TriangleMesh)
    assert "TriangleMesh object at" in repr(half)


def test_rerank_orders_the_safe_ones_alone(context):
    """Rejected candidates keep rank 0 whatever their cost, and no verdict changes."""
    candidates = pt.search(context)
    mine = pt.rerank(candidates, -candidates.path.length)
    assert np.array_equal(mine.safe, candidates.safe)
    assert (mine.ranking.rank[~mine.safe] == 0).all()
    assert (np.diff(mine.path.length[mine.ranked]) <= 0).all()
    assert sorted(mine.ranking.rank[mine.safe]) == list(range(1, int(mine.safe.sum()) + 1))


@pytest.mark.parametrize("cost", [np.zeros(3), "nan", "complex"], ids=["another shape", "not a number", "complex"])
def test_rerank_refuses_a_cost_that_orders_nothing(context, cost):
    """One line that says what is allowed."""
    candidates = pt.search(context)
    if isinstance(cost, str):
        cost = np.full(len(candidates), np.nan if cost == "nan" else 1.0 + 2.0j)
    with refused("wrong_shape"):
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


def test_register_refuses_a_method_that_is_none():
    """It is not taken for another one."""
    good = {"a": (0, 0, 0), "b": (100, 0, 0), "c": (0, 80, 0)}
    with refused("unknown_method", "magic"):
        pt.register(good, good, target_ct=(0, 0, 0), method="magic")


def test_register_refuses_points_that_are_none():
    """Two coordinates, or something that is no number, is one line, not a traceback."""
    good = {"a": (0, 0, 0), "b": (100, 0, 0), "c": (0, 80, 0)}
    for bad, code in (((0, 0), "not_a_number"), ((0, 0, "x"), "not_a_number"), ((0, 0, float("nan")), "not_finite")):
        with refused(code):
            pt.register({**good, "c": bad}, good, target_ct=(0, 0, 0))


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


@pytest.mark.parametrize("angles", [(400.0, 10.0), (-1.0, 0.0), (10.0, 361.0), (float("nan"), 10.0)])
def test_check_refuses_an_angle_outside_of_its_range(context, angles):
    """400 degrees would be explained as 40: the command line refuses it, and so does the library."""
    with refused("out_of_range"):
        pt.check(context, *angles)


@pytest.mark.parametrize(
    ("target", "code"), [((0, 0), "wrong_shape"), ((0, 0, float("nan")), "not_finite"), ("abc", "not_a_number")]
)
def test_register_refuses_a_target_that_is_no_point(target, code):
    """One line that names the target, not NumPy's complaint."""
    markers = {"a": (0, 0, 0), "b": (100, 0, 0), "c": (0, 80, 0)}
    with refused(code, "target"):
        pt.register(markers, markers, target_ct=target, fle_mm=0.5)
