"""`touch CASE --host HOST`: markers that somebody touches with a real UR's needle, read off its joints."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np

from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.output.output_set import writing
from puncture_twin.planning.base.provenance import inputs_document
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.formats.points import NamedPoints, write_points
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.fits import fit_rigid
from puncture_twin.planning.registration.marker_pairs import MIN_MARKERS
from puncture_twin.planning.search.choice import Choice
from puncture_twin.twin.devices import Arm
from puncture_twin.twin.jobs.terminal import write_result
from puncture_twin.twin.plant.truth import read_points
from puncture_twin.twin.report.present import Field, Section, footer, grid, text

TOUCH, SUMMARY = "touch.csv", "touch.json"


@dataclass(frozen=True, eq=False)
class LedTouches:
    """The k markers that were touched of a case's n, in its CT, and where the arm read them, base frame, mm."""

    case: Case
    ct: NamedPoints
    base: NamedPoints
    left_out: tuple[str, ...]
    files: tuple[Path, ...] = ()

    @property
    def suffices(self) -> bool:
        """Whether the readings register."""
        return len(self.base.names) >= MIN_MARKERS

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON: mm and degrees; what the rigid fit leaves of each marker, None of fewer than three."""
        assert self.base.joints is not None
        left: Floats | None = None
        if self.suffices:
            T_base_ct = fit_rigid(self.ct.points, self.base.points)
            left = np.linalg.norm(apply(T_base_ct, self.ct.points) - self.base.points, axis=1)
        rows = zip(self.base.names, self.base.points, np.degrees(self.base.joints), strict=True)
        return {
            "case": self.case.name,
            "touches": [
                {"marker": name, "point_mm": point.tolist(), "joints_deg": q.tolist(),
                 "residual_mm": None if left is None else float(left[row])}
                for row, (name, point, q) in enumerate(rows)
            ],
            "left_out": list(self.left_out),
            "suffices": self.suffices,
            "fre_mm": None if left is None else float(np.sqrt(np.mean(left**2))),
            "inputs": inputs_document(self.case.inputs),
            "files": [str(path) for path in self.files],
        }  # fmt: skip


def refuse_of_twin(choice: Choice, seed: int) -> None:
    """Refuse what is of the twin alone beside ``--host``."""
    if choice != Choice() or seed:
        refuse("a direction, or a seed, beside --host", "touch", "--host HOST alone: no tour is planned",
               "conflicting_options")  # fmt: skip


def touch_by_hand(case: Case, arm: Arm, ready: Callable[[str], bool], out: Path) -> LedTouches:
    """Read the arm at each of a case's markers, by its nominal kinematics; written as `markers_base` is read.

    Args:
        ready: Asks for a marker, and returns when the tip is on it; False where nobody touches any more.

    Raises:
        InputError: The case has no markers, none is touched, or the robot hangs up.
        NoAnswerError: The arm does not come to rest.
    """
    if case.registration is None:
        refuse("no list of markers", case.path, "[registration] markers_ct", "no_markers")
    listed = read_points(case, case.registration.markers_ct, case.space)
    q = np.array([arm.measured_jp() for _ in takewhile(ready, listed.names)]).reshape(-1, 6)
    if not (count := len(q)):
        refuse("no marker was touched", "touch --host", "a line (Enter) for each, the tip on it", "empty")
    T = flange_pose(case.robot.model, q)
    tips = T[:, :3, 3] + case.needle.length_mm * T[:, :3, 2]
    ct = NamedPoints(listed.names[:count], listed.points[:count], listed.space)
    read = LedTouches(case, ct, NamedPoints(ct.names, tips, None, joints=q), listed.names[count:])
    with writing(out, "touch", inputs=case.inputs, names=(TOUCH, SUMMARY)) as draft:
        read = replace(read, files=draft.final(tuple(draft.folder / name for name in (TOUCH, SUMMARY))))
        write_points(draft.folder / TOUCH, read.base)
        write_result(read.summary(), draft.folder / SUMMARY, out)
    return read


ROWS = (
    Field("marker", "marker"),
    Field("base frame, mm", lambda row: "  ".join(f"{mm:8.2f}" for mm in row["point_mm"])),
    Field("the rigid fit leaves", "residual_mm", 2, "mm"),
)


def led_text(read: LedTouches) -> str:
    """For the terminal."""
    said = read.summary()
    left = [f"not touched: {', '.join(said['left_out'])}"] if said["left_out"] else []
    few = [] if read.suffices else [f"no registration: {MIN_MARKERS} markers are needed"]
    head = f"{len(said['touches'])} markers read off the joints of the nominal {read.case.robot.model.name}"
    return text([Section(head, [grid(ROWS, said["touches"]), *left, *few]), *footer(read.files)])
