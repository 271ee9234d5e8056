"""Compiled kernels are made anew when any kernel's source has changed, or a file of theirs is not whole."""

import os
import pickle
import subprocess
import sys

import pytest
from kernel_world import CALLEE, CALLER, copy_package, write_kernels


def _run(project, own=True):
    """Let a process of its own ask the kernel, and say how often it came from the cache."""
    lines = [
        "import puncture_twin.planning.base.numba_kernels",
        "from numba.core import caching, dispatcher",
        "" if own else "dispatcher.FunctionCache = caching.FunctionCache",
    ]
    lines += ["from puncture_twin.planning.caller import add", "print(add(1), sum(add.stats.cache_hits.values()))"]
    return _python(project, "\n".join(lines))


def _python(project, code):
    """What a process of its own prints."""
    environment = os.environ | {"PYTHONPATH": str(project), "NUMBA_CACHE_DIR": str(project / "cache")}
    return subprocess.run(
        [sys.executable, "-c", code], env=environment, cwd=project, capture_output=True, text=True, check=True
    )


def _answer(project, own=True):
    """What the kernel says in a process of its own, and how often it came from the cache."""
    return tuple(int(word) for word in _run(project, own).stdout.split())


@pytest.fixture
def project(tmp_path):
    """A project with a kernel that takes in another."""
    copy_package(tmp_path)
    write_kernels(tmp_path)
    return tmp_path


@pytest.mark.parametrize("own", [True, False], ids=["ours", "numba's"])
def test_an_edit_of_a_kernel_that_is_taken_in_reaches_its_callers(project, own):
    """Numba alone goes on answering by the old rule: then this module is not needed any more."""
    tmp_path, folder = project, project / "puncture_twin" / "planning"
    assert _answer(tmp_path, own) == (2, 0)
    assert _answer(tmp_path, own) == (2, 1)
    (folder / "callee.py").write_text(CALLEE.format(10))
    assert _answer(tmp_path, own) == ((11, 0) if own else (2, 1))
    (folder / "size.py").write_text("SIZE = 1 + 1\n")
    assert _answer(tmp_path, own) == ((21, 0) if own else (2, 1))
    (folder / "beside.py").write_text("SIZE = 3\n")  # no kernel names it
    assert _answer(tmp_path, own) == ((21, 1) if own else (2, 1))


def _kept(project, ending):
    """The files of the kernel that is asked."""
    return [path for path in (project / "cache").rglob(f"*{ending}") if path.name.startswith("caller.")]


SPOILS = {
    "empty": lambda content: b"",
    "half": lambda content: content[: len(content) // 2],
    "one byte short": lambda content: content[:-1],
    "a pickle": lambda content: pickle.dumps({}),
    "garbage": lambda content: b"garbage",
    "a bit in the middle": lambda content: content[: len(content) // 2] + b"\xa5" + content[len(content) // 2 + 1 :],
    "a bit at the end": lambda content: content[:-1] + bytes([content[-1] ^ 1]),
}


@pytest.mark.parametrize("ending", [".nbi", ".nbc"])
def test_a_damaged_file_is_compiled_anew_said_once_and_replaced(project, ending):
    """Index and data, cut, changed or foreign: the same answer, one line, and the next run has it again."""
    assert _answer(project) == (2, 0)
    assert _answer(project) == (2, 1)
    (path,) = _kept(project, ending)
    whole = path.read_bytes()
    for name, spoil in SPOILS.items():
        assert spoil(whole) != whole, name
        path.write_bytes(spoil(whole))
        run = _run(project)
        assert run.stdout.split() == ["2", "0"], name
        assert run.stderr.count("CacheWarning: cache: a compiled kernel is cut, damaged, or another's") == 1, name
        again = _run(project)
        assert (again.stdout.split(), again.stderr) == (["2", "1"], ""), name


@pytest.mark.parametrize("ending", [".nbi", ".nbc"])
def test_a_folder_in_a_files_place_is_replaced(project, ending):
    """Numba alone would end in an error."""
    assert _answer(project) == (2, 0)
    (path,) = _kept(project, ending)
    path.unlink()
    path.mkdir()
    (path / "x").write_text("")
    run = _run(project)
    assert run.stdout.split() == ["2", "0"]
    assert "a compiled kernel is no plain file" in run.stderr
    assert _answer(project) == (2, 1)


def test_machine_code_of_another_kernel_is_not_run(project):
    """Swapped data files are honest, but under the wrong name."""
    other = CALLER.replace("add", "other").replace("rule(x)", "rule(x) + 100")
    (project / "puncture_twin" / "planning" / "caller.py").write_text(CALLER + other.split("\n\n", 1)[1])
    (project / "both.py").write_text("from puncture_twin.planning.caller import add, other\nprint(add(1), other(1))\n")
    environment = os.environ | {"PYTHONPATH": str(project), "NUMBA_CACHE_DIR": str(project / "cache")}
    command = [sys.executable, str(project / "both.py")]
    options = {"env": environment, "cwd": project, "capture_output": True, "text": True, "check": True}
    assert subprocess.run(command, **options).stdout.split() == ["2", "102"]
    one, two = _kept(project, ".nbc")
    contents = one.read_bytes(), two.read_bytes()
    one.write_bytes(contents[1])
    two.write_bytes(contents[0])
    run = subprocess.run(command, **options)
    assert run.stdout.split() == ["2", "102"]
    assert "CacheWarning" in run.stderr


def test_what_a_function_left_under_older_sources_is_cleared(project):
    """Numba names its files by the function's line: after an edit above, the old ones would stay for ever."""
    assert _answer(project) == (2, 0)
    before = {path.name for ending in (".nbi", ".nbc") for path in _kept(project, ending)}
    (project / "puncture_twin" / "planning" / "caller.py").write_text("# one line more\n" + CALLER)
    assert _answer(project) == (2, 0)
    after = {path.name for ending in (".nbi", ".nbc") for path in _kept(project, ending)}
    assert len(before) == len(after) == 2
    assert not before & after


def test_kernels_of_others_are_left_to_numba(tmp_path):
    """A function outside the project is stamped with its own file."""
    project, other = tmp_path / "project", tmp_path / "other"
    copy_package(project)
    other.mkdir()
    (other / "stranger.py").write_text("import numba as nb\n\n@nb.njit(cache=True)\ndef f(x):\n    return x\n")
    lines = ("import puncture_twin.planning.base.numba_kernels, stranger", "cache = stranger.f._cache")
    lines += ("print(type(cache._impl.locator).__module__, type(cache._cache_file).__name__)",)
    code = "; ".join(lines)
    environment = os.environ | {"PYTHONPATH": f"{project}{os.pathsep}{other}"}
    run = subprocess.run(
        [sys.executable, "-c", code], env=environment, cwd=other, capture_output=True, text=True, check=True
    )
    assert run.stdout.split() == ["numba.core.caching", "IndexDataCacheFile"]


def test_it_is_known_whether_a_kernel_is_compiled(project):
    """Of today's sources: not before its first call; afterwards in other processes too, until an edit."""
    asked = "from puncture_twin.planning.base.cache.kernel_cache import is_compiled\n"
    asked += "from puncture_twin.planning.caller import add\nprint(is_compiled(add))\n"

    def compiled(then=""):
        return _python(project, asked + then).stdout.split()

    assert compiled() == ["False"]
    assert compiled("add(1); print(is_compiled(add))") == ["False", "True"]
    assert compiled() == ["True"]
    (project / "puncture_twin" / "planning" / "size.py").write_text("SIZE = 1 + 1\n")
    assert compiled() == ["False"]


def test_what_is_kept_is_loaded_without_what_only_compiling_needs(project):
    """Numba's implementations of NumPy stay out until something is compiled, which then takes in what was loaded."""
    (project / "puncture_twin" / "planning" / "caller.py").write_text(
        CALLER.replace("rule(x)", "rule(x) + np.zeros(2).max()").replace("from", "import numpy as np\nfrom", 1)
    )
    loads = (
        "import sys\nfrom puncture_twin.planning.caller import add\nprint(add(1), 'numba.np.arraymath' in sys.modules)"
    )
    assert _python(project, loads).stdout.split() == ["2.0", "True"]
    compiles = "\nimport numba\nprint(numba.njit(lambda x: add(x) + 1)(1), 'numba.np.arraymath' in sys.modules)"
    assert _python(project, loads + compiles).stdout.split() == ["2.0", "False", "3.0", "True"]


@pytest.mark.parametrize("others", [False, True], ids=["ours", "others'"])
def test_bitcode_is_parsed_when_another_kernel_takes_it_in(project, others):
    """A kept kernel answers without; one that is compiled later has it, and answers right."""
    (project / "stranger.py").write_text("import numba\n@numba.njit(cache=True)\ndef add(x):\n    return x + 1\n")
    source = "stranger" if others else "puncture_twin.planning.caller"
    loads = "import puncture_twin.planning.base.numba_kernels, numba\nimport llvmlite.binding as llvm\n"
    loads += "read, real = [], llvm.parse_bitcode\nllvm.parse_bitcode = lambda code: read.append(code) or real(code)\n"
    loads += f"from {source} import add\nprint(add(1), sum(add.stats.cache_hits.values()), len(read))\n"
    takes_in = "numba.njit(lambda x: add(x) + 1)(1)\nprint(numba.njit(lambda x: add(x) * 10)(1), len(read))"
    assert _python(project, loads).stdout.split()[:2] == ["2", "0"]
    assert _python(project, loads + takes_in).stdout.split() == ["2", "1", "0", "20", "1"]


def test_an_edit_between_import_and_first_call_reaches_the_next_process(project):
    """What is compiled is what was imported, and is kept as that."""
    edits = "import pathlib, puncture_twin.planning.callee as callee\nfrom puncture_twin.planning.caller import add\n"
    edits += f"pathlib.Path(callee.__file__).write_text({CALLEE.format(10)!r})\nprint(add(1))"
    assert _python(project, edits).stdout.split() == ["2"]
    assert _answer(project) == (11, 0)


@pytest.mark.parametrize("back", ["before it is compiled", "at the end"])
def test_what_is_loaded_after_an_edit_is_not_kept_as_made_before_it(project, back):
    """Sources are stamped with the first kernel; a later one may be another's, and the edit taken back by then."""
    edit, undo = (f"file.write_text({CALLEE.format(number)!r})\n" for number in (10, 1))
    code = "import pathlib\nimport puncture_twin.planning.base.numba_kernels\n"
    code += "from puncture_twin.planning import first\n"
    code += "file = pathlib.Path(first.__file__).with_name('callee.py')\n"
    code += edit + "from puncture_twin.planning.caller import add\n"
    code += undo + "print(add(1))" if back == "before it is compiled" else "print(add(1))\n" + undo
    first = CALLEE.format(1).replace("rule", "other").replace("* SIZE", "")
    (project / "puncture_twin" / "planning" / "first.py").write_text(first)
    assert _python(project, code).stdout.split() == ["11"]
    assert _answer(project) == (2, 0)


@pytest.mark.parametrize(
    "way", ["import puncture_twin.planning.callee as room", "from puncture_twin.planning import callee as room"]
)
def test_a_kernel_taken_in_as_an_attribute_counts_too(project, way):
    """No import names it."""
    caller = CALLER.replace(
        "from puncture_twin.planning.callee import rule", "import puncture_twin.planning.hall as hall"
    )
    (project / "puncture_twin" / "planning" / "hall.py").write_text(f"{way}\nrule = room.rule\n")
    (project / "puncture_twin" / "planning" / "caller.py").write_text(caller.replace("rule(x)", "hall.rule(x)"))
    assert _answer(project) == (2, 0)
    (project / "puncture_twin" / "planning" / "callee.py").write_text(CALLEE.format(10))
    assert _answer(project) == (11, 0)


def test_a_users_place_for_compiled_code_stays_in_force(project):
    """Numba's setting of locators decides where kernels lie, not what they are stamped with."""
    place = "from numba.core import config\nconfig.CACHE_LOCATOR_CLASSES = 'InTreeCacheLocator'\n"
    asked = place + "from puncture_twin.planning.caller import add\nprint(add(1), sum(add.stats.cache_hits.values()))"
    assert _python(project, asked).stdout.split() == ["2", "0"]
    assert not (project / "cache").exists()
    assert list((project / "puncture_twin" / "planning" / "__pycache__").glob("caller.add*.nbc"))
    assert _python(project, asked).stdout.split() == ["2", "1"]
    (project / "puncture_twin" / "planning" / "size.py").write_text("SIZE = 1 + 1\n")
    assert _python(project, asked).stdout.split() == ["3", "0"]
