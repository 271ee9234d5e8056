"""``confirm``: where the needle is in a control CT, what its line touches, what to do next; ``--learn`` from many."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtri

from puncture_twin.planning.anatomy.default_roles import BONES, plain_name
from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.base.errors import Finding, refuse
from puncture_twin.planning.base.output.manifest import read_output
from puncture_twin.planning.base.provenance import Input, InputFiles, inputs_document
from puncture_twin.planning.base.strict_json import array, fitting, or_null, parse_json
from puncture_twin.planning.base.text import Facts, Shown
from puncture_twin.planning.case.named_files import CaseVolumes
from puncture_twin.planning.formats.points import NamedPoints
from puncture_twin.planning.formats.volumes.volume_files import Volume
from puncture_twin.planning.geometry.containment import inside_each
from puncture_twin.planning.geometry.rigid import apply, inverse
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.plan.plan_check import check_inputs
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.search.taken_line import SURE, UNCERTAIN, Aim, LineCheck, check_line, next_aims
from puncture_twin.twin.devices import ControlScan, Scanner
from puncture_twin.twin.guidance.ct.needle import needle_error, read_needle
from puncture_twin.twin.guidance.ct.needle_fit import FoundNeedle
from puncture_twin.twin.guidance.ct.tie import Body, Tie, body_of, tie_frames
from puncture_twin.twin.jobs.patient.main_job import read_noted_plan
from puncture_twin.twin.jobs.patient.run import case_draft
from puncture_twin.twin.jobs.terminal import write_result
from puncture_twin.twin.report import present
from puncture_twin.twin.report.present import Card, Field, Section, facts, grid, number, percent, vector

PAGE, PICTURE, REPORT = FILES = ("confirm.html", "confirm.png", "confirm.json")
MAX_REPORT_BYTES = 5_000_000
FEW = 10  # fewer needles say little about the size of errors
SHOWN = 8  # structures in the text; the page and the JSON have all


@dataclass(frozen=True, eq=False)
class Confirmed(Shown):
    """A needle in a control CT, in the case's frame (LPS mm)."""

    context: CaseContext
    plan: Plan | None
    """The plan to which the needle is compared, or None."""
    volume: Volume
    tie: Tie
    needle: FoundNeedle
    """The needle that was read, with the covariance of the reading and of the frames' tie together."""
    line: LineCheck
    aims: tuple[Aim, ...]
    """Possible next aims, the best first."""
    findings: tuple[Finding, ...]
    read: tuple[Input, ...]
    files: tuple[Path, ...] = ()

    def _title(self) -> str:
        return f"The needle of {self.context.case.name}, confirmed"

    def _facts(self) -> Facts:
        yield "line", f"{self.line.verdict} {self.line.structure}".strip()
        yield "tip, CT", vector(self.needle.tip_ct.tolist(), 1, "mm")
        yield "next", aim_text(self.aims[0])

    @property
    def yes(self) -> bool:
        """Whether the needle's line is safe and its tip is best left where it is."""
        return self.line.safe and self.aims[0].kind == "accept"

    def against(self, tip_ct: Floats, forward_ct: Floats) -> dict[str, float]:
        """Errors of the tip from a point (3,), along and across a direction (3,), and of the direction."""
        split = needle_error(self.needle.tip_ct, forward_ct, tip_ct)
        angle = float(np.degrees(np.arccos(np.clip(self.needle.forward_ct @ forward_ct, -1.0, 1.0))))
        return {"tip_mm": split.tip_to_target_mm, "lateral_mm": split.lateral_mm, "depth_mm": split.depth_mm,
                "angle_deg": angle}  # fmt: skip

    def predicted(self) -> dict[str, Any] | None:
        """The error against the plan beside what was predicted of it; None without a plan or declared errors."""
        error = self.context.pose_error
        if self.plan is None or error is None:
            return None
        cov = error.covariance_ct(self.plan.insertion.q[-1:])[0, :3, :3] + self.needle.cov_ct[:3, :3]
        off = self.needle.tip_ct - self.plan.target_ct
        square = float(off @ np.linalg.solve(cov, off))
        return {
            "off_mm": off.tolist(),
            "cov_mm2": cov.tolist(),
            "rms_mm": float(np.sqrt(np.trace(cov))),
            "deviations": float(np.sqrt(square)),
            "region_deviations": error.fit.test.region_factor,
            "inside": bool(square <= error.fit.test.region_factor**2),
        }

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON: mm, degrees, chances 0..1."""
        needle, target = self.needle, self.context.case.target_ct
        at_target, predicted, plan = self.against(target, needle.forward_ct), self.predicted(), self.plan
        of_plan = None if plan is None else self.against(plan.target_ct, -plan.outward_ct)
        return {
            **self.context.provenance(),
            "inputs": inputs_document((*self.read, *self.context.case.inputs)),
            "tip_ct_mm": needle.tip_ct.tolist(),
            "axis_ct": needle.forward_ct.tolist(),
            "tip_cov_mm2": needle.cov_ct[:3, :3].tolist(),
            "axis_cov_rad2": needle.cov_ct[3:, 3:].tolist(),
            "path_ct_mm": needle.path_ct.tolist(),
            "diameter_mm": self.context.case.needle.diameter_mm,
            "bent": needle.sagitta_mm > 0,
            "sagitta_mm": needle.sagitta_mm,
            "lateral_mm": at_target["lateral_mm"],
            "depth_mm": at_target["depth_mm"],
            "angle_deg": None if of_plan is None else of_plan["angle_deg"],
            "against_plan": of_plan,
            "verdict": self.line.verdict,
            "structure": self.line.structure,
            "entry_ct_mm": [or_null(one) for one in self.line.entry_ct],
            "inserted_mm": or_null(self.line.inserted_mm),
            "structures": [one.document() for one in self.line.each],
            "in_predicted_region": None if predicted is None else predicted["inside"],
            "predicted": predicted,
            "next_aim": self.aims[0].document(),
            "aims": [one.document() for one in self.aims],
            "frames": {
                "tied_by": self.tie.how, "residual_mm": self.tie.residual_mm, "sd_mm": self.tie.sd_mm,
                "surfaces_found": self.tie.found, "moved_mm": or_null(self.tie.moved_mm),
                "moved_deg": or_null(self.tie.moved_deg), "T_scan_ct": self.tie.T_scan_ct.tolist(),
            },
            "findings": [one.document() for one in (*self.context.anatomy.findings, *self.findings)],
            "files": [str(path) for path in self.files],
        }  # fmt: skip

    def text(self) -> str:
        """What a terminal shows."""
        return present.text([*self.sections(SHOWN), *present.footer(self.files, [o.sentence for o in self.findings])])

    def sections(self, most: int | None = None) -> list[Section]:
        """Sections for terminal and page; of structures so many, or all."""
        needle, tie, line, said = self.needle, self.tie, self.line, self.predicted()
        at_target, off = self.against(self.context.case.target_ct, needle.forward_ct), f"± {tie.sd_mm:.2f} mm"
        rows = [
            ("tip", f"{vector(needle.tip_ct.tolist(), 1, 'mm')}, ± {needle.tip_sd_mm:.2f} mm (sd, worst direction)"),
            ("direction", f"{vector(needle.forward_ct.tolist(), 3)}, ± {np.degrees(needle.axis_sd):.2f}°"),
            ("shape", f"bent, sagitta {needle.sagitta_mm:.1f} mm" if needle.sagitta_mm > 0 else "straight"),
            ("frames", f"tied by {tie.how}, residual {tie.residual_mm:.2f} mm (rms), {off} at the target"),
            ("against the target", _off_text(at_target)),
        ]
        if self.plan is not None:
            of_plan = self.against(self.plan.target_ct, -self.plan.outward_ct)
            rows.append(("against the plan", f"{_off_text(of_plan)}; direction {of_plan['angle_deg']:.1f}° off"))
        if said is not None:
            inside = "{deviations:.1f} of {region_deviations:.1f} deviations".format(**said)
            where = "inside" if said["inside"] else "outside"
            rows.append(("predicted", f"{said['rms_mm']:.1f} mm (rms); {where} the 95 % region ({inside})"))
        verdict = f"safe, by {SURE:g} standard deviations of the reading or more"
        if not line.safe:
            unsure = ", its margin may be broken by what the reading errs" if line.verdict == UNCERTAIN else ""
            verdict = f"not safe, {line.verdict}{f': {line.structure}' if line.structure else ''}{unsure}"
        return [
            Section("the needle in the scan", [facts(rows)]),
            Section(f"the line that it takes: {verdict}", [grid(STRUCTURES, line.each[:most]), LINE_TEXT]),
            Section(f"next: {aim_text(self.aims[0])}", [grid(AIMS, self.aims), AIM_TEXT]),
        ]


def _off_text(off: Mapping[str, float]) -> str:
    depth = f"{abs(off['depth_mm']):.1f} {'short' if off['depth_mm'] < 0 else 'too deep'}"
    return f"tip {off['tip_mm']:.1f} mm off: {off['lateral_mm']:.1f} across, {depth}"


LINE_TEXT = (
    "Clearance of the needle as it lies from tip to flange, bent pieces one by one; ±: by what the reading and the "
    "frames' tie may err (standard deviation). A line is safe only if every margin is kept by two of them. Structures "
    "are those of the planning CT: what has moved since is not seen."
)
AIM_TEXT = (
    "Chances count the reading, the frames' tie, and how exactly target and contours are known; not what tissue does "
    "on the way. Deeper: along the needle's own end. Turn: back to the skin, and from the same entry to the target, "
    "aimed to half a degree."
)


STRUCTURES = (
    Field("structure", lambda one: one.name), Field("clearance", lambda one: one.clearance_mm, 1, "mm"),
    Field("±", lambda one: one.sd_mm, 2, "mm"), Field("margin", lambda one: one.margin_mm, 1, "mm"),
    Field("from the tip", lambda one: one.depth_mm, 0, "mm"),
    Field("chance to touch", lambda one: "" if np.isnan(one.p_touch) else percent(one.p_touch)),
)  # fmt: skip
AIMS = (
    Field("what", lambda one: aim_text(one)),
    Field("chance to hit", lambda one: "–" if np.isnan(one.p_hit) else percent(one.p_hit)),
    Field("passes the target by", lambda one: one.lateral_mm, 1, "mm"),
    Field("line", lambda one: f"{one.verdict} {one.structure}".strip()),
)


def aim_text(aim: Aim) -> str:
    """An aim in words."""
    if aim.kind == "accept":
        return "accept"
    if aim.kind == "deeper":
        return f"deeper by {aim.by_mm:.1f} mm" if aim.by_mm > 0 else f"back by {-aim.by_mm:.1f} mm"
    if aim.kind == "turn":
        return f"withdraw by {number(aim.by_mm, 0)} mm to the skin and turn by {aim.turn_deg:.1f}°"
    return "withdraw, and plan again: no line from this entry is safe"


def confirm_needle(context: CaseContext, scanner: Scanner, plan_path: Path | None = None) -> Confirmed:
    """Read a control scan of a case's patient with the needle in, of a scanner such as `ScanFiles`; check its line."""
    read: list[Input] = []
    plan = None
    if plan_path is not None:
        source, plan = read_noted_plan(plan_path, context.watcher.note)
        check_inputs(plan, context.case, plan_path)
        read.append(source)
    with context.stages.time("scan"):
        volume, frame, inputs = scanner.measured_scan()
    with context.stages.time("frames"):
        own = "" if context.anatomy.scan is None else _frame_of(context.anatomy.scan.source.surfaces.source)
        body = _body(context)
        tie = tie_frames(volume, body, same_frame=bool(frame) and frame == own)
    with context.stages.time("needle"):
        T, back = tie.T_scan_ct, inverse(tie.T_scan_ct)
        skin, target = context.anatomy.skin.mesh, apply(tie.T_scan_ct, context.case.target_ct)
        planned = None if plan is None else (apply(T, plan.target_ct), -T[:3, :3] @ plan.outward_ct)
        diameter = context.case.needle.diameter_mm
        markers = None if body.markers is None else apply(T, body.markers.points)

        def inside(points: Floats) -> Bools:
            return inside_each(skin, apply(back, points))

        seen, findings = read_needle(volume, target, diameter, inside, planned, markers)
        needle = seen.moved(back, tie.cov_at(apply(back, seen.tip_ct)))
    with context.stages.time("line"):
        line = check_line(context, needle.path_ct, needle.covs_ct)
        aims = next_aims(context, needle.path_ct, needle.covs_ct, needle.forward_ct, line)
    said = (*tie.findings, *findings)
    return Confirmed(context, plan, volume, tie, needle, line, tuple(aims), said, (*read, *inputs))


def confirm_case(context: CaseContext, scan: Path, out: Path, plan_path: Path | None = None) -> Confirmed:
    """`confirm_needle`, with its page, picture and report as one set of files."""
    done = confirm_needle(context, ScanFiles(scan), plan_path)
    from puncture_twin.twin.jobs.patient.pictures import draw_confirmed  # with matplotlib: not before a refusal

    planned = next((one for one in done.read if one.role == "plan"), None)
    with case_draft(context, out, "confirm", FILES, done.read, planned) as draft:
        draw_confirmed(done, draft.folder / PICTURE)
        _write_page(done, draft.folder)
        done = replace(done, files=draft.final(tuple(draft.folder / name for name in FILES)))
        write_result(done.summary(), draft.folder / REPORT, out)
    return done


@dataclass(frozen=True)
class ScanFiles:
    """A `Scanner` whose scan was taken already: a DICOM folder or a file in it, NIfTI, or NRRD."""

    path: Path

    def measured_scan(self) -> ControlScan:
        """The scan, read from its files; an `InputError` where they cannot be."""
        place = self.path.resolve()
        files = InputFiles(place.parent)
        volumes = CaseVolumes(files, place.parent / "--scan")
        volumes.read("ct", place.name, key="--scan")
        source = volumes.source(place.name)
        read = tuple(Input(f"control {one.role}", one.path, one.sha256) for one in files.inputs)
        return ControlScan(source.volume(), _frame_of(source), read)


def _frame_of(source: object) -> str:
    return str(getattr(source, "frame_of_reference", ""))


def _body(context: CaseContext) -> Body:
    case, anatomy = context.case, context.anatomy
    rigid = [bool(BONES & set(plain_name(one.name).split("_"))) or "spine" in one.name for one in anatomy.structures]
    meshes = [one.mesh for one in anatomy.structures]
    bones, organs = ([mesh for mesh, hard in zip(meshes, rigid, strict=True) if hard == kind] for kind in (True, False))
    registration = None if context.placement is None else context.placement.registration
    markers, cov = None, np.zeros((3, 3))
    if registration is not None:
        pairs = registration.markers
        markers = NamedPoints(tuple(pairs.names), pairs.points_ct, case.space)
        cov = np.eye(3) * 0.25 if case.errors is None else case.errors.marker_cov_ct
    return body_of(anatomy.skin.mesh, bones, organs or bones, case.target_ct, markers, cov)


def _write_page(done: Confirmed, folder: Path) -> None:
    best, line = done.aims[0], done.line
    cards = [
        Card("line", line.verdict, line.structure, not line.safe),
        Card("next", best.kind, aim_text(best).removeprefix("accept"), best.kind == "withdraw"),
        Card("chance to hit now", percent(next((one.p_hit for one in done.aims if one.kind == "accept"), 0.0)), ""),
    ]
    sentences = tuple(one.sentence for one in done.findings)
    warned = [Section("warnings", [present.Warn(sentences)])] if sentences else []
    shown = present.picture(folder / PICTURE, "slices along the needle")
    sections = [*warned, *done.sections(), Section("slices of the control scan", [shown, PICTURE_TEXT])]
    inputs = (*done.read, *done.context.case.inputs)
    under = f"{done.context.case.name}: the needle in the control scan."
    present.write_page(folder / PAGE, "Confirmation", under, cards, sections, inputs,
                       origin=present.origin_section(None))  # fmt: skip


PICTURE_TEXT = (
    "Cyan: the needle as it was read; magenta, dashed: the planned line; green cross: target. Outlines are those of "
    "the planning CT, carried to the scan."
)


class Learned(NamedTuple):
    """Size of the errors of n needles in terms of the predicted ones."""

    needles: int
    factor: float  # of every standard deviation: 1 where the declaration is right; `low` to `high` is its 95 % interval
    low: float
    high: float
    mean_mm: tuple[float, ...]  # shape (3,), the mean error, LPS
    rms_mm: float  # realised
    predicted_rms_mm: float
    inside: int  # how many were in their 95 % region
    inputs: tuple[Input, ...]

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {**self._asdict(), "mean_mm": list(self.mean_mm), "inputs": inputs_document(self.inputs)}

    def text(self) -> str:
        """What a terminal shows."""
        size = "too small" if self.low > 1 else "too large" if self.high < 1 else "neither too small nor too large"
        few = f"; so few say little: {FEW} or more narrow the interval" if self.needles < FEW else ""
        interval = f"(95 %: {self.low:.2f} to {self.high:.2f})"
        rows = [
            ("needles", f"{self.needles}, {self.inside} in their predicted 95 % region"),
            ("tip against plan", f"{self.rms_mm:.2f} mm (rms), predicted {self.predicted_rms_mm:.2f} mm"),
            ("mean error, LPS", vector(self.mean_mm, 2, "mm")),
            ("errors", f"{self.factor:.2f} times what is declared {interval}: it is {size}{few}"),
        ]
        return present.text([Section("what these needles say of [errors]", [facts(rows)])])


def learn(paths: Sequence[Path]) -> Learned:
    """Estimate the size of a case's errors from many ``confirm.json``: sum d' S^-1 d = f^2 chi-squared, 3 n degrees."""
    offs, covs, inside, inputs = [], [], 0, []
    allowed = "confirm.json of a case with [errors], markers and --plan"
    for path in paths:
        read = read_output(path, max_bytes=MAX_REPORT_BYTES)
        document = parse_json(read.data, where=path, allowed=allowed)
        with fitting(path, allowed):
            stated = document["predicted"]
            offs.append(array(stated["off_mm"], (3,)))
            covs.append(array(stated["cov_mm2"], (3, 3)))
            inside += stated["inside"] is True
        inputs.append(read.input("confirmation"))
    if len({one.sha256 for one in inputs}) < len(inputs):
        refuse("one confirmation is named twice", "--learn", "each needle once", "duplicate_name")
    off, n = np.array(offs), 3 * len(offs)
    square = float(sum(d @ np.linalg.solve(cov, d) for d, cov in zip(offs, covs, strict=True)))
    low, high = (float(np.sqrt(square / chdtri(n, tail))) for tail in (0.025, 0.975))
    predicted = float(np.sqrt(np.mean([np.trace(cov) for cov in covs])))
    rms, mean = float(np.sqrt(np.mean((off**2).sum(axis=1)))), tuple(off.mean(axis=0).tolist())
    return Learned(len(offs), float(np.sqrt(square / n)), low, high, mean, rms, predicted, inside, tuple(inputs))


def confirm_source(case: Path | None, scan: Path | None, learned: Sequence[Path]) -> Path | None:
    """The case that is confirmed; None where confirmations are learned from. One of both is demanded."""
    if learned:
        if case is not None or scan is not None:
            allowed = "confirm --learn confirm.json ..."
            refuse("--learn takes no case and no scan", "--learn", allowed, "conflicting_options")
        return None
    if case is None or scan is None:
        refuse("a case and its control scan are needed", "confirm", "confirm CASE --scan SCAN", "missing_option")
    return case
