"""A real abdomen: the same target judged with two label maps of one patient.

The markers beside the cases are simulated: points on the CT's skin, read with ±1.5 mm (half a voxel) and touched with
0.1 mm of noise, for a base that hangs 500 mm in front of the target.
"""

import shutil

import numpy as np
import pytest
from places import REAL_CT, TESTS

from puncture_twin.planning.reach.standoff import waiting_flange
from puncture_twin.planning.search.context import prepare

DATA = REAL_CT
CASES = TESTS / "real"

pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="the real CT (totalseg_abdomen_3mm) is not on this machine")


@pytest.fixture(scope="module")
def searches(tmp_path_factory):
    here = tmp_path_factory.mktemp("real")
    for file in CASES.iterdir():
        shutil.copy(file, here)
    for name in ("ct", "labels_v1_normal", "labels_v2_fast"):
        (here / f"{name}.nii.gz").symlink_to(DATA / f"{name}.nii.gz")
    for version in ("v1", "v2"):
        path = here / f"case_{version}.toml"
        path.write_text(path.read_text().replace("step_deg = 2.0", "step_deg = 4.0"))
    return {version: _searched(here / f"case_{version}.toml") for version in ("v1", "v2")}


def _searched(path):
    context = prepare(path, arm=False)
    return context, context.search()


def test_every_structure_is_closed_and_the_maps_agree_by_and_large(searches, record_property):
    for version, count in (("v1", 61), ("v2", 63)):
        structures = searches[version][0].anatomy.structures
        assert len(structures) == count
        assert all(s.mesh.closed for s in structures)
    for context, found in searches.values():
        rows = found.safe
        assert rows.sum() > 20
        demanding = ~np.isnan(found.clearance.margins)
        assert (found.clearance.by_structure[rows][:, demanding] >= found.clearance.margins[demanding] - 1e-4).all()
        assert (found.path.length[rows] <= context.case.needle.shaft_mm).all()
        assert (found.path.skin_angle[rows] <= context.case.search.max_skin_angle).all()
    verdicts = [searches[version][1].safe for version in ("v1", "v2")]
    differ = int(np.sum(verdicts[0] != verdicts[1]))
    record_property("verdicts that differ", f"{differ} of {len(verdicts[0])}")

    assert 0 < differ < 0.2 * len(verdicts[0])


def flange_beyond(context, found):
    """How far the flanges lie beyond the planes of the cuts while the tip waits, shape (n,), mm; below 0 before all."""
    view, flange = context.anatomy.skin.field_of_view, waiting_flange(context.case.needle, *path_of(found))
    at = view.to_box(context.case.target_ct + flange[:, None] * found.outward_ct)
    beyond = np.stack([-at, at - view.size_mm], axis=2)
    return np.where(view.cut, beyond, -np.inf).max(axis=(1, 2))


def path_of(found):
    return found.path.length, found.path.skin_angle


def test_where_nothing_says_where_the_arms_lie_no_flange_leaves_the_image(searches):
    context, found = searches["v2"]
    assert context.anatomy.skin.field_of_view.cut.sum() == 4
    beyond = flange_beyond(context, found)
    assert (beyond[found.safe] <= -0.6 - 2.0 + 1e-6).all()
    alone = found.verdict.structure == "beyond_image"
    assert alone.sum() > 20
    assert (beyond[alone] > -0.6 - 2.0 - 1e-6).all()


def test_what_hangs_on_the_body_beyond_is_what_a_search_without_it_adds(searches):
    """The hub that passes a plane in air costs directions; as many as are said become safe where it is as wide as cut.

    Of those none has its flange where the nearest voxel of the image is body.
    """
    context, found = searches["v2"]
    path = context.case.path.with_name("case_declared.toml")
    path.write_text(context.case.path.read_text() + "\n[ct]\nbeyond_mm = 0\n")
    other, more = _searched(path)
    (said,) = (one for one in found.findings if one.code == "hangs_on_beyond_image")
    assert said.numbers["directions"] == more.safe.sum() - found.safe.sum() > 100
    assert more.safe[found.safe].all()
    body, T = other.anatomy.scan._body, other.anatomy.scan._ct.T_ct_index
    for length in (waiting_flange(other.case.needle, *path_of(more)), waiting_flange(other.case.needle, 0.0, 0.0)):
        at = other.case.target_ct + np.broadcast_to(length, len(more))[more.safe, None] * more.outward_ct[more.safe]
        index = np.rint(np.linalg.solve(T[:3, :3], (at - T[:3, 3]).T).T).astype(int)
        outside = ((index < 0) | (index >= body.shape)).any(axis=1)
        nearest = np.clip(index, 0, np.array(body.shape) - 1)
        assert not body[tuple(nearest[outside].T)].any()
