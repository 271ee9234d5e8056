"""Whether a surface is closed is kept beside it: the same answer from a full, a damaged, another's and no cache."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from case_world import ORGAN, SKIN, ball, case_text, structure, write_balls, write_labels

from puncture_twin.planning.anatomy.anatomy import Anatomy, load_anatomy
from puncture_twin.planning.base.cache.array_cache import NO_CACHE, Cache, Memory
from puncture_twin.planning.base.cache.entry_file import packed, unpacked
from puncture_twin.planning.base.errors import CacheWarning
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.geometry.mesh import TriangleMesh

VESSEL = structure("vessel", "avoid", {"labelmap": "labels.nii.gz", "label": 3})


def case_folder(folder: Path, low: int = 28) -> Path:
    """A case whose skin and organ are meshes and whose vessel is a label; where that begins."""
    folder.mkdir()
    write_balls(folder, "skin", "organ")
    labels = np.zeros((100, 100, 100), np.uint8)
    labels[48:52, low:32, 48:52] = 3
    write_labels(folder / "labels.nii.gz", labels)
    (folder / "case.toml").write_text(case_text(SKIN, ORGAN, VESSEL))
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return case_folder(tmp_path / "case")


@pytest.fixture
def cache(tmp_path: Path) -> Cache:
    return Cache(tmp_path / "cache")


def anatomy(folder: Path, cache: Cache) -> Anatomy:
    return load_anatomy(load_case(folder), cache=cache)


def meshes(found: Anatomy) -> list[TriangleMesh]:
    return [found.skin.mesh, *(one.mesh for one in found.structures)]


def facts(found: Anatomy) -> list[tuple[str, bool, bool]]:
    return [(mesh.digest, mesh.closed, mesh.wound_alike) for mesh in meshes(found)]


def entry(cache: Cache, what: str) -> Path:
    """The entry of the vessel, of the skin, or of what was found of all structures."""
    assert cache.folder is not None
    if what == "all":
        (path,) = cache.folder.glob("*mesh_files*")
        return path
    found = [path for path in cache.folder.glob("*anatomy.surfaces*") if b"faces" in path.read_bytes()[:300]]
    has_flags = {b"cut_faces" in path.read_bytes()[:300]: path for path in found}
    return has_flags[what == "skin"]


def as_if_found(mesh: TriangleMesh) -> tuple[bool, bool]:
    again = TriangleMesh(mesh.vertices, mesh.faces)
    return again.closed, again.wound_alike


@pytest.mark.parametrize("memory", [Memory(), Memory(10**9)], ids=["a process a case", "many cases a process"])
def test_what_is_kept_is_what_the_surfaces_say(folder: Path, cache: Cache, memory: Memory) -> None:
    """From no cache, an empty and a full one; the second time all are known without a look."""
    expected = facts(anatomy(folder, NO_CACHE))
    kept = Cache(cache.folder, memory=memory)
    assert facts(anatomy(folder, kept)) == expected == facts(anatomy(folder, kept))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = anatomy(folder, cache)
    for mesh in meshes(again):
        assert (mesh.closed, mesh.wound_alike) == as_if_found(mesh)
    for mesh in meshes(again):
        assert {"closed", "wound_alike"} <= set(vars(mesh)) and "_welded" not in vars(mesh)


def test_an_open_skin_stays_open(folder: Path, cache: Cache) -> None:
    """Read from the cache it is as open as its file, and the warning is the same."""
    skin = (folder / "skin.stl").read_bytes()
    count = int.from_bytes(skin[80:84], "little") - 40
    (folder / "skin.stl").write_bytes(skin[:80] + count.to_bytes(4, "little") + skin[84 : 84 + 50 * count])
    first, again, without = (anatomy(folder, one) for one in (cache, cache, NO_CACHE))
    assert (first.skin.mesh.closed, again.skin.mesh.closed, without.skin.mesh.closed) == (False, False, False)
    assert first.skin.warnings == again.skin.warnings == without.skin.warnings != ()
    assert facts(first) == facts(again) == facts(without)


def test_another_file_under_the_same_name_is_another_surface(tmp_path: Path, cache: Cache) -> None:
    """The label map and the skin of another patient, under the same names: nothing of the first is taken for theirs."""
    first = anatomy(case_folder(tmp_path / "first"), cache)
    second = case_folder(tmp_path / "second", low=26)
    ball(second / "skin.stl", 90.0, (0.0, 1.0, 0.0))
    assert not {one[0] for one in facts(first)} >= {one[0] for one in facts(anatomy(second, cache))}
    assert facts(anatomy(second, cache)) == facts(anatomy(second, NO_CACHE))


WRONG = {
    "no facts": lambda arrays: {name: array for name, array in arrays.items() if name != "facts"},
    "of another type": lambda arrays: {**arrays, "facts": np.array([1, 1])},
    "too many": lambda arrays: {**arrays, "facts": np.array([True, True, False])},
    "one": lambda arrays: {**arrays, "facts": np.array(True)},
}


@pytest.mark.parametrize("what", ["skin", "vessel", "all"])
@pytest.mark.parametrize("wrong", WRONG)
def test_an_entry_without_what_it_should_say_is_made_anew(folder: Path, cache: Cache, what: str, wrong: str) -> None:
    expected = facts(anatomy(folder, cache))
    path = entry(cache, what)
    key, whole = path.name.split(".")[-2], path.read_bytes()
    path.write_bytes(packed(WRONG[wrong](unpacked(whole, key)), key))
    with pytest.warns(CacheWarning, match="does not have the expected content; it is computed again and replaced"):
        assert facts(anatomy(folder, cache)) == expected
    assert path.read_bytes() == whole


@pytest.mark.parametrize("what", ["skin", "vessel", "all"])
def test_a_changed_flag_is_seen(folder: Path, cache: Cache, what: str) -> None:
    """An open surface that says it is closed would have an inside: one flipped flag is damage, and is said."""
    expected = facts(anatomy(folder, cache))
    path = entry(cache, what)
    key, whole = path.name.split(".")[-2], path.read_bytes()
    stated = unpacked(whole, key)["facts"]
    assert stated.all()
    at = stated.__array_interface__["data"][0] - np.frombuffer(whole, np.uint8).__array_interface__["data"][0]
    changed = bytearray(whole)
    changed[at] = 0
    path.write_bytes(changed)
    with pytest.warns(CacheWarning, match=r"is truncated, damaged, or foreign"):
        assert facts(anatomy(folder, cache)) == expected
    assert path.read_bytes() == whole
