"""What is built of a tree, however it came here: the same package, whole; and the wheel that brings machine code."""

import base64
import csv
import hashlib
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
from base.test_brought_kernels import OWN, PLAINEST, begin, end, kept
from places import ROOT
from walls.house import PARTS, modules

from benchmarks.build_wheels import build
from puncture_twin.planning.base.cache.brought_kernels import BROUGHT, classes_of
from puncture_twin.planning.base.cache.kernel_cache import host_features

DRAW = """
import numba, numpy as np
from puncture_twin.twin.report.map_view import MapCells
cells = MapCells(np.arange(2), np.array([0.0, 3.0]), np.array([0, 1, 2]), np.array([0.0, 1.0]), 0.5, np.full(2, 0.5))
print(cells.rows(np.array([0.1, 0.9, 3.0]), np.array([0.2, 3.1, 3.0])).sum(), numba.core.config.CPU_NAME)
"""
"""A use of one small kernel: all of them would take minutes."""


@pytest.fixture(scope="module")
def wheels(tmp_path_factory):
    """The plain one, and one with the code that a small use needs, for the plainest class."""
    if PLAINEST not in classes_of(host_features()):
        pytest.skip("this processor is of no class that code is brought for")
    return build(tmp_path_factory.mktemp("wheels"), [("-c", DRAW)], [PLAINEST])


def contents(wheel):
    """The content of every file in a wheel."""
    with zipfile.ZipFile(wheel) as files:
        return {name: files.read(name) for name in files.namelist()}


def test_code_is_all_that_is_added(wheels):
    """The same files, and beside them the code, for one Python and one system."""
    plain, coded = wheels
    assert plain.name.endswith("-py3-none-any.whl")
    assert coded.name.endswith(f"-cp{sys.version_info.major}{sys.version_info.minor}-none-linux_x86_64.whl")
    before, after = contents(plain), contents(coded)
    added = after.keys() - before.keys()
    assert added
    assert all(name.startswith(f"puncture_twin/{BROUGHT.name}/") for name in added)
    assert {name.rpartition(".")[2] for name in added} == {"nbi", "nbc", "txt"}
    changed = {name.rpartition("/")[2] for name, content in before.items() if after.get(name) != content}
    assert changed == {"RECORD", "WHEEL"}


def test_the_code_is_listed_with_its_digest(wheels):
    """RECORD covers it as it covers every module: what pip removes again, and what can be compared."""
    files = contents(wheels[1])
    (record,) = (content.decode() for name, content in files.items() if name.endswith("/RECORD"))
    listed = {name: digest for name, digest, _ in csv.reader(record.splitlines())}
    assert listed.keys() == files.keys()
    for name in (name for name in files if f"/{BROUGHT.name}/" in name):
        digest = base64.urlsafe_b64encode(hashlib.sha256(files[name]).digest()).rstrip(b"=").decode()
        assert listed[name] == f"sha256={digest}", name


@pytest.mark.parametrize("which", [0, 1], ids=["plain", "with code"])
def test_what_pip_installs_works(wheels, which, tmp_path):
    """The plain one compiles for this processor; from the other nothing is compiled; both draw the same."""
    install(wheels[which], tmp_path)
    said, _ = end(begin(tmp_path, DRAW))
    assert said.split()[1] == (OWN, PLAINEST)[which]
    assert said.split()[0] == end(begin(tmp_path, DRAW, NUMBA_DISABLE_JIT="1"))[0].split()[0]
    assert bool(kept(tmp_path)) == (which == 0)


def install(wheel, target):
    """As pip does it, into a folder that was empty."""
    place = ["--no-deps", "--no-index", "--no-compile", "--quiet", "--target", str(target)]
    subprocess.run([sys.executable, "-m", "pip", "install", *place, str(wheel)], check=True)


def built(tree, target, out):
    """What hatchling builds of a tree, as pip asks it to: the file, or the last line of its complaint."""
    words = ["-m", "hatchling", "build", "--target", target, "--directory", str(out)]
    done = subprocess.run([sys.executable, *words], cwd=tree, capture_output=True, text=True, check=False)
    return done.stderr.splitlines()[-1] if done.returncode else next(Path(out).iterdir())


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory):
    """The tree of a source archive: as of a zip, without git and what `make install` makes."""
    here = tmp_path_factory.mktemp("archive")
    with tarfile.open(built(ROOT, "sdist", here)) as archive:
        archive.extractall(here, filter="data")
    (tree,) = (path for path in here.iterdir() if path.is_dir())
    return tree


@pytest.fixture(scope="module")
def wheel(unpacked, tmp_path_factory):
    """The wheel of that tree."""
    return built(unpacked, "wheel", tmp_path_factory.mktemp("wheel"))


def test_the_repository_holds_no_links():
    """A zip, and a checkout on a system that makes text of links, are the same files."""
    listed = subprocess.run(["git", "ls-files", "--stage"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("this is no clone")
    assert [line for line in listed.stdout.splitlines() if line.startswith("120000")] == []


def test_a_wheel_is_the_same_from_a_checkout_and_from_an_archive(wheel, unpacked, tmp_path):
    """Links or none, git or none: every byte; and a tree holds no link."""
    assert not any(path.is_symlink() for path in unpacked.rglob("*"))
    assert contents(built(ROOT, "wheel", tmp_path)) == contents(wheel)


def test_every_file_of_the_product_is_in_the_wheel_once(wheel):
    """By the tree itself: what is beside the modules too."""
    parts = [path for part in PARTS for path in (ROOT / part).rglob("*") if path.is_file()]
    names = [path.relative_to(ROOT).as_posix() for path in parts if "__pycache__" not in path.parts]
    own = ("__init__.py", "__init__.pyi", "__main__.py", "api.py", "py.typed", "run_twin.py")
    with zipfile.ZipFile(wheel) as files:
        held = [name for name in files.namelist() if ".dist-info/" not in name]
    assert sorted(held) == sorted(f"puncture_twin/{name}" for name in (*own, *names))


LOOK = """
from importlib.util import find_spec
from puncture_twin.run_twin import main
missing = [name for name in {names} if not find_spec(name).origin.startswith({place!r})]
case = "puncture_twin/meshes/carton/case_h.toml"
print(len(missing), main(["check", case, "--theta", "64", "--beta", "98", "--json"]))
"""


def test_an_installed_package_finds_all_of_itself_and_checks(wheel, tmp_path):
    """No module is missing or another's; kernels that the checkout has compiled are as good here, for sources count."""
    install(wheel, tmp_path)
    for part in PARTS:
        for kernel in (ROOT / part).rglob("__pycache__/*.nb?"):
            place = tmp_path / "puncture_twin" / kernel.relative_to(ROOT)
            place.parent.mkdir(exist_ok=True)
            shutil.copy(kernel, place)
    said, _ = end(begin(tmp_path, LOOK.format(names=sorted(modules()), place=str(tmp_path))))
    assert said.splitlines()[-1] in ("0 0", "0 1"), said


WRONG = {
    "links became text": lambda tree: (shutil.rmtree(tree / "twin"), (tree / "twin").write_text("../twin")),
    "a folder is missing": lambda tree: shutil.rmtree(tree / "meshes"),
    "a file is left out": lambda tree: (tree / ".gitignore").write_text("api.py\n"),
}
"""What a tree, or a build's rules, may be: to a function that makes them so."""


@pytest.mark.parametrize("wrong", WRONG)
def test_a_build_that_is_not_whole_is_an_error(wrong, unpacked, tmp_path):
    """It was a package of three files, and exit code 0."""
    tree = shutil.copytree(unpacked, tmp_path / "tree")
    WRONG[wrong](tree)
    assert "missing" in (said := built(tree, "wheel", tmp_path / "out")) or "not found" in said
