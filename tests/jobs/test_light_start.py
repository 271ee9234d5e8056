"""What the command line loads before a command starts, and what a command loads that it does not use."""

import subprocess
import sys

from places import ROOT

NUMBERS = {"numba", "trimesh", "matplotlib", "scipy", "numpy", "pybullet", "pyarrow", "fcl", "ompl"}
UNUSED = {"matplotlib", "ompl", "networkx", "trimesh", "scipy.stats", "scipy.ndimage", "jinja2", "plotly", "pybullet"}
"""What organs' clearance alone needs none of: each costs a tenth of a second to half of one."""
SEARCH = ["search", str(ROOT / "meshes/carton/case_m.toml"), "--no-arm", "--out"]
CHECK = ["check", str(ROOT / "meshes/abdomen"), "--theta", "64", "--beta", "98"]


def left_loaded(*asked):
    """Of commands one after another in a new process, each with some modules: its exit code, and which are loaded."""
    code = "import sys\nfrom puncture_twin.run_twin import main\n"
    for words, unused in asked:
        code += f"code = main({[*map(str, words)]!r})\nprint('LOADED', code, *sorted({unused!r} & set(sys.modules)))\n"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    return [line for line in done.stdout.splitlines() if line.startswith("LOADED ")]


def test_a_command_loads_no_library_that_it_does_not_use(tmp_path):
    """Help and a wrong argument none of numbers; a search none of the arm and pictures that nobody asked it for.

    A check of one direction none that writes tables. With pictures no window system is asked for, and nothing is drawn
    that another part of a program has set up.
    """
    assert left_loaded(
        (["rehearse", "--help"], NUMBERS),
        (["search", "case.toml", "--certify-size", "0"], NUMBERS),
        (["demo", "--out", "run_twin.py"], NUMBERS),
        ([*SEARCH, tmp_path / "table", "--no-pictures"], UNUSED),
        ([*SEARCH, tmp_path / "out"], {"matplotlib.pyplot", "plotly"}),
    ) == ["LOADED 0", "LOADED 2", "LOADED 2", "LOADED 0", "LOADED 0"]
    assert {path.name for path in (tmp_path / "out").iterdir()} >= {"map.png", "scene.png", "slices.png", "report.html"}
    assert left_loaded((CHECK, {"pyarrow", "matplotlib", "plotly"})) == ["LOADED 0"]
