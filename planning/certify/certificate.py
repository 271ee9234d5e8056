"""A certified map of a cap of directions: the value, its versioned file, and the safe cone that it gives candidates."""

import json
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.structure import Structure
from puncture_twin.planning.base import strict_json
from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.files import atomic
from puncture_twin.planning.base.output.manifest import read_output
from puncture_twin.planning.base.polar_map import Entry, Sectors, polar_map
from puncture_twin.planning.base.provenance import Input, inputs_document, read_inputs
from puncture_twin.planning.base.reasons import REASON_COLOURS, REASON_TEXT, SAFE, Reason, Rgb
from puncture_twin.planning.base.text import Facts, Shown, brief
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.entry import angles
from puncture_twin.planning.certify.cells import SQUARE_DEGREES, Cells, nearest_cell, split
from puncture_twin.planning.reach.standoff import farthest_flange
from puncture_twin.planning.search.candidates import CONE_CERTIFIED, Candidates
from puncture_twin.planning.search.ranking import ranked
from puncture_twin.planning.uncertainty.pose_error import PoseError, any_pose

MOST_TOUCH = 0.5
"""More than every other needle is no limit."""


@dataclass(frozen=True, eq=False)
class Question:
    """The question of a certificate: everything but the surfaces that a verdict depends on; mm and rad."""

    case_name: str
    inputs: tuple[Input, ...]
    target_ct: Floats  # shape (3,)
    R_ct_entry: Floats  # shape (3, 3)
    theta: tuple[float, float]
    """The cap's lowest and highest angle, as ``beta``."""
    beta: tuple[float, float]
    length: float
    standoff: float | None
    """Distance tip to target before the insertion where the case states one, else None."""
    skin_gap: float
    """The least distance from the waiting tip to the skin, along the needle."""
    farthest: float
    """The flange's greatest distance from the target while the tip waits: how far skin matters."""
    radius: float
    longest: float
    max_skin_angle: float
    structures: tuple[str, ...]
    """Names of the k structures that demand a margin."""
    margins: Floats  # shape (k,), their margins; with ``touch`` at least so wide that the chance is kept
    touch: float | None = None
    """The chance to touch each structure that no safe cell exceeds; None asks for none."""

    def cap(self) -> Cells:
        """The whole cap of directions as one cell."""
        return Cells(np.array([self.theta], float), np.array([self.beta], float))


def question_of(
    case: Case,
    anatomy: Anatomy,
    *,
    theta: tuple[float, float] | None = None,
    beta: tuple[float, float] | None = None,
    touch: float | None = None,
    error: PoseError | None = None,
) -> Question:
    """The question that a certificate of a case answers; see `certify`."""
    for table, declared, straight in (
        ("breathing", case.breathing, "a body that does not move"),
        ("tissue", case.bending, "a needle that does not bend"),
    ):
        if declared is not None:
            what = f"[{table}]: a certificate proves {straight}"
            refuse(what, case.path, f"a case without [{table}]; or a search, which includes it", "not_certifiable")
    theta, beta = theta or case.search.theta, beta or case.search.beta
    if not (0 <= theta[0] <= theta[1] <= np.pi + 1e-12 and beta[0] <= beta[1] <= beta[0] + 2 * np.pi + 1e-12):
        refuse("the cap is not a range of angles", "certify", "theta 0 to 180, beta 0 to 360", "out_of_range")
    demanding = [s for s in anatomy.checked if s.demands_margin]
    margins = np.array([s.margin_mm for s in demanding], dtype=np.float64)
    if touch is not None:  # where it is more than a margin, what keeps the chance in any configuration
        margins = np.maximum(margins, _kept(case, demanding, touch, error))
    return Question(
        case_name=case.name,
        inputs=case.inputs,
        target_ct=case.target_ct,
        R_ct_entry=case.T_ct_entry[:3, :3],
        theta=(float(theta[0]), float(theta[1])),
        beta=(float(beta[0]), float(beta[1])),
        length=case.needle.length_mm,
        standoff=case.needle.standoff_mm,
        skin_gap=case.needle.skin_gap_mm,
        farthest=farthest_flange(case.needle, case.search.max_skin_angle),
        radius=case.needle.radius_mm,
        longest=case.needle.longest_path_mm,
        max_skin_angle=float(case.search.max_skin_angle),
        structures=tuple(s.name for s in demanding),
        margins=margins,
        touch=touch,
    )


def _kept(case: Case, demanding: list[Structure], touch: float, error: PoseError | None) -> Floats:
    """Clearances, (k,), mm, at which structures are touched no more often than ``touch``."""
    if not 0.0 < touch <= MOST_TOUCH:
        refuse(f"chance to touch {touch:g}", "certify", f"above 0, at most {MOST_TOUCH:g}", "out_of_range")
    if error is None:
        message = "a chance to touch cannot be certified: the needle's error needs markers and [errors]"
        refuse(message, case.path, "[registration] with markers, and [errors]; or no such limit", "not_certifiable")
    farthest = np.array([np.linalg.norm(s.mesh.vertices - case.target_ct, axis=1).max() for s in demanding])
    waiting = farthest_flange(case.needle, case.search.max_skin_angle)
    lengths = np.array([waiting if s.outside else case.needle.length_mm for s in demanding])
    surface_mm = np.sqrt([np.linalg.eigvalsh(error.surface_cov_ct(s.voxel_ct))[-1] for s in demanding])
    return any_pose(error).margin(touch, error.freedom, farthest, lengths, case.needle.radius_mm, surface_mm)


CERTIFICATE_VERSION = 7
"""Version of the file's layout and of what a cell claims. 3: lists its inputs with their roles, files that a file names
included; a length each structure is checked to. 4: a safe cell keeps the image up to the flange at standoff. 5: a
chance to touch that no safe cell exceeds, to first order. 6: whatever the structure's shape. 7: what is outside of
the body, and beyond the image, counts up to each direction's own flange."""
MAX_CERTIFICATE_BYTES = 500_000_000
"""A certificate has some ten thousand cells; a larger file is something else."""
CERTIFICATE_ALLOWED = f"a certificate of version {CERTIFICATE_VERSION}, as search --certify writes it"

NAMES = frozenset({
    *("version", "case", "inputs", "target_ct_mm", "R_ct_entry", "theta_rad", "beta_rad", "length_mm", "standoff_mm"),
    *("skin_gap_mm", "farthest_flange_mm", "radius_mm", "longest_path_mm", "max_skin_angle_rad", "margins_mm"),
    *("touch", "size_rad", "queries", "summary", "tree", "witness"),
})  # fmt: skip
"""The keys of a certificate."""
CONE_ROUNDING_RAD = 1e-7
"""Taken from a safe cone: arccos near 1 rounds to 1e-8."""
CERTIFIED = (
    "clearance to every structure with a margin",
    "what is outside of the body, or beyond the image, up to the flange at standoff; faces that cut the body",
    "skin entry",
    "skin re-entry up to the flange at standoff",
    "path length",
    "skin angle",
)
"""The constraints that hold all over a safe cell."""
TOUCH_CERTIFIED = "chance to touch each structure: at most {:g}"
"""Also certified where a chance was stated; margins are then so wide that a cell is rejected for it."""
NOT_CERTIFIED = ("reach of the arm", "approach of the arm", "limits of chances (min_hit, max_touch)")
"""Constraints that a certificate does not prove."""
PROVED_SAFE, REJECTED, UNDECIDED = "SRU"
"""Letters of the leaves in the tree; lower-case letters are splits (`puncture_twin.planning.certify.cells.SPLITS`)."""
UNDECIDED_COLOUR: Rgb = (255, 255, 255)
"""Colour of cells that are too small to decide: neither a safe colour nor a reason's."""


@dataclass(frozen=True, eq=False)
class Certificate(Shown):
    """A certified map: directions proven safe, proven rejected, and cells too small to decide."""

    question: Question
    size: float
    """No undecided cell has a larger angular diameter, rad."""
    tree: tuple[str, ...]
    """Level by level, a letter for each cell of the level: a split, or a leaf's verdict. The parts of a level's split
    cells, in order, are the next level."""
    leaves: Cells
    """The leaves, in the order in which the tree names them."""
    verdict: NDArray[np.str_]  # shape (n,), letter of each leaf
    reason: NDArray[np.str_]  # shape (n,), for a rejected leaf the `Reason` that holds all over it, else ""
    structure: NDArray[np.str_]
    """Shape (n,), for ``too_close`` the structure that every axis comes too near to, else ""."""
    triangle: Ints
    """Shape (n,), which of its triangles, or -1: no axis of the leaf keeps its limit from this one."""
    bound: Floats
    """Shape (n,), for ``too_close`` the largest clearance (mm), for ``too_long`` the least path length (mm), for
    ``skin_angle`` the least angle (deg), for ``unknown_region`` the largest depth (mm); NaN where no number was
    needed."""
    queries: int
    """Cells for which distances from structures were measured."""

    @brief
    def __repr__(self) -> str:
        words = {PROVED_SAFE: "safe for the organs", REJECTED: "rejected", UNDECIDED: "undecided"}
        areas = ", ".join(f"{self.areas[letter]:.1f} square degrees {word}" for letter, word in words.items())
        return f"case {self.question.case_name}, {len(self.verdict):,} cells to {np.degrees(self.size):g} deg: {areas}"

    def _title(self) -> str:
        return f"Certificate of {self.question.case_name}"

    def _facts(self) -> Facts:
        summary = self.summary()
        for word in ("safe", "rejected", "undecided"):
            text = "proven safe for the organs" if word == "safe" else word
            yield text, f"{summary[f'{word}_square_deg']:.2f} deg², {summary[f'{word}_cells']:,} cells"
        yield "smallest cell", f"{summary['size_deg']:g}°"
        yield "proven for every direction of a safe cell", "; ".join(summary["certified"])
        yield "not certified", "; ".join(summary["not_certified"])

    def _picture(self) -> str:
        legend = [
            Entry("proven safe for the organs", SAFE),
            *(Entry(REASON_TEXT[reason], colour) for reason, colour in REASON_COLOURS.items()),
            Entry("undecided", UNDECIDED_COLOUR),
        ]
        number = {reason.value: row for row, reason in enumerate(REASON_COLOURS, start=1)}
        of_letter, letters = {"S": 0, "U": len(legend) - 1}, zip(self.verdict, self.reason, strict=True)
        code = np.array([of_letter.get(letter, number.get(str(why), 1)) for letter, why in letters])
        beta = self.leaves.beta
        shifted = beta - 2 * np.pi * np.floor(beta[:, :1] / (2 * np.pi))
        return polar_map(Sectors(self.leaves.theta, shifted, code), legend)._repr_html_()

    @cached_property
    def areas(self) -> dict[str, float]:
        """Verdict letter to area, square degrees."""
        area = self.leaves.solid_angle() * SQUARE_DEGREES
        return {letter: float(area[self.verdict == letter].sum()) for letter in (PROVED_SAFE, REJECTED, UNDECIDED)}

    def fraction(self, letter: str) -> float | None:
        """Part of the cap's area with a verdict, 0..1; None for a cap without area."""
        total = float(self.question.cap().solid_angle()[0]) * SQUARE_DEGREES
        return self.areas[letter] / total if total > 0 else None

    def at(self, theta: Floats, beta: Floats) -> NDArray[np.str_]:
        """Verdict letter at directions (n,) of the entry frame, rad; "" outside the cap."""
        letters = np.full(len(theta), "", dtype="U1")
        for letter in (UNDECIDED, REJECTED, PROVED_SAFE):
            letters[nearest_cell(theta, beta, self.leaves.take(self.verdict == letter)) == 0] = letter
        return letters

    def safe_cone(self, outward_ct: Floats) -> Floats:
        """Angle by which each direction (n, 3) may be off in any direction and still be proven safe, shape (n,), rad.

        0 for a direction in a cell that is not safe, or outside the cap: nothing is proven there.
        """
        theta, beta = angles(outward_ct @ self.question.R_ct_entry)
        free = nearest_cell(theta, beta, self.leaves.take(self.verdict != PROVED_SAFE))
        (low, high), (first, last) = self.question.theta, self.question.beta
        outside, turn = [], 2 * np.pi  # the cap
        if low > 0:
            outside.append((0.0, low, 0.0, turn))
        if high < np.pi:
            outside.append((high, np.pi, 0.0, turn))
        if last - first < turn:
            outside.append((0.0, np.pi, last, first + turn))
        ranges = np.array(outside, float).reshape(-1, 4)
        to_border = nearest_cell(theta, beta, Cells(ranges[:, :2], ranges[:, 2:]))
        return np.maximum(np.minimum(free, to_border) - CONE_ROUNDING_RAD, 0.0)

    def summary(self) -> dict[str, Any]:
        """The main numbers as plain values; degrees, square degrees."""
        areas, touch = self.areas, self.question.touch
        cells = {letter: int((self.verdict == letter).sum()) for letter in areas}
        return {
            "size_deg": float(np.degrees(self.size)),
            "certified": [*CERTIFIED, *(() if touch is None else (TOUCH_CERTIFIED.format(touch),))],
            "not_certified": list(NOT_CERTIFIED),
            "touch": touch,
            "safe_square_deg": areas[PROVED_SAFE],
            "rejected_square_deg": areas[REJECTED],
            "undecided_square_deg": areas[UNDECIDED],
            "safe_share": self.fraction(PROVED_SAFE),
            "undecided_share": self.fraction(UNDECIDED),
            "safe_cells": cells[PROVED_SAFE],
            "rejected_cells": cells[REJECTED],
            "undecided_cells": cells[UNDECIDED],
            "queries": self.queries,
        }


def leaves_of(cap: Cells, tree: tuple[str, ...], where: Path) -> Cells:
    """The leaves that a tree names, level by level; they tile the cap because halves and quarters do.

    Raises InputError: The tree has a cell too many or too few, or an unknown letter.
    """
    theta, beta, cells = [], [], cap
    for depth, level in enumerate(tree):
        letters = np.array(list(level), dtype="U1")
        if len(letters) != len(cells) or not np.isin(letters, list("tbqSRU")).all():
            what = f"level {depth} of the tree has {len(letters)} cells or an unknown letter"
            refuse(what, where, f"{len(cells)} of t, b, q, S, R, U", "certificate_damaged")
        inner = np.isin(letters, list("tbq"))
        theta.append(cells.theta[~inner])
        beta.append(cells.beta[~inner])
        cells, _ = split(cells.take(inner), letters[inner])
    if len(cells):
        refuse(f"the tree ends {len(cells)} cells early", where, "a complete tree", "certificate_damaged")
    return Cells(np.concatenate(theta), np.concatenate(beta))


def write_certificate(certificate: Certificate, path: Path) -> None:
    """Write a certificate as JSON, whole or not at all; lengths in mm, angles in rad where not named ``_deg``."""
    question = certificate.question
    columns = certificate.reason, certificate.structure, certificate.triangle, certificate.bound
    document = {
        "version": CERTIFICATE_VERSION,
        "case": question.case_name,
        "inputs": inputs_document(question.inputs),
        "target_ct_mm": question.target_ct.tolist(),
        "R_ct_entry": question.R_ct_entry.tolist(),
        "theta_rad": list(question.theta),
        "beta_rad": list(question.beta),
        "length_mm": question.length,
        "standoff_mm": question.standoff,
        "skin_gap_mm": question.skin_gap,
        "farthest_flange_mm": question.farthest,
        "radius_mm": question.radius,
        "longest_path_mm": question.longest,
        "max_skin_angle_rad": question.max_skin_angle,
        "margins_mm": dict(zip(question.structures, question.margins.tolist(), strict=True)),
        "touch": question.touch,
        "size_rad": certificate.size,
        "queries": certificate.queries,
        "summary": certificate.summary(),
        "tree": list(certificate.tree),
        "witness": [  # of each leaf
            [reason, structure, triangle, round(bound, 6) if np.isfinite(bound) else None]
            for reason, structure, triangle, bound in zip(*(column.tolist() for column in columns), strict=True)
        ],
    }
    with atomic(path) as temporary:
        temporary.write_text(json.dumps(document, allow_nan=False) + "\n", encoding="utf-8")


def read_certificate(path: Path) -> Certificate:
    """Read a certificate, from a whole output set or from outside of any, and check it as `parse_certificate` does.

    Raises InputError: It cannot be read, its folder's manifest lists other bytes, or see `parse_certificate`.
    """
    return parse_certificate(read_output(path, max_bytes=MAX_CERTIFICATE_BYTES).data, path)


def parse_certificate(data: bytes, path: Path) -> Certificate:
    """Check that a certificate's bytes are whole and agree with themselves; `checker.verify` proves it.

    Raises InputError: Not a certificate, another version, missing or contradicting parts.
    """
    document = strict_json.parse_document(data, CERTIFICATE_VERSION, where=path, allowed=CERTIFICATE_ALLOWED)
    with strict_json.fitting(path, CERTIFICATE_ALLOWED):
        certificate = _certificate(document, path)
    for name in sorted(set(document) - NAMES):
        refuse(f"key '{name}' is not known", path, ", ".join(sorted(NAMES)), "unknown_key")
    stated, counted = document.get("summary"), json.loads(json.dumps(certificate.summary()))
    if stated != counted:
        wrong = [key for key in counted if not isinstance(stated, dict) or stated.get(key) != counted[key]]
        what = f"its summary does not follow from its cells ({', '.join(wrong) or 'other keys'})"
        refuse(what, path, "an unchanged certificate", "certificate_damaged")
    return certificate


def _certificate(document: dict[str, Any], path: Path) -> Certificate:
    names, standoff, touch = tuple(document["margins_mm"]), document["standoff_mm"], document["touch"]
    margins = [document["margins_mm"][name] for name in names]
    question = Question(
        case_name=strict_json.field(document, "case", strict_json.text),
        inputs=strict_json.field(document, "inputs", read_inputs),
        target_ct=strict_json.field(document, "target_ct_mm", strict_json.point),
        R_ct_entry=strict_json.array(document["R_ct_entry"], (3, 3)),
        theta=strict_json.field(document, "theta_rad", _range),
        beta=strict_json.field(document, "beta_rad", _range),
        length=strict_json.field(document, "length_mm", strict_json.number),
        standoff=None if standoff is None else strict_json.number(standoff),
        skin_gap=strict_json.field(document, "skin_gap_mm", strict_json.number),
        farthest=strict_json.field(document, "farthest_flange_mm", strict_json.number),
        radius=strict_json.field(document, "radius_mm", strict_json.number),
        longest=strict_json.field(document, "longest_path_mm", strict_json.number),
        max_skin_angle=strict_json.field(document, "max_skin_angle_rad", strict_json.number),
        structures=names,
        margins=strict_json.array(margins, (len(names),)),
        touch=None if touch is None else strict_json.number(touch),
    )
    tree = strict_json.field(document, "tree", strict_json.texts)
    leaves = leaves_of(question.cap(), tree, path)
    rows = document["witness"]
    if len(rows) != len(leaves):
        refuse(f"{len(rows)} witnesses for {len(leaves)} cells", path, "one witness per cell", "certificate_damaged")
    reasons, structures, triangles, bounds = zip(*rows, strict=True)
    return Certificate(
        question=question,
        size=strict_json.field(document, "size_rad", strict_json.number),
        tree=tree,
        leaves=leaves,
        verdict=np.array([letter for level in tree for letter in level if letter in "SRU"], dtype="U1"),
        reason=np.array([Reason(reason).value for reason in reasons], dtype=np.str_),
        structure=np.array([strict_json.text(name) for name in structures], dtype=np.str_),
        triangle=np.array([strict_json.whole(triangle) for triangle in triangles], dtype=np.int64),
        bound=np.array([strict_json.number_or_nan(bound) for bound in bounds]),
        queries=strict_json.field(document, "queries", strict_json.whole),
    )


def _range(values: Any) -> tuple[float, float]:
    low, high = map(strict_json.number, values)
    return low, high


def with_safe_cone(case: Case, candidates: Candidates, certificate: Certificate) -> Candidates:
    """The candidates with their safe cones, ranked again."""
    cone, rows = np.full(len(candidates), np.nan), np.flatnonzero(candidates.safe)
    cone[rows] = certificate.safe_cone(candidates.outward_ct[rows])
    return ranked(case, replace(candidates, safe_cone=cone, cone_source=CONE_CERTIFIED))
