"""The loop: a case of meshes is scanned, `init` makes a case of it, and `search` gives the verdicts of the meshes."""

import numpy as np
import pytest
import trimesh
from case_world import case_text, structure

from puncture_twin.planning.case.entry import grid
from puncture_twin.planning.search.context import prepare
from puncture_twin.planning.search.search import search
from puncture_twin.run_twin import main

PIXEL, STEP_DEG = 2.0, 9.0
TARGET = 'position_mm = [-10.0, 5.0, 4.0]\nstructure = "lesion"'
NEEDLE = "length_mm = 150.0\nshaft_mm = 120.0\ndiameter_mm = 1.2"
TABLE = '[[obstacle]]\nname = "table"\nframe = "ct"\ncenter_mm = [0.0, 82.0, 0.0]\nsize_mm = [240.0, 30.0, 400.0]\n'
ROLES = {
    "skin": ("skin", {}),
    "liver": ("traverse", {}),
    "lesion": ("target", {}),
    "aorta": ("avoid", {"margin_mm": 5.0}),
    "spine": ("avoid", {"margin_mm": 2.0, "hu": 60.0}),
    "rib_left_7": ("avoid", {"margin_mm": 1.0, "hu": 60.0}),
    "colon": ("avoid", {"margin_mm": 3.0}),
    "ganglion": ("avoid", {"margin_mm": 9.0}),
}


def meshes():
    """A small body of round parts; the liver holds lesion and vessel."""
    rod = trimesh.creation.cylinder
    skin = trimesh.creation.icosphere(4, 80.0)
    skin.apply_scale([1.0, 0.8, 1.0])
    lesion, liver = trimesh.creation.icosphere(3, 10.0), trimesh.creation.icosphere(4, 40.0)
    lesion.apply_translation([-10.0, 5.0, 4.0])
    liver.apply_translation([-12.0, 0.0, 0.0])
    return {
        "skin": skin,
        "liver": liver,
        "lesion": lesion,
        "aorta": rod(6.0, segment=[[12, 14, -50], [12, 14, 50]]),
        "spine": rod(9.0, segment=[[5, 42, -45], [5, 42, 45]]),
        "rib_left_7": rod(4.0, segment=[[-52, -38, 0], [30, -50, 18]]),
        "colon": rod(9.0, segment=[[-45, -25, -34], [40, -28, -34]]),
    }


def written(folder, parts):
    """The case of these meshes, prepared, and its verdicts."""
    sections = [TABLE]
    for name, mesh in parts.items():
        mesh.export(folder / f"{name}.ply")
        role, keys = ROLES[name]
        sections.append(structure(name, role, {"mesh": f"{name}.ply", "unit": "mm"}, **keys))
    text = case_text(*sections, target=TARGET, needle=NEEDLE, search="theta_deg = [0, 90]\nstep_deg = 9.0")
    (folder / "case.toml").write_text(text)
    context = prepare(folder, arm=False)
    return context, answers(context, context.case.T_ct_entry[:3, :3])


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    return written(tmp_path_factory.mktemp("small"), meshes())


def answers(context, R):
    directions = grid((0.0, np.pi / 2), (0.0, 2 * np.pi), np.radians(STEP_DEG), R)
    return search(context.case, context.anatomy, context.engine, directions)


@pytest.fixture
def scanned(run, undrawn, tmp_path):
    """A function: what `scan` reports of a case, and the case that `init` makes of the files, with the same needle."""

    def scan(context, *flags):
        out = tmp_path / "ct"
        code, report = run("scan", context.case.path, "--out", out, *flags)
        target = ",".join(str(round(one, 3)) for one in report["target_mm"])
        assert code == 0 and main(["init", str(out), "--ct", "dicom", f"--target={target}"]) == 0
        text = (out / "case.toml").read_text()
        before, after = text[: text.index("[needle]")], text[text.index("[search]") :]
        (out / "case.toml").write_text(f"{before}[needle]\n{NEEDLE}\n{after}")
        return report, prepare(out, arm=False)

    return scan


def least_slack(context, found):
    """Clearance beyond the margin of the structure nearest to its own, mm, by direction."""
    demanding = [k for k, one in enumerate(context.anatomy.checked) if one.demands_margin]
    margins = np.array([context.anatomy.checked[k].margin_mm for k in demanding])
    return (found.clearance.by_structure[:, demanding] - context.case.needle.radius_mm - margins).min(axis=1)


def clearances(context, found):
    """Distance of the axis from each structure, (directions, structures), in one order; mm."""
    order = np.argsort([one.name for one in context.anatomy.structures])
    return found.clearance.by_structure[:, order]


@pytest.mark.parametrize(("spacing", "turn", "noise"), [("5", 0, "20"), ("2.5", 35, "40")])
def test_a_scanned_case_has_the_verdicts_of_its_meshes(truth, scanned, spacing, turn, noise):
    """Whatever has a voxel's diagonal to spare keeps its verdict, and no safe direction is wrong by more than that."""
    context, wanted = truth
    report, again = scanned(context, "--spacing", spacing, "--pixel", PIXEL, "--turn", turn, "--noise", noise)
    found = answers(again, np.array(report["T_scan_case"])[:3, :3] @ context.case.T_ct_entry[:3, :3])
    margins = ({one.name: one.margin_mm for one in of.anatomy.structures} for of in (again, context))
    assert next(margins) == next(margins)
    voxel = np.linalg.norm([PIXEL, PIXEL, float(spacing)])
    apart = clearances(again, found) - clearances(context, wanted)
    assert np.abs(apart).max() < voxel
    slack = least_slack(context, wanted)
    assert not np.any(found.safe & ~wanted.safe & (slack < -voxel))
    clear = np.abs(slack) > voxel
    at_skin = np.abs(wanted.path.skin_angle - context.case.search.max_skin_angle) < np.radians(8)
    assert np.array_equal(found.safe[clear & ~at_skin], wanted.safe[clear & ~at_skin])
    assert (wanted.safe & clear).sum() > 30
    assert (~wanted.safe & ~found.safe).sum() > 60


def test_what_is_thinner_than_a_voxel_is_not_lost(scanned, tmp_path):
    """A sheet of 0.3 mm and a ball of 1 mm before the target: none is safe that breaks a margin by a voxel."""
    sheet = trimesh.creation.box([50.0, 0.3, 50.0])
    sheet.apply_transform(trimesh.transformations.rotation_matrix(0.4, [1.0, 0.3, -0.2]))
    sheet.apply_translation([-30.0, -25.0, -15.0])
    speck = trimesh.creation.icosphere(2, 0.5)
    speck.apply_translation([11.3, -24.2, 22.1])
    parts = {name: mesh for name, mesh in meshes().items() if name in ("skin", "lesion", "spine")}
    context, wanted = written(tmp_path, {**parts, "colon": sheet, "ganglion": speck})
    report, again = scanned(context, "--spacing", 2.5, "--pixel", 1.5)
    assert report["thin_voxels"]["colon"] > 50 and report["thin_voxels"]["ganglion"] >= 1
    found = answers(again, context.case.T_ct_entry[:3, :3])
    margin = {one.name: one.margin_mm for one in again.anatomy.structures}
    voxel = np.linalg.norm([1.5, 1.5, 2.5])
    for name in ("colon", "ganglion"):
        column = [one.name for one in context.anatomy.structures].index(name)
        lack = margin[name] - wanted.clearance.by_structure[:, column]
        assert lack.max() > voxel
        assert not np.any(found.safe & (lack > voxel))
    assert found.safe.sum() > 50
