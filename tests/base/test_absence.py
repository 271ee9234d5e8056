"""What an error says of a file that cannot be used is so."""

from pathlib import Path

import pytest
from refusals import refused

from puncture_twin.planning.base.files import absence, read_input


@pytest.fixture
def place(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "Liver.STL").write_bytes(b"x")
    (tmp_path / "link.stl").symlink_to("gone.stl")
    return tmp_path


def test_what_is_in_the_place_is_said(place, monkeypatch):
    for name, said in (
        ("folder", "is a folder"),
        ("link.stl", "is a link to a missing file"),
        ("liver.stl", "does not exist; did you mean 'Liver.STL'?"),
        *((one, "does not exist") for one in ("spleen.stl", "folder/spleen.stl", "none/a", "a" * 5000, "nul\0")),
    ):
        assert absence(place / name) == said

    def refused(path, **_):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "stat", refused)
    assert absence(place / "Liver.STL") == "cannot be looked up (Permission denied)"


def test_a_file_in_another_case_is_named_by_its_reader(place):
    """As systems that fold cases would have found it."""
    with refused("no_such_file", "Liver.STL"):
        read_input(place / "liver.stl", max_bytes=10, where="liver.stl")
