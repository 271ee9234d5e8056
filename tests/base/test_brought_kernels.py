"""Machine code that a wheel brings is used where all fits, and nowhere else; the answer is the same."""

import os
import shutil
import subprocess
import sys

import pytest
from base.test_kernel_cache import SPOILS
from kernel_world import CALLEE, CALLER, copy_package, write_kernels

from benchmarks.build_wheels import FIXED, STAMP, lay
from puncture_twin.planning.base.cache.brought_kernels import (
    BROUGHT,
    CLASSES,
    MADE_FOR,
    brought_class,
    brought_folder,
    classes_of,
)
from puncture_twin.planning.base.cache.kernel_cache import COMPILERS, class_in_use, host_features

PLAINEST = list(CLASSES)[-1]
OWN = "None"
"""What numba is told of the processor where it compiles for the one that it runs on."""

ANSWER = """
import puncture_twin.planning.base.numba_kernels, numba
from puncture_twin.planning.caller import add
print(add(1), sum(add.stats.cache_hits.values()), numba.core.config.CPU_NAME)
"""


def begin(project, code, **settings):
    """A process of its own, with no settings of numba's but these."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith("NUMBA_")}
    environment = {**kept, "PYTHONPATH": str(project), **settings}
    pipe = subprocess.PIPE
    return subprocess.Popen(
        [sys.executable, "-c", code], env=environment, cwd=project, stdout=pipe, stderr=pipe, text=True
    )


def end(process):
    """What it printed, and what it warned of."""
    out, err = process.communicate(timeout=600)
    assert process.returncode == 0, err
    return out.strip(), err


def answer(project, before="", **settings):
    """The kernel's answer, how often it was loaded, and what it was compiled for."""
    said, warned = end(begin(project, before + ANSWER, **settings))
    assert warned == ""
    return tuple(said.split())


def kept(project):
    """The files of compiled kernels that the package does not bring."""
    package = project / "puncture_twin"
    files = [path for ending in ("nbi", "nbc") for path in project.rglob(f"*.{ending}")]
    return [path for path in files if not path.is_relative_to(package / BROUGHT.name)]


@pytest.fixture(scope="module")
def as_installed(tmp_path_factory):
    """A project that brings its kernels for the plainest class, as wheels do."""
    if PLAINEST not in classes_of(host_features()):
        pytest.skip("this processor is of no class that code is brought for")
    project = tmp_path_factory.mktemp("built")
    copy_package(project)
    write_kernels(project)
    assert answer(project, NUMBA_CPU_NAME=PLAINEST, **FIXED) == ("2", "0", PLAINEST)
    stamp, _ = end(begin(project, STAMP))
    lay(project / "puncture_twin", [stamp, PLAINEST])
    return project


@pytest.fixture
def project(as_installed, tmp_path):
    """Another place with the same files."""
    return shutil.copytree(as_installed, tmp_path / "installed")


def brought(project, ending):
    """The file of the kernel that is called."""
    (path,) = (project / "puncture_twin" / BROUGHT.name).rglob(f"caller.*{ending}")
    return path


def test_what_is_brought_is_used_in_any_place(project):
    """It is loaded, nothing is compiled, and nothing is written."""
    assert answer(project) == ("2", "1", PLAINEST)
    assert kept(project) == []


@pytest.mark.parametrize(
    ("file", "text", "expected"),
    [
        ("callee.py", CALLEE.format(10), "11"),
        ("size.py", "SIZE = 10\n", "11"),
        ("caller.py", CALLER.replace("rule(x)", "rule(x) + 100"), "102"),
    ],
)
def test_an_edit_of_what_is_installed_is_noticed(project, file, text, expected):
    """Of the kernel, of one that it takes in, of a constant: compiled anew, for this very processor."""
    (project / "puncture_twin" / "planning" / file).write_text(text)
    assert answer(project) == (expected, "0", OWN)
    assert answer(project) == (expected, "1", OWN)


@pytest.mark.parametrize("library", COMPILERS)
def test_other_compilers_are_noticed(project, library):
    """What one version has compiled is not what another would."""
    other = (
        f"import importlib.metadata as m\nreal = m.version\nm.version = lambda n: '0' if n == {library!r} else real(n)"
    )
    assert answer(project, other) == ("2", "0", OWN)


def test_a_processor_that_can_do_less_compiles_for_itself(project):
    """Numba is told to see no AVX, as on a processor without; also a second process would begin, as ever."""
    asked = "from puncture_twin.planning.base.cache.kernel_cache import is_compiled\n"
    asked += "from puncture_twin.planning.caller import add\nprint(is_compiled(add))"
    assert end(begin(project, asked))[0] == "True"
    assert end(begin(project, asked, NUMBA_ENABLE_AVX="0"))[0] == "False"
    assert answer(project, NUMBA_ENABLE_AVX="0") == ("2", "0", OWN)
    assert len(kept(project)) > 0


@pytest.mark.parametrize("name", CLASSES)
def test_a_class_needs_all_of_its_features(tmp_path, name):
    """Without any one of them the next plainer class is used, or none; one that is not brought never is."""
    (tmp_path / MADE_FOR).write_text("stamp\n" + "\n".join(CLASSES))
    names = [*CLASSES, None]
    assert brought_class("stamp", CLASSES[name], tmp_path) == name
    for feature in CLASSES[name]:
        assert brought_class("stamp", CLASSES[name] - {feature}, tmp_path) in names[names.index(name) + 1 :]
    assert brought_class("other", CLASSES[name], tmp_path) is None
    (tmp_path / MADE_FOR).write_text("stamp\n")
    assert brought_class("stamp", CLASSES[name], tmp_path) is None


@pytest.mark.parametrize("content", [None, b"", b"\n", b"\xff\xfe", b"stamp"])
def test_what_does_not_say_what_it_was_made_from_is_not_used(tmp_path, content):
    """A file that is missing, empty, no text, or cut."""
    if content is not None:
        (tmp_path / MADE_FOR).write_bytes(content)
    assert brought_class("stamp", CLASSES[PLAINEST], tmp_path) is None


def test_what_the_user_tells_numba_stays_in_force(project):
    """A processor's name or features."""
    assert answer(project, NUMBA_CPU_NAME="generic") == ("2", "0", "generic")
    assert answer(project, NUMBA_CPU_FEATURES="+avx2") == ("2", "0", OWN)


def test_numba_that_has_compiled_before_goes_on_for_its_processor(project):
    """It chooses once a process: what is brought does not fit that, and is found again by the next one."""
    assert answer(project, "import numba\nnumba.njit(lambda x: x)(1)\n")[:2] == ("2", "0")
    assert answer(project) == ("2", "1", PLAINEST)
    assert answer(project, "import numba\nnumba.njit(lambda x: x)(1)\n")[:2] == ("2", "1")


@pytest.mark.parametrize("spoil", ["half", "garbage", "a bit in the middle"])
@pytest.mark.parametrize("ending", [".nbi", ".nbc"])
def test_damaged_code_is_not_run(project, ending, spoil):
    """Compiled anew, which is said once, kept apart from what was installed, and then used."""
    file = brought(project, ending)
    file.write_bytes(SPOILS[spoil](file.read_bytes()))
    damaged = file.read_bytes()
    said, warned = end(begin(project, ANSWER))
    assert said.split() == ["2", "0", PLAINEST]
    assert warned.count("CacheWarning: cache: a compiled kernel is cut, damaged, or another's") == 1
    assert answer(project) == ("2", "1", PLAINEST)
    assert file.read_bytes() == damaged


def test_a_place_that_cannot_be_written_is_no_hindrance(project, tmp_path):
    """Root's site-packages, or a folder of the user's own for kernels: what is brought is found all the same."""
    folder = project / "puncture_twin" / "planning" / "__pycache__"
    folder.write_text("in its way")
    settings = {"XDG_CACHE_HOME": str(tmp_path / "user")}
    assert answer(project, **settings) == ("2", "1", PLAINEST)
    assert answer(project, **settings, NUMBA_CACHE_DIR=str(tmp_path / "set")) == ("2", "1", PLAINEST)
    brought(project, ".nbc").unlink()
    assert answer(project, **settings) == ("2", "0", PLAINEST)
    assert answer(project, **settings) == ("2", "1", PLAINEST)
    assert kept(project) == []
    assert list((tmp_path / "user").rglob("caller.*.nbc"))


def test_no_place_that_can_be_written_is_no_hindrance_either(project, tmp_path):
    """A read-only system and a user without a home: what is not brought is compiled each time."""
    for path in (project / "puncture_twin" / "planning" / "__pycache__", tmp_path / "user"):
        path.write_text("in its way")
    settings = {"XDG_CACHE_HOME": str(tmp_path / "user")}
    assert answer(project, **settings) == ("2", "1", PLAINEST)
    brought(project, ".nbc").unlink()
    for _ in range(2):
        assert answer(project, **settings) == ("2", "0", PLAINEST)
    assert kept(project) == []


def test_two_processes_at_once(project):
    """Both load what is brought; what is missing both compile, or one finds what the other has just kept."""
    both = [begin(project, ANSWER) for _ in range(2)]
    assert [end(process) for process in both] == [(f"2 1 {PLAINEST}", "")] * 2
    brought(project, ".nbc").unlink()
    both = [begin(project, ANSWER) for _ in range(2)]
    assert [(said[0], warned) for said, warned in map(end, both)] == [("2", "")] * 2
    assert answer(project) == ("2", "1", PLAINEST)


def test_a_checkout_brings_nothing():
    """Nor does an editable install, which is the same files."""
    assert not BROUGHT.exists()
    assert class_in_use() is None


def test_code_lies_where_its_source_does():
    """Of the package's own files; others' have none."""
    assert brought_folder(BROUGHT.parent / "planning" / "base" / "x.py") == BROUGHT / "planning" / "base"
    assert brought_folder(BROUGHT.parent.parent / "x.py") is None
