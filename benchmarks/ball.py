"""How well the cameras see: the ball's centre in a picture, its refusal, and its place in space.

    python benchmarks/ball.py [--count 500] [--points 250] [--seed 1] [--only centre|refused|stereo]

Pictures of 1280 x 960, focal length 2560 px, two cameras 500 mm apart, 1 m from the room's centre, an 8 mm ball on a
3 mm rod that points anywhere, a lamp anywhere on the cameras' side, a lens with k1 -0.2, k2 0.05, p1 5e-4, p2 -5e-4.
Distances are root mean squares in the plane (px) or in space (mm). Times are CPU milliseconds per picture. The squared
error over the claimed variance is 1 where the claimed covariance is right.
"""

import argparse
import platform
from collections import Counter
from importlib.metadata import version
from time import process_time
from typing import NamedTuple

import numpy as np

from puncture_twin.twin.guidance.stereo.ball.ball_image import BallScene, render
from puncture_twin.twin.guidance.stereo.ball.tracker import DetectedBall, LostBall, find_ball
from puncture_twin.twin.guidance.stereo.cameras.calibration import calibrate
from puncture_twin.twin.guidance.stereo.cameras.camera import Camera, stereo_pair
from puncture_twin.twin.guidance.stereo.cameras.triangulation import triangulate

SIZE, FOCAL, RADIUS_MM, SEARCH_PX = (1280, 960), 2560.0, 4.0, 12.0
LENS = (-0.2, 0.05, 5e-4, -5e-4)
FIELD_MM = np.array([150.0, 120.0, 100.0])
"""Half sizes of where the balls of the pictures are."""
GRID = np.stack(np.meshgrid([-80.0, 0, 80], [-60.0, 60], [-60.0, 60], indexing="ij"), -1).reshape(-1, 3)
PREDICTION_MM = 1.0
"""Standard deviation per axis of what the kinematics predict."""
POINTS_PER_CALIBRATION = 25

MEASURED = {
    "diffuse light": {},
    "light from everywhere": {"diffuse": 1.0},
    "without rod": {"rod": False},
    "lamp 40 %": {"diffuse": 0.6},
    "noise 6": {"noise": 6.0},
    "15 % hidden": {"hidden_fraction": 0.15},
    "30 % hidden": {"hidden_fraction": 0.30},
    "background +-15": {"texture_grey": 15.0},
}
REFUSED = {
    "no ball": {"ball": False},
    "no ball, background +-25": {"ball": False, "texture_grey": 25.0},
    "as its background": {"ball_grey": 66.0, "diffuse": 1.0},
    "as its background +-15": {"ball_grey": 66.0, "diffuse": 1.0, "texture_grey": 15.0},
    "60 % hidden": {"hidden_fraction": 0.60},
    "70 % hidden": {"hidden_fraction": 0.70},
    "radius +15 %": {"radius_mm": 4.6},
}


class Row(NamedTuple):
    """What the tracker made of one kind of picture."""

    errors: np.ndarray
    squared: np.ndarray
    hough: np.ndarray
    reasons: Counter
    ms: float


def main() -> None:
    """Run all of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=500, help="pictures of each kind")
    parser.add_argument("--points", type=int, default=250, help="balls in space, a calibration for every 25")
    parser.add_argument("--only", choices=("centre", "refused", "stereo"))
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    names = ("numpy", "scipy", "opencv-python-headless")
    print(platform.processor() or platform.machine(), platform.python_version(), *(f"{n} {version(n)}" for n in names))
    print(f"{arguments.count} pictures of each kind, seed {arguments.seed}\n")
    camera = stereo_pair(*SIZE, FOCAL, 500, 1000, LENS)[0]
    if arguments.only in (None, "centre"):
        measured(camera, arguments.count, arguments.seed)
    if arguments.only in (None, "refused"):
        refused(camera, arguments.count, arguments.seed)
    if arguments.only in (None, "stereo"):
        stereo(arguments.points, arguments.seed)


def measured(camera: Camera, count: int, seed: int) -> None:
    """Table 1: the centre."""
    print(f"{'centre, px':24}{'found':>8}{'rms':>8}{'max':>8}{'e2/var':>8}{'Hough':>8}{'ratio':>7}{'ms':>7}")
    for name, changes in MEASURED.items():
        row = look(camera, count, seed, **changes)
        ours, hough = rms(row.errors), rms(row.hough)
        print(
            f"{name:24}{len(row.errors) / count:8.1%}{ours:8.3f}{np.linalg.norm(row.errors, axis=1).max():8.3f}"
            f"{row.squared.mean():8.2f}{hough:8.3f}{hough / ours:7.1f}{row.ms:7.1f}",
            flush=True,
        )
    print()


def refused(camera: Camera, count: int, seed: int) -> None:
    """Table 2: what must not be believed."""
    print(f"{'must be refused':28}{'refused':>9}  reasons; rms of those that were not")
    for name, changes in REFUSED.items():
        row = look(camera, count, seed, **changes)
        lost = sum(row.reasons.values()) / count
        believed = f"; {rms(row.errors):.3f} px" if len(row.errors) else ""
        print(f"{name:28}{lost:9.1%}  {dict(row.reasons.most_common())}{believed}", flush=True)
    print()


def stereo(count: int, seed: int) -> None:
    """Table 3: the ball in space, after a calibration from 12 pictures."""
    print(f"{'stereo, mm':44}{'lost':>6}{'mean':>8}{'max':>8}{'reproj px':>11}")
    rows = {
        "500 mm, lens modelled": {},
        "the same, 250 x 200 x 200 mm": {"half_mm": np.array([125.0, 100.0, 100.0])},
        "points measured to .01 mm": {"point_mm": 0.01},
        "points measured to .03 mm": {"point_mm": 0.03},
        "noise 6": {"noise": 6.0},
        "baseline 200 mm": {"baseline": 200.0},
        "k1 -0.1 not modelled": {"lens": (-0.1, 0.0, 0.0, 0.0), "modelled": False},
        "k1 -0.3 not modelled": {"lens": (-0.3, 0.0, 0.0, 0.0), "modelled": False},
        "Hough alone (the paper's way)": {"hough_only": True, "modelled": False, "lens": (0.0, 0.0, 0.0, 0.0)},
    }
    for name, changes in rows.items():
        errors, lost, reprojection = in_space(count, seed, **changes)
        print(f"{name:44}{lost:6d}{errors.mean():8.4f}{errors.max():8.4f}{reprojection:11.3f}", flush=True)


def scene(rng: np.random.Generator, center_c: np.ndarray, **changes: object) -> BallScene:
    """Rod, lamp and occluder from anywhere."""
    light = rng.normal(size=3)
    light[2] = -abs(light[2])
    drawn = {"rod_c": rng.normal(size=3), "light_c": light, "hidden_from": rng.uniform(0, 2 * np.pi)}
    return BallScene(center_c, **(drawn | changes))


def look(camera: Camera, count: int, seed: int, *, noise: float = 2.0, **changes: object) -> Row:
    """One kind of picture, many times."""
    rng = np.random.default_rng(seed)
    errors, squared, hough, reasons, spent = [], [], [], Counter(), 0.0
    for _ in range(count):
        center = rng.uniform(-1, 1, 3) * FIELD_MM
        picture = render(camera, scene(rng, center, **changes), rng=rng, noise=noise, half_px=44)
        predicted = center + rng.normal(0, PREDICTION_MM, 3)
        start = process_time()
        found = find_ball(picture, camera, predicted, RADIUS_MM, search_px=SEARCH_PX)
        spent += process_time() - start
        true = camera.project(center)
        if isinstance(found, DetectedBall):
            errors.append(found.pixel - true)
            squared.append(errors[-1] @ np.linalg.solve(found.covariance, errors[-1]) / 2)
        else:
            reasons[found.reason] += 1
        rough = find_ball(picture, camera, predicted, RADIUS_MM, search_px=SEARCH_PX, hough_only=True)
        if isinstance(rough, DetectedBall):
            hough.append(rough.pixel - true)
    return Row(np.array(errors), np.array(squared), np.array(hough), reasons, 1000 * spent / count)


def in_space(
    count: int,
    seed: int,
    *,
    baseline: float = 500.0,
    lens: tuple[float, ...] = LENS,
    modelled: bool = True,
    noise: float = 2.0,
    point_mm: float = 0.0,
    half_mm: np.ndarray = np.array([80.0, 60.0, 60.0]),  # noqa: B008 - never changed
    hough_only: bool = False,
) -> tuple[np.ndarray, int, float]:
    """Errors of balls in space, mm, over calibrations drawn anew; how many were lost; the calibrations' rms."""
    rng = np.random.default_rng(seed)
    true = stereo_pair(*SIZE, FOCAL, baseline, 1000, lens)
    planned = stereo_pair(*SIZE, FOCAL, baseline, 1000)
    errors, lost, reprojection = [], 0, []

    def seen(point: np.ndarray, believed: tuple[Camera, ...]) -> list[DetectedBall | LostBall]:
        scenes = scene(rng, point)
        pictures = [render(camera, scenes, rng=rng, noise=noise, half_px=50) for camera in true]
        return [
            find_ball(picture, camera, point, RADIUS_MM, search_px=SEARCH_PX + 6, hough_only=hough_only)
            for picture, camera in zip(pictures, believed, strict=True)
        ]

    for _ in range(int(np.ceil(count / POINTS_PER_CALIBRATION))):
        held = [(point, spheres) for point in GRID if not any_lost(spheres := seen(point, planned))]
        known = np.array([point for point, _ in held]) + rng.normal(0, point_mm, (len(held), 3))
        cameras = []
        for number in (0, 1):
            pixels = np.array([spheres[number].pixel for _, spheres in held])
            fit = calibrate(known, pixels, SIZE, distortion=modelled)
            cameras.append(fit.camera)
            reprojection.append(fit.rms_px)
        for _ in range(POINTS_PER_CALIBRATION):
            point = rng.uniform(-1, 1, 3) * half_mm
            spheres = seen(point, tuple(cameras))
            if any_lost(spheres):
                lost += 1
                continue
            pixels = np.stack([[ball.pixel] for ball in spheres])
            found = triangulate(cameras, pixels, np.stack([[ball.covariance] for ball in spheres])).points_c[0]
            errors.append(np.linalg.norm(found - point))
    return np.array(errors), lost, float(np.mean(reprojection))


def any_lost(spheres: list[DetectedBall | LostBall]) -> bool:
    """Whether a camera did not find it."""
    return any(isinstance(ball, LostBall) for ball in spheres)


def rms(errors: np.ndarray) -> float:
    """Root mean square distance; NaN where there is none."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1)))) if len(errors) else float("nan")


if __name__ == "__main__":
    main()
