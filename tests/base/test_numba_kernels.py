"""Compiled kernels are kept for the very sources that they were made from, in a folder that nobody else may write."""

import json
import os
import pickle
import shutil
import stat
import subprocess
import sys
import time

import numpy as np
import pytest

from puncture_twin.planning.base import numba_kernels
from puncture_twin.planning.base.cache.source_stamp import PACKAGE
from puncture_twin.planning.base.errors import CacheWarning
from puncture_twin.planning.base.numba_kernels import KEPT_FOLDERS, KEPT_S, PREFIX, allocation_free, nb

BASE = "planning/base"
EMPTY = ("__init__.py", "planning/__init__.py", f"{BASE}/__init__.py", f"{BASE}/cache/__init__.py")
COPIED = (
    *(f"{BASE}/{name}.py" for name in ("errors", "files", "numba_kernels")),
    *(f"{BASE}/cache/{name}.py" for name in ("source_stamp", "entry_file")),
)
"""What a project needs to keep its kernels as ours does; what a room hands on is not there."""
TAKES_NB = "from puncture_twin.planning.base.numba_kernels import nb\n"
CALLEE = (
    TAKES_NB + "from puncture_twin.planning.size import SIZE\n\n"
    "@nb.njit(cache=True, forceinline=True)\ndef rule(x):\n    return x + {} * SIZE\n"
)
CALLER = (
    TAKES_NB
    + "from puncture_twin.planning.callee import rule\n\n@nb.njit(cache=True)\ndef add(x):\n    return rule(x)\n"
)
ASKED = "from puncture_twin.planning.caller import add\nprint(add(1), sum(add.stats.cache_hits.values()))\n"
"""The kernel's answer, and how often it was loaded."""


def write(project, **files):
    for name, text in files.items():
        (project / "puncture_twin" / "planning" / f"{name}.py").write_text(text)


def process(project, code=ASKED, **settings):
    """A process of its own that keeps its kernels in the project."""
    environment = {**os.environ, "PYTHONPATH": str(project), "NUMBA_CACHE_DIR": str(project / "cache"), **settings}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([sys.executable, "-c", code], env=environment, cwd=project, **pipes)


def said(project, code=ASKED, **settings):
    """The words that a process prints, and what it warns of."""
    begun = process(project, code, **settings)
    out, err = begun.communicate(timeout=600)
    assert begun.returncode == 0, err
    return out.split(), err


def answer(project, code=ASKED, **settings):
    words, warned = said(project, code, **settings)
    assert warned == ""
    return words


def folders(project):
    """One for each state of the sources."""
    return sorted((project / "cache").glob(f"{PREFIX}*"))


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """A package that keeps kernels, and its kernel, kept: of one that takes in another's, which names a constant."""
    project = tmp_path_factory.mktemp("kernels") / "project"
    for name in (*EMPTY, *COPIED):
        copy = project / "puncture_twin" / name
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes(b"" if name in EMPTY else (PACKAGE / name).read_bytes())
    write(project, caller=CALLER, size="SIZE = 1\n", callee=CALLEE.format(1))
    assert answer(project) == ["2", "0"]
    shutil.copytree(project, project.with_name("kept"))
    return project


@pytest.fixture
def project(compiled):
    """As it was when its kernel was kept, in the same place."""
    shutil.rmtree(compiled)
    return shutil.copytree(compiled.with_name("kept"), compiled)


@pytest.fixture
def fresh(project):
    """As it was before anything was kept."""
    shutil.rmtree(project / "cache")
    return project


def test_an_edit_of_any_source_of_a_kernel_is_noticed(project):
    """Of a kernel that is taken in, by name or as an attribute, and of a constant; back again, the old is as good."""
    write(project, callee=CALLEE.format(10))
    assert answer(project) == ["11", "0"]
    write(project, size="SIZE = 1 + 1\n", beside="SIZE = 3\n")
    assert answer(project) == ["21", "0"]
    write(project, size="SIZE = 1\n", callee=CALLEE.format(1), beside="SIZE = 4\n")  # no kernel names that
    assert answer(project) == ["2", "1"]
    hall = "from puncture_twin.planning import callee as room\nrule = room.rule\n"
    caller = CALLER.replace("from puncture_twin.planning.callee import rule", "import puncture_twin.planning.hall as h")
    write(project, hall=hall, caller=caller.replace("rule(x)", "h.rule(x)"))
    assert answer(project) == ["2", "0"]
    write(project, callee=CALLEE.format(10))
    assert answer(project) == ["11", "0"]
    assert len(folders(project)) == 5
    assert {stat.S_IMODE(folder.stat().st_mode) for folder in folders(project)} == {0o700}


def test_other_compilers_are_noticed(monkeypatch, tmp_path):
    """What one version has compiled is not what another would: each has a folder."""
    real, asked = numba_kernels.library_versions, []
    monkeypatch.setattr(numba_kernels, "_own_folder", lambda folder: asked.append(folder.name) or folder)
    monkeypatch.setattr(numba_kernels.atexit, "register", lambda *_, **__: None)
    monkeypatch.setattr(numba_kernels, "config", type("Config", (), {}))
    for name in (numba_kernels.FOLDER_VARIABLE, "NUMBA_CACHE_LOCATOR_CLASSES"):
        monkeypatch.setenv(name, str(tmp_path))
    for other in (None, *numba_kernels.COMPILERS):
        versions = {name: "0" if name == other else one for name, one in real(numba_kernels.COMPILERS).items()}
        monkeypatch.setattr(numba_kernels, "library_versions", lambda _, versions=versions: versions)
        numba_kernels._use_folder()
    assert len(set(asked)) == 1 + len(numba_kernels.COMPILERS)


def test_what_a_process_compiles_whose_sources_are_edited_is_not_kept(fresh):
    """An edit after the import, or before a later import and taken back: who knows which of them was compiled."""
    edit, undo = (f"file.write_text({CALLEE.format(number)!r})\n" for number in (10, 1))
    begin = "import pathlib\nimport puncture_twin.planning.base.numba_kernels\n"
    begin += "import puncture_twin.planning.size as size\nfile = pathlib.Path(size.__file__).with_name('callee.py')\n"
    assert answer(fresh, begin + ASKED + edit)[0] == "2"
    assert folders(fresh) == []
    write(fresh, callee=CALLEE.format(1))
    assert answer(fresh, begin + edit + "from puncture_twin.planning.caller import add\n" + undo + ASKED)[0] == "11"
    assert answer(fresh) == ["2", "0"]


def test_files_that_are_cut_are_removed_and_said(tmp_path):
    """As a system leaves them that goes down while it writes: numba would end in an error."""
    whole = pickle.dumps(list(range(100)))
    contents = {"a.nbi": whole, "b.nbc": whole, "c.nbi": b"", "d.nbc": whole[:-1], "e.nbi": whole + bytes(9)}
    (tmp_path / "kernels").mkdir(mode=0o700)
    for name, content in {**contents, "f.nbc.tmp.12": b""}.items():
        (tmp_path / "kernels" / name).write_bytes(content)
    with pytest.warns(CacheWarning, match="a compiled kernel is cut or damaged") as said_of:
        numba_kernels._own_folder(tmp_path / "kernels")
    assert {path.name for path in (tmp_path / "kernels").iterdir()} == {"a.nbi", "b.nbc", "f.nbc.tmp.12"}
    assert len(said_of) == 3


def test_a_bit_that_flips_in_a_kept_kernel_is_seen(project):
    """It would run, or end the process: nothing of what was kept is as it was. It is compiled anew, and said once."""
    (data,) = (project / "cache").rglob("caller.*.nbc")
    content, status = bytearray(data.read_bytes()), data.stat()
    content[len(content) // 2] ^= 1
    data.write_bytes(content)
    os.utime(data, ns=(status.st_atime_ns, status.st_mtime_ns))
    words, warned = said(project)
    assert words == ["2", "0"] and warned.count("a compiled kernel is cut or damaged") == 1
    assert answer(project) == ["2", "1"]


def test_a_list_of_sums_that_cannot_be_read_is_written_anew(project):
    (sums,) = (project / "cache").rglob("sums.json")
    whole = json.loads(sums.read_text())
    for content in ("{", '{"a": 1}'):
        sums.write_text(content)
        assert numba_kernels._sums(sums.parent) == {}
    assert answer(project) == ["2", "1"]
    assert json.loads(sums.read_text()) == whole


FULL = (
    "import errno, os\nreal = os.replace\ndef full(source, target):\n"
    "    if str(target).endswith({!r}):\n        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))\n"
    "    real(source, target)\nos.replace = full\n"
)


def test_a_disk_that_is_full_leaves_nothing_that_a_later_process_stumbles_over(fresh):
    """Such a process ends with the system's error, which a command tells in one line."""
    for ending in (".nbi", ".nbc"):
        begun = process(fresh, FULL.format(ending) + ASKED)
        assert "No space left" in begun.communicate(timeout=600)[1] and begun.returncode == 1
    assert answer(fresh) == ["2", "0"]


class Forged:
    """What runs where it is unpickled."""

    def __reduce__(self):
        return print, ("it was unpickled",)


def test_a_folder_that_others_may_write_is_refused_before_it_is_unpickled(project):
    """An index is a pickle: whoever may write there runs what they like. One line says where, and what to do."""
    (index,) = (project / "cache").rglob("caller.*.nbi")
    index.write_bytes(pickle.dumps(Forged()))
    caught = f"try:\n    {ASKED.splitlines()[0]}\n    print(add(1))\nexcept Exception as error:\n    print(error)"
    assert "unpickled" in said(project, caught)[0]
    (folder,) = folders(project)
    folder.chmod(0o722)
    words = answer(project, caught)
    assert "unpickled" not in words and f"{folder}:" in words and "$NUMBA_CACHE_DIR" in " ".join(words)


NO_HOME = "import pathlib\ndef home():\n    raise RuntimeError('no home')\npathlib.Path.home = home\n"
"""As where a user has no name and the environment says nothing."""


@pytest.mark.parametrize("before", ["", NO_HOME], ids=["a file in its place", "no home"])
def test_without_a_folder_kernels_live_as_long_as_the_process(fresh, before, tmp_path):
    """One line says so; what this process begins shares them, and nothing is left."""
    (tmp_path / "home").write_text("")
    settings = {"NUMBA_CACHE_DIR": "", "XDG_CACHE_HOME": "", "HOME": str(tmp_path / "home"), "TMPDIR": str(tmp_path)}
    again = f"import subprocess, sys\nprint(subprocess.run([sys.executable, '-c', {ASKED!r}]).returncode)"
    words, warned = said(fresh, before + ASKED + ("" if before else again), **settings)
    assert sorted(words) == (["0", "2"] if before else ["0", "0", "1", "2", "2"])
    assert warned.count("kernels are compiled for this run only") == 1
    assert list(tmp_path.glob("puncture-twin-*")) == []


def test_old_folders_go_when_a_new_one_is_made(tmp_path):
    """The newest stay, and what was used within a week: other checkouts share the place."""
    now = time.time()
    for number in range(KEPT_FOLDERS + 4):
        folder = tmp_path / f"{PREFIX}{number}"
        folder.mkdir()
        age = (number - 2) * KEPT_S if number >= KEPT_FOLDERS + 2 else 1.0
        os.utime(folder, (now - age, now - age))
    (tmp_path / "beside").mkdir()
    numba_kernels._own_folder(tmp_path / f"{PREFIX}new")
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"beside", f"{PREFIX}new", *(f"{PREFIX}{number}" for number in range(KEPT_FOLDERS + 2))}


def test_two_processes_at_once(fresh):
    both = [process(fresh) for _ in range(2)]
    assert [one.communicate(timeout=600)[0].split()[0] for one in both] == ["2", "2"]
    assert answer(fresh) == ["2", "1"]


def test_the_folder_stays_when_numba_reads_its_settings_again(project):
    """It does so at the next compilation after any of them was changed in the environment."""
    again = "import os\nimport numba\nimport puncture_twin.planning.base.numba_kernels\n"
    again += "os.environ['NUMBA_NUM_THREADS'] = '1'\nnumba.njit(lambda x: x)(1)\n"
    assert answer(project, again + ASKED) == ["2", "1"]
    assert list((project / "puncture_twin").rglob("*.nbi")) == []


def passed_on(pair):
    """Takes arrays out of a tuple, lets them change places and cuts them."""
    first, second = pair
    total = 0.0
    for row in range(len(first)):
        if first[row, 0] > total:
            first, second = second, first
        total += first[row][0] * second[row, 1]
    return total


def test_it_counts_no_references():
    """The plain kernel of the same function does, and answers the same; what only the call holds is whole too."""
    pair = np.arange(6.0).reshape(3, 2), np.arange(6.0).reshape(3, 2)
    counting, free = nb.njit(passed_on), allocation_free(cache=False)(passed_on)
    assert free(pair) == counting(pair) == passed_on(pair)
    assert "NRT_incref" in next(iter(counting.inspect_llvm().values()))
    assert "NRT_incref" not in next(iter(free.inspect_llvm().values()))
    for _ in range(1000):
        assert free((np.ones((3, 2)), np.ones((3, 2)))) == 3.0


def test_one_that_makes_an_array_is_refused():
    """Rather than to lose what it has made."""

    def made(count):
        return np.zeros(count).sum()

    with pytest.raises(nb.errors.NumbaError, match="NRT|returning of array"):
        allocation_free(cache=False)(made)(3)
