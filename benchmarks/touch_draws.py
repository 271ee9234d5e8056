"""The chances to touch against needles that are truly displaced, and what the chances cost.

python -m benchmarks.touch_draws              200 directions of each of three anatomies, 10,000 displaced needles each
python -m benchmarks.touch_draws --quick      20 directions
python -m benchmarks.touch_draws --directions 40
python -m benchmarks.touch_draws --size 3     with errors three times as large

Every displaced needle is measured with the engine's own arithmetic on all faces that it can come near to; some of them
are measured again by the whole engine.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.special import ndtr

from benchmarks.timing import least_seconds
from benchmarks.trust import Scene, punctures, scenes
from puncture_twin.planning.clearance.fast_engine import NearFaces, near_faces
from puncture_twin.planning.geometry.rigid import exp_rotation
from puncture_twin.planning.reach.standoff import own_lengths
from puncture_twin.planning.uncertainty.chance_model import ChanceModel, chance_model, demanding
from puncture_twin.planning.uncertainty.hit import touch_chance
from puncture_twin.planning.uncertainty.lines import NeedleUncertainty, line_chance, needle_uncertainty, walked

SEED, MARKERS = 20191104, 4
SURE = 1e-3
"""Pairs whose chance is nearer than this to 0 or 1, by every count, are left out."""

NAMES = ("first order (target .01 rms)", "lines (target .005 rms)", "one line alone", "ten distances")

AGREE_MM = 1e-9
REPEATS = 3


def model_of(scene: Scene, size: float) -> ChanceModel:
    """Of the scene's declaration, its errors so many times as large."""
    _, error = next(iter(punctures(replace(scene, errors=scene.errors.scaled(size)), MARKERS)))
    model = chance_model(scene.context.case, scene.context.anatomy, scene.context.engine, error)
    assert model is not None
    return model


def pairs_of(scene: Scene, model: ChanceModel, draws: int) -> np.ndarray:
    """Rows: by draws, then as in `NAMES`, seconds of lines; of each direction, structure and threshold."""
    case, anatomy, engine, rng = scene.context.case, scene.context.anatomy, scene.context.engine, _rng()
    columns, lengths = demanding(anatomy.checked), own_lengths(case, anatomy, scene.outward_ct)
    needles, rows = model.needles(scene.outward_ct, scene.q), []
    cov_ct, near = needles.cov_ct, needles.near
    for i, outward in enumerate(scene.outward_ct):
        errors = rng.multivariate_normal(np.zeros(6), cov_ct[i], draws, method="eigh")
        origins, along = case.target_ct + errors[:, :3], exp_rotation(errors[:, 3:]) @ outward
        uncertainty = needle_uncertainty(case.target_ct, outward, cov_ct[i], 0.0)
        for place, column in enumerate(columns):
            length = float(lengths[i, column])
            for threshold in case.needle.radius_mm + np.array([0.0, anatomy.checked[column].margin_mm]):
                first = touch_chance(near, threshold)[i, place]
                start = time.thread_time()
                reach = uncertainty.reach(length, threshold)
                if near.distance[i, place] > max(reach):
                    continue
                faces = near_faces(engine.blocks[column], case.target_ct, outward, length, reach)
                lines = line_chance(faces, uncertainty, length, threshold, near.gradient[i, place])
                took = time.thread_time() - start
                distance = faces.distance(origins, along, length)
                drawn = float(np.mean(distance < threshold))
                if max(first, lines, drawn) > SURE and min(first, lines, drawn) < 1 - SURE:
                    gradient = near.gradient[i, place]
                    one = one_line(faces, uncertainty, length, float(threshold), gradient)
                    ten = ten_distances(faces, uncertainty, length, float(threshold), gradient)
                    rows.append((drawn, first, lines, one, ten, took))
                    _measured_again(scene, int(column), (origins, along, length), threshold, distance)
    return np.array(rows).reshape(-1, 6)


def one_line(
    faces: NearFaces, uncertainty: NeedleUncertainty, length: float, threshold: float, gradient: np.ndarray
) -> float:
    """The chance along the line that first order says is steepest, followed to where it truly touches."""
    slope = uncertainty.root.T @ gradient
    basis = np.zeros((6, 6))
    basis[0, :5] = -slope / np.linalg.norm(slope)
    problem = (faces.triangles, faces.faces, faces.blocks, uncertainty.origin, uncertainty.outward, length, threshold)
    return float(walked(problem, uncertainty.root, 0.0, basis, np.zeros((1, 5)), np.ones(1))[0])


def ten_distances(
    faces: NearFaces, uncertainty: NeedleUncertainty, length: float, threshold: float, gradient: np.ndarray
) -> float:
    """The chance of a normal distance, its mean and deviation those of ten displaced needles.

    They lie at sqrt(5) standard deviations along five axes, both ways: exact for polynomials of the third degree.
    Needles that meet the structure are given first order's distance.
    """
    moved = math.sqrt(5.0) * np.vstack([uncertainty.root.T, -uncertainty.root.T])
    nominal = float(faces.distance(uncertainty.origin[None], uncertainty.outward[None], length)[0])
    found = faces.distance(uncertainty.origin + moved[:, :3], exp_rotation(moved[:, 3:]) @ uncertainty.outward, length)
    found = np.where(found > 0.0, found, np.minimum(nominal + moved @ gradient, 0.0))
    return float(ndtr(-(found.mean() - threshold) / found.std()))


def _rng() -> np.random.Generator:
    return np.random.default_rng(SEED)


def _measured_again(
    scene: Scene, column: int, axes: tuple[np.ndarray, np.ndarray, float], threshold: float, distance: np.ndarray
) -> None:
    """The needle that passes nearest to touching, by the whole engine: the same."""
    row = int(np.argmin(np.abs(distance - 0.9 * threshold)))
    origins, along, length = axes
    whole = scene.context.engine.measure(origins[row], along[row][None], length, shown=False).distance[0, column]
    if min(whole, distance[row]) < threshold and abs(whole - distance[row]) > AGREE_MM:
        raise AssertionError(f"the engine says {whole} mm, the faces near the needle {distance[row]} mm")


def cost(scene: Scene, model: ChanceModel) -> tuple[float, float, float, float]:
    """Microseconds a direction: search of the structures, chances to touch on top and without it, chances to hit."""
    case, anatomy, engine = scene.context.case, scene.context.anatomy, scene.context.engine
    many = 4000 // len(scene.q)
    outward, q = np.tile(scene.outward_ct, (many, 1)), np.tile(scene.q, (many, 1))
    lengths, rows = own_lengths(case, anatomy, outward), np.arange(len(q))
    axes = engine.measure(case.target_ct, outward, lengths, shown=False)
    works = (
        lambda: engine.measure(case.target_ct, outward, lengths, shown=False),
        lambda: model.chances(outward, q, axes.at(rows)),
        lambda: model.chances(outward, q),
        lambda: model.hit.chance(model.error, model.error.covariance_ct(q)),
        lambda: model.error.covariance_ct(q),
    )
    search, on_top, alone, hit, covariance = (least_seconds(work, REPEATS) / len(q) * 1e6 for work in works)
    hit -= covariance
    return search, on_top - hit, alone - hit, hit


def main() -> None:
    """Print one table of errors and one of costs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="20 directions")
    parser.add_argument("--directions", type=int, default=200, help="of each anatomy")
    parser.add_argument("--draws", type=int, default=10_000, help="displaced needles of each direction")
    parser.add_argument("--size", type=float, default=1.0, help="of the errors, over the declared ones")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        for scene in scenes(20 if options.quick else options.directions, Path(temporary)):
            model = model_of(scene, options.size)
            rows = pairs_of(scene, model, options.draws)
            noise = np.sqrt(np.mean(rows[:, 0] * (1 - rows[:, 0])) / options.draws)
            print(f"{scene.name}: {len(scene.q)} directions, {len(rows)} pairs; the draws' own error {noise:.4f} rms")
            for column, name in enumerate(NAMES, 1):
                error = rows[:, column] - rows[:, 0]
                figures = f"{np.sqrt(np.mean(error**2)):.4f} rms, largest {np.abs(error).max():.4f}"
                print(f"  {name}: {figures}, too low by at most {-error.min():.4f}")
            took = rows[:, -1] * 1e6
            print(f"  lines: {np.median(took):.0f} us a pair, mean {took.mean():.0f}")
            search, on_top, alone, hit = cost(scene, model)
            touch = f"on top of it touch {on_top:.1f} us and hit {hit:.1f} us (target 20 together)"
            print(f"  a direction: search {search:.1f} us, {touch}; touch without it {alone:.1f} us", flush=True)


if __name__ == "__main__":
    main()
