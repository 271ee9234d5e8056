"""Answers of `live`: the safe map of a target, and the verdict of a needle's direction, as `check` gives it.

    Target  a point       -> SafeMap (POLYDATA), SafeGrid (IMAGE), SafeMapInfo (STRING)
    Needle  a pose        -> Verdict (STRING), Entry (POINT)
    Query   a text        -> Status (STRING); GET_STATUS -> STATUS

The needle's axis z runs from hub to tip; its line passes the target f at the distance |(f - p) - ((f - p)'z) z|, p the
tip. A verdict is that of the parallel path through f. With its tip a = max((p - f)'z, 0) beyond f and d beside it, no
point of the needle is farther from the path than sqrt(d^2 + a^2): by no more than that path's least slack it keeps
every margin. One that is off by more, or by more than `AIMED_MM`, is "not aimed".

What cannot be answered takes the place of the answer (a map without cells, a verdict "refused", no entry): nothing that
was said of an earlier target or needle is left where the newest is expected.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.errors import InputError, PlanningError, refuse
from puncture_twin.planning.budget.guidance import explained_ways
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.entry import AngleGrid, angles, outward
from puncture_twin.planning.geometry.spaces import Space, point_text, to_lps
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.choice import Choice, explain_choice
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.search.explain import Explanation, finite
from puncture_twin.planning.search.safe_map import NOT_TESTED, SafeMap, safe_map
from puncture_twin.twin.jobs.live import messages

AIMED_MM = 2.0  # a hand and a tracker together keep a needle on a line to about this
NOT_AIMED = "not aimed"  # the path is safe, and the needle is not on it
LEFT_OUT = ("case", "inputs", "entry_ct_mm", "warnings", "findings")
"""Keys of a direction's summary that are left out: Status has them, or they are in the case's space."""
FREE, NO_STRUCTURE = 0, 65_535  # values of SafeGrid where nothing blocks, and where no structure can be named
ELSEWHERE_MM = 1e-6  # within this of the case's target another is as good
WARM = 64  # directions that are checked before the first client comes: kernels are compiled then
SUBJECTS = ("status", "target", "needle")  # as they are answered: a needle is checked against the newest target


@dataclass(frozen=True, eq=False)
class MapMesh:
    """The sphere on which a map is drawn: a quad for each of the n directions, corners (4 n, 3) RAS, unit.

    Each quad has corners of its own, and so a colour of its own; scalars of cells would say the same, but the
    OpenIGTLink library (1.11, and later) takes them for tensors and reads beyond the message.
    """

    grid: AngleGrid
    corners: Floats
    cells: bytes
    radius_mm: float

    @classmethod
    def of(cls, case: Case) -> MapMesh:
        """The mesh of a case's grid."""
        directions, half = case.directions(), case.search.step / 2.0
        assert directions.grid is not None  # every case's grid is regular
        theta = np.clip(directions.theta[:, None] + half * np.array([-1, -1, 1, 1]), 0.0, np.pi)
        beta = directions.beta[:, None] + half * np.array([-1, 1, 1, -1])
        units = outward(theta.ravel(), beta.ravel()) @ case.T_ct_entry[:3, :3].T
        quads = np.arange(len(units)).reshape(-1, 4)
        return cls(directions.grid, to_lps(units, Space.RAS), messages.quad_bytes(quads), case.needle.length_mm)

    def content(self, target_ras: list[float], scalars: Mapping[str, NDArray[Any]]) -> bytes:
        """Content of a POLYDATA about a target, with values (n,) by name."""
        points = np.array(target_ras) + self.radius_mm * self.corners
        return messages.mesh_content(
            points, self.cells, {name: np.repeat(values, 4) for name, values in scalars.items()}
        )

    def image(self, values: Ints) -> bytes:
        """Content of an IMAGE: a value (n,) a direction; beta along its rows, theta along its columns, in degrees."""
        shape = len(self.grid.theta), len(self.grid.beta)
        first = float(np.degrees(self.grid.beta[0])), float(np.degrees(self.grid.theta[0]))
        return messages.image_content(values.astype(np.uint16).reshape(shape), first, float(np.degrees(self.grid.step)))


@dataclass(eq=False)
class Session:
    """State of a client: its target, unless it was refused, and its needle."""

    context: CaseContext | None
    needle: Question | None = None


class Question(NamedTuple):
    """A message about a subject, and whose it is; one with a fault could not be read."""

    client: int
    session: Session
    subject: str
    stamp: messages.Stamp
    message: messages.Message | None = None
    fault: PlanningError | None = None


class Answer(NamedTuple):
    """An outgoing message, its type and its name: of each only the newest waits."""

    name: str
    data: bytes


class Planner:
    """Answers the questions of many clients about one case, each with a target of its own."""

    def __init__(self, context: CaseContext) -> None:
        """Prepare everything that is computed once, before questions come."""
        if context.case.space is Space.LOCAL:
            refuse('space "local": OpenIGTLink knows RAS', context.case.path, "a case of a patient", "local_space")
        self._mesh = MapMesh.of(context.case)
        with suppress(InputError):  # the first target that no cache on disk knows fills the memory for all others
            context.at(context.case.target_ct + ELSEWHERE_MM * np.random.default_rng().uniform(size=3))
        self._context = at = context.at(context.case.target_ct)  # shows no progress
        free = safe_map(at)
        deque(self._map(free, messages.Stamp(1, 0, 0, 0)), maxlen=0)  # packed and summed, as an answer is
        rows = np.append(np.flatnonzero(~free.blocked), 0)[:: 1 + len(free.blocked) // WARM]
        checked = at.check(free.directions.theta[rows], free.directions.beta[rows])  # compilers run now, not later
        best = 0 if checked.best is None else checked.best.row
        explained(at, float(checked.theta[best]), float(checked.beta[best])).summary()

    def begin(self) -> None:
        """Prepare what belongs to the answering thread, before the first question."""
        if self._context.reach is not None:
            _ = self._context.reach.checker

    def session(self) -> Session:
        """Session of a new client: the case's target."""
        return Session(self._context)

    def subject(self, header: messages.Header) -> str | None:
        """Subject of a message; see the head of this module."""
        kind, name = header.kind, header.name
        if kind == "GET_STATUS" or (kind, name) == ("STRING", "Query"):
            return "status"
        if name == "Target" and kind in ("POINT", "TRANSFORM"):
            return "target"
        return "needle" if kind == "TDATA" or (kind, name) == ("TRANSFORM", "Needle") else None

    def needle(self, session: Session) -> Question | None:
        """Question of a client's last needle, which a new target answers anew; None where it was refused."""
        return None if session.context is None else session.needle

    def answers(self, question: Question) -> Iterator[Answer]:
        """The answers to a message, as they are found; an `InputError` where there are none."""
        session = question.session
        if question.subject == "target":
            session.context = None  # an old target is not answered for, should this one be refused
        elif question.subject == "needle":
            session.needle = question
        message = question.message
        if message is None:
            raise question.fault or PlanningError("a question without a message")
        if question.subject == "status":
            yield self._status(session, message.kind, message.stamp)
        elif question.subject == "target":
            target_ras = messages.read_place(message)
            target_ct = to_lps(target_ras[None], Space.RAS)[0]
            try:
                session.context = self._context.at(target_ct)
            except InputError as error:  # says where the case's space has the point: beside it stands what was sent
                raise error.at(f"{message.kind} Target ({point_text(target_ct, Space.RAS)})") from error
            yield from self._map(safe_map(session.context), message.stamp)
        else:
            tip_ras, axis_ras = messages.read_pose(message, "Needle")
            yield from self._verdict(session, tip_ras, axis_ras, message.stamp)

    def refused(self, subject: str | None, stamp: messages.Stamp, error: PlanningError) -> Iterator[Answer]:
        """Answers to a refused question: no cells, no free direction, no entry, and why."""
        document = {"error": {"code": error.code, "sentence": str(error)}}
        if subject == "target":
            yield _answer("POLYDATA", "SafeMap", stamp, messages.mesh_content(np.zeros((0, 3)), b"", {}))
            yield _answer("IMAGE", "SafeGrid", stamp, self._mesh.image(np.full(len(self._mesh.grid), NO_STRUCTURE)))
            yield _text("SafeMapInfo", stamp, document)
        if subject in ("target", "needle"):
            yield _text("Verdict", stamp, {"verdict": "refused", **document})
            yield _answer("POINT", "Entry", stamp, messages.point_content(None, ""))
        else:
            yield _text("Error", stamp, document)

    def _status(self, session: Session, kind: str, stamp: messages.Stamp) -> Answer:
        fault = None if session.needle is None else session.needle.fault
        if kind == "GET_STATUS":
            code, text = (messages.READY, "ready") if fault is None else (messages.TIMED_OUT, str(fault))
            return _answer("STATUS", "Status", stamp, messages.status_content(code, text))
        context = session.context
        document = {
            "case": self._context.case.name,
            "target_ras_mm": None if context is None else _ras(context.case.target_ct),
            "needle": None if session.needle is None else "known" if fault is None else fault.code,
            "arm": self._context.arm_note,
            "structures": [one.name for one in self._context.anatomy.checked],
            "warnings": list(self._context.anatomy.warnings),
        }
        return _text("Status", stamp, document)

    def _map(self, tested: SafeMap, stamp: messages.Stamp) -> Iterator[Answer]:
        mesh, target_ras = self._mesh, _ras(tested.target_ct)
        scalars: dict[str, NDArray[Any]] = {"blocked": tested.blocked.astype(np.int64), "structure": tested.structure}
        yield _answer("POLYDATA", "SafeMap", stamp, mesh.content(target_ras, scalars))
        values = np.where(tested.blocked, np.where(tested.structure < 0, NO_STRUCTURE, tested.structure + 1), FREE)
        yield _answer("IMAGE", "SafeGrid", stamp, mesh.image(values))
        document = {
            "target_ras_mm": target_ras,
            "radius_mm": mesh.radius_mm,
            "directions": len(tested.blocked),
            "blocked": int(tested.blocked.sum()),
            "not_tested": NOT_TESTED,
            "structures": list(tested.structures),
        }
        yield _text("SafeMapInfo", stamp, document)

    def _verdict(self, session: Session, tip_ras: Floats, axis_ras: Floats, stamp: messages.Stamp) -> Iterator[Answer]:
        """Verdict of `check` on the needle's direction, and whether its line is the one that was checked."""
        if session.context is None:
            refuse("the last target was refused", "Needle", "a Target first", "no_target")
        case = session.context.case
        tip, axis = to_lps(np.array([tip_ras, axis_ras]), Space.RAS)
        theta, beta = angles(-axis @ case.T_ct_entry[:3, :3])
        explanation = explained(session.context, float(theta), float(beta))
        ahead = float((case.target_ct - tip) @ axis)
        off = float(np.linalg.norm(case.target_ct - tip - ahead * axis))
        entry, q = explanation.candidates.path.entry_ct[0], explanation.candidates.arm.q_insertion[0]
        farthest = float(np.hypot(off, max(-ahead, 0.0)))  # a point of the needle from the path, up to its hub
        aimed = farthest <= AIMED_MM and farthest <= slack_mm(explanation.candidates)
        verdict, text = explanation.verdict, " ".join(line.strip() for line in explanation.head())
        if explanation.safe:
            verdict = explanation.candidates.safe_text if aimed else NOT_AIMED
        if verdict == NOT_AIMED:
            where = f"the line passes the target at {off:.1f} mm, {ahead:.1f} mm ahead"
            text = f"{verdict}: {where}; parallel to it, {text}"
        point = _ras(entry) if np.isfinite(entry).all() else None
        document = {
            "verdict": verdict,
            "text": text,
            "target_ras_mm": _ras(case.target_ct),
            "off_line_mm": off,
            "ahead_mm": ahead,
            "slack_mm": finite(slack_mm(explanation.candidates)),
            "entry_ras_mm": point,
            "joints_deg": np.degrees(q).tolist() if np.isfinite(q).all() else None,
            "check": {key: value for key, value in explanation.summary().items() if key not in LEFT_OUT},
        }
        yield _text("Verdict", stamp, document)
        yield _answer("POINT", "Entry", stamp, messages.point_content(point, verdict))


def explained(context: CaseContext, theta: float, beta: float) -> Explanation:
    """One direction (rad) in full: what ``run-twin check --theta --beta`` shows."""
    return explained_ways(context, explain_choice(context, Choice(angles=(theta, beta))))


def slack_mm(candidates: Candidates) -> float:
    """Least clearance of the first path beyond each margin, mm, less what the needle may bend.

    Over the breath, the least clearance is held against the largest margin, since it is known of no structure. inf
    where nothing demands a margin, NaN where it is not known.
    """
    clearance, breathing = candidates.clearance, candidates.breathing
    slack = np.nanmin(np.append(clearance.by_structure[0] - clearance.margins, np.inf))
    if breathing is not None:
        slack = np.minimum(slack, breathing.clearance[0] - np.nanmax(np.append(clearance.margins, 0.0)))
    return float(slack if candidates.deflection is None else slack - candidates.deflection[0])


def _ras(point_ct: Floats) -> list[float]:
    return [float(one) for one in to_lps(point_ct[None], Space.RAS)[0]]


def _text(name: str, stamp: messages.Stamp, document: dict[str, Any]) -> Answer:
    answered = {"time_s": stamp.time_s, "number": stamp.number}
    text = json.dumps({"answers": answered, **document}, allow_nan=False)
    return _answer("STRING", name, stamp, messages.text_content(text))


def _answer(kind: str, name: str, stamp: messages.Stamp, content: bytes) -> Answer:
    return Answer(f"{kind} {name}", messages.packed(kind, name, stamp, content))
