"""What the needle detector finds in B-mode pictures, beside a plainer detector on the same pictures.

    python benchmarks/bmode.py [--pictures N] [--empty N]

Insertions of 20 to 75 degrees from either side, tips anywhere in the picture. The plainer detector is the one of the
specification (background-subtracted brightest 1.5 %, weighted RANSAC line, tip where the cumulated contrast ends, gate
on contrast), as far as its words go.
"""

import argparse
import platform
from importlib.metadata import version
from time import process_time
from typing import NamedTuple

import cv2
import numpy as np

from puncture_twin.twin.guidance.ultrasound.image.needle_detector import (
    Detection,
    DetectorSettings,
    Missed,
    detect,
)
from puncture_twin.twin.guidance.ultrasound.image.probe_image import Imager, NeedleEcho, NeedleInImage, render

IMAGER = Imager()

UNGATED = DetectorSettings(least_score_mm=0.0, least_length_mm=0.0, least_step=-np.inf, sure_step=-np.inf, edge_mm=-1e9)
"""The brightest segment is taken for a needle, whatever it is."""


class Scene(NamedTuple):
    """One row of the table."""

    name: str
    off_plane_mm: float = 0.0
    lean_deg: float = 0.0
    contrast_db: float = 28.0
    needle: bool = True


SCENES = (
    Scene("in the plane"),
    Scene("0.4 mm off the plane", off_plane_mm=0.4),
    Scene("0.8 mm off the plane", off_plane_mm=0.8),
    Scene("leaning 3 deg", lean_deg=3.0),
    Scene("faint (13 dB less)", contrast_db=15.0),
    Scene("no needle", needle=False),
)


def main() -> None:
    """Run all of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pictures", type=int, default=40, help="per scene")
    parser.add_argument("--empty", type=int, default=400, help="pictures without a needle for the gate")
    arguments = parser.parse_args()
    names = ("numpy", "opencv-python-headless", "numba")
    print(platform.processor() or platform.machine(), platform.python_version(), *(f"{n} {version(n)}" for n in names))
    detect(render(IMAGER, None, np.random.default_rng(0)), IMAGER)  # compiled
    print("\nscene                    detector  found     along mm: mean    sd   worst  across sd  angle sd deg   ms")
    for scene in SCENES:
        compare(scene, arguments.pictures)
    gate(arguments.empty)
    bias(max(10, arguments.pictures // 2))


def draw_needle(rng: np.random.Generator, scene: Scene) -> NeedleInImage:
    """A needle somewhere in the picture."""
    steep, lean, side = np.radians(rng.uniform(20, 75)), np.radians(scene.lean_deg), rng.choice([-1.0, 1.0])
    direction = np.array([side * np.cos(steep) * np.cos(lean), np.sin(steep) * np.cos(lean), np.sin(lean)])
    return NeedleInImage(np.array([rng.uniform(12, 38), rng.uniform(15, 52), scene.off_plane_mm]), direction)


def compare(scene: Scene, count: int) -> None:
    """Both detectors on the same pictures."""
    rng, chance = np.random.default_rng(2023), np.random.default_rng(7)
    needles = [draw_needle(rng, scene) for _ in range(count)]
    echo = NeedleEcho(contrast_db=scene.contrast_db)
    pictures = [render(IMAGER, needle if scene.needle else None, rng, echo=echo) for needle in needles]
    for name, detector in (("ours", lambda p: detect(p, IMAGER)), ("plainer", lambda p: plainer(p, chance))):
        begin = process_time()
        found = [detector(picture) for picture in pictures]
        ms = 1e3 * (process_time() - begin) / count
        pairs = [(a, b) for a, b in zip(found, needles, strict=True) if isinstance(a, Detection)]
        errors = np.array([error(a, b) for a, b in pairs]).reshape(-1, 3)
        row = f"{scene.name:24s} {name:8s} {len(errors):3d}/{count}"
        if len(errors):
            along, across, angle = errors.T
            row += f"{along.mean():17.2f} {along.std():8.2f} {np.abs(along).max():6.1f} {across.std():9.3f}"
            row += f" {np.degrees(angle).std():12.3f}"
        else:
            row += 57 * " "
        print(f"{row} {ms:7.0f}")


def error(found: Detection, needle: NeedleInImage) -> tuple[float, float, float]:
    """Detected minus true: along and across the shaft, mm, and the angle, rad."""
    d = needle.direction_image[:2] / np.linalg.norm(needle.direction_image[:2])
    e, v = found.tip_image - needle.tip_image[:2], found.direction_image
    return e @ d, d[0] * e[1] - d[1] * e[0], np.arctan2(d[0] * v[1] - d[1] * v[0], d @ v)


def plainer(picture: np.ndarray, rng: np.random.Generator, gate_grey: float = 26.0) -> Detection | Missed:
    """The detector of the specification, from its words."""
    contrast = np.maximum(picture.astype(float) - cv2.medianBlur(picture, 61), 0.0)
    smooth = cv2.GaussianBlur(contrast, (0, 0), 1.5)
    rows, columns = np.nonzero(smooth >= np.quantile(smooth, 0.985))
    points, weights = np.stack([columns, rows], axis=1) * IMAGER.pixel_mm, smooth[rows, columns]
    best, inside = 0.0, np.zeros(len(points), bool)
    for first, second in rng.choice(len(points), (300, 2), p=weights / weights.sum()):
        way = points[second] - points[first]
        length = np.hypot(*way)
        if length < 3.0:
            continue
        away = np.abs((points - points[first]) @ np.array([-way[1], way[0]]) / length)
        total = weights[away < 0.6].sum()
        if total > best:
            best, inside = total, away < 0.6
    if inside.sum() < 10:
        return Missed.NO_NEEDLE
    middle = np.average(points[inside], axis=0, weights=weights[inside])
    spread = (points[inside] - middle) * np.sqrt(weights[inside])[:, None]
    direction = np.linalg.svd(spread, full_matrices=False)[2][0]
    direction = direction * np.sign(direction[1])
    s = (points[inside] - middle) @ direction
    order = np.argsort(s)
    cumulated = np.cumsum(weights[inside][order]) / weights[inside].sum()
    start, end = s[order][np.searchsorted(cumulated, [0.01, 0.99])]
    along = np.arange(start, end, 0.2)
    maps = ((middle + along[:, None] * direction) / IMAGER.pixel_mm).astype(np.float32)
    level = cv2.remap(smooth.astype(np.float32), maps[:, 0], maps[:, 1], cv2.INTER_LINEAR).mean()
    if level < gate_grey:
        return Missed.NO_NEEDLE
    return Detection(middle + end * direction, direction, best, end - start, level)


def gate(count: int) -> None:
    """The search's score where there is no needle, against the gate."""
    rng = np.random.default_rng(99)
    found = (detect(render(IMAGER, None, rng), IMAGER, UNGATED) for _ in range(count))
    scores = np.array([one.score_mm for one in found if isinstance(one, Detection)])
    scale = scores.std() * np.sqrt(6.0) / np.pi
    place = scores.mean() - 0.5772 * scale
    limit = DetectorSettings().least_score_mm
    chance = -np.expm1(-np.exp(-(limit - place) / scale))
    print(
        f"\nno needle, {count} pictures: score {scores.mean():.2f} on average, {scores.max():.2f} at most;"
        f" gate {limit:g}"
    )
    print(f"  Gumbel's law through them passes the gate with probability {chance:.1e}")


def bias(count: int) -> None:
    """What the uncorrected tip lies beyond the true one, by what might matter."""
    settings = DetectorSettings(tip_bias=0.0)
    print(
        "\ntip beyond the true one, not corrected: mm, over the pulse's standard deviation along the shaft, and sd mm"
    )
    for steep in (25.0, 45.0, 65.0):
        for depth in (20.0, 45.0):
            for contrast in (18.0, 26.0):
                rng = np.random.default_rng([int(steep), int(depth), int(contrast)])
                direction = np.array([np.cos(np.radians(steep)), np.sin(np.radians(steep)), 0.0])
                needle = NeedleInImage(np.array([25.0, depth, 0.0]), direction)
                echo = NeedleEcho(contrast_db=contrast)
                found = [detect(render(IMAGER, needle, rng, echo=echo), IMAGER, settings) for _ in range(count)]
                errors = np.array([error(f, needle)[0] for f in found if isinstance(f, Detection)])
                lateral, axial = IMAGER.spread.lateral_sigma(depth), IMAGER.spread.axial_sigma(depth)
                sigma = np.hypot(lateral * direction[0], axial * direction[1])
                print(
                    f"  insertion {steep:2.0f} deg, depth {depth:2.0f} mm, {contrast:2.0f} dB: {np.mean(errors):+.2f}"
                    f"  {np.mean(errors) / sigma:+.2f}  sd {errors.std():.2f}  ({len(errors)}/{count})"
                )


if __name__ == "__main__":
    main()
