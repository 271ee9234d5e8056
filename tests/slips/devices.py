"""Recordings and lists that say what no device can have read, or something else than they mean."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from puncture_twin.planning.arm.kinematics import check_recording, flange_pose
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.formats.points import parse_joint_recording
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, pose
from puncture_twin.planning.registration.marker_pairs import MarkerPairs
from puncture_twin.planning.registration.registration import register
from puncture_twin.twin.guidance.ultrasound.recording_file import checked_calibration
from puncture_twin.twin.plant.simulated_recording import simulate_recording
from slips.kinds import RIGHT, SILENT, WARNED, Answer, Kind, answer

FILE = Path("recording.csv")
READING_MM = 0.3


def _negated(rng, one):
    return replace(one, v=-one.v)


def _half_negated(rng, one):
    return replace(one, v=np.where(np.arange(len(one.v)) % 2, -1, 1)[:, None] * one.v)


def _turned(rng, one):
    angle = np.radians(rng.uniform(5, 90)) * rng.choice([-1, 1])
    c, s = np.cos(angle), np.sin(angle)
    return replace(one, v=one.v @ [[c, s], [-s, c]])


def _pixels(rng, one):
    return replace(one, P=one.P * (1 + rng.choice([-1, 1]) * rng.uniform(0.03, 0.08)))


def _directions(slip_of, rng, folder, slip):
    """Needle directions and tips of a self-calibration; V must come out right, or something must be said."""
    recording, truth = simulate_recording(rng, 28)
    recording = slip_of(rng, recording) if slip else recording

    def call():
        found = checked_calibration(recording, None, FILE)
        codes = [one.code for one in found.findings if one.severity == "warning"]
        aligned = found.needle_direction_end2 @ truth.direction_end2 > 0.9995
        near = np.linalg.norm(found.tip_end2 - truth.tip_end2) < 1.0
        return Answer(WARNED, codes[0]) if codes else Answer(RIGHT if aligned and near else SILENT)

    return answer(call)


def _scale(rng, points):
    return points * (1 + rng.choice([-1, 1]) * rng.uniform(0.016, 0.08))


def _stretch(rng, points):
    return points * np.where(np.arange(3) == rng.integers(3), 1 + rng.choice([-1, 1]) * rng.uniform(0.025, 0.1), 1.0)


def _mirrored(rng, points):
    return points * np.where(np.arange(3) == rng.integers(3), -1.0, 1.0)


def _unit(rng, points):
    return points * rng.choice([0.001, 0.1, 10.0, 1000.0])


def _exchanged(rng, points):
    first, second = rng.choice(len(points), 2, replace=False)
    swapped = points.copy()
    swapped[[first, second]] = points[[second, first]]
    return swapped


def _lists(slip_of, rng, folder, slip):
    """Six to twelve markers on a trunk, touched with an error of .3 mm; a slip in the touched list."""
    count = int(rng.integers(6, 13))
    angle, height = rng.uniform(np.pi, 2 * np.pi, count), rng.uniform(-90, 90, count)
    points_ct = np.column_stack([115 * np.cos(angle), 105 * np.sin(angle), height])
    T = pose(exp_rotation(rng.normal(size=3)), rng.uniform(-400, 400, 3))
    touched = slip_of(rng, points_ct) if slip else points_ct
    points_base = apply(T, touched) + rng.normal(0, READING_MM, touched.shape)
    target = rng.uniform(-40, 40, 3)
    names = tuple("ABCDEFGHIJKL"[:count])

    def call():
        found = register(MarkerPairs(names, points_ct, points_base), method="rigid", target_ct=target)
        if found.flags:
            return Answer(WARNED, found.flags[0].code)
        miss = np.linalg.norm(apply(found.T_base_ct, target[None])[0] - apply(T, target[None])[0])
        limit = 3.0 * found.expected_tre_mm(target[None])[0]
        return Answer(RIGHT if miss < limit or not slip else SILENT)

    return answer(call)


START = np.array([20.0, -100.0, -95.0, -75.0, 90.0, 10.0])
MODELS = ("ur3", "ur3e", "ur5", "ur5e", "ur10", "ur10e")


def _degrees_as_radians(rng, table):
    return table | {"q": np.degrees(table["q"])}


def _radians_as_degrees(rng, table):
    return table | {"unit": "deg"}


def _backwards(rng, table):
    times = table["times"].copy()
    row = int(rng.integers(1, len(times)))
    times[row] = times[row - 1] - rng.uniform(1e-3, 10)
    return table | {"times": times}


def _no_number(rng, table):
    q = table["q"].copy()
    q[rng.integers(len(q)), rng.integers(6)] = rng.choice([np.nan, np.inf, -np.inf])
    return table | {"q": q}


def _beyond(rng, table):
    q = table["q"].copy()
    q[rng.integers(len(q)), rng.integers(5)] += rng.choice([-1, 1]) * rng.uniform(4.5, 100) * np.pi
    return table | {"q": q}


def _other_model(rng, table):
    return table | {"model": str(rng.choice([one for one in MODELS if one != table["model"]]))}


def _joints(slip_of, rng, folder, slip):
    """A controller's recording: joints, times and where it had its tool."""
    count, name = int(rng.integers(4, 20)), str(rng.choice(MODELS))
    q = np.radians(START + rng.uniform(4, 25) * rng.normal(size=(count, 6)))
    table = {"q": q, "times": 0.1 * np.arange(count), "unit": "rad", "model": name}
    flanges = flange_pose(ur_model(name), q)
    tool = flanges[:, :3, 3] + flanges[:, :3, :3] @ [0.0, 0.0, 210.0]
    table = slip_of(rng, table) if slip else table
    header = ["timestamp", *(f"q{k}_{table['unit']}" for k in range(1, 7)), *(f"actual_TCP_pose_{k}" for k in range(6))]
    if table["unit"] == "rad" and rng.random() < 0.5:
        header[1:7] = [f"actual_q_{k}" for k in range(6)]
    rows = np.column_stack([table["times"], table["q"], tool / 1000.0, np.zeros((count, 3))])
    text = "\n".join([",".join(header), *(",".join(f"{value:.9g}" for value in row) for row in rows), ""])

    def call():
        read = parse_joint_recording(text.encode(), FILE, timed=True)
        check_recording(ur_model(table["model"]), 210.0, read, where=FILE)
        return Answer(RIGHT if np.allclose(read.q, q, atol=1e-6) and table["model"] == name else SILENT)

    return answer(call)


KINDS = (
    Kind("directions negated", 38, partial(_directions, _negated)),
    Kind("half of the directions negated", 38, partial(_directions, _half_negated)),
    Kind("directions turned", 45, partial(_directions, _turned)),
    Kind("pixels of another size", 30, partial(_directions, _pixels)),
    Kind("touched list scaled", 45, partial(_lists, _scale)),
    Kind("touched list stretched", 45, partial(_lists, _stretch)),
    Kind("touched list mirrored", 30, partial(_lists, _mirrored)),
    Kind("touched list in another unit", 30, partial(_lists, _unit)),
    Kind("two markers exchanged", 30, partial(_lists, _exchanged)),
    Kind("degrees under rad", 22, partial(_joints, _degrees_as_radians)),
    Kind("radians under deg", 22, partial(_joints, _radians_as_degrees)),
    Kind("times run backwards", 22, partial(_joints, _backwards)),
    Kind("no number", 15, partial(_joints, _no_number)),
    Kind("beyond what a joint reads", 22, partial(_joints, _beyond)),
    Kind("joints of another arm", 30, partial(_joints, _other_model)),
)
