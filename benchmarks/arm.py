"""How fast the arm answers: inverse kinematics, states, and the reach of every organ-safe direction.

    python -m benchmarks.arm [--quick]

Compared with ur-analytic-ik (per pose, all branches) and with FCL alone (states, reach). Times are CPU seconds of this
process, so that other work on the machine counts little. Every comparison also counts the answers that differ.
"""

import shutil
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from time import process_time

import numpy as np
import ur_analytic_ik

from benchmarks.shared import options, real_ct, versions
from puncture_twin.meshes import folder
from puncture_twin.planning.arm.inverse_kinematics import inverse, wrap_to_pi
from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.arm.ur import UR_MODELS, ur_model
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.collision.fast_checker import FastChecker
from puncture_twin.planning.collision.workcell import ARM_PADDING_MM, case_boxes, case_tool
from puncture_twin.planning.reach.reach import assess_reach_all
from puncture_twin.planning.search.constraints import reach_request
from puncture_twin.planning.search.context import prepare
from puncture_twin.planning.search.search import organ_candidates

CHUNK = 200
"""Poses between changes from one to the other, so that both meet the machine in the same mood."""
SAME_ANGLE = 1e-5
"""rad: how far two solutions of one pose may differ; near a singularity both lose half their digits."""


def main() -> None:
    """Run all of it."""
    arguments = options(__doc__, quick=False)
    print(versions("numpy", "numba", "python-fcl", "ur-analytic-ik"))
    for name in UR_MODELS:
        kinematics(name, 2_000 if arguments.quick else 20_000)
    step = 6.0 if arguments.quick else 2.0
    with tempfile.TemporaryDirectory() as name:
        here = Path(name)
        shutil.copytree(folder() / "abdomen", here / "abdomen")
        reach("abdomen", here / "abdomen" / "case.toml", step, 1_000 if arguments.quick else 10_000)
        if real_ct(here):
            reach("real CT", here / "case_v2.toml", step, 0)


def kinematics(name: str, count: int) -> None:
    """All branches of many poses, in turns with ur-analytic-ik, and which of its solutions we lack."""
    model, theirs = ur_model(name), getattr(ur_analytic_ik, name).inverse_kinematics
    poses = flange_pose(model, np.random.default_rng(0).uniform(-np.pi, np.pi, (count, 6)))
    metres = poses.copy()
    metres[:, :3, 3] /= 1000.0
    inverse(model, poses[:2])
    ours_s = theirs_s = 0.0
    solutions, found = [], []
    for start in range(0, count, CHUNK):
        one, other = poses[start : start + CHUNK], [np.array(T) for T in metres[start : start + CHUNK]]
        begin = process_time()
        solutions.append(inverse(model, one))
        middle = process_time()
        found += [theirs(T) for T in other]
        ours_s, theirs_s = ours_s + middle - begin, theirs_s + process_time() - middle
    every = np.concatenate(solutions)
    missed = sum(_missed(ours, np.array(their)) for ours, their in zip(every, found, strict=True) if their)
    exist = ~np.isnan(every[..., 0])
    worst = np.abs(flange_pose(model, every) - poses[:, None])[exist].max()
    print(
        f"IK {name}: {theirs_s / ours_s:.1f}x; {1e6 * ours_s / count:.2f} us a pose and {1e6 * theirs_s / count:.1f};"
        f" solutions {exist.sum()} and {sum(map(len, found))}, missed {missed}, worst pose error {worst:.1e} mm"
    )


def _missed(ours: np.ndarray, theirs: np.ndarray) -> int:
    """How many of their solutions (k, 6) are none of ours (8, 6)."""
    apart = np.abs(wrap_to_pi(theirs[:, None] - ours[~np.isnan(ours[:, 0])])).max(axis=2)
    return int((apart.min(axis=1, initial=np.inf) > SAME_ANGLE).sum())


def reach(name: str, case_file: Path, step_deg: float, n_states: int) -> None:
    """The reach of every organ-safe direction of a case with FCL alone and with the fast checker, and states."""
    case_file.write_text(case_file.read_text().replace("step_deg = 2.0", f"step_deg = {step_deg}"))
    context = prepare(case_file)
    case, anatomy, placed = context.case, context.anatomy, context.reach
    assert placed is not None
    found = organ_candidates(case, anatomy, context.engine, case.directions())
    requests = [reach_request(case, found, int(row), placed.T_base_ct) for row in np.flatnonzero(found.safe)]
    skin = anatomy.skin.mesh.transformed(placed.T_base_ct)
    room = (case.robot.model, case_tool(case), case_boxes(case, placed.T_base_ct), skin)
    begin = process_time()
    slow = CellChecker(*room, padding_mm=ARM_PADDING_MM)
    middle = process_time()
    fast = FastChecker(*room, padding_mm=ARM_PADDING_MM)
    built = f"built in {middle - begin:.2f} s and {process_time() - middle:.2f} s"
    assess_reach_all(fast, requests[:50])  # compiled, or read from the cache
    begin = process_time()
    answers = assess_reach_all(fast, requests)
    middle = process_time()
    plain = [assess_reach_all(slow, [asked])[0] for asked in requests]
    ours_s, theirs_s = middle - begin, process_time() - middle
    keys = ("reachable", "reason", "depth_mm", "contact", "branch", "margin", "detail")
    differ = sum(any(getattr(a, k) != getattr(b, k) for k in keys) for a, b in zip(answers, plain, strict=True))
    print(
        f"reach {name}: {theirs_s / ours_s:.1f}x; {len(requests)} directions at {step_deg} deg in {ours_s:.2f} s and"
        f" {theirs_s:.2f} s ({1e3 * ours_s / len(requests):.2f} and {1e3 * theirs_s / len(requests):.2f} ms each);"
        f" {differ} answers differ; skin of {len(skin.faces)} triangles; {built}"
    )
    print("  ", dict(Counter(answer.reason.value or "reachable" for answer in answers)))
    if n_states:
        states(slow, fast, n_states, [a.insertion_q for a in answers if a.reachable])


def states(slow: CellChecker, fast: FastChecker, count: int, drives: list[np.ndarray]) -> None:
    """Single states anywhere, and whole insertions."""
    q = np.random.default_rng(1).uniform(-np.pi, np.pi, (count, 6))
    verdicts: list[list[object]] = [[], []]
    seconds = [0.0, 0.0]
    for start in range(0, count, CHUNK):
        for k, checker in enumerate((fast, slow)):
            begin = process_time()
            verdicts[k] += [checker.contact(row, needle_may_touch_patient=False) for row in q[start : start + CHUNK]]
            seconds[k] += process_time() - begin
    free = [i for i in range(count) if verdicts[1][i] is None]
    proven = sum(not fast.open_checks(q[i], needle_may_touch_patient=False) for i in free)
    differ = sum(a != b for a, b in zip(*verdicts, strict=True))
    print(
        f"states anywhere: {seconds[1] / seconds[0]:.1f}x; {count / seconds[0]:.0f} a second against"
        f" {count / seconds[1]:.0f}; {differ} of {count} differ; {len(free)} free, {proven} of them without FCL"
    )
    some = drives[:: max(1, len(drives) // 100)]
    total = sum(map(len, some))
    ours_s, ours = _timed(lambda: [fast.first_contact(d, needle_may_touch_patient=True) for d in some])
    theirs_s, theirs = _timed(lambda: [slow.first_contact(d, needle_may_touch_patient=True) for d in some])
    print(
        f"states of insertions: {theirs_s / ours_s:.1f}x; {total / ours_s:.0f} a second against {total / theirs_s:.0f};"
        f" {sum(a != b for a, b in zip(ours, theirs, strict=True))} of {len(some)} drives differ"
    )


def _timed(work: Callable[[], list[object]]) -> tuple[float, list[object]]:
    begin = process_time()
    result = work()
    return process_time() - begin, result


if __name__ == "__main__":
    main()
