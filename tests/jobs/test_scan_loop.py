"""The loop: a case of meshes is scanned, `init` makes a case of it, and `search` gives the verdicts of the meshes."""

import json

import numpy as np
import pytest
import trimesh
from case_world import whole

from puncture_twin.planning.case.entry import grid
from puncture_twin.planning.search.context import prepare
from puncture_twin.planning.search.search import search
from puncture_twin.run_twin import main

PIXEL, STEP_DEG = 2.0, 9.0
NEEDLE = "[needle]\nlength_mm = 150.0\nshaft_mm = 120.0\ndiameter_mm = 1.2\n"
CASE = """schema = 2
region = "other"
name = "small"
space = "LPS"
[target]
position_mm = [-10.0, 5.0, 4.0]
structure = "lesion"
""" + NEEDLE + """[search]
theta_deg = [0, 90]
step_deg = 9.0
[[obstacle]]
name = "table"
frame = "ct"
center_mm = [0.0, 82.0, 0.0]
size_mm = [240.0, 30.0, 400.0]
"""  # fmt: skip
ROLES = {
    "skin": 'role = "skin"',
    "liver": 'role = "traverse"',
    "lesion": 'role = "target"',
    "aorta": 'role = "avoid"\nmargin_mm = 5.0',
    "spine": 'role = "avoid"\nmargin_mm = 2.0\nhu = 60.0',
    "rib_left_7": 'role = "avoid"\nmargin_mm = 1.0\nhu = 60.0',
    "colon": 'role = "avoid"\nmargin_mm = 3.0',
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


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    folder = tmp_path_factory.mktemp("small")
    text = CASE
    for name, mesh in meshes().items():
        mesh.export(folder / f"{name}.ply")
        text += f'[[structure]]\nname = "{name}"\nmesh = "{name}.ply"\nunit = "mm"\n{ROLES[name]}\n'
    (folder / "case.toml").write_text(whole(text))
    context = prepare(folder, arm=False)
    return folder, context, answers(context, context.case.T_ct_entry[:3, :3])


def answers(context, R):
    directions = grid((0.0, np.pi / 2), (0.0, 2 * np.pi), np.radians(STEP_DEG), R)
    return search(context.case, context.anatomy, context.engine, directions)


def started(out, report):
    target = ",".join(str(round(one, 3)) for one in report["target_mm"])
    assert main(["init", str(out), "--ct", "dicom", f"--target={target}"]) == 0
    text = (out / "case.toml").read_text()
    (out / "case.toml").write_text(text[: text.index("[needle]")] + NEEDLE + text[text.index("[search]") :])
    return prepare(out, arm=False)


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
def test_a_scanned_case_has_the_verdicts_of_its_meshes(truth, tmp_path, capsys, spacing, turn, noise):
    """Whatever has a voxel's diagonal to spare keeps its verdict, and no safe direction is wrong by more than that."""
    folder, context, wanted = truth
    out = tmp_path / "ct"
    flags = ["--spacing", spacing, "--pixel", str(PIXEL), "--turn", str(turn), "--noise", noise, "--json"]
    assert main(["scan", str(folder), "--out", str(out), *flags]) == 0
    report = json.loads(capsys.readouterr().out)
    T = np.array(report["T_scan_case"])
    scanned = started(out, report)
    found = answers(scanned, T[:3, :3] @ context.case.T_ct_entry[:3, :3])
    margins = ({one.name: one.margin_mm for one in of.anatomy.structures} for of in (scanned, context))
    assert next(margins) == next(margins)
    voxel = np.linalg.norm([PIXEL, PIXEL, float(spacing)])
    apart = clearances(scanned, found) - clearances(context, wanted)
    assert np.abs(apart).max() < voxel
    slack = least_slack(context, wanted)
    assert not np.any(found.safe & ~wanted.safe & (slack < -voxel))
    clear = np.abs(slack) > voxel
    at_skin = np.abs(wanted.path.skin_angle - context.case.search.max_skin_angle) < np.radians(8)
    assert np.array_equal(found.safe[clear & ~at_skin], wanted.safe[clear & ~at_skin])
    assert (wanted.safe & clear).sum() > 30
    assert (~wanted.safe & ~found.safe).sum() > 60


THIN = {"colon": 'role = "avoid"\nmargin_mm = 3.0', "ganglion": 'role = "avoid"\nmargin_mm = 9.0'}


def test_what_is_thinner_than_a_voxel_is_not_lost(tmp_path, capsys):
    """A sheet of 0.3 mm and a ball of 1 mm before the target: none is safe that breaks a margin by a voxel."""
    sheet = trimesh.creation.box([50.0, 0.3, 50.0])
    sheet.apply_transform(trimesh.transformations.rotation_matrix(0.4, [1.0, 0.3, -0.2]))
    sheet.apply_translation([-30.0, -25.0, -15.0])
    speck = trimesh.creation.icosphere(2, 0.5)
    speck.apply_translation([11.3, -24.2, 22.1])
    parts = {name: mesh for name, mesh in meshes().items() if name in ("skin", "lesion", "spine")}
    text = CASE
    for name, mesh in {**parts, "colon": sheet, "ganglion": speck}.items():
        mesh.export(tmp_path / f"{name}.ply")
        role = THIN.get(name) or ROLES[name]
        text += f'[[structure]]\nname = "{name}"\nmesh = "{name}.ply"\nunit = "mm"\n{role}\n'
    (tmp_path / "case.toml").write_text(whole(text))
    context = prepare(tmp_path, arm=False)
    wanted = answers(context, context.case.T_ct_entry[:3, :3])
    out = tmp_path / "ct"
    assert main(["scan", str(tmp_path), "--out", str(out), "--spacing", "2.5", "--pixel", "1.5", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["thin_voxels"]["colon"] > 50 and report["thin_voxels"]["ganglion"] >= 1
    scanned = started(out, report)
    found = answers(scanned, context.case.T_ct_entry[:3, :3])
    names = [one.name for one in scanned.anatomy.structures]
    margin = {one.name: one.margin_mm for one in scanned.anatomy.structures}
    voxel = np.linalg.norm([1.5, 1.5, 2.5])
    for name in THIN:
        column = [one.name for one in context.anatomy.structures].index(name)
        lack = margin[name] - wanted.clearance.by_structure[:, column]
        assert name in names and lack.max() > voxel
        assert not np.any(found.safe & (lack > voxel))
    assert found.safe.sum() > 50
