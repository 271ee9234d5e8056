"""Bad input through the command line: exit code 2, one line (what, where, what is allowed), nothing written.

What each reader refuses is asked of the reader itself, in tests/formats; here stands one fault of each kind of file,
and all that a case alone makes wrong.
"""

import gzip
import json
import struct

import case_world as world
import numpy as np
import pytest
import trimesh
from refusals import refused_command

from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.run_twin import main
from puncture_twin.twin.jobs.exit_codes import exit_code_of

CASE = world.case_text(
    world.SKIN,
    world.ORGAN,
    world.structure("rib", "avoid"),
    world.structure("vessel", "avoid", {"labelmap": "labels.nii.gz", "label": 3}),
    world.registration_section(),
    name="bad",
)


def opened(path, radius, wound_at_random=False, shells=1):
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    faces = mesh.faces[5:]
    if wound_at_random:
        flip = np.random.default_rng(3).random((len(faces), 1)) < 0.5
        faces = np.where(flip, faces[:, ::-1], faces)
    parts = [trimesh.Trimesh(mesh.vertices * (1 + k / 5), faces, process=False) for k in range(shells)]
    trimesh.util.concatenate(parts).export(path)


@pytest.fixture
def folder(tmp_path):
    here = tmp_path / "case"
    here.mkdir()
    (here / "case.toml").write_text(CASE)
    world.write_balls(here)
    labels = np.zeros((100, 100, 100), np.uint8)
    labels[42:58, 67:69, 67:69] = 3
    world.write_labels(here / "labels.nii.gz", labels)
    world.write_labels(here / "labels.nrrd", labels, compressed=False)
    world.write_markers(here)
    return here


# Each break gets the folder, and spoils one thing in it.


def edited(name, change):
    def spoil(folder):
        (folder / name).write_bytes(change((folder / name).read_bytes()))

    return spoil


def overwrite(name, data):
    return lambda folder: (folder / name).write_bytes(data if isinstance(data, bytes) else data.encode())


def replace(name, old, new):
    def change(data):
        assert old.encode() in data
        return data.replace(old.encode(), new.encode(), 1)

    return edited(name, change)


def patched(data, offset, new):
    return data[:offset] + new + data[offset + len(new) :]


AT, ORIGIN = "[registration]", "[0.0, 0.0, 0.0]"
NO_WEIGHT = "clearance = 0\npath_length = 0\nskin_angle = 0\ntissue = 0\nreach = 0\nsafe_cone = 0"

BREAKS = {
    # the case file
    "unknown key": (replace("case.toml", "shaft_mm", "shaft"), "unknown_key shaft"),
    "unknown unit": (replace("case.toml", '"mm"\nrole = "skin"', '"inch"\nrole = "skin"'), "unknown_unit"),
    "label that is not there": (replace("case.toml", "label = 3", "label = 4"), "label_absent"),
    "target structure that is not there": (replace("case.toml", '"organ"', '"orgn"'), "unknown_structure"),
    "unknown arm": (replace("case.toml", AT, f'[robot]\nmodel = "ur99"\n{AT}'), "unknown_robot ur99"),
    "affine": (replace("case.toml", AT, f'{AT}\nmethod = "affine"'), "method_bends"),
    "too many directions": (
        replace("case.toml", "theta_deg = [0, 10]\nstep_deg = 10.0", "step_deg = 0.05"),
        "too_many 000",
    ),
    "a coordinate beyond any room": (replace("case.toml", ORIGIN, "[1e300, 0, 0]"), "bad_value 100000"),
    "no weight at all": (replace("case.toml", AT, f"[ranking]\n{NO_WEIGHT}\n{AT}"), "no_weight"),
    # the target
    "target outside the skin": (replace("case.toml", ORIGIN, "[0.0, 0.0, 95.0]"), "target_misplaced"),
    "target outside the label map": (replace("case.toml", ORIGIN, "[0.0, 0.0, 300.0]"), "labels_end"),
    "target outside its structure": (replace("case.toml", ORIGIN, "[0.0, 0.0, 50.0]"), "target_misplaced"),
    "target inside an avoid structure": (lambda f: world.ball(f / "rib.stl", 30), "target_misplaced rib"),
    "an organ beside the body": (lambda f: world.ball(f / "rib.stl", 5, (400, 0, 40)), "outside_skin"),
    "an organ inside the box of a round body": (
        lambda f: world.ball(f / "rib.stl", 5, (75, 75, 75)),
        "outside_skin rib 100.0",
    ),
    "an organ to be crossed half outside": (
        lambda f: (world.ball(f / "rib.stl", 20, (90, 0, 0)), replace("case.toml", '"avoid"', '"traverse"')(f)),
        "outside_skin rib",
    ),
    "an open organ around the target": (lambda f: opened(f / "rib.stl", 30), "open_around_target rib 98"),
    "one wound at random": (lambda f: opened(f / "rib.stl", 30, wound_at_random=True), "open_around_target 98"),
    "an open region of role unknown around the target": (
        lambda f: (opened(f / "rib.stl", 30), replace("case.toml", '"avoid"', '"unknown"')(f)),
        "open_around_target rib 98",
    ),
    "two open shells around the target": (lambda f: opened(f / "rib.stl", 30, shells=2), "open_around_target 1.97"),
    "a label map that ends inside the body": (
        edited(
            "labels.nii.gz", lambda data: gzip.compress(patched(gzip.decompress(data), 80, struct.pack("<3f", 1, 1, 1)))
        ),
        "geometry_contradicted labels.nii.gz",
    ),
    "a flat end of the skin that nobody explains": (
        lambda f: trimesh.creation.box((150, 150, 150)).export(f / "skin.stl"),
        "skin_cut_unstated",
    ),
    "a skin cut where there is no flat end": (
        replace("case.toml", 'mesh = "skin.stl"', 'mesh = "skin.stl"\ncut = ["head"]'),
        "no_flat_end",
    ),
    # other files; what else their readers refuse is asked in tests/formats
    "stl: cut in the middle": (edited("rib.stl", lambda data: data[: len(data) // 2]), "size_mismatch rib.stl"),
    "stl: a folder": (lambda f: ((f / "rib.stl").unlink(), (f / "rib.stl").mkdir()), "no_such_file rib.stl"),
    "stl: in metres": (lambda f: world.ball(f / "rib.stl", 0.00005, (0.04, 0, 0.04)), "implausible_size"),
    "nifti: cut": (edited("labels.nii.gz", lambda data: data[: len(data) * 3 // 5]), "size_mismatch labels.nii.gz"),
    "nrrd: another file's data": (
        lambda f: (
            replace("labels.nrrd", "encoding: raw", "encoding: raw\ndata file: /etc/passwd")(f),
            replace("case.toml", "labels.nii.gz", "labels.nrrd")(f),
        ),
        "outside_folder labels.nrrd",
    ),
    "markers: in metres": (replace("touch.csv", "x_mm,y_mm,z_mm", "x_m,y_m,z_m"), "wrong_unit"),
    "markers: binary": (overwrite("touch.csv", b"\xff\xfe\x00\x01"), "file_cut touch.csv"),
}


@pytest.mark.parametrize("name", BREAKS)
def test_a_broken_input_is_refused(name, folder, tmp_path, capfd):
    spoil, message = BREAKS[name]
    spoil(folder)
    refused_command(["search", folder, "--no-arm", "--out", tmp_path / "out"], capfd, *message.split())
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["check", "CASE", "--theta", "10"], "one_angle"),
        (["check", "CASE", "--theta", "190", "--beta", "0"], "command_line 180"),
        (["search", "CASE", "--cross-check", "x"], "command_line allowed: a whole number from 0"),
        (["register", "CASE", "--space", "ABC"], "command_line ABC LPS RAS local"),
        (["batch", "run", "CASE"], "command_line allowed: see batch run --help"),
        (["serach", "CASE"], "command_line serach"),
        (["search"], "command_line CASE"),
        (["reproduce", "chen2020"], "unknown_choice chen2020"),
        (["plan", "CASE"], "no_base"),
        (["rehearse", "plan.json"], "missing_option"),
        (["rehearse", "CASE", "--seeds", "2", "--physics", "3"], "conflicting_options"),
        (["search", "CASE", "--certify-size", "1"], "conflicting_options"),
        (["search", "CASE", "--certify-touch", "0.1"], "conflicting_options"),
        (["compare", "CASE", "--rank", "1"], "same_direction"),
        (["check", "CASE", "--theta", "0", "--beta", "0", "--picture", "no/such/a.png"], "not_a_folder"),
        (["verify", "MANIFEST", "--case", "CASE"], "not_in_manifest"),
    ],
)
def test_a_wrong_command_line_is_refused(arguments, message, folder, capfd):
    """Missing, misspelled and impossible arguments: the same exit code and form."""
    text = (folder / "case.toml").read_text()
    (folder / "case.toml").write_text(world.whole(text[: text.index("[registration]")]))
    (folder / "manifest.json").write_text("{}")
    named = {"CASE": folder, "MANIFEST": folder / "manifest.json"}
    refused_command([named.get(a, a) for a in arguments], capfd, *message.split())


def test_what_the_broken_ones_are_made_from_works(folder, tmp_path, capfd):
    """Open and inverted meshes, common in real anatomy, too: what cannot be known is said; JSON is alone on stdout."""
    assert main(["check", str(folder), "--theta", "5", "--beta", "0", "--no-arm", "--json"]) == 0
    found = json.loads(capfd.readouterr().out)
    assert (found["verdict"], found["reachable"]) == ("safe", None)
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=5)
    mesh.apply_translation((40, 0, 40))
    trimesh.Trimesh(mesh.vertices, mesh.faces[5:], process=False).export(folder / "rib.stl")
    inverted = trimesh.creation.icosphere(subdivisions=2, radius=20)
    trimesh.Trimesh(inverted.vertices, inverted.faces[:, ::-1], process=False).export(folder / "organ.stl")
    assert main(["search", str(folder), "--no-arm", "--no-pictures", "--json", "--out", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "candidates.parquet").stat().st_size > 0
    warnings = " ".join(json.loads(capfd.readouterr().out)["warnings"])
    assert all(word in warnings for word in ("rib", "inside", "organ"))


def test_that_nothing_is_found_is_the_one_object_of_json(capfd):

    def command():
        raise NoAnswerError("nothing is safe", counts={"crossed": 3}, code="no_safe_direction")

    assert exit_code_of(command, print, as_json=True) == 1
    error = json.loads(capfd.readouterr().out.splitlines()[0])["error"]
    assert (error["code"], error["numbers"]) == ("no_safe_direction", {"crossed": 3})
