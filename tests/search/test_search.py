"""The batch search on the embedded cases: rows, ranking, the table, the closest miss."""

import base64
import io
import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings, strategies as st
from PIL import Image
from refusals import refused

from puncture_twin.meshes import folder
from puncture_twin.planning.anatomy.structure import Role, Structure
from puncture_twin.planning.base.provenance import inputs_document
from puncture_twin.planning.base.reasons import SAFE, Reason
from puncture_twin.planning.case.entry import outward
from puncture_twin.planning.case.tables import RankingSection
from puncture_twin.planning.clearance.fcl_engine import CrossCheckError
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.context import prepare
from puncture_twin.planning.search.ranking import pareto_front, rank
from puncture_twin.planning.search.search import inside_length
from puncture_twin.planning.search.table import write_table
from tests.carton_truth import carton_field


@pytest.fixture(scope="module")
def carton():
    return prepare(folder() / "carton" / "case_m.toml", arm=False)


@pytest.fixture(scope="module")
def found(carton):
    return carton.search()


def test_every_direction_has_one_row_ranked_by_cost(carton, found):
    assert len(found) == 46 * 180
    R = carton.case.T_ct_entry[:3, :3]
    np.testing.assert_allclose(found.outward_ct, outward(found.theta, found.beta) @ R.T, atol=1e-12)
    assert set(found.verdict.reason) <= {reason.value for reason in Reason}
    assert sum(found.counts().values()) == len(found)
    assert (found.arm.reachable == -1).all()
    order = found.ranked
    assert (
        np.diff(found.ranking.cost[order]) >= -1e-9
    ).all()  # costs that agree to nine digits keep the order of the grid
    np.testing.assert_array_equal(np.sort(found.ranking.rank[found.safe]), np.arange(1, found.safe.sum() + 1))
    assert np.isnan(found.ranking.cost[~found.safe]).all()
    assert not found.ranking.pareto[~found.safe].any()
    assert found.ranking.pareto[order[0]]


def test_clearances_equal_the_analytic_truth(carton, found, rng):
    """Against the exact fields of the true bolts, sampled along the axis (Lipschitz 1): within 0.02 mm."""
    depths = np.arange(0, carton.case.needle.length_mm, 0.01)
    for row in rng.choice(len(found), 40, replace=False):
        points = carton.case.target_ct + depths[:, None] * found.outward_ct[row]
        for column, name in enumerate(s.name for s in carton.anatomy.structures):
            truth = max(carton_field(name)(points).min(), 0) - carton.case.needle.radius_mm
            if name != "bolt_m":  # the target lies in its end face, where mesh and field differ by rounding
                assert found.clearance.by_structure[row, column] == pytest.approx(truth, abs=0.02)


def test_the_table_holds_what_was_found(carton, found, tmp_path):
    path = tmp_path / "candidates.parquet"
    write_table(found, path)
    table = pq.read_table(path)
    assert table.num_rows == len(found)
    wanted = {"theta_deg", "beta_deg", "verdict", "reason", "reason_structure", "reason_depth_mm", "entry_x_mm",
              "entry_y_mm", "entry_z_mm", "path_length_mm", "skin_angle_deg", "min_clearance_mm", "clearance_bolt_h_mm",
              "reachable", "cost", "rank"}  # fmt: skip
    assert wanted <= set(table.column_names)
    np.testing.assert_allclose(table["theta_deg"].to_numpy(), np.degrees(found.theta))
    assert table["reachable"].null_count == len(found)
    assert table["cost"].null_count == (~found.safe).sum()
    run = json.loads(table.schema.metadata[b"run"])
    assert run["case"] == "carton-m"
    assert run["inputs"] == inputs_document(carton.case.inputs)
    assert run["step_deg"] == pytest.approx(2)


def test_tissue_is_the_length_inside(carton, found, ball):
    organ = Structure("organ", Role.TRAVERSE, 0, ball(20, (0, 0, 60), 5), "")
    up = np.array([[0, 0, 1.0], [0, 0, 1.0], [0, 0, 1.0], [1.0, 0, 0]])
    lengths = inside_length(organ, np.zeros(3), up, np.array([100.0, 60, 30, 100]))
    np.testing.assert_allclose(lengths, [40, 20, 0, 0], atol=0.1)
    from_inside = inside_length(organ, np.array([0, 0, 60.0]), up[:2], np.array([100.0, 5]))
    np.testing.assert_allclose(from_inside, [20, 5], atol=0.1)


@given(st.lists(st.tuples(*[st.integers(0, 4)] * 3), min_size=1, max_size=40))
@settings(max_examples=100)
def test_the_pareto_front_is_what_the_definition_says(rows):
    terms = np.array(rows, float)
    expected = [not any((other <= row).all() and (other < row).any() for other in terms) for row in terms]
    np.testing.assert_array_equal(pareto_front(terms), expected)


def test_each_term_of_the_cost_says_what_it_should():
    weights = RankingSection(clearance=1, path_length=1, skin_angle=1, tissue=1, reach=1, safe_cone=1)
    order = rank(
        min_clearance=np.array([5.0, 40.0]),
        path_length=np.array([75.0, 30.0]),
        skin_angle=np.array([0.5, 0.0]),
        tissue=np.array([15.0, 0.0]),
        reach_margin=np.array([0.25, np.nan]),
        safe_cone=np.array([np.radians(4.0), np.radians(9.0)]),
        shaft=150.0,
        max_skin_angle=1.0,
        weights=weights,
    )
    np.testing.assert_allclose(order.terms, [[0.75, 0.5, 0.5, 0.1, 0.75, 0.2], [0, 0.2, 0, 0, 0, 0]])
    np.testing.assert_allclose(order.cost, [2.8 / 6, 0.2 / 6])
    np.testing.assert_array_equal(order.rank, [2, 1])
    np.testing.assert_array_equal(order.pareto, [False, True])


def test_other_engines_give_the_same_or_are_caught(carton, found):
    plain = prepare(folder() / "carton" / "case_m.toml", arm=False, engine="fcl").search()
    np.testing.assert_array_equal(plain.verdict.reason, found.verdict.reason)
    np.testing.assert_array_equal(plain.verdict.structure, found.verdict.structure)
    np.testing.assert_allclose(plain.clearance.by_structure, found.clearance.by_structure, atol=1e-9)
    np.testing.assert_array_equal(plain.ranking.rank, found.ranking.rank)
    assert carton.cross_check(40).pairs == 40 * 4  # three bolts and the table

    class Wrong:
        def measure(self, *arguments):
            found = carton.engine.measure(*arguments)
            return replace(found, distance=found.distance + np.array([0, 0, 1e-3, 0]))

    with pytest.raises(CrossCheckError, match="structure 2: the engine finds"):
        replace(carton, engine=Wrong()).cross_check(40)
    with refused("unknown_engine", "quick"):
        prepare(folder() / "carton" / "case_m.toml", engine="quick")


@pytest.mark.parametrize(("voxel_mm", "shown"), [(0.0, "5.00"), (0.7, "5.00"), (1.0, "5.0"), (3.0, "5.0")])
def test_clearances_of_coarse_voxels_are_printed_without_hundredths_and_json_keeps_them(carton, voxel_mm, shown):
    found = carton.explain(0.0, 0.0)
    voxel_ct = voxel_mm * np.eye(3) if voxel_mm else None
    structures = tuple(replace(one, voxel_ct=voxel_ct) for one in found.anatomy.structures)
    coarse = replace(found, anatomy=replace(found.anatomy, structures=structures))
    line = next(line for line in coarse.text().splitlines() if line.split()[:1] == ["bolt_h"])
    assert line.split()[2] == shown
    assert coarse.summary()["clearance_mm"] == found.summary()["clearance_mm"]


class Grid(SimpleNamespace):
    """With a length."""

    def __len__(self):
        return len(self.theta)


def grid(step_deg):
    theta, beta = np.meshgrid(np.arange(0, 60.01, step_deg), np.arange(0, 360, step_deg), indexing="ij")
    n = theta.size
    return Grid(
        theta=np.radians(theta.ravel()), beta=np.radians(beta.ravel()), safe=np.ones(n, bool), safe_text="safe",
        verdict=SimpleNamespace(reason=np.full(n, "", object)), ranked=np.empty(0, int), arm_note="checked",
        counts=lambda: {"safe": n},
    )  # fmt: skip


@pytest.mark.parametrize("step_deg", [1.0, 2.0, 5.0, 12.0])
def test_a_safe_cap_is_one_whole_disc(step_deg):
    shown = Candidates.plot_map(grid(step_deg))._repr_html_()
    data = base64.b64decode(re.search(r'base64,([^"]+)"', shown)[1])
    picture = np.asarray(Image.open(io.BytesIO(data))).astype(int)
    inside = np.hypot(*np.meshgrid(*2 * [(np.arange(640) - 319.5) / 320])) < 1
    lined = np.round(np.array(SAFE) * 0.55)
    assert ((picture == SAFE) | (picture == lined)).all(axis=2)[inside].all()
    assert (picture == SAFE).all(axis=2)[inside].mean() > 0.95
    assert "no skin entry" not in shown
