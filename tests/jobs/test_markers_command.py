"""The command ``markers``: its files, its answers, and what `init` makes of a CT that shows markers."""

import json

import numpy as np
import pytest
from case_world import coarse_carton
from marker_world import Markers, scanned, scene
from refusals import refused_command

import puncture_twin as pt
from puncture_twin.planning.formats.points import NamedPoints, read_points, write_points
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.run_twin import main
from puncture_twin.twin.plant.scanner.image import ScanSettings
from puncture_twin.twin.plant.scanner.writers import write_nifti


@pytest.fixture(scope="module")
def patient(tmp_path_factory):
    here, rng = tmp_path_factory.mktemp("patient"), np.random.default_rng(3)
    true, solids = scene(Markers(count=5), rng, others=False)
    volume = scanned(solids, ScanSettings(2.5, 1.0), rng)
    write_nifti(here / "ct.nii.gz", volume.values, volume.T_ct_index)
    index = np.argwhere(np.ones(volume.values.shape, bool))
    points = index @ volume.T_ct_index[:3, :3].T + volume.T_ct_index[:3, 3]
    for name, middle in (("liver", [5.0, 5, 0]), ("aorta", [-15.0, 5, 0])):
        mask = np.linalg.norm(points - middle, axis=1).reshape(volume.values.shape) < 8.0
        write_nifti(here / f"{name}.nii.gz", mask.astype(np.uint8), volume.T_ct_index)
    return true, here


def test_markers_are_written_for_case_and_slicer(patient, tmp_path, run):
    """As CSV, as Slicer's list, as a picture; in JSON with standard deviations; all of one set."""
    true, here = patient
    code, found = run("markers", here / "ct.nii.gz", "--out", tmp_path)
    assert (code, found["space"]) == (0, "LPS") and [one["name"] for one in found["markers"]] == [
        "M1",
        "M2",
        "M3",
        "M4",
        "M5",
    ]
    position = np.array([one["position_mm"] for one in found["markers"]])
    sd = np.array([one["sd_mm"] for one in found["markers"]])
    nearest = np.linalg.norm(position[:, None] - true, axis=2).argmin(axis=1)
    assert sorted(nearest) == [0, 1, 2, 3, 4] and np.all(np.abs(position - true[nearest]) < 4 * sd)
    for name in ("markers_ct.csv", "markers_ct.mrk.json"):
        assert np.array_equal(read_points(tmp_path / name, default_space=Space.LPS).points, position)
    assert found["doubtful"] == []
    api = pt.markers(here / "ct.nii.gz", count=5)
    assert api.points.names == tuple(one["name"] for one in found["markers"])
    assert np.allclose(api.points.points, position) and "<td" in api._repr_html_()
    listed = json.loads((tmp_path / "manifest.json").read_text())["entries"]["markers"]["files"]
    assert {"markers_ct.csv", "markers_ct.mrk.json", "markers.png", "markers.json"} <= set(listed)


def test_a_layout_names_them(patient, tmp_path, run):
    """Of any frame: here turned by 90 degrees."""
    true, here = patient
    turned = true[::-1] @ np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]) + 30.0
    write_points(tmp_path / "layout.csv", NamedPoints(tuple("PQRST"), turned, None))
    code, found = run("markers", here, "--layout", tmp_path / "layout.csv", "--out", tmp_path / "out")
    named = {one["name"]: one["position_mm"] for one in found["markers"]}
    assert code == 0 and np.allclose([named[name] for name in "PQRST"], true[::-1], atol=0.3)


@pytest.mark.parametrize("options", [("--count", "6"), ("--count", "4"), ("--diameter", "14")])
def test_no_is_one_line_and_nothing_is_written(patient, tmp_path, capfd, options):
    """Too few, too many, none of that size: exit 1."""
    capfd.readouterr()
    assert main(["markers", str(patient[1]), "--out", str(tmp_path / "out"), *options]) == 1
    (line,) = [one for one in capfd.readouterr().err.splitlines() if one.strip() and ", took " not in one]
    assert "mm" in line and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "code"),
    [
        (("--kind", "cube"), "unknown_choice"),
        (("--diameter", "20"), "out_of_range"),
        (("--count", "1"), "out_of_range"),
        (("--propose", "4", "--count", "4"), "conflicting_options"),
        (("--propose", "2"), "out_of_range"),
        (("--layout", "nothing.csv"), "no_such_file"),
    ],
)
def test_what_cannot_be_used_is_refused(patient, tmp_path, capfd, options, code):
    """Before the CT is read; nothing is written."""
    refused_command(["markers", patient[1], "--out", tmp_path / "out", *options], capfd, code)
    assert not (tmp_path / "out").exists()


def test_a_source_without_a_ct_is_refused(tmp_path, capfd):
    """An empty folder, and a case of meshes."""
    (tmp_path / "empty").mkdir()
    refused_command(["markers", tmp_path / "empty", "--out", tmp_path / "out"], capfd, "no_ct")
    refused_command(["markers", coarse_carton(tmp_path / "carton"), "--out", tmp_path / "out"], capfd, "no_ct")


def test_init_lists_the_markers_of_a_ct_and_proposes_a_registration(patient, tmp_path):
    """In the case's space, once; the commented section names the list; a second `init` reads it."""
    true, here = patient
    arguments = ["init", str(here), "--target=5,5,0", "--region", "other", "--space", "RAS"]
    assert main(arguments) == 0
    points = read_points(here / "markers_ct.csv", default_space=Space.RAS)
    assert np.linalg.norm(points.points[:, None] - true, axis=2).min(axis=0).max() < 0.3
    assert '# markers_ct = "markers_ct.csv"' in (here / "case.toml").read_text()
    before = (here / "markers_ct.csv").read_bytes()
    assert main([*arguments, "--force"]) == 0
    assert (here / "markers_ct.csv").read_bytes() == before


def test_places_are_proposed(tmp_path, run):
    """Of a case with its arm: a list under another name than that of markers that are there."""
    case = coarse_carton(tmp_path / "carton", 30.0)
    code, found = run("markers", case, "--propose", 4, "--out", tmp_path / "out")
    assert code == 0
    points = read_points(tmp_path / "out" / "markers_proposed.csv")
    assert points.names == tuple(one["name"] for one in found["proposed"])
    assert np.allclose(points.points, [one["position_mm"] for one in found["proposed"]])
    assert found["expected_error_mm"] > 0 and found["arm"] == "checked"
    assert not (tmp_path / "out" / "markers_ct.csv").exists()
