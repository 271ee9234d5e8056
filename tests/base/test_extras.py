"""What is installed by itself is enough for planner, map and page; what needs more says so."""

import subprocess
import sys
from pathlib import Path

import pytest
from refusals import refused
from walls.house import modules

from puncture_twin.planning.base import errors as extras
from puncture_twin.planning.base.errors import MODULES, require_extra
from puncture_twin.run_twin import main

ROOT = Path(__file__).parents[2]


IMPORT_ALL = """
import importlib, sys
for name in {missing!r}:
    sys.modules[name] = None  # as if it were not installed
for name in {modules!r}:
    importlib.import_module(name)
"""


def test_planner_map_and_page_need_no_extra():
    """All of the planner, and what searches, plans, exports, draws and reads touches, is imported without any extra."""
    missing = [*MODULES["twin"], *MODULES["mirror"], "SimpleITK", "pytest", "gdcm", "h5py"]
    rooms = tuple(f"puncture_twin.{room}." for room in ("planning", "twin.report", "twin.jobs.patient"))
    rehearsing = ("twin.jobs.patient.rehearsed", "twin.jobs.patient.guidance_job")
    others = ("planning.collision_cases", "twin.report.scene.film", *rehearsing)
    names = [name for name in modules() if name.startswith((*rooms, "puncture_twin.twin.jobs.experiment.pivot_job"))]
    names = [name for name in names if not name.startswith(tuple(f"puncture_twin.{other}" for other in others))]
    assert len(names) > 200
    code = IMPORT_ALL.format(missing=missing, modules=["puncture_twin.run_twin", *names])
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


def test_a_missing_extra_is_one_line(monkeypatch, capsys):
    """A command that needs it names it, says how to get it, and ends with exit code 2 before it does anything."""
    monkeypatch.setattr("puncture_twin.planning.base.errors.find_spec", lambda name: None)
    for arguments in (["rehearse", "nowhere"], ["servo", "nowhere"], ["selfcal"], ["reproduce", "chen2019"]):
        assert main(arguments) == 2
        (told,) = capsys.readouterr().err.splitlines()
        assert told.startswith(f"{arguments[0]}: it needs the extra 'twin', which is not installed (no pybullet")
        assert told.endswith(f"allowed: pip install --editable '{ROOT}[twin]'")


@pytest.mark.parametrize("extra", MODULES)
def test_no_message_names_an_index(extra, monkeypatch, tmp_path):
    """Installed from a folder or a file, it is that one; and pip knows the words after it as an extra's."""
    monkeypatch.setattr(extras, "find_spec", lambda name: None)
    monkeypatch.setattr(extras.sys, "version_info", (3, 11, 0))
    monkeypatch.setattr(extras, "__file__", str(tmp_path / "puncture_twin" / "planning" / "base" / "extras.py"))
    folder = tmp_path / "puncture_twin-0.1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Name: puncture-twin\nVersion: 0.1.0\n")
    monkeypatch.syspath_prepend(tmp_path)
    for told, named in (("{}", "FOLDER"), ('{"url": "file:///home/me/twin"}', "/home/me/twin")):
        (folder / "direct_url.json").write_text(told)
        with refused("missing_extra") as caught:
            require_extra(extra, "here")
        assert f"pip install '{named}[{extra}]'" in str(caught.value)


def test_what_has_no_wheel_is_named_by_itself(monkeypatch):
    """The extra leaves it out there: to install that again would change nothing."""
    monkeypatch.setattr(extras, "find_spec", lambda name: None if name == "pybullet" else name)
    monkeypatch.setattr(extras.sys, "version_info", (3, 13, 0))
    with refused("missing_extra"):
        require_extra("twin", "demo")
