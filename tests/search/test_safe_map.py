"""Another target in the same anatomy, and the map of what its structures block."""

import numpy as np
import pytest
from case_world import coarse_carton, write_case
from refusals import refused

import puncture_twin as pt
from puncture_twin.planning.search.context import prepare


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """The usual patient with a grid all about."""
    path = write_case(tmp_path_factory.mktemp("map"))
    path.write_text(path.read_text().replace("theta_deg = [0, 10]", "theta_deg = [0, 180]"))
    return path


def test_another_target_is_what_the_case_with_that_target_is(tmp_path):
    """Candidates, inputs, findings and placement are those of the case prepared anew, the second time too."""
    context = prepare(coarse_carton(tmp_path / "carton"))
    for target in context.case.target_ct + [[0.5, -0.4, -1.0], [-0.5, 0.4, -2.0]]:
        moved, fresh = context.at(target), prepare(context.case.replace(target_ct=target))
        one, other = moved.search(), fresh.search()
        assert one.provenance == other.provenance
        assert moved.anatomy.findings == fresh.anatomy.findings
        assert np.array_equal(moved.placement.T_base_ct, fresh.placement.T_base_ct)
        for table in ("verdict", "path", "clearance", "arm"):
            for name, column in vars(getattr(one, table)).items():
                expected = getattr(getattr(other, table), name)
                np.testing.assert_array_equal(column, expected, err_msg=f"{table}.{name}")
        with refused("input_changed"):
            context.own(one)


def test_a_target_that_the_case_could_not_have_is_refused(case):
    """Outside the label map, outside its structure, and no point at all."""
    context = prepare(case, arm=False)
    for target, code in (([0.0, 0.0, 500.0], "labels_end"), ([0.0, 0.0, 40.0], "target_misplaced")):
        with refused(code):
            pt.safe_map(context, target)
    with refused("not_finite"):
        context.at([0.0, np.nan, 0.0])
