"""What each way to fit the markers leaves at the target: predicted beside rooms drawn with exact kinematics.

python -m benchmarks.fit_methods               20,000 rooms a cell, minutes
python -m benchmarks.fit_methods --rooms N

Least squares, weights by the declared readings, and pose and arm estimated together with the aim corrected. The
markers are touched in three ways: as an arm that stands far from singular does, rolled by 60 degrees from marker to
marker, and as the needle is inserted later. The last column has rooms whose arm errs twice as much as is declared.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from benchmarks.shared import options
from puncture_twin.meshes import folder
from puncture_twin.planning.arm.insertion import flange_poses
from puncture_twin.planning.arm.inverse_kinematics import inverse
from puncture_twin.planning.arm.kinematics import farthest_from_singular
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.case.case import Case, load_case
from puncture_twin.planning.case.errors import ErrorModel, error_model
from puncture_twin.planning.case.tables import ErrorsSection
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.planning.registration.fits import Method, fit_rigid
from puncture_twin.planning.registration.marker_noise import reading_noise
from puncture_twin.planning.registration.marker_pairs import MarkerPairs
from puncture_twin.planning.registration.placement import aim_at, aimed, load_placement
from puncture_twin.planning.registration.registration import register
from puncture_twin.planning.uncertainty.pose_error import PoseError
from puncture_twin.twin.rehearsal.trials import Puncture, draw_trials

ROLLS = np.radians(np.arange(0.0, 360.0, 2.0))
APART = np.radians(60.0)
"""By how much the needle is rolled from one marker to the next."""
NOMINAL = {"arm": "nominal", "tip_offset_mm": 1.0, "needle_direction_deg": 0.5, "joint_drift_deg": 0.0}
FINE = {"ct_in_plane_mm": 0.2, "ct_slice_mm": 0.2, "touch_mm": 0.1, "joint_drift_deg": 0.0}
SLICES = {"ct_pixel_mm": 1.0, "ct_spacing_mm": 5.0, "bed_axis": (1.0, 0.0, 0.0)}
ROWS = (
    ("abdomen, calibrated arm", "abdomen/case.toml", (62.0, 96.0), FINE),
    ("abdomen, nominal arm", "abdomen/case.toml", (62.0, 96.0), FINE | NOMINAL),
    ("carton, nominal arm", "carton/case_m.toml", (18.0, 232.0), SLICES | NOMINAL),
)
"""Name, case, direction (degrees) and declaration; a nominal arm has its tip known to 1 mm and 0.5 degrees."""
SVD: Method = "rigid"


class Cell(NamedTuple):
    """Predicted and realised rms of the tip, mm, and how often the 95 % region holds it."""

    predicted: float
    realised: float
    coverage: float

    def text(self) -> str:
        """For a table."""
        return f"{self.predicted:.2f} / {self.realised:.2f}"


class Stand(NamedTuple):
    """What does not depend on the fit: arm, markers as they lie, and the insertion."""

    model: UrModel
    tip_mm: float
    case: Case
    markers: MarkerPairs
    T_base_ct: np.ndarray
    outward_ct: np.ndarray
    q: np.ndarray


def stand_of(path: Path, theta_deg: float, beta_deg: float) -> Stand:
    """A case's markers where they were touched, free of errors, and the insertion farthest from singular."""
    case = load_case(path)
    placement = load_placement(case)
    assert placement is not None and placement.registration is not None
    found, model, tip = placement.registration.markers, case.robot.model, case.needle.length_mm
    T = fit_rigid(found.points_ct, found.points_base)
    theta, beta = np.radians([theta_deg, beta_deg])
    outward = case.T_ct_entry[:3, :3] @ [np.sin(theta) * np.cos(beta), np.sin(theta) * np.sin(beta), np.cos(theta)]
    reached = _reached(model, tip, apply(T, case.target_ct), T[:3, :3] @ outward, ROLLS)
    q = farthest_from_singular(model, reached, T[:3, :3] @ outward)
    return Stand(model, tip, case, MarkerPairs(found.names, found.points_ct, apply(T, found.points_ct)), T, outward, q)


def touches(of: Stand) -> dict[str, np.ndarray]:
    """Joints (N, 6), rad, at the touches, by how they are chosen."""
    up, along = of.T_base_ct[:3, :3] @ of.case.T_ct_entry[:3, 2], of.T_base_ct[:3, :3] @ of.outward_ct
    far, rolled, alike = [], [], []
    for row, point in enumerate(of.markers.points_base):
        for kept, rolls in ((far, np.zeros(1)), (rolled, np.array([row * APART]))):
            q = _reached(of.model, of.tip_mm, point, up, rolls)
            q = q if len(q) else _reached(of.model, of.tip_mm, point, along, ROLLS)
            kept.append(farthest_from_singular(of.model, q, up))
        q = _reached(of.model, of.tip_mm, point, along, ROLLS)
        turns = (q - of.q + np.pi) % (2 * np.pi) - np.pi
        alike.append(of.q + turns[np.abs(turns).max(axis=1).argmin()])
    ways = {"far from singular": far, "rolled": rolled, "as inserted": alike}
    return {name: np.array(q) for name, q in ways.items()}


def _reached(model: UrModel, tip: float, point: np.ndarray, outward: np.ndarray, rolls: np.ndarray) -> np.ndarray:
    q = inverse(model, flange_poses(point, outward, tip, rolls)).reshape(-1, 6)
    return np.asarray(q[~np.isnan(q).any(axis=1)])


def cell(of: Stand, errors: ErrorModel, q_touch: np.ndarray, method: Method, rooms: int, arm: float = 1.0) -> Cell:
    """One fit, in rooms whose arm errs so many times as much as is declared; without rooms what is predicted alone."""
    noise = reading_noise(errors, of.model, of.tip_mm, q_touch, known=True)
    target = of.case.target_ct
    fitted = register(of.markers, method=method, target_ct=target, noise=noise)
    done = aimed(fitted, aim_at(of.model, of.tip_mm, target, of.q)) if method == "joint" else fitted
    assert done.uncertainty is not None
    error = PoseError(of.model, of.tip_mm, apply(of.T_base_ct, target), errors, done.uncertainty)
    puncture = Puncture(
        of.model, of.tip_mm, method, noise, of.markers.points_ct, q_touch, of.T_base_ct, target, of.outward_ct, of.q,
        aim=done.aim,
    )  # fmt: skip
    cov = error.tip_covariance_ct(of.q[None])[0]
    predicted = float(np.sqrt(np.trace(cov)))
    if rooms == 0:
        return Cell(predicted, np.nan, np.nan)
    truth = replace(errors, arm=errors.arm.scaled(arm))
    drawn = draw_trials(puncture, truth, rooms, np.random.default_rng(0))
    drawn = drawn.of(drawn.reached)
    off = drawn.tip_ct - drawn.target_ct
    inside = np.einsum("na,ab,nb->n", off, np.linalg.inv(cov), off) <= chdtri(3, 0.05)
    return Cell(predicted, float(np.sqrt(np.mean(np.sum(off**2, axis=1)))), float(inside.mean()))


def main() -> None:
    """Print the table."""
    rooms = options(__doc__, rooms=20_000).rooms
    print("| | markers touched | least squares | weighted | corrected | weighted, twice | corrected, twice |")
    print("|" + "---|" * 7)
    regions = []
    for name, how, cells in rows(rooms):
        regions += [one.coverage for one, (_, arm) in zip(cells, FITS, strict=True) if arm == 1]
        print(f"| {name} | {how} | {' | '.join(one.text() for one in cells)} |", flush=True)
    print(f"95 % regions where the declaration is right: {min(regions):.3f} to {max(regions):.3f}")


FITS: tuple[tuple[Method, float], ...] = ((SVD, 1), ("weighted", 1), ("joint", 1), ("weighted", 2), ("joint", 2))
"""Of each column: how it is fitted, and by how much more than is declared the true arm errs."""


def rows(rooms: int) -> Iterator[tuple[str, str, list[Cell]]]:
    """The table, row by row: whose, how the markers are touched, and a cell for each of `FITS`."""
    for name, path, angles, keys in ROWS:
        of, errors = stand_of(folder() / path, *angles), error_model(ErrorsSection(**keys), space=Space.LOCAL)
        for how, q in touches(of).items():
            yield name, how, [cell(of, errors, q, method, rooms, arm) for method, arm in FITS]


if __name__ == "__main__":
    main()
