"""Drawn patients with arms, bed and lines, scanned and searched: what is safe, and what it truly passes.

``python -m benchmarks.beside [--first N] [--scenes N]``: a line per scene, then the sums. Anatomy, what lies beside it,
spacing, noise and field of view are drawn by the scene's number.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np

from benchmarks.beside.scene import Asked, judged
from puncture_twin.planning.base.errors import InputError
from puncture_twin.twin.plant.outside_objects import OutsideObjects
from puncture_twin.twin.plant.scanner.image import ScanSettings

ARMS, BEDS = ("beside", "pressed", "across"), ("flat", "curved", "pad", "none")
VOXELS = ((4.0, 3.0, 20.0), (2.5, 2.0, 15.0), (5.0, 4.0, 30.0), (3.0, 3.0, 20.0), (3.0, 2.5, 20.0))
"""Spacing, pixel, noise."""
FIELDS = (None, None, 420.0, 340.0)
LENGTH_MM = 160.0
LINES = ("line_", "cable_")


def asked(number: int) -> Asked:
    """The scene of a number."""
    rng = np.random.default_rng([number, 15])
    spacing, pixel, noise = VOXELS[rng.integers(len(VOXELS))]
    beside = OutsideObjects(ARMS[number % 3], BEDS[rng.integers(len(BEDS))], int(rng.integers(0, 5)))
    fov = FIELDS[rng.integers(len(FIELDS))]
    return Asked(number, beside, ScanSettings(spacing, pixel, noise, seed=number, fov_mm=fov, length_mm=LENGTH_MM))


def main() -> int:
    """Exit code 1 where a safe needle passes something by more than a voxel's diagonal."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.beside", description=__doc__)
    parser.add_argument("--first", type=int, default=1000)
    parser.add_argument("--scenes", type=int, default=30)
    options = parser.parse_args()
    sums: Counter[str] = Counter()
    for number in range(options.first, options.first + options.scenes):
        with tempfile.TemporaryDirectory() as name:
            sums += _scene(Path(name), asked(number))
    print(", ".join(f"{what}: {count}" for what, count in sums.items()))
    return int(sums["wrong"] > 0)


def _scene(folder: Path, one: Asked) -> Counter[str]:
    told = f"{one.seed} {one.beside.arms}, {one.beside.bed}, {one.beside.lines} lines, {one.settings.spacing_mm:g} mm"
    try:
        scene = judged(folder, one)
    except InputError as error:
        print(f"{told}: refused: {error}", flush=True)
        return Counter(scenes=1, refused=1)
    voxel = scene.voxel_mm
    bodies = [p for p in scene.passed if not p.part.startswith(LINES)]
    missed = {p.row for p in scene.blind if not p.part.startswith(LINES) and p.deepest_mm > voxel}
    wrong = {p.row for p in scene.passed if p.deepest_mm > voxel}
    short = max(scene.lacks.values(), default=0.0)
    deepest = max((p.deepest_mm for p in bodies), default=0.0)
    through = {p.row for p in scene.passed if p.part.startswith(LINES)}
    safe = int(scene.found.safe.sum())
    print(
        f"{told}, diagonal {voxel:.1f} mm: {safe} safe; into arms or bed {deepest:.1f} mm; "
        f"margins lack {short:.1f} mm; through lines {len(through)}; without the CT {len(missed)} wrong",
        flush=True,
    )
    counts = {
        "scenes": 1,
        "safe": safe,
        "wrong": len(wrong) + int(short > voxel),
        "grazing": len({p.row for p in bodies}),
    }
    return Counter({**counts, "through lines": len(through), "wrong without the CT": len(missed)})


if __name__ == "__main__":
    sys.exit(main())
