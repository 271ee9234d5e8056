"""What the command line loads before a command starts."""

import subprocess
import sys

from places import ROOT

HEAVY = {"numba", "trimesh", "matplotlib", "scipy", "numpy", "pybullet", "pyarrow", "fcl", "ompl"}

COMMANDS = (["rehearse", "--help"], ["search", "case.toml", "--certify-size", "0"], ["demo", "--out", "run_twin.py"])
CODE = f"""
import sys
from puncture_twin.run_twin import main
for command in {COMMANDS!r}:
    code = main(command)
    print(sorted({HEAVY!r} & set(sys.modules)), code)
"""


def test_help_and_a_wrong_argument_load_no_library_of_numbers():
    done = subprocess.run([sys.executable, "-c", CODE], cwd=ROOT, capture_output=True, text=True, check=True)
    assert [line for line in done.stdout.splitlines() if line.startswith("[")][-3:] == ["[] 0", "[] 2", "[] 2"]


UNUSED = {"matplotlib", "ompl", "networkx", "trimesh", "scipy.stats", "scipy.ndimage", "jinja2", "plotly", "pybullet"}
"""What organs' clearance alone needs none of: each costs a tenth of a second to half of one."""
SEARCH = ["search", str(ROOT / "meshes/carton/case_m.toml"), "--no-arm"]


def left_loaded(arguments, unused):
    """Which modules of some a command has loaded at its end, and its exit code."""
    code = f"import sys\nfrom puncture_twin import run_twin\ncode = run_twin.main({[*map(str, arguments)]!r})\n"
    said = code + f"print(sorted({unused!r} & set(sys.modules)), code)"
    done = subprocess.run([sys.executable, "-c", said], cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.splitlines()[-1]


def test_a_search_without_arm_and_pictures_loads_no_library_that_it_does_not_use(tmp_path):
    assert left_loaded([*SEARCH, "--no-pictures", "--out", tmp_path / "out"], UNUSED) == "[] 0"


def test_a_check_of_one_candidate_loads_no_writer_of_tables():
    check = ["check", ROOT / "meshes/abdomen", "--theta", 64, "--beta", 98]
    assert left_loaded(check, {"pyarrow", "matplotlib", "plotly"}) == "[] 0"


def test_pictures_are_drawn_without_the_state_of_pyplot(tmp_path):
    """No window system is asked for, and nothing is drawn that another part of a program has set up."""
    assert left_loaded([*SEARCH, "--out", tmp_path / "out"], {"matplotlib.pyplot", "plotly"}) == "[] 0"
    assert {path.name for path in (tmp_path / "out").iterdir()} >= {"map.png", "scene.png", "slices.png", "report.html"}
