"""The examples run as they are printed, in an empty folder, and say something."""

import json
import os
import runpy
import subprocess
import sys

import pytest
from places import ROOT

EXAMPLES = sorted([*(ROOT / "examples").glob("*.py"), *(ROOT / "examples").glob("*.ipynb")])
SAYS = {
    "01": "rejected",
    "02": "touched anew",
    "03": "safe for the organs",
    "04": "the tip ended",
    "05": "verified",
    "06": "# checked against its case",
    "07": "written: report.html",
    "08": "safe directions with wider margins",
    "09": "safe: theta",
}


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs_and_says_its_answer(path, tmp_path, tmp_path_factory):
    environment = os.environ | {"PYTHONPATH": str(ROOT), "TMPDIR": str(tmp_path_factory.mktemp("scratch"))}
    options = {"cwd": tmp_path, "env": environment, "capture_output": True, "text": True}
    runner = [str(ROOT / "tests" / "notebooks.py")] if path.suffix == ".ipynb" else []
    run = subprocess.run([sys.executable, *runner, str(path)], **options)
    assert run.returncode == 0, run.stderr
    assert SAYS[path.name[:2]] in run.stdout
    assert list(tmp_path.iterdir()) == []


def test_every_example_is_short_and_says_how_it_is_started():
    """20 to 50 lines of code, numbered from 01 on, with a usage line or, in a notebook, a headline; no outputs kept."""
    assert [path.name[:2] for path in EXAMPLES] == [f"{number:02d}" for number in range(1, len(EXAMPLES) + 1)]
    for path in EXAMPLES:
        text = path.read_text(encoding="utf-8")
        if path.suffix == ".ipynb":
            cells = json.loads(text)["cells"]
            assert cells[0]["cell_type"] == "markdown" and cells[0]["source"][0].startswith("# ")
            assert [cell for cell in cells if cell.get("outputs") or cell.get("execution_count")] == []
            assert 20 <= sum(len(cell["source"]) for cell in cells if cell["cell_type"] == "code") <= 50
            continue
        assert 20 <= len(text.splitlines()) <= 50, path.name
        assert f"python examples/{path.name}" in text


def test_the_gallery_holds_the_examples_as_they_are():
    gallery = runpy.run_path(str(ROOT / "docs" / "gallery.py"), run_name="gallery")
    assert gallery["PAGE"].read_text(encoding="utf-8") == gallery["gallery"]()
