"""The wheels that are built: the plain one, and the one that brings machine code, as pip installs them."""

import base64
import csv
import hashlib
import subprocess
import sys
import zipfile

import pytest
from base.test_brought_kernels import OWN, PLAINEST, begin, end, kept

from benchmarks.build_wheels import build
from puncture_twin.planning.base.cache.brought_kernels import BROUGHT, classes_of
from puncture_twin.planning.base.cache.kernel_cache import host_features

DRAW = """
import numba, numpy as np
from puncture_twin.twin.report.canvas.canvas import Canvas
canvas = Canvas(8, 8)
canvas.fill(np.array([(1.0, 1.0), (6.0, 1.0), (1.0, 6.0)]), (0, 0, 0))
print(canvas.pixels.sum(), numba.core.config.CPU_NAME)
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
    place = ["--no-deps", "--no-index", "--no-compile", "--quiet", "--target", str(tmp_path)]
    subprocess.run([sys.executable, "-m", "pip", "install", *place, str(wheels[which])], check=True)
    said, _ = end(begin(tmp_path, DRAW))
    assert said.split()[1] == (OWN, PLAINEST)[which]
    assert said.split()[0] == end(begin(tmp_path, DRAW, NUMBA_DISABLE_JIT="1"))[0].split()[0]
    assert bool(kept(tmp_path)) == (which == 0)
