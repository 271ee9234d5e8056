"""What many tests share."""

import gc
import json
import os
from importlib.util import find_spec

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy comes, as the command line does

import numpy as np
import pytest
from hypothesis import settings
from slow_tests import listed, names_of, plugins

settings.register_profile("shared machine", deadline=None)  # the first call of compiled code takes seconds
settings.load_profile("shared machine")

LONG_S = 1e6
"""No test takes so long."""
LOOK_EVERY = 50_000
"""Objects after which Python looks for circles of them. Thousands of tests and their modules stay until the end; to
look through them after every 700 took a sixth of the time to collect them."""


def pytest_configure(config):
    """Measure what tests take, where that is wanted."""
    gc.set_threshold(LOOK_EVERY, 50, 50)
    for plugin in plugins():
        config.pluginmanager.register(plugin)


def pytest_collection_modifyitems(items):
    """Mark what is slow, as measured, and what skips where real data is absent."""
    slow = listed()
    for item in items:
        if not slow.isdisjoint(names_of(item)):
            item.add_marker(pytest.mark.slow)
        if any("not on this machine" in mark.kwargs.get("reason", "") for mark in item.iter_markers("skipif")):
            item.add_marker(pytest.mark.real)


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    """Where PyBullet is not installed (no wheel after Python 3.11), what needs the simulator skips, by name."""
    report = yield
    if report.outcome == "failed" and "No module named 'pybullet'" in str(report.longrepr):
        report.outcome, report.longrepr = "skipped", (str(collector.path), 0, "Skipped: PyBullet is not installed")
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    """So does a test that comes to a command which needs it: what that answers is the subject of `test_extras`."""
    report = yield
    if report.failed and find_spec("pybullet") is None:
        said = f"{report.longrepr}{report.capstdout}{report.capstderr}"
        if "needs the extra 'twin'" in said or "No module named 'pybullet'" in said:
            report.outcome, report.longrepr = "skipped", (str(item.path), 0, "Skipped: PyBullet is not installed")
    return report


@pytest.fixture
def rng():
    return np.random.default_rng(20191104)


@pytest.fixture
def run(capfd):
    """A function: a command with --json; its exit code, and the one object on stdout, or None."""
    from puncture_twin.run_twin import main

    def answer(*arguments):
        capfd.readouterr()
        code = main([*map(str, arguments), "--json"])
        out = capfd.readouterr().out
        return code, json.loads(out) if out else None

    return answer


@pytest.fixture(scope="session")
def ball():
    """A function: a closed, fine sphere (320 triangles for 2 subdivisions)."""
    import trimesh  # here: the process that hands out tests needs none, and waits a second for it

    from puncture_twin.planning.geometry.mesh import TriangleMesh

    def make(radius, center=(0, 0, 0), subdivisions=3):
        mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
        return TriangleMesh(mesh.vertices + np.asarray(center), mesh.faces)

    return make


@pytest.fixture(scope="session")
def box():
    """A function: a closed box of 12 triangles."""
    import trimesh

    from puncture_twin.planning.geometry.mesh import TriangleMesh

    def make(size, center=(0, 0, 0)):
        mesh = trimesh.creation.box(extents=size)
        return TriangleMesh(mesh.vertices + np.asarray(center), mesh.faces)

    return make


@pytest.fixture(autouse=True, scope="session")
def own_cache(tmp_path_factory):
    """Tests neither see nor fill the user's cache; all processes of a run share one, as those of a user do."""
    run = tmp_path_factory.getbasetemp()
    shared = (run.parent if "PYTEST_XDIST_WORKER" in os.environ else run) / "cache"
    shared.mkdir(mode=0o700, exist_ok=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PUNCTURE_TWIN_CACHE", str(shared))
        yield


@pytest.fixture(autouse=True, scope="session")
def no_progress_lines():
    """A slow machine's progress, a line every few seconds, would stand among what commands are expected to say."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("puncture_twin.twin.report.progress.LINE_EVERY_S", LONG_S)
        yield
