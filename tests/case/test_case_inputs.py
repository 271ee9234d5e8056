"""Every byte that decides a verdict is read once, hashed as it was read, and listed with its role."""

import gzip
import os
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813 - the name that its whole documentation uses
from case_world import ORGAN, case_text, image_of, registration_section, structure, write_balls, write_markers

from puncture_twin.planning.base.provenance import differing_input, inputs_document
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.search.context import prepare
from puncture_twin.twin.plant.truth import draw_truth

CASE = case_text(
    structure("skin", "skin", {"ct": "ct.nhdr"}),
    ORGAN,
    structure("rib", "avoid"),
    structure("bowel", "avoid", {"labelmap": "bowel.nii.gz", "label": 3}),
    '[[structures]]\nlabelmap = "vessels/labels.nhdr"\nnaming = "names.csv"\navoid = { "v*" = 2.0 }\n',
    registration_section(),
    '[rehearsal]\ntruth_base = "truth.csv"\n',
    name="inputs",
    listed=1,
    target='# 1\npoints = "targets.csv"\nname = "T"\nstructure = "organ"',
)

MARKERS = "name,x_mm,y_mm,z_mm\nA,0,0,85\nB,50,0,70\nC,0,60,60\nD,-40,-30,72\n"

IN_BASE = "name,x_mm,y_mm,z_mm\nA,0,400,85\nB,50,400,70\nC,0,460,60\nD,-40,370,72\n"

FILES = [
    ("case", "case.toml", (b"# 1", b"# 2")),
    ("target", "targets.csv", (b"T,0", b"T,1")),
    ("mesh organ", "organ.stl", (bytes(80), bytes(79) + b"x")),
    ("mesh rib", "rib.stl", (bytes(80), bytes(79) + b"x")),
    ("naming", "names.csv", (b"v1", b"v2")),
    ("markers_ct", "markers_ct.csv", (b"85", b"86")),
    ("markers_base", "touch.csv", (b"85", b"86")),
    ("truth_base", "truth.csv", (b"85", b"86")),
    ("ct", "ct.nhdr", (b"# written", b"# Written")),
    ("ct data", "ct.raw", None),
    ("labelmap", "bowel.nii.gz", (b"\x1f\x8b\x08\x00\x00", b"\x1f\x8b\x08\x00\x01")),
    ("labelmap", "vessels/labels.nhdr", (b"# written", b"# Written")),
    ("labelmap data", "vessels/labels.raw", None),
]
"""Of the case below, in the order of its sections, volumes last: role, file, and one byte of it that may change without
a refusal; None: the last one."""
ROLES = [(role, path) for role, path, _ in FILES]


def sliced(values: np.ndarray) -> np.ndarray:
    """Values with the slices first, from values with axis i first."""
    return np.ascontiguousarray(values.transpose(2, 1, 0))


def detached(values: np.ndarray, header: Path) -> None:
    sitk.WriteImage(image_of(sliced(values)), str(header), useCompression=False)
    text = header.read_bytes()
    header.write_bytes(text.replace(b"\n", b"\n# written for a test\n", 1))


def vessel(place: tuple[int, int, int]) -> np.ndarray:
    """A label map with a short vessel, label 1, about a voxel."""
    labels = np.zeros((100, 100, 100), np.uint8)
    i, j, k = place
    labels[i - 3 : i + 3, j - 3 : j + 3, k - 3 : k + 3] = 1
    return labels


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    here = tmp_path / "case"
    (here / "vessels").mkdir(parents=True)
    (here / "case.toml").write_text(CASE)
    (here / "targets.csv").write_text("name,x_mm,y_mm,z_mm\nT,0,0,0\n")
    (here / "names.csv").write_text("id,name\n1,v1\n")
    (here / "truth.csv").write_text(IN_BASE + "T,0.5,400,0\n")
    write_markers(here, MARKERS, IN_BASE)
    write_balls(here, "organ", "rib")
    for name in ("organ", "rib"):
        (here / f"{name}.stl").write_bytes(bytes(80) + (here / f"{name}.stl").read_bytes()[80:])
    place = np.indices((100, 100, 100)) * 2.0 - 99.0
    hounsfield = np.where(np.linalg.norm(place, axis=0) < 90, 40, -1000).astype(np.int16)
    hounsfield[4:96, 96:98] = 100  # what the body lies on: without it nothing beyond the image's faces is known
    detached(hounsfield, here / "ct.nhdr")
    detached(vessel((80, 50, 50)), here / "vessels" / "labels.nhdr")
    sitk.WriteImage(image_of(sliced(3 * vessel((50, 80, 50)))), str(here / "bowel.nii"))
    (here / "bowel.nii.gz").write_bytes(gzip.compress((here / "bowel.nii").read_bytes(), mtime=0))
    (here / "bowel.nii").unlink()
    return here


def test_every_file_is_listed_with_its_role(folder: Path) -> None:
    """Also the data that a detached header names; every result carries the same list."""
    context = prepare(folder, arm=False)
    assert [(one.role, one.path) for one in context.case.inputs] == ROLES
    assert context.provenance()["inputs"] == inputs_document(context.case.inputs)
    assert {path for _, path in ROLES} == {str(one.relative_to(folder)) for one in folder.rglob("*") if one.is_file()}


def test_data_rewritten_beside_their_header_change_the_verdict(folder: Path) -> None:
    """A vessel that enters the path is seen although header, names and cache are as before."""
    before = prepare(folder, arm=False)
    assert before.check(0.0, 0.0).safe[0]
    header = (folder / "vessels" / "labels.nhdr").read_bytes()
    across = vessel((50, 25, 50))  # half way to the skin in front
    (folder / "vessels" / "labels.raw").write_bytes(across.tobytes(order="F"))
    after = prepare(folder, arm=False)
    found = after.check(0.0, 0.0)
    assert (folder / "vessels" / "labels.nhdr").read_bytes() == header
    assert (str(found.verdict.reason[0]), str(found.verdict.structure[0])) == ("too_close", "v1")
    assert found.clearance.least[0] < 0
    assert differing_input(before.case.inputs, after.case.inputs) == "labelmap data (vessels/labels.raw)"
    (folder / "vessels" / "labels.raw").write_bytes(vessel((80, 50, 50)).tobytes(order="F"))
    assert prepare(folder, arm=False).check(0.0, 0.0).safe[0]


def test_one_changed_byte_of_any_file_changes_its_hash_alone(folder: Path) -> None:
    """A result made from it is not taken for one that was made before."""
    before = load_case(folder).inputs
    for _, name, change in FILES:
        content = bytearray((folder / name).read_bytes())
        changed = content.replace(*change, 1) if change else content[:-1] + bytes([content[-1] ^ 1])
        (folder / name).write_bytes(changed)
        after = load_case(folder).inputs
        assert [old.path for old, new in zip(before, after, strict=True) if old != new] == [name]
        said = differing_input(before, after)
        assert name in said or said == "case"
        (folder / name).write_bytes(content)


def test_each_file_is_opened_once(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """So no file can be swapped between hashing and parsing; with an empty and with a full cache, the arm included."""
    monkeypatch.setenv("PUNCTURE_TWIN_CACHE", str(tmp_path / "cache"))
    opened: Counter[str] = Counter()

    def hook(event: str, arguments: tuple[object, ...]) -> None:
        if event == "open" and isinstance(arguments[0], str) and arguments[0].startswith(str(folder)):
            opened[os.path.relpath(arguments[0], folder)] += 1

    sys.addaudithook(hook)
    for _ in range(2):
        opened.clear()
        context = prepare(folder)
        assert context.placement is not None
        draw_truth(context.case, context.placement.T_base_ct)
        assert opened == {path: 1 for _, path in ROLES}
