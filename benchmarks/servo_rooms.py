"""Does the needle's predicted error by the cameras hold? Many rooms without pictures, each drawn anew.

    python -m benchmarks.servo_rooms [--rooms 2000] [--jobs 2] [--only WORD]

A fast room draws everything that a servo case declares: arm, cameras, lenses, rod, needle, head, readings. The arm
holds the ball at the calibration's points, the cameras see balls and markers with normal errors of the declared size,
the arm is sent to one target by the mapping alone, then corrected by one look. Left out are pictures, contacts and the
play's memory: each arrival errs by itself.
"""

import os
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtrc, chdtri

from benchmarks.shared import options, versions
from puncture_twin.meshes import folder
from puncture_twin.planning.arm.inverse_kinematics import inverse
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.base.processes import process_pool
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.fits import fit_rigid
from puncture_twin.twin.guidance.stereo.ball import Detection, Detector, Search
from puncture_twin.twin.guidance.stereo.joint_model import (
    Adjusted,
    Guess,
    Observed,
    adjust,
    open_loop_error,
    servoed_error,
)
from puncture_twin.twin.guidance.stereo.servo_case import (
    ServoCase,
    ServoErrors,
    calibrating_rod,
    carried_rod,
    grid_points,
    load_servo_case,
    planned_cameras,
)
from puncture_twin.twin.guidance.stereo.servo_law import CarriedRod, ball_base, ball_jacobian, flange_poses
from puncture_twin.twin.plant.stereo_workcell import StereoPlant, StereoWorkcell, draw_workcell
from puncture_twin.twin.rehearsal.stereo_session import NeedleOutcome, needle_outcome, needle_statistics

PIXEL_PX = 0.03
"""Of a centre by edges, per axis; declared here, since there are no pictures of which a tracker could tell it."""
BRANCH = 6
"""Of the inverse kinematics, as a session chooses it."""
DOUBTED = 0.01
"""Chance of residuals so large below which a declaration is doubted."""


class RoomOutcome(NamedTuple):
    """One fast room."""

    open_loop: NeedleOutcome
    servoed: NeedleOutcome
    chi_squared: float
    """Of the joint estimate's residuals."""
    freedom: int


def pixel_detector(plant: StereoPlant, sigma_px: float) -> Detector:
    """True pixels with normal errors of a standard deviation per axis."""

    def see(number: int, search: Search) -> Detection:
        ball = plant.nearest(number, search.camera.project(search.predicted_c))
        pixel = plant.workcell.cameras[number].project(ball.center_c) + plant.pictures.normal(0.0, sigma_px, 2)
        return Detection(pixel, max(sigma_px, 1e-6) ** 2 * np.eye(2))

    return see


def varied(case: ServoCase, **sections: dict[str, Any]) -> ServoCase:
    """The case with some keys of its sections changed, such as ``cameras={"noise_grey": 6.0}``."""
    content = case.file.model_dump(by_alias=True)
    for section, keys in sections.items():
        content[section] = (content[section] or {}) | keys
    return replace(case, file=type(case.file).model_validate(content))


@cache
def commands(case: ServoCase, branch: int) -> Floats:
    """Joints for the calibration's points, shape (12, 6), rad."""
    rod = calibrating_rod(case)
    return reached(rod, grid_points(case), branch)


def reached(rod: CarriedRod, points_base: Floats, branch: int) -> Floats:
    """Joints that put the nominal ball on points (n, 3), one branch, shape (n, 6), rad."""
    q = inverse(rod.model, flange_poses(rod, points_base))[:, branch]
    if np.isnan(q).any():
        raise NoAnswerError(f"branch {branch} does not reach", code="out_of_reach")
    return q


class Room:
    """One drawn room, what was measured in it so far, and its truth."""

    def __init__(self, case: ServoCase, seed: int, branch: int) -> None:
        self.case, self.branch = case, branch
        self.rng = np.random.default_rng(seed)
        self.workcell: StereoWorkcell = draw_workcell(case, self.rng)
        self.rod = carried_rod(case)
        self.q = list(commands(case, branch))
        self.q_true = [self.arrived(q) for q in self.q]
        self.pixels = [self.seen(self.workcell.ball_c(q)) for q in self.q_true]
        truth = case.truth_errors
        read = self.rng.normal(0.0, truth.measuring_arm_mm, (12, 3))
        self.measured_c = self.workcell.ball_c(np.array(self.q_true)) + read
        self.markers = np.array([self.seen(point) for point in self.workcell.markers_c])
        self.markers_m = case.markers.points + self.rng.normal(0.0, truth.marker_mm, case.markers.points.shape)
        self.T_base_c = fit_rigid(self.measured_c, ball_base(calibrating_rod(case), np.array(self.q)))
        self.found: Adjusted | None = None

    def arrived(self, q: Floats) -> Floats:
        """Where the joints come to rest."""
        return q + self.rng.normal(0.0, self.case.truth_errors.arrival, 6)

    def seen(self, point_c: Floats) -> Floats:
        """Pixels of a point in both cameras, shape (2, 2)."""
        exact = np.array([camera.project(point_c) for camera in self.workcell.cameras])
        return exact + self.rng.normal(0.0, self.case.truth_errors.ball_px or PIXEL_PX, exact.shape)

    def go(self, q: Floats) -> Floats:
        """Send the arm, without a look; returns where it truly is."""
        self.q.append(q)
        self.q_true.append(self.arrived(q))
        return self.q_true[-1]

    def look(self) -> None:
        """See the ball where it is."""
        self.pixels.append(self.seen(self.workcell.ball_c(self.q_true[-1])))

    def adjusted(self) -> Adjusted:
        """The joint estimate of what was seen."""
        count, told = len(self.pixels), self.case.errors.ball_px or PIXEL_PX
        pixels, markers = np.array(self.pixels).transpose(1, 0, 2), self.markers.transpose(1, 0, 2)
        round_errors = [np.broadcast_to(told**2 * np.eye(2), (*one.shape, 2)) for one in (pixels, markers)]
        observed = Observed(
            planned_cameras(self.case), self.rod, self.case.errors, np.array(self.q[:count]), pixels, round_errors[0],
            self.measured_c, markers, round_errors[1], self.markers_m,
        )  # fmt: skip
        T_c_base = np.asarray(np.linalg.inv(self.T_base_c))
        more = apply(T_c_base, ball_base(self.rod, np.array(self.q[12:count]).reshape(-1, 6)))
        guess = Guess(T_c_base, self.workcell.T_c_m, np.concatenate([self.measured_c, more]))
        start = None
        if self.found is not None:
            before = self.found.unknowns
            start = before._replace(balls_c=np.concatenate([before.balls_c, more[len(before.balls_c) - 12 :]]))
        self.found = adjust(observed, guess, start)
        return self.found


def room_outcome(case: ServoCase, seed: int, branch: int = BRANCH) -> RoomOutcome:
    """One room: to one target by the mapping alone, then by a look."""
    one = Room(case, seed, branch)
    target = int(one.rng.integers(len(case.targets.names)))
    target_m = case.targets.points[target] + one.rng.normal(0.0, case.truth_errors.target_mm, 3)
    radius = case.file.target.hit_radius_mm
    found = one.adjusted()
    aim = found.offset(0, target_m).target_c
    q = reached(one.rod, apply(one.T_base_c, aim[None]), branch)[0]
    unseen = needle_outcome(open_loop_error(found, q, target_m), one.workcell.needle_m(one.go(q), target), radius)
    one.look()
    offset = one.adjusted().offset(-1, target_m)
    move = np.concatenate([one.T_base_c[:3, :3] @ (offset.target_c - offset.ball_c), np.zeros(3)])
    q_true = one.go(q + np.linalg.solve(ball_jacobian(one.rod, q), move))
    one.look()
    found = one.adjusted()
    seen = needle_outcome(servoed_error(found, -1, target_m), one.workcell.needle_m(q_true, target), radius)
    return RoomOutcome(unseen, seen, found.chi2, found.freedom)


def told_of_pixels(case: ServoCase, **errors: float | str) -> ServoCase:
    """The case with the pixels' error declared, and other errors where they are named."""
    return varied(case, errors={"ball_px": PIXEL_PX, **errors})


def drawn_from(case: ServoCase, factor: float) -> ServoCase:
    """The case with a truth whose errors are all so many times as large as the belief declares them."""
    return varied(case, rehearsal={"errors": case.errors.scaled(factor).stated()})


def rows() -> dict[str, ServoCase]:
    """What is drawn and declared in each row."""
    head = told_of_pixels(load_servo_case(folder() / "head"))
    plain = replace(head, file=head.file.model_copy(update={"errors": ServoErrors()}))
    moved = {"ball_px": 0.3, "head_shift_mm": 0.2, "head_turn_deg": 0.1}
    return {
        "meshes/head as declared": head,
        "the defaults of [errors]": told_of_pixels(varied(plain, errors={}), target_mm=0.3),
        "arm nominal, no play": told_of_pixels(varied(plain, errors=ServoErrors(arm="nominal").model_dump())),
        "cameras of .3 px, head moves .2 mm, .1 deg": told_of_pixels(head, **moved),
        "liu2007": told_of_pixels(load_servo_case(folder() / "head" / "liu2007.toml")),
        "declared half of the truth": drawn_from(head, 2.0),
        "declared twice the truth": drawn_from(head, 0.5),
    }


HEAD = " " * 53 + "        tip, mm  ratio in 95 %  direction, deg   pose        hit, %  doubted"


def line(name: str, outcomes: Sequence[NeedleOutcome], doubted: float) -> str:
    """One way in a line: realised and predicted, share in both 95 % regions, hits, share of rooms that are doubted."""
    ours = needle_statistics(outcomes)
    assert ours is not None
    pose = np.mean([one.square_of_pose <= chdtri(6, 0.05) for one in outcomes])
    ratio = ours["realised_rms_mm"] / ours["predicted_rms_mm"]
    hits = [100 * (ours[key] or 0.0) for key in ("hit_share", "mean_p_hit")]
    hit = "" if ours["hit_share"] is None else f"{hits[0]:5.1f} {hits[1]:5.1f}"
    figures = "{realised_rms_mm:7.3f} {predicted_rms_mm:7.3f} {ratio:6.3f} {coverage_95:7.3f} "
    figures += "{realised_direction_deg:7.3f} {predicted_direction_deg:7.3f}"
    return f"{name:52s} {figures.format(ratio=ratio, **ours)} {pose:6.3f} {hit:>13s} {100 * doubted:6.1f} %"


def fast_rooms(name: str, case: ServoCase, count: int, jobs: int) -> None:
    """One row of the table."""
    with process_pool(jobs, count) as pool:
        found = list(pool.map(partial(room_outcome, case), range(count), chunksize=50))
    doubted = float(np.mean([chdtrc(one.freedom, one.chi_squared) < DOUBTED for one in found]))
    print(line(f"{name}: unseen", [one.open_loop for one in found], doubted))
    print(line(f"{'':{len(name)}s}  servoed", [one.servoed for one in found], doubted), flush=True)


def main() -> None:
    """Parse, run, print."""
    asked = options(__doc__, rooms=2000, jobs=2, only="")
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # for the processes that are started: one thread each
    start = time.perf_counter()
    print(f"{versions('numpy')}, {os.cpu_count()} cores, {asked.jobs} processes")
    print(f"fast rooms: {asked.rooms} a row; realised, predicted\n{HEAD}")
    for name, case in rows().items():
        if asked.only in name:
            fast_rooms(name, case, asked.rooms, asked.jobs)
    print(f"{time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
