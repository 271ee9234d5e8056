"""How well markers and a needle are found again in the virtual CT: ``python -m benchmarks.virtual_ct [--scans N]``.

Pixels of 0.7 mm, noise of 20 HU; 240 markers a row (six a scan), and a needle a scan, anywhere in their cells.
"""

from pathlib import Path

import numpy as np

from benchmarks.shared import options
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.formats.points import NamedPoints
from puncture_twin.planning.formats.volumes.volume_files import Volume
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid
from puncture_twin.twin.guidance.ct.markers import find_markers
from puncture_twin.twin.guidance.ct.needle import find_needle
from puncture_twin.twin.plant.scanner.image import ScanSettings, Solid, ball, box, rod, scan_solids

PIXEL_MM = 0.7
METAL_HU = 8000.0
BLOCK = Solid("block", box(np.zeros(3), np.array([90.0, 60.0, 130.0])), 20.0)


def scanned(solids: list[Solid], spacing: float, size: Floats, centre: Floats, rng: np.random.Generator) -> Volume:
    """A scan about a place, whose grid falls anywhere."""
    cell = np.array([PIXEL_MM, PIXEL_MM, spacing])
    T = np.diag([*cell, 1.0])
    T[:3, 3] = centre - size / 2 + rng.uniform(0, 1, 3) * cell
    shape = tuple(int(n) for n in size / cell)
    image = scan_solids(solids, VolumeGrid(shape, T, {}), ScanSettings(spacing, PIXEL_MM), rng)
    return Volume(image.hu, T, Path("scan"))


def markers(kind: str, spacing: float, scans: int) -> str:
    """Markers of 8 mm on the front of a block (discs 1.5 mm thick), each anywhere in its cell."""
    fine, rule, rng = [], [], np.random.default_rng(20191104)
    for _ in range(scans):
        places = np.array([(x, -30.0, z) for x in (-20.0, 20.0) for z in (-35.0, 0.0, 35.0)])
        places += rng.uniform(-0.5, 0.5, (6, 3)) * [PIXEL_MM, 0.0, spacing]
        half = np.array([0.0, 0.75, 0.0])
        shapes = [rod(p - half, p + half, 8.0) if kind == "disc" else ball(p, 8.0) for p in places]
        solids = [BLOCK, *(Solid("marker", shape, METAL_HU) for shape in shapes)]
        volume = scanned(solids, spacing, np.array([66.0, 40.0, 110.0]), np.array([0.0, -30.0, 0.0]), rng)
        found = find_markers(volume, NamedPoints(tuple("abcdef"), places + 2.0, None))
        fine.append(found.fine.points - places)
        rule.append(found.rule.points - places)
    fine_mm, rule_mm = np.concatenate(fine), np.concatenate(rule)
    in_plane = float(np.sqrt(fine_mm[:, :2].var(axis=0).mean()))
    bias = float(np.abs(fine_mm.mean(axis=0)).max())
    return f"{rule_mm[:, 2].std():.2f} | {fine_mm[:, 2].std():.2f}, {in_plane:.3f} | {bias:.2f}"


def needles(spacing: float, scans: int) -> str:
    """A needle of 1.2 mm, 60 mm of it in the image, at any angle within 75 degrees of the front."""
    errors, angles, rng = [], [], np.random.default_rng(7)
    for _ in range(scans):
        theta, beta = rng.uniform(0, np.radians(75)), rng.uniform(0, 2 * np.pi)
        forward = np.array([np.sin(theta) * np.cos(beta), np.cos(theta), np.sin(theta) * np.sin(beta)])
        tip = rng.uniform(-1, 1, 3)
        needle = Solid("needle", rod(tip - 60 * forward, tip, 1.2), METAL_HU)
        volume = scanned([BLOCK, needle], spacing, np.array([110.0, 70.0, 110.0]), np.array([0.0, -10.0, 0.0]), rng)
        found = find_needle(volume, np.zeros(3), 1.2)
        errors.append(float(np.linalg.norm(found.tip_ct - tip)))
        angles.append(float(np.degrees(np.arccos(np.clip(found.forward_ct @ forward, -1, 1)))))
    return f"{np.sqrt(np.mean(np.square(errors))):.2f} mm, {np.sqrt(np.mean(np.square(angles))):.2f} deg"


def main() -> None:
    """Parse, measure, print."""
    scans = options(__doc__, scans=40).scans
    print("| marker, slices | rule, sd along the bed, mm | metal: along the bed, in the plane | largest bias |")
    print("|---|---|---|---|")
    for kind in ("disc", "ball"):
        for spacing in (1.0, 2.0, 3.0, 5.0):
            print(f"| {kind}, {spacing:g} mm | {markers(kind, spacing, scans)} |", flush=True)
    for spacing in (1.0, 2.5, 5.0):
        print(f"needle, slices of {spacing:g} mm: tip, direction (rms) {needles(spacing, scans)}", flush=True)


if __name__ == "__main__":
    main()
