"""How well detectors see: the ball's centre in a picture, its refusal and its place in space; the needle in B-mode.

    python -m benchmarks.detectors [--only centre refused space needle bias] [--count 500] [--seed 1]

The ball: pictures of 1280 x 960, focal length 2560 px, two cameras 500 mm apart, 1 m from the room's centre, an 8 mm
ball on a 3 mm rod that points anywhere, a lamp anywhere on the cameras' side, a lens with k1 -0.2, k2 0.05, p1 5e-4,
p2 -5e-4; ``--count`` of a kind, half as many in space, a calibration for every 25. Distances are root mean squares. The
squared error over the claimed variance is 1 where the claim is right. The needle: insertions of 20 to 75 degrees from
either side, tips anywhere in the picture; a twelfth of ``--count`` a row.
"""

import argparse
from collections import Counter
from time import process_time

import numpy as np

from benchmarks.shared import versions
from puncture_twin.twin.guidance.stereo.ball import find_ball
from puncture_twin.twin.guidance.stereo.camera import stereo_pair
from puncture_twin.twin.guidance.stereo.camera_calibration import calibrate, triangulate
from puncture_twin.twin.guidance.stereo.servo_law import Lost
from puncture_twin.twin.guidance.ultrasound.needle_detector import Detection, Imager, NeedleEcho, detect
from puncture_twin.twin.plant.ball_image import BallScene, render as render_ball
from puncture_twin.twin.plant.bmode_image import NeedleInImage, render

SIZE, FOCAL, RADIUS_MM, SEARCH_PX = (1280, 960), 2560.0, 4.0, 12.0
LENS = (-0.2, 0.05, 5e-4, -5e-4)
FIELD_MM = np.array([150.0, 120.0, 100.0])
"""Half sizes of where the balls of the pictures are."""
GRID = np.stack(np.meshgrid([-80.0, 0, 80], [-60.0, 60], [-60.0, 60], indexing="ij"), -1).reshape(-1, 3)
PREDICTION_MM = 1.0
"""Standard deviation per axis of what the kinematics predict."""
POINTS_PER_CALIBRATION = 25

CENTRE = {
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
SPACE = {
    "500 mm, lens modelled": {},
    "lens modelled, 250 x 200 x 200 mm": {"half_mm": (125.0, 100.0, 100.0)},
    "points measured to .01 mm": {"point_mm": 0.01},
    "points measured to .03 mm": {"point_mm": 0.03},
    "noise 6": {"noise": 6.0},
    "baseline 200 mm": {"baseline": 200.0},
    "k1 -0.1 not modelled": {"lens": (-0.1, 0.0, 0.0, 0.0), "modelled": False},
    "k1 -0.3 not modelled": {"lens": (-0.3, 0.0, 0.0, 0.0), "modelled": False},
    "Hough alone (as the paper)": {"hough_only": True, "modelled": False, "lens": (0.0, 0.0, 0.0, 0.0)},
}
IMAGER = Imager()
NEEDLE = {
    "in the plane": {},
    "0.4 mm off": {"off_mm": 0.4},
    "0.8 mm off": {"off_mm": 0.8},
    "leaning 3 deg": {"lean_deg": 3.0},
    "faint, 13 dB less": {"contrast_db": 15.0},
    "no needle": {"needle": False},
}


def ball_scene(rng, center_c, **changes):
    """Rod, lamp and occluder from anywhere."""
    light = rng.normal(size=3)
    light[2] = -abs(light[2])
    drawn = {"rod_c": rng.normal(size=3), "light_c": light, "hidden_from": rng.uniform(0, 2 * np.pi)}
    return BallScene(center_c, **(drawn | changes))


def look(count, seed, *, noise=2.0, **changes):
    """Pictures of one kind: errors, px, their squares over the variance, Hough's, reasons of refusals, CPU ms each."""
    camera, rng = stereo_pair(*SIZE, FOCAL, 500, 1000, LENS)[0], np.random.default_rng(seed)
    errors, squared, hough, reasons, spent = [], [], [], Counter(), 0.0
    for _ in range(count):
        center = rng.uniform(-1, 1, 3) * FIELD_MM
        picture = render_ball(camera, ball_scene(rng, center, **changes), rng=rng, noise=noise, half_px=44)
        asked, true = (picture, camera, center + rng.normal(0, PREDICTION_MM, 3), RADIUS_MM), camera.project(center)
        start = process_time()
        found = find_ball(*asked, search_px=SEARCH_PX)
        spent += process_time() - start
        if not isinstance(found, Lost):
            errors.append(found.pixel - true)
            squared.append(errors[-1] @ np.linalg.solve(found.covariance, errors[-1]) / 2)
        else:
            reasons[found.reason] += 1
        rough = find_ball(*asked, search_px=SEARCH_PX, hough_only=True)
        if not isinstance(rough, Lost):
            hough.append(rough.pixel - true)
    return np.array(errors).reshape(-1, 2), np.array(squared), np.array(hough), reasons, 1000 * spent / count


def centre(count, seed):
    """The centre."""
    print(f"{'centre, px':24}{'found':>8}{'rms':>8}{'max':>8}{'e2/var':>8}{'Hough':>8}{'ratio':>7}{'ms':>7}")
    for name, changes in CENTRE.items():
        errors, squared, hough, _, ms = look(count, seed, **changes)
        figures = rms(errors), np.linalg.norm(errors, axis=1).max(), squared.mean(), rms(hough)
        row = f"{figures[0]:8.3f}{figures[1]:8.3f}{figures[2]:8.2f}{figures[3]:8.3f}{figures[3] / figures[0]:7.1f}"
        print(f"{name:24}{len(errors) / count:8.1%}{row}{ms:7.1f}", flush=True)


def refused(count, seed):
    """What must not be believed."""
    print(f"{'must be refused':28}{'refused':>9}  reasons; rms of those that were not")
    for name, changes in REFUSED.items():
        errors, _, _, reasons, _ = look(count, seed, **changes)
        believed = f"; {rms(errors):.3f} px" if len(errors) else ""
        lost = sum(reasons.values()) / count
        print(f"{name:28}{lost:9.1%}  {dict(reasons.most_common())}{believed}", flush=True)


def space(count, seed):
    """The ball in space, after a calibration from 12 pictures."""
    print(f"{'stereo, mm':44}{'lost':>6}{'mean':>8}{'max':>8}{'reproj px':>11}")
    for name, changes in SPACE.items():
        errors, lost, reprojection = in_space(count // 2, seed, **changes)
        print(f"{name:44}{lost:6d}{np.mean(errors):8.4f}{max(errors):8.4f}{reprojection:11.3f}", flush=True)


def in_space(
    count, seed, *, baseline=500.0, lens=LENS, modelled=True, noise=2.0, point_mm=0.0, half_mm=(80.0, 60.0, 60.0),
    hough_only=False,
):  # fmt: skip
    """Errors of balls in space, mm, over calibrations drawn anew; how many were lost; the calibrations' rms."""
    rng, errors, lost, reprojection = np.random.default_rng(seed), [], 0, []
    true, planned = stereo_pair(*SIZE, FOCAL, baseline, 1000, lens), stereo_pair(*SIZE, FOCAL, baseline, 1000)

    def seen(point, believed):
        scene, search = ball_scene(rng, point), SEARCH_PX + 6
        pictures = [render_ball(camera, scene, rng=rng, noise=noise, half_px=50) for camera in true]
        pairs = zip(pictures, believed, strict=True)
        return [find_ball(*pair, point, RADIUS_MM, search_px=search, hough_only=hough_only) for pair in pairs]

    for _ in range(int(np.ceil(count / POINTS_PER_CALIBRATION))):
        held = [(point, balls) for point in GRID if not any_lost(balls := seen(point, planned))]
        known = np.array([point for point, _ in held]) + rng.normal(0, point_mm, (len(held), 3))
        pixels = np.array([[ball.pixel for ball in balls] for _, balls in held])
        fits = [calibrate(known, pixels[:, k], SIZE, distortion=modelled) for k in (0, 1)]
        cameras = [fit.camera for fit in fits]
        reprojection += [fit.rms_px for fit in fits]
        for _ in range(POINTS_PER_CALIBRATION):
            point = rng.uniform(-1, 1, 3) * half_mm
            balls = seen(point, cameras)
            if any_lost(balls):
                lost += 1
                continue
            pixels, covariances = (np.array([[getattr(one, key)] for one in balls]) for key in ("pixel", "covariance"))
            errors.append(float(np.linalg.norm(triangulate(cameras, pixels, covariances).points_c[0] - point)))
    return errors, lost, float(np.mean(reprojection))


def any_lost(balls):
    """Whether a camera did not find it."""
    return any(isinstance(ball, Lost) for ball in balls)


def rms(errors):
    """Root mean square distance; NaN where there is none."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1)))) if len(errors) else float("nan")


def needle(count, seed):
    """The needle in B-mode, by how it lies in the slice."""
    del seed
    count = max(10, count // 12)
    print("needle                  found  along mm: mean    sd   worst  angle sd deg")
    for name, changes in NEEDLE.items():
        errors = needle_errors(count, **changes)
        row = f"{name:22s} {len(errors):3d}/{count}"
        if len(errors):
            along, angle = errors.T
            row += f"{along.mean():14.2f} {along.std():8.2f} {np.abs(along).max():6.1f} {np.degrees(angle).std():10.3f}"
        print(row, flush=True)


def needle_errors(count, *, off_mm=0.0, lean_deg=0.0, contrast_db=28.0, needle=True):
    """Of the needles that are found: tip along the shaft, mm, and angle, rad, shape (n, 2)."""
    rng, lean, pairs = np.random.default_rng(2023), np.radians(lean_deg), []
    for _ in range(count):
        steep, side = np.radians(rng.uniform(20, 75)), rng.choice([-1.0, 1.0])
        along = np.array([side * np.cos(steep) * np.cos(lean), np.sin(steep) * np.cos(lean), np.sin(lean)])
        pairs.append(NeedleInImage(np.array([rng.uniform(12, 38), rng.uniform(15, 52), off_mm]), along))
    echo = NeedleEcho(contrast_db=contrast_db)
    found = [detect(render(IMAGER, one if needle else None, rng, echo=echo), IMAGER) for one in pairs]
    return np.array([error(*pair) for pair in zip(found, pairs, strict=True) if isinstance(pair[0], Detection)])


def error(found, true):
    """Detected minus true: along the shaft, mm, and the angle, rad."""
    d = true.direction_image[:2] / np.linalg.norm(true.direction_image[:2])
    v = found.direction_image
    return (found.tip_image - true.tip_image[:2]) @ d, np.arctan2(d[0] * v[1] - d[1] * v[0], d @ v)


def bias(count, seed):
    """What the uncorrected tip lies beyond the true one, by what might matter."""
    del seed
    print("tip beyond the true one, not corrected: mm, over the pulse's standard deviation along the shaft, and sd mm")
    for steep, depth, contrast in ((s, d, c) for s in (25.0, 45.0, 65.0) for d in (20.0, 45.0) for c in (18.0, 26.0)):
        rng = np.random.default_rng([int(steep), int(depth), int(contrast)])
        direction = np.array([np.cos(np.radians(steep)), np.sin(np.radians(steep)), 0.0])
        true, echo = NeedleInImage(np.array([25.0, depth, 0.0]), direction), NeedleEcho(contrast_db=contrast)
        pictures = [render(IMAGER, true, rng, echo=echo) for _ in range(max(10, count // 25))]
        found = [detect(one, IMAGER, tip_bias=0.0) for one in pictures]
        errors = np.array([error(one, true)[0] for one in found if isinstance(one, Detection)])
        spread = IMAGER.spread
        sigma = np.hypot(spread.lateral_sigma(depth) * direction[0], spread.axial_sigma(depth) * direction[1])
        figures = f"{errors.mean():+.2f}  {errors.mean() / sigma:+.2f}  sd {errors.std():.2f}"
        print(f"  insertion {steep:2.0f} deg, depth {depth:2.0f} mm, {contrast:2.0f} dB: {figures}", flush=True)


TABLES = {"centre": centre, "refused": refused, "space": space, "needle": needle, "bias": bias}


def main() -> None:
    """Parse, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=tuple(TABLES), default=tuple(TABLES))
    parser.add_argument("--count", type=int, default=500, help="pictures of each kind")
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    print(versions("numpy", "scipy", "opencv-python-headless", "numba"))
    for name in chosen.only:
        TABLES[name](chosen.count, chosen.seed)


if __name__ == "__main__":
    main()
