"""Another target in the same anatomy, and the map of what its structures block."""

import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
from case_world import case_text, coarse_carton, structure, write_case
from refusals import refused

import puncture_twin as pt
from puncture_twin.planning.search.context import prepare


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    path = write_case(tmp_path_factory.mktemp("map"))
    path.write_text(path.read_text().replace("theta_deg = [0, 10]", "theta_deg = [0, 180]"))
    return path


def test_another_target_is_what_the_case_with_that_target_is(tmp_path):
    context = prepare(coarse_carton(tmp_path / "carton"))
    for target in context.case.target_ct + [[0.5, -0.4, -1.0], [-0.5, 0.4, -2.0]]:
        moved, fresh = context.at(target), prepare(context.case.replace(target_ct=target))
        assert moved.anatomy.findings == fresh.anatomy.findings
        assert np.array_equal(moved.placement.T_base_ct, fresh.placement.T_base_ct)
        assert moved.placement.target_error_mm == fresh.placement.target_error_mm
        one, other = moved.check(0.2, 0.3), fresh.check(0.2, 0.3)
        assert one.provenance == other.provenance
        for table in ("verdict", "path", "clearance", "arm"):
            for name, column in vars(getattr(one, table)).items():
                np.testing.assert_array_equal(column, getattr(getattr(other, table), name), err_msg=f"{table}.{name}")
        with refused("input_changed"):
            context.own(one)


def test_of_two_phantoms_another_target_chooses_the_one_that_holds_it(tmp_path):
    x, y, z = (np.arange(-160.0, 161.0, 5.0)[at] for at in np.ix_(*[range(65)] * 3))
    dense = [np.maximum(abs(x - at), np.maximum(abs(y), abs(z))) < half for at, half in ((-70.0, 42.0), (70.0, 52.0))]
    air = np.random.default_rng(1).normal(-1000.0, 10.0, dense[0].shape)
    image = sitk.GetImageFromArray(np.where(np.logical_or(*dense), 40.0, air).astype(np.int16).T)
    image.SetSpacing((5.0, 5.0, 5.0))
    image.SetOrigin((-160.0, -160.0, -160.0))
    sitk.WriteImage(image, str(tmp_path / "ct.nii.gz"))
    skin, target = structure("skin", "skin", {"ct": "ct.nii.gz"}), "position_mm = [-70, 0, 0]\nhit_radius_mm = 5.0"
    (tmp_path / "case.toml").write_text(case_text(skin, region="phantom", target=target))
    context = prepare(tmp_path / "case.toml", arm=False)
    for middle, half in ((-70.0, 42.0), (70.0, 52.0), (-70.0, 42.0)):
        context = context.at([middle, 0.0, 0.0])
        low, high = context.anatomy.skin.mesh.bounds[:, 0]
        assert middle - half - 5.0 < low < middle < high < middle + half + 5.0
    with refused("target_misplaced"):
        context.at([0.0, 0.0, 0.0])


def test_a_target_that_the_case_could_not_have_is_refused(case):
    context = prepare(case, arm=False)
    for target, code in (([0.0, 0.0, 500.0], "labels_end"), ([0.0, 0.0, 40.0], "target_misplaced")):
        with refused(code):
            pt.safe_map(context, target)
    with refused("not_finite"):
        context.at([0.0, np.nan, 0.0])


def test_the_map_is_that_of_the_reference_engine(case):
    path = case.with_name("table.toml")
    table = (
        '[[obstacle]]\nname = "table"\nframe = "ct"\ncenter_mm = [0.0, 130.0, 0.0]\nsize_mm = [300.0, 40.0, 400.0]\n'
    )
    path.write_text(case.read_text().replace("[end]", f"{table}[end]"))
    ours, reference = (pt.safe_map(prepare(path, arm=False, engine=name)) for name in ("fast", "fcl"))
    assert np.array_equal(ours.structure, reference.structure)
    assert np.array_equal(ours.blocked, ours.structure >= 0)
    assert {ours.structures[row] for row in np.unique(ours.structure[ours.blocked])} == {"rib", "vessel", "table"}
    assert ours.theta_deg.max() == pytest.approx(180.0) and len(ours.beta_deg) == len(ours.blocked)


def test_the_best_target_has_the_widest_window_and_is_a_case(case):
    context = prepare(case, arm=False)
    found = pt.best_target(context, [[0.0, 0.0, 40.0], [2.0, 3.0, 1.0], [-3.0, -2.0, 0.0]])
    windows = [
        max((one.square_deg for one in at.search().windows), default=0.0)
        for at in (context, *(context.at(point) for point in found.points_ct[2:]))
    ]
    np.testing.assert_allclose(found.window_deg2, [windows[0], 0.0, *windows[1:]])
    assert found.best == 3 and found.best_deg2 == found.window_deg2[3] == pytest.approx(max(windows))
    assert np.array_equal(found.context.case.target_ct, found.target_ct)
    inside = pt.best_target(context, 20)
    assert 10 <= len(inside.points_ct) <= 40 and inside.best_deg2 >= windows[0]
    with refused("empty", by=pt.InputError):
        pt.best_target(context, np.zeros((0, 3)))


def test_a_moved_context_goes_to_another_process_and_threads_share_one(case):
    context = prepare(case, arm=False).at([2.0, 3.0, 1.0])
    assert context.memory.held_bytes > 0
    sent = pickle.loads(pickle.dumps(context))
    assert sent.memory.held_bytes == 0
    assert np.array_equal(pt.safe_map(sent).structure, pt.safe_map(context).structure)
    assert np.array_equal(sent.at([0.0, 1.0, 0.0]).case.target_ct, [0.0, 1.0, 0.0])
    context, targets = prepare(case, arm=False), [[0.5 * k, 0.2 * k, -0.3 * k] for k in range(8)]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda target: pt.safe_map(context, target).structure, targets))
    for target, blocked_by in zip(targets, found, strict=True):
        assert np.array_equal(blocked_by, pt.safe_map(context, target).structure)


def test_no_two_threads_share_a_checker(tmp_path):
    """FCL's bodies are moved to be asked: one checker for all targets of a thread, and another for each other thread.

    With one for all, four threads that search an abdomen at four targets find 5 of 4,000 verdicts of others' states.
    """
    context = prepare(coarse_carton(tmp_path / "carton"))
    moved = context.at(context.case.target_ct + [0.1, 0.2, -0.2])
    assert moved.reach.checker is context.reach.checker
    with ThreadPoolExecutor(1) as pool:
        others = pool.submit(lambda: (moved.reach.checker, context.reach.checker)).result()
    assert others[0] is others[1] is not moved.reach.checker
    assert others[0].contact(np.zeros(6), needle_may_touch_patient=False) == moved.reach.checker.contact(
        np.zeros(6), needle_may_touch_patient=False
    )
