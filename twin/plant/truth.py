"""The ground truth of a rehearsal (where the patient lies, what the joints do) and of an arm off its nominal values.

A commanded configuration becomes a true one in three steps: gears stop at the edge of their play, joints miss by their
repeatability, and true Denavit-Hartenberg numbers carry the flange.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.kinematics import ErringArm
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats, read_only
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.errors import ArmErrors
from puncture_twin.planning.case.tables import MarkerSection
from puncture_twin.planning.formats.points import NamedPoints, parse_points
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.planning.registration.fits import fit_rigid, fit_triad
from puncture_twin.planning.registration.marker_pairs import MIN_MARKERS, match

COLLINEAR = 0.01
"""s2/s1 of the true points below which they leave a rotation free."""


@dataclass(frozen=True, eq=False)
class Truth:
    """Ground truth of a rehearsal; the bevel of a needle that bends points to its side about the needle's z, rad."""

    T_base_ct_true: Floats  # shape (4, 4), mm: the patient in the true base frame
    joint_offsets: Floats
    """Shape (6,), rad: true joint angle minus what the encoder says. They stand for all that changed or was not seen
    since the markers were touched."""
    seed: int
    source: str
    target_ct: Floats | None = None  # shape (3,), mm: true target in the CT; None where it was read without error
    bevel_side: float = 0.0

    def __post_init__(self) -> None:
        for name in ("T_base_ct_true", "joint_offsets", *(() if self.target_ct is None else ("target_ct",))):
            object.__setattr__(self, name, read_only(getattr(self, name)))


def draw_truth(case: Case, T_base_ct: Floats, *, seed: int | None = None) -> Truth:
    """The truth of a case.

    Where the case names a file of true positions, the patient lies where that file says. Otherwise marker errors are
    drawn such that T_base_ct (4, 4), mm, the belief, is a plausible registration of this truth. Without markers belief
    and truth agree. The seed is the case's own where none is given.

    Raises:
        InputError: The file of true positions cannot be used.
    """
    settings = case.rehearsal
    seed = settings.seed if seed is None else seed
    rng = np.random.default_rng(seed)
    offsets = rng.normal(0.0, np.radians(settings.joint_offset_deg), 6)
    if settings.truth_base is not None:
        T_true = _from_file(case, settings.truth_base)
        source = f"true positions from {settings.truth_base}"
    elif case.registration is not None:
        T_true = _drawn(case, case.registration, T_base_ct, rng)
        source = (
            f"drawn with seed {seed}: marker errors of {settings.fle_ct_mm:g} mm in the CT and "
            f"{settings.fle_touch_mm:g} mm at the touch (standard deviations per axis)"
        )
    else:
        T_true, source = T_base_ct, "same as the belief: the case has no markers with errors"
    return Truth(T_true, offsets, seed, source)


def registration_error(
    points_ct: Floats, T_base_ct: Floats, fit: Callable[[Floats, Floats], Floats], noise_mm: tuple[float, float],
    rng: np.random.Generator,
) -> Floats:  # fmt: skip
    """E with T_believed = T_true E: one registration of noisy markers, shape (4, 4), mm, CT frame.

    They are touched at T_base_ct (4, 4); the noise, standard deviations per axis, is of a marker in the CT and a touch.
    """
    read_ct = points_ct + rng.normal(0.0, noise_mm[0], points_ct.shape)
    touched_base = apply(T_base_ct, points_ct) + rng.normal(0.0, noise_mm[1], points_ct.shape)
    return np.asarray(np.linalg.inv(T_base_ct) @ fit(read_ct, touched_base))


def _drawn(case: Case, registration: MarkerSection, T_base_ct: Floats, rng: np.random.Generator) -> Floats:
    in_ct = read_points(case, registration.markers_ct, case.space)
    markers = match(in_ct, read_points(case, registration.markers_base, None), use=registration.use)
    fit = fit_triad if registration.method == "triad" else fit_rigid
    noise = case.rehearsal.fle_ct_mm, case.rehearsal.fle_touch_mm
    error = registration_error(markers.points_ct, T_base_ct, fit, noise, rng)
    return np.asarray(T_base_ct @ np.linalg.inv(error))


def _from_file(case: Case, name: str) -> Floats:
    """T_base_ct, shape (4, 4), mm, of the patient whose true points a file states: the rigid least-squares fit of all.

    Where the target is among them, the translation puts it exactly on its true place: what the twin measures is the
    distance from there.
    """
    true_base = read_points(case, name, None)
    in_ct = {case.target_name: case.target_ct}
    if case.registration is not None:
        markers = read_points(case, case.registration.markers_ct, case.space)
        in_ct = dict(zip(markers.names, markers.points, strict=True)) | in_ct
    rows = [row for row, point in enumerate(true_base.names) if point in in_ct]
    names, points_base = [true_base.names[row] for row in rows], true_base.points[rows]
    points_ct = np.array([in_ct[point] for point in names]).reshape(-1, 3)
    where, named = f"{case.path}: rehearsal.truth_base", ", ".join(names) or "none"
    allowed = "3 or more points, named as the markers and the target, not on a line"
    if len(names) < MIN_MARKERS:
        refuse(f"names shared with the CT: {named}", where, allowed, "too_few_points")
    for side in (points_ct, points_base):
        spread = np.linalg.svd(side - side.mean(axis=0), compute_uv=False)
        if spread[1] <= COLLINEAR * spread[0]:
            refuse(f"{named} are on a line", where, allowed, "points_collinear")
    T = np.array(fit_rigid(points_ct, points_base))
    if case.target_name in names:
        row = names.index(case.target_name)
        T[:3, 3] = points_base[row] - T[:3, :3] @ points_ct[row]
    return T


def read_points(case: Case, name: str, space: Space | None) -> NamedPoints:
    """The points of one of a case's files."""
    return parse_points(case.files.content(name), case.folder / name, default_space=space)


class Gears(NamedTuple):
    """Repeatable errors of a true arm's gears: rad at the output, periods per turn of the joint, phases (6,), rad."""

    amplitude: float
    cycles: float
    phase: Floats  # shape (6,), rad

    def off(self, q: Floats) -> Floats:
        """By how much each joint of (..., 6), rad, is turned too far."""
        return np.asarray(self.amplitude * np.sin(self.cycles * q + self.phase))


NO_GEARS = Gears(0.0, 0.0, np.zeros(6))


class TrueArm(NamedTuple):
    """One arm, drawn: with every joint's full play, and its deviation drawn anew at each arrival, rad."""

    nominal: UrModel
    true: ErringArm
    backlash: float
    repeatability: float
    gears: Gears = NO_GEARS

    def flange_pose(self, q_true: Floats) -> Floats:
        """T_base_flange, shape (..., 4, 4), mm, of true configurations (..., 6), rad, to which the gears add theirs."""
        return np.ascontiguousarray(self.true.link_poses(q_true + self.gears.off(q_true))[..., 6, :, :])

    def settle(self, q_command: Floats, q_before: Floats, rng: np.random.Generator) -> Floats:
        """Joints at rest (6,), rad, for a command, and what this gave for the arrival before, or the first command.

        The play operator: a joint moves only when the motor has crossed the play, q = clip(q_before, q_command - b/2,
        q_command + b/2); then its repeatability adds a normal error, which the next arrival draws anew.
        """
        half = 0.5 * self.backlash
        settled = np.clip(q_before, q_command - half, q_command + half)  # the play operator
        return np.asarray(settled + rng.normal(0.0, self.repeatability, 6))


class PlantArm:
    """An arm as it moves, with the play of its last arrival."""

    def __init__(self, arm: TrueArm, rng: np.random.Generator) -> None:
        self._arm, self._rng, self._sent = arm, rng, np.zeros(6)
        self.rests: list[Floats] = []
        """True joints after each move, (6,), rad."""

    def move_jp(self, q: Floats) -> None:
        """Move to joints (6,), rad: its gears stop short, its joints miss."""
        self.rests.append(self._arm.settle(q, self.rests[-1] if self.rests else q, self._rng))
        self._sent = q

    def measured_jp(self) -> Floats:
        """The last command, (6,), rad: encoders are on the motors' side, and see no play."""
        return self._sent


def draw_true_arm(nominal: UrModel, errors: ArmErrors, rng: np.random.Generator) -> TrueArm:
    """An arm whose errors are drawn from their standard deviations."""
    d_errors = rng.normal(0.0, errors.link_mm, 6)
    d_errors[1] = 0.0  # d2 along axis 2: its axis is parallel to d3's, and both move the arm alike
    a, alpha = np.array(nominal.a) + rng.normal(0.0, errors.link_mm, 6), np.array(nominal.alpha)
    alpha = alpha + rng.normal(0.0, errors.twist, 6)
    true = ErringArm(a, np.array(nominal.d) + d_errors, alpha, rng.normal(0.0, errors.joint, 6))
    return TrueArm(nominal, true, errors.backlash, errors.repeatability)
