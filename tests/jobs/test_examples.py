"""The examples run as they are printed, in an empty folder, and say something."""

import os
import subprocess
import sys

import pytest
from places import ROOT

EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
SAYS = {
    "01": "rejected",
    "02": "is expected there",
    "03": "safe for the organs",
    "04": "the tip ended",
    "05": "verified",
    "06": "# checked against its case",
}


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs_and_says_its_answer(path, tmp_path):
    """A process of its own, as a reader would start it."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    options = {"cwd": tmp_path, "env": environment, "capture_output": True, "text": True}
    run = subprocess.run([sys.executable, str(path)], **options)
    assert run.returncode == 0, run.stderr
    assert SAYS[path.name[:2]] in run.stdout
    assert list(tmp_path.iterdir()) == []


def test_every_example_is_short_and_says_how_it_is_started():
    """20 to 50 lines, numbered from 01 on, with a usage line."""
    assert [path.name[:2] for path in EXAMPLES] == [f"{number:02d}" for number in range(1, len(EXAMPLES) + 1)]
    for path in EXAMPLES:
        text = path.read_text(encoding="utf-8")
        assert 20 <= len(text.splitlines()) <= 50, path.name
        assert f"python examples/{path.name}" in text
