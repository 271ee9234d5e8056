"""Where the time of a whole ``search`` goes, cold and warm: ``python benchmarks/stages.py``.

The case is the real CT with the labels of version 2 where that is on this machine, the abdomen phantom otherwise. Cold:
an empty cache folder (meshes and trees are made). Warm: the same command again. Compiled code is there in both.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a script, beside the package

from planning.cache import FOLDER_VARIABLE

REPOSITORY = Path(__file__).resolve().parents[1]
DATA = REPOSITORY.parent / "shared" / "data" / "totalseg_abdomen_3mm"


def place(folder: Path) -> Path:
    """The case file, with its data beside it."""
    if not DATA.is_dir():
        print(f"the real CT is not on this machine ({DATA.name}): the phantom")
        return REPOSITORY / "meshes" / "abdomen"
    for file in (REPOSITORY / "tests" / "real").iterdir():
        shutil.copy(file, folder)
    for file in DATA.glob("*.nii.gz"):
        (folder / file.name).symlink_to(file)
    return folder / "case_v2.toml"


def whole(case: Path, out: Path, cache: Path, options: list[str]) -> dict[str, float]:
    """Seconds of each stage of one ``search`` in a new process; ``start and end`` is what no stage counts."""
    environment = os.environ | {FOLDER_VARIABLE: str(cache)}
    command = [sys.executable, "run_twin.py", "search", str(case), "--out", str(out), "--json", *options]
    start = time.perf_counter()
    done = subprocess.run(command, cwd=REPOSITORY, env=environment, capture_output=True, text=True, check=False)
    took = time.perf_counter() - start
    if done.returncode > 1:
        raise SystemExit(done.stderr)
    stages: dict[str, float] = json.loads(done.stdout)["seconds"]
    return {**stages, "start and end": took - sum(stages.values()), "all": took}


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arm", action="store_true", help="ask the arm too")
    parser.add_argument("--certify", action="store_true", help="certify the map to 0.25 degrees too")
    parser.add_argument("--case", type=Path, help="another case")
    chosen = parser.parse_args()
    options = [*([] if chosen.arm else ["--no-arm"]), *(["--certify"] if chosen.certify else [])]
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        case = chosen.case.resolve() if chosen.case else place(folder)
        whole(REPOSITORY / "meshes" / "carton" / "case_m.toml", folder / "warm-up", folder / "other", options)
        cold, warm = (whole(case, folder / "out", folder / "cache", options) for _ in range(2))
    print("| stage | cold, s | warm, s | of warm |\n|---|---|---|---|")
    for stage in cold:
        again = warm.get(stage, 0.0)
        print(f"| {stage} | {cold[stage]:.2f} | {again:.2f} | {100 * again / warm['all']:.0f} % |")


if __name__ == "__main__":
    main()
