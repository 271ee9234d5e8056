"""What is built of a tree, however it came here: the same package, whole."""

import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
from places import ROOT
from walls.house import PARTS, modules


def contents(wheel):
    with zipfile.ZipFile(wheel) as files:
        return {name: files.read(name) for name in files.namelist()}


def install(wheel, target):
    place = ["--no-deps", "--no-index", "--no-compile", "--quiet", "--target", str(target)]
    subprocess.run([sys.executable, "-m", "pip", "install", *place, str(wheel)], check=True)


def built(tree, target, out):
    words = ["-m", "hatchling", "build", "--target", target, "--directory", str(out)]
    done = subprocess.run([sys.executable, *words], cwd=tree, capture_output=True, text=True, check=False)
    return done.stderr.splitlines()[-1] if done.returncode else next(Path(out).iterdir())


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory):
    here = tmp_path_factory.mktemp("archive")
    with tarfile.open(built(ROOT, "sdist", here)) as archive:
        archive.extractall(here, filter="data")
    (tree,) = (path for path in here.iterdir() if path.is_dir())
    return tree


@pytest.fixture(scope="module")
def wheel(unpacked, tmp_path_factory):
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
print(len(missing), main(["schema"]), main(["check", "puncture_twin/meshes/carton/case_h.toml", "--theta", "nan"]))
"""


def test_an_installed_package_finds_all_of_itself_and_runs(wheel, tmp_path):
    """No module is missing or another's, from one that prints to one that refuses."""
    install(wheel, tmp_path)
    code = LOOK.format(names=sorted(modules()), place=str(tmp_path))
    run = subprocess.run(
        [sys.executable, "-P", "-c", code],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert run.stdout.splitlines()[-1] == "0 0 2", run


WRONG = {
    "a folder is missing": lambda tree: shutil.rmtree(tree / "meshes"),
    "a file is left out": lambda tree: (tree / ".gitignore").write_text("api.py\n"),
}
"""What a tree, or a build's rules, may be: to a function that makes them so."""


@pytest.mark.parametrize("wrong", WRONG)
def test_a_build_that_is_not_whole_is_an_error(wrong, unpacked, tmp_path):
    tree = shutil.copytree(unpacked, tmp_path / "tree")
    WRONG[wrong](tree)
    assert "missing" in (said := built(tree, "wheel", tmp_path / "out")) or "not found" in said
