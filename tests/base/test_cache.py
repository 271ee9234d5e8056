"""The cache: right when it is right, and never trusted when it is not."""

import ast
import functools
import os
import pickle
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from refusals import refused

from puncture_twin.planning.anatomy import surfaces
from puncture_twin.planning.base.cache import array_cache as cache_module
from puncture_twin.planning.base.cache.array_cache import LIBRARIES, Cache, user_cache
from puncture_twin.planning.base.cache.entry_file import packed
from puncture_twin.planning.base.cache.source_stamp import PROJECT, closure, source_stamp, sources_with
from puncture_twin.planning.base.errors import CacheWarning

BY = "puncture_twin.planning.anatomy.surfaces"
CHECKOUT = Path(__file__).resolve().parents[2]
SOURCES = [*(CHECKOUT / "planning").rglob("*.py"), *(CHECKOUT / "twin").rglob("*.py")]
KEEPING = [one.relative_to(CHECKOUT).with_suffix("") for one in SOURCES if "by=__name__" in one.read_text("utf-8")]
MAKERS = (BY, *sorted({"puncture_twin." + ".".join(one.parts) for one in KEEPING} - {BY}))
"""Every module whose results are kept."""


class Counted:
    """A cache that counts what is made."""

    def __init__(self, folder, **options):
        self.cache, self.folder, self.made = Cache(folder, **options), folder, 0

    def get(self, by=BY, check=len, **key):
        return self.cache.arrays(key or {"file": "abc"}, self._make, by=by, check=check)

    def _make(self):
        self.made += 1
        vertices, none = np.arange(12.0).reshape(4, 3), np.zeros((0, 3))
        return {"vertices": vertices, "names": np.array(["a", "bc"]), "none": none, "n": np.array(3)}

    def entries(self):
        return list(self.folder.glob("*.arrays"))


@pytest.fixture
def kept(tmp_path):
    """One that holds an entry, and the entry's file."""
    counted = Counted(tmp_path / "cache")
    counted.get()
    return counted, *counted.entries()


def test_the_second_time_nothing_is_made(kept):
    """The same inputs give the stored arrays, bit for bit, with shape and type, and nothing is said; others do not."""
    cache = Counted(kept[0].folder)
    first = cache.get(file="x", what="label 5")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        second = cache.get(file="x", what="label 5")
    assert cache.made == 1
    assert set(second) == set(first)
    for name in first:
        np.testing.assert_array_equal(second[name], first[name])
        assert (second[name].dtype, second[name].shape) == (first[name].dtype, first[name].shape)
        assert not first[name].flags.writeable and not second[name].flags.writeable
    for other in ({"file": "y"}, {"what": "label 6"}, {"extra": 1}):
        cache.get(**({"file": "x", "what": "label 5"} | other))
    assert cache.made == 4
    for by in MAKERS[1:]:
        cache.get(by, file="x", what="label 5")
    assert cache.made == 3 + len(MAKERS)


def flipped(content, place):
    changed = bytearray(content)
    changed[place] ^= 1
    return bytes(changed)


SPOILS = {
    "empty": lambda content: b"",
    "a pickle": lambda content: pickle.dumps({"vertices": np.zeros(3)}),
    "half": lambda content: content[: len(content) // 2],
    "one byte more": lambda content: content + b"\0",
    "a later layout": lambda content: content.replace(b"arrays 3", b"arrays 4"),
}


@pytest.mark.parametrize("spoil", SPOILS)
def test_a_spoiled_file_is_made_anew_said_and_replaced(kept, spoil):
    """Empty, foreign, a pickle, cut, longer or of another layout: made anew, whole afterwards."""
    cache, path = kept
    path.write_bytes(SPOILS[spoil](path.read_bytes()))
    said = r"cache: a stored result is truncated, damaged, or foreign; it is computed again"
    with pytest.warns(CacheWarning, match=said):
        again = cache.get()
    np.testing.assert_array_equal(again["vertices"], np.arange(12.0).reshape(4, 3))
    cache.get()
    assert cache.made == 2


def test_every_flipped_byte_is_seen(kept):
    cache, path = kept
    content = path.read_bytes()
    for place in range(0, len(content), 9):
        path.write_bytes(flipped(content, place))
        with pytest.warns(CacheWarning):
            cache.get()


@pytest.mark.parametrize("kind", ["full folder", "pipe", "link", "dangling link"])
def test_something_else_in_an_entrys_place_is_replaced(kept, kind, tmp_path):
    """A directory, a pipe (which is not waited for) and a link, even to the right content, are no entries."""
    cache, path = kept
    path.rename(tmp_path / "elsewhere")
    if kind == "full folder":
        path.mkdir()
        (path / "x").write_text("x")
    elif kind == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to(tmp_path / ("elsewhere" if kind == "link" else "nowhere"))
    with pytest.warns(CacheWarning, match="is not a regular file"):
        cache.get()
    cache.get()
    assert cache.made == 2


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_an_unreadable_entry_is_replaced(kept):
    cache, path = kept
    path.chmod(0)
    with pytest.warns(CacheWarning, match="cannot be read"):
        cache.get()
    cache.get()
    assert cache.made == 2


def test_a_file_of_another_key_is_not_believed(kept):
    """An honest file under the wrong name would give one label another's surface; its digest says whose it is."""
    cache, path = kept
    cache.get(file="two")
    (other,) = set(cache.entries()) - {path}
    other.write_bytes(path.read_bytes())
    with pytest.warns(CacheWarning):
        cache.get(file="two")
    assert cache.made == 3


@pytest.mark.parametrize(
    "wrong",
    [{"vertices": np.zeros((4, 2))}, {"vertices": np.zeros((4, 3), np.float32)}, {"other": np.zeros((4, 3))}],
    ids=["shape", "type", "name"],
)
def test_a_whole_entry_with_other_arrays_is_made_anew(kept, wrong):
    """A forged digest does not help: whoever uses the arrays says what they must be."""

    def check(arrays):
        if arrays["vertices"].shape[1] != 3 or arrays["vertices"].dtype != np.float64:
            raise ValueError

    cache, path = kept
    path.write_bytes(packed(wrong, path.name.split(".")[-2]))
    with pytest.warns(CacheWarning, match="does not have the expected content"):
        found = cache.get(check=check)
    assert found["vertices"].shape == (4, 3) and cache.made == 2


def test_a_folder_that_cannot_be_written_costs_nothing_but_time(tmp_path):
    """A file stands where the folder should be: the result is made all the same, and nothing is said."""
    (tmp_path / "taken").write_text("")
    cache = Counted(tmp_path / "taken" / "cache")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cache.get()
    assert cache.made == 1


def test_the_least_recently_used_goes_when_the_folder_is_full(tmp_path):
    """The folder never holds more than its bound, and what was used last stays."""
    cache = Cache(tmp_path, most_bytes=30_000)
    calls = []

    def ask(name):
        def make():
            calls.append(name)
            return {"values": np.zeros(1000)}

        cache.arrays({"name": name}, make, by=BY)
        kept = sorted(tmp_path.glob("*.arrays"), key=lambda p: p.stat().st_mtime_ns, reverse=True)
        for age, path in enumerate(kept):
            os.utime(path, ns=(0, 10**18 - age * 10**9))  # file systems may keep time to a second only

    for name in "abcab":
        ask(name)
    assert calls == ["a", "b", "c"]
    ask("d")  # the fourth does not fit: c is the oldest
    assert sum(path.stat().st_size for path in tmp_path.glob("*.arrays")) <= 30_000
    for name in "abd":
        ask(name)
    assert calls == ["a", "b", "c", "d"]
    cache.arrays({"name": "large"}, lambda: {"values": np.zeros(10_000)}, by=BY)
    assert len(list(tmp_path.glob("*.arrays"))) == 3  # what does not fit at all drives nothing out


def test_what_older_versions_left_is_cleared(kept, monkeypatch):
    """Another version of a library or of the code: made anew, and what can never be used again is removed."""
    cache, _ = kept
    cache.get(MAKERS[1])
    (cache.folder / "notes.txt").write_text("a user's own")
    dead, alive = cache.folder / ".x.arrays", cache.folder / ".y.arrays"
    for temporary in (dead, alive):
        temporary.write_bytes(b"half")
    os.utime(dead, (0, 0))
    cache_module._generation.cache_clear()
    monkeypatch.setattr(cache_module, "library_versions", lambda names: dict.fromkeys(names, "next"))
    cache.get()
    cache_module._generation.cache_clear()
    assert cache.made == 3
    left = {path.name for path in cache.folder.iterdir()}
    assert len(cache.entries()) == 2 + alive.exists()
    assert {"notes.txt", ".y.arrays"} <= left
    assert ".x.arrays" not in left


def place_of(module):
    return module.partition(".")[2].replace(".", "/")


def test_the_libraries_of_every_maker_are_in_the_key():
    """Whatever its code imports is this project, Python's own or a library whose version counts."""
    packages = {"skimage": "scikit-image", "fcl": "python-fcl", "PIL": "pillow"}
    packages["fast_simplification"] = "fast-simplification"
    for maker in MAKERS:
        files = closure([f"{PROJECT}/{place_of(maker)}.py"])
        tops = {name.split(".")[0] for file in files for name in imported_by_python(file)}
        foreign = tops - set(sys.stdlib_module_names) - {"puncture_twin"}
        assert {packages.get(name, name) for name in foreign} <= set(LIBRARIES)
        assert len(source_stamp(maker)) == 64


def test_the_code_that_reads_a_volume_decides_what_is_kept_of_it(tmp_path, monkeypatch):
    """Readers of DICOM are handed in: the organ of the old one stayed when one was mended."""
    names = closure([f"{PROJECT}/planning/anatomy/surfaces.py"])
    volumes = (f"formats/volumes/{name}" for name in ("nifti_header", "volume_header"))
    wanted = ("anatomy/skin", "anatomy/body/body_mask", "formats/labels/labelmaps", *volumes)
    assert {f"{PROJECT}/planning/{name}.py" for name in wanted} <= names
    files = closure([f"{PROJECT}/{place_of(surfaces.READERS)}.py"])
    dicom = [f"dicom/{name}" for name in ("ct_series", "slices", "segmentation", "structure_set")]
    assert {f"{PROJECT}/planning/formats/{name}.py" for name in (*dicom, "labels/label_sources")} <= files
    assert {"pydicom", "python-gdcm"} <= set(LIBRARIES)
    cache = Counted(tmp_path)
    for stamp in ("old", "old", "mended"):
        monkeypatch.setattr(surfaces, "_readers", lambda stamp=stamp: stamp)
        volume = surfaces.VolumeSurfaces(None, ("abc",), cache.cache)
        volume.kept({"what": "x"}, cache._make, len, by=BY)
    assert cache.made == 2


def test_an_edit_behind_any_kind_of_import_changes_the_stamp(tmp_path):
    lines = (
        "from puncture_twin.planning.made.inner import make",
        "from puncture_twin.planning.made import inner",
        "from puncture_twin.planning.made import (\n    inner as other,\n)",
        "import puncture_twin.planning.made.inner",
        "def late():\n    from puncture_twin.planning.made.inner import make",
    )
    made = small_package(tmp_path, *lines)
    makers = [f"puncture_twin.planning.maker{number}" for number in range(len(lines))]
    code = "from puncture_twin.planning.base.cache.source_stamp import source_stamp\n"
    code += f"print(*map(source_stamp, {makers}))"
    stamps = []
    for size in (1, 1, 2):
        (made / "inner.py").write_text(f"SIZE = {size}\n")
        stamps.append(python_in(tmp_path, code).split())
    assert stamps[0] == stamps[1]
    assert all(old != new for old, new in zip(stamps[1], stamps[2], strict=True))


@pytest.mark.parametrize("edit", ["again", "another", "gone", "swapped", "nothing"])
def test_a_source_that_was_written_since_its_stamp_is_told(tmp_path, edit):
    """With the same words too: it may have said other ones when it was loaded. What it hands on counts."""
    made = small_package(tmp_path, "from puncture_twin.planning.made.inner import make")
    (made / "inner.py").write_text("SIZE = 1\n")
    (made / "new.py").write_text("SIZE = 1\n")
    edits = {
        "again": "file.write_text('SIZE = 1\\n')",
        "another": "file.write_text('SIZE = 2\\n')",
        "gone": "file.unlink()",
        "swapped": "file.with_name('new.py').replace(file)",
        "nothing": "",
    }
    code = (
        "import pathlib, puncture_twin\n"
        "from puncture_twin.planning.base.cache.source_stamp import module_unedited, source_stamp\n"
        "file = pathlib.Path(puncture_twin.__file__).parent / 'planning' / 'made' / 'inner.py'\n"
        f"source_stamp('puncture_twin.planning.maker0')\n{edits[edit]}\n"
        "print(module_unedited('puncture_twin.planning.maker0'))"
    )
    assert python_in(tmp_path, code).split() == [str(edit == "nothing")]


def test_what_an_edited_source_makes_is_not_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(cache_module, "module_unedited", lambda maker: maker != BY)
    cache = Counted(tmp_path / "cache")
    cache.get()
    cache.get()
    assert cache.made == 2
    assert not cache.folder.exists()


@functools.cache
def imported_by_python(file):
    nodes = [*ast.walk(ast.parse(Path(file).read_bytes()))]
    from_these = [node for node in nodes if isinstance(node, ast.ImportFrom)]
    assert all(node.level == 0 for node in from_these)
    plain = [name.name for node in nodes if isinstance(node, ast.Import) for name in node.names]
    return plain + [f"{node.module}.{name.name}" for node in from_these for name in node.names]


def test_no_import_of_the_project_is_written_so_that_a_stamp_misses_it():
    for file in sources_with(b"import"):
        taken = closure([file])
        for name in imported_by_python(file):
            places = (f"{PROJECT}/{place_of(one)}" for one in (name, name.rpartition(".")[0]))
            found = [place + end for place in places for end in (".py", "/__init__.py")]
            files = [one for one in found if Path(one).is_file()]
            assert not files or files[0] in taken, f"{file}: {name}"


def small_package(root, *lines):
    planning = root / "puncture_twin" / "planning"
    made, stamps_folder = planning / "made", planning / "base" / "cache"
    for folder in (made, stamps_folder):
        folder.mkdir(parents=True)
    source = Path(cache_module.__file__).with_name("source_stamp.py")
    (stamps_folder / "source_stamp.py").write_bytes(source.read_bytes())
    for folder in (planning.parent, planning, made):
        (folder / "__init__.py").write_text("")
    for number, line in enumerate(lines):
        (planning / f"maker{number}.py").write_text(line + "\n")
    return made


def python_in(root, code):
    environment = os.environ | {"PYTHONPATH": str(root)}
    options = {"cwd": root, "capture_output": True, "text": True, "check": True}
    return subprocess.run([sys.executable, "-c", code], env=environment, **options).stdout


SHARED = """
import sys
import numpy as np
from pathlib import Path
from puncture_twin.planning.base.cache.array_cache import Cache
cache = Cache(Path(sys.argv[1]), most_bytes=400_000)
for turn in range(100):
    name = turn % 17
    by = "puncture_twin.planning.anatomy.surfaces"
    found = cache.arrays({"name": name}, lambda: {"values": np.full(5000, float(name))}, by=by)
    assert np.all(found["values"] == name)
"""


def test_many_processes_may_share_a_folder(tmp_path):
    """Each gets what it asked for, while all write and the oldest is driven out; nobody has to say anything."""
    command = [sys.executable, "-W", "error", "-c", SHARED, str(tmp_path)]
    running = [subprocess.Popen(command, stderr=subprocess.PIPE, text=True) for _ in range(4)]
    assert [one.communicate()[1] for one in running] == [""] * 4
    assert [one.returncode for one in running] == [0] * 4
    assert sum(path.stat().st_size for path in tmp_path.glob("*.arrays")) <= 400_000


def test_the_environment_names_the_folder_and_bounds_its_size(monkeypatch, tmp_path):
    """2 GB unless it says otherwise, in megabytes; anything else is refused in one line."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("PUNCTURE_TWIN_CACHE_MB", raising=False)
    monkeypatch.delenv("PUNCTURE_TWIN_CACHE", raising=False)
    assert user_cache().folder == tmp_path / "puncture-twin" and user_cache().most_bytes == 2_000_000_000
    monkeypatch.setenv("PUNCTURE_TWIN_CACHE", str(tmp_path / "own"))
    assert user_cache().folder == tmp_path / "own"
    monkeypatch.setenv("PUNCTURE_TWIN_CACHE", "")
    assert user_cache().folder is None
    monkeypatch.setenv("PUNCTURE_TWIN_CACHE_MB", "150")
    assert user_cache().most_bytes == 150_000_000
    for wrong in ("-1", "many", "1e3", "9" * 50):
        monkeypatch.setenv("PUNCTURE_TWIN_CACHE_MB", wrong)
        with refused("not_a_number"):
            user_cache()
