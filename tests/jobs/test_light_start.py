"""What the command line loads before a command starts."""

import subprocess
import sys

import pytest
from places import ROOT

HEAVY = {"numba", "trimesh", "matplotlib", "scipy", "numpy", "pybullet", "pyarrow", "fcl", "ompl"}

CODE = f"""
import sys
from puncture_twin.run_twin import main
code = main(sys.argv[1:])
print(sorted({HEAVY!r} & set(sys.modules)), code)
"""


def loaded(*arguments):
    """The heavy libraries that a command line loads, and its exit code."""
    done = subprocess.run(
        [sys.executable, "-c", CODE, *arguments], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return done.stdout.splitlines()[-1]


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["rehearse", "--help"], 0),
        (["search", "case.toml", "--certify-size", "0"], 2),
        (["demo", "--out", "run_twin.py"], 2),
    ],
    ids=lambda value: "_".join(value) if isinstance(value, list) else None,
)
def test_help_and_a_wrong_argument_load_no_library_of_numbers(arguments, code):
    assert loaded(*arguments) == f"[] {code}"


SEARCH = """
import sys
sys.argv = ["run_twin.py", "search", {case!r}, "--no-arm", *{options!r}, "--out", {out!r}]
from puncture_twin import run_twin
code = run_twin.main(sys.argv[1:])
print(sorted({unused!r} & set(sys.modules)), code)
"""

UNUSED = {"matplotlib", "ompl", "networkx", "trimesh", "scipy.stats", "scipy.ndimage", "jinja2", "plotly", "pybullet"}
"""What organs' clearance alone needs none of."""


def test_a_search_without_arm_and_pictures_loads_no_library_that_it_does_not_use(tmp_path):
    """The embedded carton; each of these costs a tenth of a second to half of one."""
    assert left_loaded(tmp_path, ["--no-pictures"], UNUSED) == "[] 0"


def test_a_check_of_one_candidate_loads_no_writer_of_tables():
    case = ["check", str(ROOT / "meshes" / "abdomen"), "--theta", "64", "--beta", "98"]
    code = f"import sys\nfrom puncture_twin import run_twin\ncode = run_twin.main({case!r})\n"
    said = code + "print(sorted({'pyarrow', 'matplotlib', 'plotly'} & set(sys.modules)), code)"
    done = subprocess.run([sys.executable, "-c", said], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[] 0"


def test_pictures_are_drawn_without_the_state_of_pyplot(tmp_path):
    """No window system is asked for, and nothing is drawn that another part of a program has set up."""
    assert left_loaded(tmp_path, [], {"matplotlib.pyplot", "plotly"}) == "[] 0"
    assert {path.name for path in (tmp_path / "out").iterdir()} >= {"map.png", "scene.png", "slices.png", "report.html"}


def left_loaded(folder, options, unused):
    """Which modules of some a search of the carton has loaded at its end, and its exit code."""
    case, out = str(ROOT / "meshes/carton/case_m.toml"), str(folder / "out")
    code = SEARCH.format(case=case, out=out, options=options, unused=unused)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.splitlines()[-1]
