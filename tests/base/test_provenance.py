"""What a result was made from: each file read once, hashed as read, listed with its role, or said to be absent."""

import hashlib
import pickle
from pathlib import Path

import pytest
from refusals import refused

from puncture_twin.planning.base.files import absence, read_input
from puncture_twin.planning.base.provenance import Input, InputFiles, differing_input, inputs_document, read_inputs

LISTED = (Input("case", "case.toml", "a" * 64), Input("mesh liver", "liver.stl", "b" * 64))


@pytest.fixture
def files(tmp_path: Path) -> InputFiles:
    (tmp_path / "a.csv").write_bytes(b"first")
    files = InputFiles(tmp_path)
    assert files.read("markers_ct", "a.csv", max_bytes=100, key="x", where=tmp_path) == b"first"
    return files


def test_the_hash_is_that_of_the_bytes_that_are_parsed(files: InputFiles, tmp_path: Path) -> None:
    """A file that changes after it was read changes neither the content nor the hash, in no role."""
    (tmp_path / "a.csv").write_bytes(b"second")
    assert files.read("target", "a.csv", max_bytes=100, key="x", where=tmp_path) == b"first"
    assert files.content("a.csv") == b"first"
    first = hashlib.sha256(b"first").hexdigest()
    assert files.inputs == (Input("markers_ct", "a.csv", first), Input("target", "a.csv", first))


def test_a_large_file_that_was_let_go_of_must_be_the_same_when_it_is_read_again(tmp_path: Path) -> None:
    (tmp_path / "ct.nii").write_bytes(bytes(11_000_000))
    files = InputFiles(tmp_path)
    files.read("ct", "ct.nii", max_bytes=1 << 30, key="x", where=tmp_path)
    files.release()
    other = pickle.loads(pickle.dumps(files))
    assert files.content("ct.nii") == other.content("ct.nii") == bytes(11_000_000)
    (tmp_path / "ct.nii").write_bytes(bytes(11_000_001))
    for each in (files, other):
        with refused("input_changed"):
            each.content("ct.nii")
    assert len(pickle.dumps(files)) < 1000


def test_many_files_are_let_go_of_as_one_large_file_is(tmp_path: Path) -> None:
    """The slices of a series are small one by one: what stays is bounded in all, the smallest files first."""
    files = InputFiles(tmp_path)
    for number, size in enumerate((4_000_000, 4_000_001, 4_000_002, 10)):
        (tmp_path / f"{number}.dcm").write_bytes(bytes(size))
        files.read("ct", f"{number}.dcm", max_bytes=1 << 30, key="x", where=tmp_path)
    files.release()
    for number in range(4):
        (tmp_path / f"{number}.dcm").write_bytes(b"other")
    assert [len(files.content(name)) for name in ("0.dcm", "1.dcm", "3.dcm")] == [4_000_000, 4_000_001, 10]
    with refused("input_changed"):
        files.content("2.dcm")


def test_a_file_that_is_not_there_is_named_by_its_key(files: InputFiles, tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    for name in ("gone.csv", "folder", "x" * 5000, "a\0b", "../none"):
        with refused("no_such_file", "case.toml", "liver"):
            files.read("mesh liver", name, max_bytes=100, key="structure 'liver'", where=tmp_path / "case.toml")


def test_a_list_survives_its_document_and_no_other_is_read() -> None:
    assert read_inputs(inputs_document(LISTED)) == LISTED
    for wrong in ({"case.toml": "a"}, "x", [["case"]], [{"role": "case", "path": 1, "sha256": "a"}]):
        with pytest.raises((TypeError, KeyError)):
            read_inputs(wrong)


def test_an_input_with_two_hashes_is_refused() -> None:
    """Whichever is compared, a person may read the other; the same twice says the same."""
    _, liver = LISTED
    assert read_inputs(inputs_document((liver, liver))) == (liver, liver)
    other = Input("mesh liver", "./liver.stl", "c" * 64)
    with pytest.raises(ValueError, match="two hashes"):
        read_inputs(inputs_document((other, *LISTED)))


def test_the_input_that_differs_is_named() -> None:
    """By role and path; another notation of a path, another name of the case file and another order are the same."""
    case, liver = LISTED
    same = (Input("mesh liver", "./liver.stl", "b" * 64), Input("case", "renamed.toml", "a" * 64))
    assert differing_input(LISTED, same) is None
    assert differing_input(LISTED, (case, Input("mesh liver", "liver.stl", "c" * 64))) == "mesh liver (liver.stl)"
    assert differing_input(LISTED, (case,)) == "mesh liver (liver.stl)"
    assert differing_input((case,), LISTED) == "mesh liver (liver.stl)"
    assert differing_input(LISTED, (Input("case", "case.toml", "d" * 64), liver)) == "case"
    labels = [Input("labelmap", name, digest * 64) for name, digest in (("a.nii", "a"), ("b.nii", "b"))]
    swapped = [Input("labelmap", name, digest * 64) for name, digest in (("a.nii", "b"), ("b.nii", "a"))]
    assert differing_input(labels, swapped) == "labelmap (a.nii)"


def test_what_is_in_a_files_place_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also one in another case, which systems that fold cases would have found: by its reader too."""
    (tmp_path / "folder").mkdir()
    (tmp_path / "Liver.STL").write_bytes(b"x")
    (tmp_path / "link.stl").symlink_to("gone.stl")
    for name, said in (
        ("folder", "is a folder"),
        ("link.stl", "is a link to a missing file"),
        ("liver.stl", "does not exist; did you mean 'Liver.STL'?"),
        *((one, "does not exist") for one in ("spleen.stl", "folder/spleen.stl", "none/a", "a" * 5000, "nul\0")),
    ):
        assert absence(tmp_path / name) == said
    with refused("no_such_file", "Liver.STL"):
        read_input(tmp_path / "liver.stl", max_bytes=10, where="liver.stl")

    def denied(path: Path, **_: object) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "stat", denied)
    assert absence(tmp_path / "Liver.STL") == "cannot be looked up (Permission denied)"
