"""Where the time of a whole ``search`` goes, cold and warm: ``python benchmarks/stages.py --arm``.

The cases are the real CT with the labels of version 2, where that is on this machine, and the abdomen phantom. Cold: an
empty cache folder (surfaces are made, and lightened for the page). Warm: the same command again, the median of
``--times``. Compiled code is there in both. Beside the wall time stands the processors' time, which other work on the
machine changes less; ``start and end`` is what no stage counts, above all the imports.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a script, beside the package

from puncture_twin.planning.base.cache.array_cache import FOLDER_VARIABLE
from puncture_twin.planning.case.case import load_case

REPOSITORY = Path(__file__).resolve().parents[1]
DATA = REPOSITORY.parent / "shared" / "data" / "totalseg_abdomen_3mm"


SHOWN = ("map", "scene", "page")
"""The stages that draw."""


def cases(folder: Path) -> list[Path]:
    """The case files; the real CT's with its data beside it."""
    phantom = REPOSITORY / "meshes" / "abdomen"
    if not DATA.is_dir():
        print(f"the real CT is not on this machine ({DATA.name}): the phantom alone")
        return [phantom]
    for file in (REPOSITORY / "tests" / "real").iterdir():
        shutil.copy(file, folder)
    for file in DATA.glob("*.nii.gz"):
        (folder / file.name).symlink_to(file)
    return [folder / "case_v2.toml", phantom]


def whole(case: Path, out: Path, cache: Path, options: list[str]) -> dict[str, float]:
    """Seconds of each stage of one ``search`` in a new process, and the processors' seconds of all of it."""
    environment = os.environ | {FOLDER_VARIABLE: str(cache)}
    command = [sys.executable, "run_twin.py", "search", str(case), "--out", str(out), "--json", *options]
    start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(command, cwd=REPOSITORY, env=environment, capture_output=True, text=True, check=False)
    took, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode > 1:
        raise SystemExit(done.stderr)
    stages: dict[str, float] = json.loads(done.stdout)["seconds"]
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    drawing = sum(stages.get(stage, 0.0) for stage in SHOWN)
    rest = {"start and end": took - sum(stages.values()), "all": took, "all, processors' time": used}
    return {**stages, **rest, "drawing / search": drawing / stages["search"]}


def report(case: Path, folder: Path, options: list[str], times: int) -> None:
    """The table of one case."""
    name = load_case(case).name
    runs = [whole(case, folder / "out", folder / f"cache-{name}", options) for _ in range(1 + times)]
    cold, warm = runs[0], {stage: median(run.get(stage, 0.0) for run in runs[1:]) for stage in runs[0]}
    print(f"\n{name}; load of the machine {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors")
    print("| stage | cold, s | warm, s | of warm |\n|---|---|---|---|")
    for stage in cold:
        share = "" if stage == "drawing / search" else f"{100 * warm[stage] / warm['all']:.0f} %"
        print(f"| {stage} | {cold[stage]:.2f} | {warm[stage]:.2f} | {share} |")


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arm", action="store_true", help="ask the arm too")
    parser.add_argument("--certify", action="store_true", help="certify the map to 0.25 degrees too")
    parser.add_argument("--case", type=Path, help="another case")
    parser.add_argument("--times", type=int, default=3, help="warm runs")
    chosen = parser.parse_args()
    options = [*([] if chosen.arm else ["--no-arm"]), *(["--certify"] if chosen.certify else [])]
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        chosen_cases = [chosen.case.resolve()] if chosen.case else cases(folder)
        whole(REPOSITORY / "meshes" / "carton" / "case_m.toml", folder / "warm-up", folder / "other", options)
        for case in chosen_cases:
            report(case, folder, options, chosen.times)


if __name__ == "__main__":
    main()
