"""Do the predicted chances come true? Many rooms drawn from a declaration, against what it predicts.

python -m benchmarks.trust                     100,000 rooms of each anatomy and set of markers, minutes
python -m benchmarks.trust --quick             a tenth of the directions and 4,000 rooms
python -m benchmarks.trust --rooms N           N rooms

Every room has its own truth: markers read and touched with errors, registered, and the needle driven by exact
kinematics. Where the noise is ``found``, the declaration gives the errors' shape alone, and each room's residuals
their size s; regions are Fisher's F then, and chances Student's t. That is what s tells where nothing is known of the
true size, so the true size is drawn evenly on a logarithmic scale, as far out as rooms that are counted can come from:
rooms with s between 1/8 and 2 of the declaration.
"""

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.special import chdtri, fdtri

from benchmarks.shared import options, real_ct
from puncture_twin.meshes import folder
from puncture_twin.planning.arm.insertion import flange_poses
from puncture_twin.planning.arm.inverse_kinematics import inverse
from puncture_twin.planning.arm.kinematics import farthest_from_singular
from puncture_twin.planning.case.errors import ErrorModel
from puncture_twin.planning.clearance.fast_engine import near_faces
from puncture_twin.planning.geometry.containment import inside_each
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.reach.standoff import case_axis_lengths
from puncture_twin.planning.registration.fits import FitUncertainty, Method, NoiseTest, fit_rigid
from puncture_twin.planning.registration.marker_noise import reading_noise, touching_configuration
from puncture_twin.planning.registration.marker_pairs import MarkerPairs
from puncture_twin.planning.registration.placement import aim_at, aimed, load_placement
from puncture_twin.planning.registration.registration import register
from puncture_twin.planning.search.chances import ChanceModel, demanding, refined_chances
from puncture_twin.planning.search.context import CaseContext, prepare
from puncture_twin.planning.search.search import organ_candidates
from puncture_twin.planning.uncertainty.hit import HitModel, hit_in_ball, hit_model
from puncture_twin.planning.uncertainty.pose_error import PoseError
from puncture_twin.twin.rehearsal.trials import Puncture, Trials, draw_trials

REAL_ERRORS = "\n[errors]\nct_pixel_mm = 1.5\nct_spacing_mm = 3.0\nsurface_mm = 0\n"
"""Its contours are taken for true: what is held against rooms here is the needle's own error."""
MARKERS = (3, 4, 6)
SEED = 20191104
BINS = 10
RADII = (0.4, 0.7, 1.0, 1.4)
"""Of balls about the target, over the tip's predicted rms: a lesion that is hit for certain shows no calibration."""
FOUND = (1 / 8, 2.0)
"""Errors' size by the residuals over the declared one: rooms in which it lies outside are not counted."""
STEPS = 24
"""Of the errors' true size, evenly on a logarithmic scale as far out as residuals within `FOUND` may come from."""
RARELY = 1e-3
"""Part of the rooms with residuals at an end of `FOUND` whose true size is left out there."""
SIZES = np.geomspace(*FOUND, 12)
"""At which chances to touch are computed, those to hit at eight times as many; between them interpolated."""
PARTS = (0.5, 0.9, 0.99, 1.0)
"""Of the rooms by how far the tip is off: those that are less far are asked about fewer faces."""
RATIO, COVERAGE, ECE = (0.97, 1.03), (0.94, 0.96), 0.01
TARGETS = f"ratio {RATIO[0]} to {RATIO[1]}, region {COVERAGE[0]} to {COVERAGE[1]}, ECE at most {ECE}"


@dataclass(frozen=True, eq=False)
class Tally:
    """Predictions beside what came, over all directions of one row of the table.

    Attributes:
        noticed: Share of rooms whose residuals break the declaration's test at its 1 %, were it taken at its word; None
            where the noise is found.
    """

    ratio: float
    coverage: float
    ece_hit: float
    ece_touch: float
    noticed: float | None

    @property
    def holds(self) -> bool:
        """Whether every figure is where it should be."""
        inside = RATIO[0] <= self.ratio <= RATIO[1] and COVERAGE[0] <= self.coverage <= COVERAGE[1]
        return inside and self.ece_hit <= ECE and self.ece_touch <= ECE

    def text(self) -> str:
        """Cells of a table."""
        figures = f"{self.ratio:.3f} | {self.coverage:.3f} | {self.ece_hit:.4f} | {self.ece_touch:.4f}"
        noticed = "" if self.noticed is None else f"{self.noticed:.3f}"
        return f"{figures} | {noticed} | {'yes' if self.holds else 'NO'}"


@dataclass(frozen=True, eq=False)
class Scene:
    """One anatomy, its declared errors, directions of a UR3; half of these pass nearest to what must not be touched."""

    name: str
    context: CaseContext
    hit: HitModel
    errors: ErrorModel
    outward_ct: np.ndarray
    q: np.ndarray
    points_ct: np.ndarray
    T_base_ct: np.ndarray


def calibration_error(predicted: np.ndarray, came: np.ndarray) -> float:
    """ECE: the mean, over ten bins weighted by their counts, of |mean prediction - share that came|."""
    which = np.minimum((predicted * BINS).astype(int), BINS - 1)
    parts = [abs(float((predicted[which == b] - came[which == b]).sum())) for b in range(BINS)]
    return sum(parts) / max(len(predicted), 1)


def scene(name: str, path: Path, directions: int) -> Scene:
    """Prepare a case: its directions are those that the organs leave and an arm reaches by its kinematics alone."""
    context = prepare(path, arm=False)
    case, found = context.case, load_placement(context.case)
    assert case.errors is not None and found is not None and found.registration is not None
    markers = found.registration.markers
    T, points = fit_rigid(markers.points_ct, markers.points_base), markers.points_ct
    pairs = [(i, j) for j in range(len(points)) for i in range(j)]
    while len(points) < max(MARKERS):  # beside the case's own: the middles between two of them
        i, j = pairs[len(points) - len(markers.points_ct)]
        points = np.vstack([points, 0.5 * (points[i] + points[j])])
    outward, q = _reached(context, T, directions)
    mesh = context.anatomy.structure(case.target_structure).mesh
    hit = hit_model(case.hit_radius_mm, mesh, case.target_ct)
    return Scene(name, context, hit, case.errors, outward, q, points[: max(MARKERS)], T)


def _reached(context: CaseContext, T_base_ct: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    case, rng = context.case, np.random.default_rng(SEED)
    judged = organ_candidates(case, context.anatomy, context.engine, case.directions())
    rows = np.flatnonzero(judged.safe)
    nearest = rows[np.argsort(judged.clearance.least[rows])]
    order = [row for pair in zip(nearest, rng.permutation(rows), strict=True) for row in pair]
    model, tip, rolls = case.robot.model, case.needle.length_mm, np.radians(np.arange(0, 360, 30))
    outward, kept = [], []
    for row in order:
        along = judged.outward_ct[row]
        poses = flange_poses(apply(T_base_ct, case.target_ct), T_base_ct[:3, :3] @ along, tip, rolls)
        q = inverse(model, poses).reshape(-1, 6)
        if np.isfinite(q).all(axis=1).any() and len(kept) < count:
            outward.append(along)
            kept.append(farthest_from_singular(model, q, T_base_ct[:3, :3] @ along))
    return np.array(outward), np.array(kept)


def punctures(of: Scene, markers: int, *, corrected: bool = False) -> Iterator[tuple[Puncture, PoseError]]:
    """Each direction's puncture, and the belief that the declaration gives of it; its aim corrected, or not."""
    case, T = of.context.case, of.T_base_ct
    model, tip, points = case.robot.model, case.needle.length_mm, of.points_ct[:markers]
    there, down = apply(T, points), -(T[:3, :3] @ case.T_ct_entry[:3, 2])
    q_touch = np.array([touching_configuration(model, tip, point, down) for point in there])
    noise = reading_noise(of.errors, model, tip, q_touch, known=True)
    pairs = MarkerPairs(tuple(f"M{i}" for i in range(markers)), points, there)
    method: Method = "joint" if corrected else "weighted"
    fitted, target = register(pairs, method=method, target_ct=case.target_ct, noise=noise), case.target_ct
    for outward, q in zip(of.outward_ct, of.q, strict=True):
        done = aimed(fitted, aim_at(model, tip, target, q)) if corrected else fitted
        assert done.uncertainty is not None
        error = PoseError(model, tip, apply(T, target), of.errors, done.uncertainty)
        yield Puncture(model, tip, method, noise, points, q_touch, T, target, outward, q, aim=done.aim), error


def tally(
    of: Scene, markers: int, rooms: int, *, truth: float = 1.0, found: bool = True, seed: int = SEED,
    corrected: bool = False,
) -> dict[str, Tally]:  # fmt: skip
    """Rooms of one anatomy and set of markers, by what is known of the noise.

    ``known``: the declaration is taken at its word. ``found``: the residuals give the size, whatever it is (`FOUND`).
    ``found, size 1``: likewise, but the true size is always the declared one, which a chance that follows from the
    residuals alone cannot know. ``truth`` is the true errors over the declared ones; where it is ``corrected``, each
    direction's aim is, by what the residuals tell of the arm.
    """
    rng, each, freedom = np.random.default_rng(seed), max(rooms // len(of.q), 1), 3 * markers - 6
    sums = {"known": _Sums(), "found": _Sums(), "found, size 1": _Sums()}
    for puncture, error in punctures(of, markers, corrected=corrected):
        drawn = draw_trials(puncture, of.errors.scaled(truth), each, rng)
        drawn = drawn.of(drawn.reached)
        came, sizes = _came(of, puncture, error, drawn), np.sqrt(drawn.chi_squared / freedom)
        sums["known"].add(_predicted(of, error, puncture, None), np.ones(len(sizes)), drawn, came)
        if not found:
            continue
        told = _predicted(of, error, puncture, freedom)
        sums["found, size 1"].add(told, sizes, drawn, came)
        true_sizes = _true_sizes(freedom)
        many = each * np.log(true_sizes[-1] / true_sizes[0]) / np.log(FOUND[1] / FOUND[0]) / len(true_sizes)
        for true_size in true_sizes:
            drawn = draw_trials(puncture, of.errors.scaled(truth * true_size), int(np.ceil(many)), rng)
            drawn = drawn.of(drawn.reached)
            sizes = np.sqrt(drawn.chi_squared / freedom)
            if FOUND[0] <= true_size <= FOUND[1]:
                sums["found"].add_error(told, sizes / true_size, drawn, true_size)
            counted = (sizes >= FOUND[0]) & (sizes <= FOUND[1])
            if counted.any():
                drawn = drawn.of(counted)
                sums["found"].add_chances(told, sizes[counted], drawn, _came(of, puncture, error, drawn))
    radius = {"known": chdtri(3, 0.05), "found": 3 * fdtri(3, freedom, 0.95)}
    drawn_for = {name: part for name, part in sums.items() if part.hits}
    return {name: part.tally(radius[name.partition(",")[0]], freedom) for name, part in drawn_for.items()}


def _true_sizes(freedom: int) -> np.ndarray:
    """From which residuals within `FOUND` come, shape (m,)."""
    low, high = np.sqrt(freedom / chdtri(freedom, (RARELY, 1 - RARELY)))
    return np.geomspace(FOUND[0] * low, FOUND[1] * high, STEPS)


class Told(NamedTuple):
    """What is predicted of one puncture: chances to hit lesion and balls (m, 5), and to touch, at m sizes."""

    cov_ct: np.ndarray
    hit: np.ndarray
    touch: np.ndarray

    def at(self, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Chances (n, 5) and (n, k) of rooms with these sizes (n,) by their residuals."""
        return _between(sizes, self.hit), _between(sizes, self.touch)


def _between(sizes: np.ndarray, chances: np.ndarray) -> np.ndarray:
    """Chances (m, k), at sizes spread over `FOUND`, at other sizes; of one alone, where size does not matter."""
    if len(chances) == 1:
        return np.broadcast_to(chances[0], (len(sizes), chances.shape[1]))
    grid = np.log(np.geomspace(*FOUND, len(chances)))
    at = np.log(np.clip(sizes, *FOUND))
    return np.clip(PchipInterpolator(grid, chances)(at), 0.0, 1.0)


def _predicted(of: Scene, error: PoseError, puncture: Puncture, freedom: int | None) -> Told:
    """Chances as the search computes them, those to touch refined."""
    outward, q = puncture.outward_ct[None], puncture.q_insertion[None]
    hit, touch = [], []
    for size in SIZES if freedom else (1.0,):
        asked = _believed(of, error, size, freedom)
        first = asked.chances(outward, q)
        touch.append(refined_chances(asked, outward, q, first, np.ones(first.touch.shape, bool)).touch[0])
    for size in np.geomspace(*FOUND, 8 * len(SIZES)) if freedom else (1.0,):
        told = _believed(of, error, size, freedom).error
        cov, tip = told.covariance_ct(q), told.tip_covariance(q)
        balls = [hit_in_ball(tip, radius, freedom)[0] for radius in _radii(error, q)]
        hit.append([of.hit.chance(told, cov)[0], *balls])
    return Told(error.tip_covariance_ct(q)[0] / error.fit.test.scale**2, np.array(hit), np.array(touch))


def _believed(of: Scene, error: PoseError, size: float, freedom: int | None) -> ChanceModel:
    """What chances are computed from where the residuals have a size."""
    fit, count = error.fit, error.fit.noise.cov_base.shape[0]
    test = NoiseTest(count, float(size**2 * (3 * count - 6)), found=freedom is not None)
    told = replace(error, fit=FitUncertainty(fit.noise, fit.R_base_ct, fit.center_base, fit.fit_map, test))
    return ChanceModel(of.context.case, of.context.anatomy, of.context.engine, told, of.hit)


def _radii(error: PoseError, q: np.ndarray) -> np.ndarray:
    """Of the balls, mm."""
    return np.array(RADII) * np.sqrt(np.trace(error.tip_covariance(q)[0]))


def _came(of: Scene, puncture: Puncture, error: PoseError, rooms: Trials) -> tuple[np.ndarray, np.ndarray]:
    """Which rooms hit lesion and balls, shape (n, 5), and which touch what, shape (n, k)."""
    case, anatomy = of.context.case, of.context.anatomy
    away = np.linalg.norm(rooms.tip_ct - rooms.target_ct, axis=1)
    if case.hit_radius_mm is not None:
        hit = away < case.hit_radius_mm
    else:
        hit = inside_each(anatomy.structure(case.target_structure).mesh, rooms.tip_ct)
    shift = np.linalg.norm(rooms.tip_ct - case.target_ct, axis=1)
    ends = np.unique(np.ceil(len(shift) * np.array(PARTS)).astype(int))
    touched = np.zeros((len(shift), len(demanding(anatomy.checked))), bool)
    for part in np.split(np.argsort(shift), ends[:-1]):
        touched[part] = _touched(of, puncture, rooms.of(part), float(shift[part].max(initial=0.0)))
    within = away[:, None] < _radii(error, puncture.q_insertion[None])
    return np.column_stack([hit, within]), touched


def _touched(of: Scene, puncture: Puncture, rooms: Trials, shift: float) -> np.ndarray:
    """Which rooms touch what, shape (n, k); their tips are no farther off than a shift."""
    case, checked = of.context.case, of.context.anatomy.checked
    columns, radius = demanding(checked), case.needle.radius_mm
    lengths = case_axis_lengths(case, of.context.anatomy, puncture.outward_ct[None])[0]
    turn = np.linalg.norm(rooms.outward_ct - puncture.outward_ct, axis=1).max(initial=0.0)
    touched = np.zeros((len(rooms.tip_ct), len(columns)), bool)
    for place, column in enumerate(columns):
        length = float(lengths[column])
        reach = (radius + shift + 1e-6, radius + shift + length * turn + 1e-6)
        faces = near_faces(of.context.engine.blocks[column], case.target_ct, puncture.outward_ct, length, reach)
        if len(faces):
            touched[:, place] = faces.distance(rooms.tip_ct, rooms.outward_ct, length) < radius
    return touched


@dataclass(eq=False)
class _Sums:
    """What is collected over the directions of one row of the table."""

    squares: list[np.ndarray] = field(default_factory=list)
    errors: list[tuple[float, float]] = field(default_factory=list)
    hits: list[np.ndarray] = field(default_factory=list)
    touches: list[np.ndarray] = field(default_factory=list)
    tests: list[np.ndarray] = field(default_factory=list)

    def add(self, told: Told, sizes: np.ndarray, rooms: Trials, came: tuple[np.ndarray, np.ndarray]) -> None:
        """One direction: what was predicted, each room's own size, and what came."""
        self.add_error(told, sizes, rooms)
        self.add_chances(told, sizes, rooms, came)
        self.tests.append(rooms.chi_squared)

    def add_error(self, told: Told, sizes: np.ndarray, rooms: Trials, true_size: float = 1.0) -> None:
        """Squares of what came and was predicted, both over the true size: their means are alike where it is fixed."""
        came = float(((rooms.tip_ct - rooms.target_ct) ** 2).sum()) / true_size**2
        self.errors.append((came, float(np.trace(told.cov_ct) * (sizes**2).sum())))

    def add_chances(self, told: Told, sizes: np.ndarray, rooms: Trials, came: tuple[np.ndarray, np.ndarray]) -> None:
        """Whether regions held, and chances came true, of rooms with these sizes."""
        error = rooms.tip_ct - rooms.target_ct
        square = np.einsum("na,ab,nb->n", error, np.linalg.inv(told.cov_ct), error)
        self.squares.append(square / sizes**2)
        hit, touch = told.at(sizes)
        self.hits += [np.array(pair) for pair in zip(hit.T, came[0].T, strict=True)]
        for place in np.flatnonzero((touch.max(axis=0) > 1e-6) | came[1].any(axis=0)):
            self.touches.append(np.array([touch[:, place], came[1][:, place]]))

    def tally(self, radius_squared: float, freedom: int) -> Tally:
        """The figures."""
        realised, predicted = np.sum(self.errors, axis=0)
        hits = np.concatenate(self.hits, axis=1)
        touches = np.concatenate([np.zeros((2, 0)), *self.touches], axis=1)
        return Tally(
            ratio=float(np.sqrt(realised / predicted)),
            coverage=float(np.mean(np.concatenate(self.squares) <= radius_squared)),
            ece_hit=calibration_error(*hits),
            ece_touch=calibration_error(*touches),
            noticed=float(np.mean(np.concatenate(self.tests) > chdtri(freedom, 0.01))) if self.tests else None,
        )


def scenes(directions: int, temporary: Path) -> Iterator[Scene]:
    """Three anatomies: the embedded abdomen and carton, and a real CT where it is on this machine."""
    yield scene("abdomen", folder() / "abdomen", directions)
    yield scene("carton-m", folder() / "carton" / "case_m.toml", directions)
    if not real_ct(temporary):
        yield scene("carton-l", folder() / "carton" / "case_l.toml", directions)
        return
    text = (temporary / "case_v2.toml").read_text("utf-8")
    for simpler in ("fle_mm = 1.0\n", "fle_ct_mm = 0.9\n", "fle_touch_mm = 0.1\n"):
        text = text.replace(simpler, "")
    (temporary / "case.toml").write_text(text + REAL_ERRORS, "utf-8")
    yield scene("real CT", temporary / "case.toml", directions)


def main() -> None:
    """Print the table."""
    stated = options(__doc__, rooms=100_000, quick=False)
    rooms, directions = (4_000, 4) if stated.quick else (stated.rooms, 10)
    head = "anatomy | markers | noise | realised / predicted rms | 95 % region | ECE hit | ECE touch | warned | holds"
    print(f"{rooms} rooms a row; targets: {TARGETS}\n| {head} |\n|" + "---|" * 9, flush=True)
    with tempfile.TemporaryDirectory() as temporary:
        for of in scenes(directions, Path(temporary)):
            for markers in MARKERS:
                right, wrong = tally(of, markers, rooms), tally(of, markers, rooms // 4, truth=2.0, found=False)
                rows = list(right.items())
                rows.append(("known, true errors twice the declared", wrong["known"]))
                for truth, name in ((1.0, "known, aim corrected"), (2.0, "aim corrected, true errors twice")):
                    aimed_at = tally(of, markers, rooms // 4, truth=truth, found=False, corrected=True)
                    rows.append((name, aimed_at["known"]))
                for noise, figures in rows:
                    print(f"| {of.name} | {markers} | {noise} | {figures.text()} |", flush=True)


if __name__ == "__main__":
    main()
