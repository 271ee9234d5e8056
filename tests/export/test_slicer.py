"""What 3D Slicer is given, read back: by the rules of its schema, by SimpleITK, and by this program."""

import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import SimpleITK
from case_world import CASE, changed, registration_section, whole, write_case
from export.slicer_facts import MARKUP, POINT, SCHEMA, check_attributes, check_properties
from refusals import refused

from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.export.slicer import entry_area
from puncture_twin.planning.formats.meshes.mesh_files import read_mesh
from puncture_twin.planning.formats.points import read_points
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, left_jacobian, pose
from puncture_twin.planning.geometry.spaces import Space, Unit
from puncture_twin.planning.registration.placement import load_placement
from puncture_twin.planning.search.candidates import find_windows
from puncture_twin.planning.search.choice import BEST, Choice
from puncture_twin.planning.search.context import prepare
from puncture_twin.run_twin import main
from puncture_twin.twin.jobs.patient.export_jobs import export_path

TURN = np.array([0.4, -1.1, 2.0])
T_BASE_CT = pose(exp_rotation(TURN), left_jacobian(TURN) @ [310.0, -120.0, 240.0])
CHANGES = (('space = "LPS"', 'space = "RAS"'), ("theta_deg = [0, 10]", 'frame = "ct"\ntheta_deg = [0, 60]'))
NO_ROBOT = (registration_section(), "")
MARKERS = np.array([[0.0, 0, 80], [50, 0, 75], [0, 60, 70], [-40, -30, 72]])
ALL = {"path.mrk.json", "markers.mrk.json", "safe_entry.vtp", "ct_to_robot.tfm", "scene.mrml"}


def placed_case(folder):
    write_case(folder, *CHANGES)
    touched = apply(T_BASE_CT, MARKERS * [-1, -1, 1])
    rows = [f"{name},{x!r},{y!r},{z!r}" for name, (x, y, z) in zip("ABCD", touched.tolist(), strict=True)]
    (folder / "touch.csv").write_text("\n".join(["name,x_mm,y_mm,z_mm", *rows, ""]))
    return folder / "case.toml"


@pytest.fixture(scope="module")
def context(tmp_path_factory):
    return prepare(placed_case(tmp_path_factory.mktemp("slicer")), arm=False)


@pytest.fixture(scope="module")
def exported(context, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    return out, export_path(context, "slicer", out, Choice(rank=3))


def check_markups(document):
    assert set(document) == {"@schema", "markups"} and document["@schema"] == SCHEMA
    (markup,) = document["markups"]
    check_properties(markup, MARKUP)
    for point in markup["controlPoints"]:
        check_properties(point, POINT)
    assert len({point["id"] for point in markup["controlPoints"]}) == len(markup["controlPoints"])
    return markup


def test_the_files_are_one_set_and_the_scene_names_what_is_there(exported):
    out, done = exported
    assert {path.name for path in done.files} == ALL
    entries = json.loads((out / "manifest.json").read_text())["entries"]
    assert set(entries) == {"export slicer"} and all((out / name).is_file() for name in ALL)
    nodes = list(ElementTree.parse(out / "scene.mrml").getroot())
    ids = [node.attrib["id"] for node in nodes]
    for node in nodes:
        check_attributes(node)
    assert len(set(ids)) == len(ids)
    assert {node.attrib["fileName"] for node in nodes if "fileName" in node.attrib} == ALL - {"scene.mrml"}
    for node in nodes:
        assert node.attrib["id"].startswith(f"vtkMRML{node.tag}Node")
        for part in node.get("references", "").split(";")[:-1]:
            role, number = part.split(":")
            assert number in ids and role in ("storage", "display")


def test_the_line_and_the_markers_read_back(exported, context):
    out, done = exported
    found = context.search()
    row = found.ranked[2]
    markup = check_markups(json.loads((out / "path.mrk.json").read_text()))
    assert markup["type"] == "Line" and markup["coordinateSystem"] == "LPS"
    read = read_points(out / "path.mrk.json", default_space=Space.RAS)
    assert read.names == ("entry", "target")
    assert np.array_equal(read.points, np.stack([found.path.entry_ct[row], context.case.target_ct]))
    assert f"theta {np.degrees(found.theta[row]):g}" in done.facts["path"]
    out, _ = exported
    assert check_markups(json.loads((out / "markers.mrk.json").read_text()))["type"] == "Fiducial"
    read = read_points(out / "markers.mrk.json", default_space=Space.RAS)
    assert read.names == tuple("ABCD") and np.array_equal(read.points, MARKERS * [-1, -1, 1])


def test_the_transform_takes_the_robots_points_to_the_ct_as_itk_reads_it(exported, context, tmp_path):
    """And a case that states it, in the direction that the note says, stands where the markers put it."""
    out, done = exported
    read = SimpleITK.ReadTransform(str(out / "ct_to_robot.tfm"))
    for ct, base in zip(MARKERS * [-1, -1, 1], apply(T_BASE_CT, MARKERS * [-1, -1, 1]), strict=True):
        assert read.TransformPoint(base.tolist()) == pytest.approx(ct, abs=1e-6)
    assert any("ct_to_robot.tfm: from base to CT in LPS" in note for note in done.facts["notes"])
    keys = '[registration]\ntransform = "ct_to_robot.tfm"\ntransform_maps = "base_to_ct"\nbase_axes = "LPS"\n'
    write_case(tmp_path, *CHANGES, text=changed(CASE, (registration_section(), keys)))
    (tmp_path / "ct_to_robot.tfm").write_bytes((out / "ct_to_robot.tfm").read_bytes())
    again = load_placement(load_case(tmp_path))
    assert again.T_base_ct == pytest.approx(context.placement.T_base_ct, abs=1e-9)


def test_the_entry_area_lies_on_the_skin_between_safe_directions(exported, context):
    """Its points are the entries of safe directions, each with its window and cone; triangles keep to one window."""
    out, _ = exported
    found, path = context.search(), out / "safe_entry.vtp"
    area, windows = entry_area(found), find_windows(found)
    mesh = read_mesh(path, unit=Unit.MM, space=Space.RAS, space_is_default=True)
    assert np.array_equal(mesh.vertices, area.points_ct) and np.array_equal(mesh.faces, area.faces)
    arrays = {one.get("Name"): one.text.split() for one in ElementTree.parse(path).iterfind(".//PointData/DataArray")}
    entries = {tuple(found.path.entry_ct[row]): row for row in np.flatnonzero(found.safe)}
    for point, window, cone in zip(mesh.vertices, arrays["window"], arrays["safe_cone_deg"], strict=True):
        row = entries[tuple(point)]
        assert int(window) == windows.of_row[row] and float(cone) == np.degrees(found.safe_cone[row])
    assert len(mesh.faces) and (area.window[area.faces] == area.window[area.faces[:, :1]]).all()
    assert np.linalg.norm(mesh.vertices, axis=1) == pytest.approx(90.0, rel=0.03)  # the skin is a ball


def test_the_area_of_a_whole_window_is_that_of_the_search(context):
    """No more than the sum over the windows' cells, and most of it: a cell at the rim is not drawn."""
    found = context.search()
    triangles = entry_area(found).points_ct[entry_area(found).faces]
    sides = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    drawn = np.linalg.norm(sides, axis=1).sum() / 200.0
    stated = sum(window.entry_cm2 for window in find_windows(found).windows)
    assert 0.5 * stated < drawn < 1.02 * stated


def test_without_a_robot_there_is_no_transform_and_that_is_said(tmp_path, capfd):
    write_case(tmp_path, *CHANGES, NO_ROBOT)
    out = tmp_path / "out"
    assert main(["export", str(tmp_path), "--format", "slicer", "--rank", "2", "--out", str(out), "--json"]) == 0
    told = json.loads(capfd.readouterr().out)
    assert {Path(one).name for one in told["files"]} == ALL - {"markers.mrk.json", "ct_to_robot.tfm"}
    assert any("no transform, no markers" in note for note in told["notes"])
    assert any("arm: not checked" in note for note in told["notes"])
    assert "markers.mrk.json" not in (out / "scene.mrml").read_text()


def test_what_cannot_be_shown_is_refused_and_nothing_is_written(tmp_path, context):
    with refused("out_of_range"):
        export_path(context, "slicer", tmp_path / "a", Choice(rank=10_000))
    with refused("direction_rejected", by=NoAnswerError):
        export_path(context, "slicer", tmp_path / "a", Choice(angles=(np.radians(45.0), 0.0)))
    local = ('space = "RAS"', 'space = "local"')
    write_case(tmp_path, *CHANGES, local, NO_ROBOT)
    text = (tmp_path / "case.toml").read_text()
    vessel = text.index('[[structure]]\nname = "vessel"')
    (tmp_path / "case.toml").write_text(whole(text[:vessel]))
    with refused("local_space"):
        export_path(prepare(tmp_path), "slicer", tmp_path / "a", BEST)
    assert not [one for one in (tmp_path / "a").glob("*") if one.suffix in (".json", ".mrml", ".tfm", ".vtp")]
    (tmp_path / "plan.json").write_text("{}")
    assert main(["export", str(tmp_path / "plan.json"), "--format", "slicer", "--out", str(tmp_path / "a")]) == 2
