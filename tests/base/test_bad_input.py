"""Bad input through the command line: exit code 2, one line (what, where, what is allowed), nothing written.

What each reader refuses is asked of the reader itself, in tests/formats; here stands one fault of each kind of file,
and all that a case alone makes wrong.
"""

import gzip
import json
import struct

import numpy as np
import pytest
import trimesh
from case_world import (
    MARKERS,
    ORGAN,
    SKIN,
    ball,
    case_text,
    registration_section,
    structure,
    whole,
    write_balls,
    write_labels,
    write_markers,
)
from refusals import refused_command

from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.run_twin import main
from puncture_twin.twin.jobs.exit_codes import exit_code_of

CASE = case_text(
    SKIN,
    ORGAN,
    structure("rib", "avoid"),
    structure("vessel", "avoid", {"labelmap": "labels.nii.gz", "label": 3}),
    registration_section(),
    name="bad",
)

SPREAD_MARKERS = "name,x_mm,y_mm,z_mm\nA,0,0,80\nB,50,0,20\nC,0,60,70\nD,-40,-30,-10\n"


def opened(path, radius, wound_at_random=False, shells=1):
    """Spheres about the target, one in the other, that lack a few triangles."""
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    faces = mesh.faces[5:]
    if wound_at_random:
        flip = np.random.default_rng(3).random((len(faces), 1)) < 0.5
        faces = np.where(flip, faces[:, ::-1], faces)
    parts = [trimesh.Trimesh(mesh.vertices * (1 + k / 5), faces, process=False) for k in range(shells)]
    trimesh.util.concatenate(parts).export(path)


@pytest.fixture
def folder(tmp_path):
    """A case in which everything is right."""
    here = tmp_path / "case"
    here.mkdir()
    (here / "case.toml").write_text(CASE)
    write_balls(here)
    labels = np.zeros((100, 100, 100), np.uint8)
    labels[42:58, 67:69, 67:69] = 3
    write_labels(here / "labels.nii.gz", labels)
    write_labels(here / "labels.nrrd", labels, compressed=False)
    write_markers(here)
    return here


def test_the_good_case_is_not_refused(folder, tmp_path, capfd):
    """What the broken ones are made from works: exit code 0, and the table is there."""
    assert main(["search", str(folder), "--no-arm", "--out", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "candidates.parquet").stat().st_size > 0
    capfd.readouterr()


# Each break gets the folder, and spoils one thing in it.


def cut(name, keep):
    """Keep only the first bytes (or that share of them)."""

    def spoil(folder):
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: int(len(data) * keep) if keep < 1 else int(keep)])

    return spoil


def overwrite(name, data):
    """Other content altogether."""

    def spoil(folder):
        (folder / name).write_bytes(data if isinstance(data, bytes) else data.encode())

    return spoil


def patch(name, offset, data):
    """Other bytes at one place."""

    def spoil(folder):
        content = bytearray((folder / name).read_bytes())
        content[offset : offset + len(data)] = data
        (folder / name).write_bytes(content)

    return spoil


def patch_gz(name, offset, data):
    """Other bytes at one place of the inflated content."""

    def spoil(folder):
        content = bytearray(gzip.decompress((folder / name).read_bytes()))
        content[offset : offset + len(data)] = data
        (folder / name).write_bytes(gzip.compress(bytes(content)))

    return spoil


def replace(name, old, new):
    """Other text in one place."""

    def spoil(folder):
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1))

    return spoil


def mesh_file(name, data):
    """A mesh of another kind in place of the rib."""

    def spoil(folder):
        (folder / name).write_bytes(data if isinstance(data, bytes) else data.encode())
        replace("case.toml", "rib.stl", name)(folder)

    return spoil


def label_file(name, spoiled=None):
    """A label map of another name in place of the vessel's, spoiled or not."""

    def spoil(folder):
        if spoiled is not None:
            spoiled(folder)
        replace("case.toml", "labels.nii.gz", name)(folder)

    return spoil


def header_line(old, new):
    """Another line in the NRRD header, which is text at the file's head."""

    def spoil(folder):
        content = (folder / "labels.nrrd").read_bytes()
        assert old in content
        (folder / "labels.nrrd").write_bytes(content.replace(old, new, 1))

    return label_file("labels.nrrd", spoil)


OBJ = "v 0 0 0\nv 10 0 0\nv 0 10 0\nv 0 0 10\nf 1 2 3\nf 1 2 4\n"
PLY = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n10 0 0\n0 10 0\n3 0 1 2\n"
)
NAN = struct.pack("<f", float("nan"))

BREAKS = {
    # the case file
    "case: not TOML": (overwrite("case.toml", b"\x89PNG\r\n"), "not_toml case.toml"),
    "case: empty": (overwrite("case.toml", ""), "file_size case.toml"),
    "case: unknown key": (replace("case.toml", "shaft_mm", "shaft"), "unknown_key shaft"),
    "case: metres": (replace("case.toml", "length_mm = 210.0", "length_mm = 0.21"), "bad_value needle.length_mm"),
    "case: unknown space": (replace("case.toml", '"LPS"', '"XYZ"'), "bad_value"),
    "case: unknown unit": (replace("case.toml", '"mm"\nrole = "skin"', '"inch"\nrole = "skin"'), "unknown_unit"),
    "case: missing mesh": (replace("case.toml", "rib.stl", "gone.stl"), "no_such_file gone.stl"),
    "case: missing marker file": (replace("case.toml", '"touch.csv"', '"gone.csv"'), "no_such_file gone.csv"),
    "case: label that is not there": (replace("case.toml", "label = 3", "label = 4"), "label_absent"),
    "case: target structure that is not there": (replace("case.toml", '"organ"', '"orgn"'), "unknown_structure"),
    "case: unknown arm": (
        replace("case.toml", "[registration]", '[robot]\nmodel = "ur99"\n[registration]'),
        "unknown_robot ur99",
    ),
    "case: affine": (replace("case.toml", "[registration]", '[registration]\nmethod = "affine"'), "method_bends"),
    # the target
    "target outside the skin": (replace("case.toml", "[0.0, 0.0, 0.0]", "[0.0, 0.0, 95.0]"), "target_misplaced"),
    "target outside the label map": (replace("case.toml", "[0.0, 0.0, 0.0]", "[0.0, 0.0, 300.0]"), "labels_end"),
    "target outside its structure": (replace("case.toml", "[0.0, 0.0, 0.0]", "[0.0, 0.0, 50.0]"), "target_misplaced"),
    "target inside an avoid structure": (lambda folder: ball(folder / "rib.stl", 30), "target_misplaced rib"),
    "an organ beside the body": (lambda f: ball(f / "rib.stl", 5, (400, 0, 40)), "outside_skin"),
    "an organ outside of a round body, inside its box": (
        lambda f: ball(f / "rib.stl", 5, (75, 75, 75)),
        "outside_skin rib 100.0",
    ),
    "an organ half outside": (lambda f: ball(f / "rib.stl", 20, (90, 0, 0)), "outside_skin"),
    "an organ to be crossed half outside": (
        lambda f: (ball(f / "rib.stl", 20, (90, 0, 0)), replace("case.toml", '"avoid"', '"traverse"')(f)),
        "outside_skin rib",
    ),
    "an open organ around the target": (lambda f: opened(f / "rib.stl", 30), "open_around_target rib 98"),
    "an open organ around the target, wound at random": (
        lambda f: opened(f / "rib.stl", 30, wound_at_random=True),
        "open_around_target 98",
    ),
    "an open region of role unknown around the target": (
        lambda f: (opened(f / "rib.stl", 30), replace("case.toml", '"avoid"', '"unknown"')(f)),
        "open_around_target rib 98",
    ),
    "two open shells around the target": (lambda f: opened(f / "rib.stl", 30, shells=2), "open_around_target 1.97"),
    "label map: ends inside the body": (
        patch_gz("labels.nii.gz", 80, struct.pack("<3f", 1.0, 1.0, 1.0)),
        "geometry_contradicted labels.nii.gz",
    ),
    "case: too many directions": (
        replace("case.toml", "theta_deg = [0, 10]\nstep_deg = 10.0", "step_deg = 0.05"),
        "too_many 000",
    ),
    "case: a coordinate beyond any room": (
        replace("case.toml", "[0.0, 0.0, 0.0]", "[1e300, 0, 0]"),
        "bad_value 100000",
    ),
    "case: no weight at all": (
        replace(
            "case.toml",
            "[registration]",
            "[ranking]\nclearance = 0\npath_length = 0\nskin_angle = 0\ntissue = 0\n"
            "reach = 0\nsafe_cone = 0\n[registration]",
        ),
        "no_weight",
    ),
    "skin: a flat end that nobody explains": (
        lambda f: trimesh.creation.box((150, 150, 150)).export(f / "skin.stl"),
        "skin_cut_unstated",
    ),
    "skin: cut where there is no flat end": (
        replace("case.toml", 'mesh = "skin.stl"', 'mesh = "skin.stl"\ncut = ["head"]'),
        "no_flat_end",
    ),
    # meshes
    "stl: cut in the middle": (cut("rib.stl", 0.5), "size_mismatch rib.stl"),
    "stl: a NaN vertex": (patch("rib.stl", 84 + 12, NAN), "not_finite"),
    "stl: a folder": (lambda f: ((f / "rib.stl").unlink(), (f / "rib.stl").mkdir()), "no_such_file rib.stl"),
    "stl: in metres": (lambda f: ball(f / "rib.stl", 0.00005, (0.04, 0, 0.04)), "implausible_size"),
    "mesh: unknown kind": (mesh_file("rib.step", "ISO-10303-21;"), "unknown_format rib.step"),
    "obj: half a line": (mesh_file("rib.obj", OBJ[:-4]), "file_cut rib.obj"),
    "ply: fewer faces than promised": (mesh_file("rib.ply", PLY.replace("face 1", "face 5")), "file_cut rib.ply"),
    "glb: false length": (
        mesh_file("rib.glb", b"glTF" + struct.pack("<II", 2, 99999) + b"\0" * 40),
        "size_mismatch rib.glb",
    ),
    "vtp: not XML": (mesh_file("rib.vtp", "<VTKFile"), "xml_damaged rib.vtp"),
    # label maps
    "nifti: cut": (cut("labels.nii.gz", 0.6), "size_mismatch labels.nii.gz"),
    "nrrd: another file's data": (
        header_line(b"encoding: raw", b"encoding: raw\ndata file: /etc/passwd"),
        "outside_folder labels.nrrd",
    ),
    "label map: unknown kind": (
        label_file("labels.dcm", overwrite("labels.dcm", b"DICM")),
        "unknown_format labels.dcm",
    ),
    # markers
    "markers: in metres": (replace("touch.csv", "x_mm,y_mm,z_mm", "x_m,y_m,z_m"), "wrong_unit"),
    "markers: a name missing": (replace("touch.csv", "B,50", "Z,50"), "markers_missing"),
    "markers: too few": (
        lambda f: [overwrite(n, MARKERS[:39])(f) for n in ("touch.csv", "markers_ct.csv")],
        "too_few_markers",
    ),
    "markers: swapped": (
        overwrite("touch.csv", MARKERS.replace("A,", "X,").replace("B,", "A,").replace("X,", "B,")),
        "marker_misses",
    ),
    "markers: mirrored": (
        lambda f: [
            overwrite("markers_ct.csv", SPREAD_MARKERS)(f),
            overwrite("touch.csv", SPREAD_MARKERS.replace("50,0", "-50,0").replace("-40", "40"))(f),
        ],
        "markers_mirrored",
    ),
    "markers: binary": (overwrite("touch.csv", b"\xff\xfe\x00\x01"), "file_cut touch.csv"),
    "markers: unknown space in a markup file": (
        lambda f: [
            overwrite("touch.mrk.json", json.dumps({"markups": [{"type": "Fiducial", "coordinateSystem": "XYZ"}]}))(f),
            replace("case.toml", "touch.csv", "touch.mrk.json")(f),
        ],
        "empty touch.mrk.json",
    ),
}


@pytest.mark.parametrize("name", BREAKS)
def test_a_broken_input_is_refused(name, folder, tmp_path, capfd):
    """Whatever is broken: exit code 2, one line, no file."""
    spoil, message = BREAKS[name]
    spoil(folder)
    refused_command(["search", folder, "--no-arm", "--out", tmp_path / "out"], capfd, *message.split())
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["check", "CASE", "--theta", "10"], "one_angle"),
        (["check", "CASE", "--theta", "190", "--beta", "0"], "command_line theta"),
        (["check", "CASE", "--theta", "ten", "--beta", "0"], "command_line theta"),
        (["check", "CASE", "--theta", "190", "--beta", "0"], "command_line 180"),
        (["search", "CASE", "--cross-check", "x"], "command_line allowed: a whole number from 0"),
        (["register", "CASE", "--space", "ABC"], "command_line ABC LPS RAS local"),
        (["compare", "CASE", "--rank", "x"], "command_line allowed: a whole number from 1"),
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
    (folder / "case.toml").write_text(whole(text[: text.index("[registration]")]))
    (folder / "manifest.json").write_text("{}")
    named = {"CASE": folder, "MANIFEST": folder / "manifest.json"}
    refused_command([named.get(a, a) for a in arguments], capfd, *message.split())


def test_open_and_inverted_meshes_work_with_a_warning(folder, tmp_path, capfd):
    """Common in real anatomy: judged all the same, and what cannot be known is said."""
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=5)
    mesh.apply_translation((40, 0, 40))
    trimesh.Trimesh(mesh.vertices, mesh.faces[5:], process=False).export(folder / "rib.stl")
    inverted = trimesh.creation.icosphere(subdivisions=2, radius=20)
    trimesh.Trimesh(inverted.vertices, inverted.faces[:, ::-1], process=False).export(folder / "organ.stl")
    assert main(["search", str(folder), "--no-arm", "--json", "--out", str(tmp_path / "out")]) == 0
    warnings = " ".join(json.loads(capfd.readouterr().out)["warnings"])
    assert "rib" in warnings
    assert "inside" in warnings
    assert "organ" in warnings


@pytest.mark.parametrize(
    ("change", "arguments", "code", "where"),
    [
        ("", ["check", "CASE", "--theta", "999", "--beta", "0"], "command_line", ""),
        ("", ["check", "CASE", "--theta", "5", "--window", "1"], "one_angle", ""),
        (
            "structures = 9",
            ["check", "CASE", "--theta", "5", "--beta", "0", "--no-arm"],
            "structures_miscounted",
            "case.toml",
        ),
    ],
)
def test_a_refusal_is_the_one_object_of_json(folder, capfd, change, arguments, code, where):
    """What, where and what is allowed, for a program; the same line stands on stderr, and the exit code is 2."""
    if change:
        text = (folder / "case.toml").read_text()
        (folder / "case.toml").write_text(text[: text.index("[end]")] + f"[end]\n{change}\n")
    assert main([str(folder) if one == "CASE" else one for one in arguments] + ["--json"]) == 2
    captured = capfd.readouterr()
    error = json.loads(captured.out)["error"]
    assert set(error) == {"code", "sentence", "where", "allowed", "numbers"}
    assert error["code"] == code
    assert where in error["where"]
    assert error["sentence"] in captured.err
    assert error["allowed"] and f"; allowed: {error['allowed']}" in captured.err


def test_that_nothing_is_found_is_the_one_object_of_json(capfd):
    """Exit code 1, and the counts of the reasons."""

    def command():
        raise NoAnswerError("nothing is safe", counts={"crossed": 3}, code="no_safe_direction")

    assert exit_code_of(command, print, as_json=True) == 1
    error = json.loads(capfd.readouterr().out.splitlines()[0])["error"]
    assert (error["code"], error["numbers"]) == ("no_safe_direction", {"crossed": 3})


def test_json_is_alone_on_stdout(folder, tmp_path, capfd):
    """With --json stdout is one object and nothing else."""
    assert main(["check", str(folder), "--theta", "5", "--beta", "0", "--no-arm", "--json"]) == 0
    found = json.loads(capfd.readouterr().out)
    assert found["verdict"] == "safe"
    assert found["reachable"] is None
