"""The examples run in an empty folder, and say something."""

import json
import runpy
import sys
import tempfile

import notebooks
import pytest
from case_world import coarse_carton
from places import ROOT
from uncertainty_world import ball

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
WITH = {"04": ["{ball}"], "05": ["{carton}", "4"], "06": ["{ball}"]}
"""Of a small case, what takes a quarter of a minute of the embedded ones."""


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs_and_says_its_answer(path, tmp_path, tmp_path_factory, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    cases = tmp_path_factory.mktemp("cases")
    small = {"carton": coarse_carton(cases / "carton"), "ball": ball(cases, errors="touch_mm = 0.2")}
    monkeypatch.setattr(sys, "argv", [str(path), *(word.format(**small) for word in WITH.get(path.name[:2], ()))])
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path_factory.mktemp("scratch")))
    if path.suffix == ".ipynb":
        notebooks.run(path)
    else:
        runpy.run_path(str(path), run_name="__main__")
    assert SAYS[path.name[:2]] in capfd.readouterr().out
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
