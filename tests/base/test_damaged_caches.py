"""Whatever lies in the caches, a command gives the same answer and says in one line what it made anew."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from case_world import ORGAN, SKIN, case_text, structure, write_balls, write_labels
from places import ROOT

from puncture_twin.planning.base.numba_kernels import nb

CASE = case_text(
    SKIN,
    ORGAN,
    structure("vessel", "avoid", {"labelmap": "labels.nii.gz", "label": 3}),
    name="kept",
    search="theta_deg = [0, 20]\nstep_deg = 10.0",
)


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    here = tmp_path_factory.mktemp("kept")
    write_balls(here, "skin", "organ")
    labels = np.zeros((100, 100, 100), np.uint8)
    labels[48:52, 28:32, 48:52] = 3
    write_labels(here / "labels.nii.gz", labels)
    (here / "case.toml").write_text(CASE)
    shutil.copytree(nb.config.CACHE_DIR, here / "kernels" / Path(nb.config.CACHE_DIR).name)
    return here


def search(world: Path) -> tuple[dict[str, object], list[str]]:
    folders = {"NUMBA_CACHE_DIR": str(world / "kernels"), "PUNCTURE_TWIN_CACHE": str(world / "surfaces")}
    options = ["--no-arm", "--no-pictures", "--json", "--out", str(world / "out")]
    root = ROOT
    command = [sys.executable, str(root / "run_twin.py"), "search", str(world), *options]
    environment = os.environ | folders | {"PYTHONPATH": str(root)}
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert run.returncode in (0, 1), run.stderr
    found = json.loads(run.stdout)
    del found["seconds"]
    return found, [line for line in run.stderr.splitlines() if "cache" in line or "Error" in line]


def damage(folder: Path, ending: str, every: int = 1) -> int:
    files = sorted(path for path in folder.rglob("*") if path.name.endswith(ending))[::every]
    for path in files:
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2].rstrip(b"."))
    return len(files)


def test_a_search_survives_damage_of_what_is_kept(world: Path) -> None:
    """Kernels and surfaces cut in half: no error, the same numbers, a line for each kind, and then silence again."""
    first, said = search(world)
    assert said == []
    assert damage(world / "kernels", ".nbi", every=60) > 1
    assert damage(world / "kernels", ".nbc", every=60) > 1
    assert damage(world / "surfaces", ".arrays") > 0
    again, said = search(world)
    assert again == first
    assert sorted(said) == [
        "note: cache: a compiled kernel is cut or damaged; it is compiled again and replaced",
        "note: cache: a stored result is truncated, damaged, or foreign; it is computed again and replaced",
    ]
    assert search(world) == (first, [])
