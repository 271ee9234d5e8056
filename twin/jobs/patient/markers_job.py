"""The job ``markers``: markers found in a CT, or places proposed for them, as files for a case and for 3D Slicer."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from puncture_twin.planning.anatomy.anatomy import load_anatomy
from puncture_twin.planning.anatomy.scan import nearest
from puncture_twin.planning.anatomy.skin import Skin
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import user_cache
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.files import is_folder, is_plain_file
from puncture_twin.planning.base.output.output_set import writing
from puncture_twin.planning.base.progress import Watcher
from puncture_twin.planning.base.provenance import Input, inputs_document
from puncture_twin.planning.base.text import Shown, first_few
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.export.slicer import markups_text
from puncture_twin.planning.formats.points import NamedPoints, read_points, write_points
from puncture_twin.planning.formats.volumes.volume_files import Volume
from puncture_twin.planning.geometry.spaces import Space, Unit, to_lps
from puncture_twin.planning.init.finder import Wanted, find
from puncture_twin.planning.init.segmentation import Place
from puncture_twin.planning.registration.fiducials import Fiducial, Seen, Stated, find_fiducials
from puncture_twin.planning.search.bedside import slice_numbers
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.touch.marker_places import MarkerPlace, Proposal, check_count, propose_markers
from puncture_twin.twin.jobs.terminal import write_result
from puncture_twin.twin.report.present import Field, Section, Table, facts, footer, grid, number, text, vector

FOUND, PROPOSED, MARKUPS = "markers_ct.csv", "markers_proposed.csv", ".mrk.json"
"""File names of markers, never one for both: a person puts a marker some mm beside its proposed place."""
PICTURE, REPORT = "markers.png", "markers.json"
NEAR_MM, WIDE_MM = 40.0, 160.0  # half a side of each slice: of a marker, and of a place to be found on the body
CASE = "case.toml"
Run = TypeVar("Run", "MarkersRun", "ProposalRun")
ALLOWED = "a folder with one CT, a CT file (NIfTI, NRRD, a DICOM folder), or a case with one"


def stated_markers(
    kind: str | None, diameter_mm: float | None, count: int | None, layout: Path | None, propose: int | None
) -> Stated:
    """Statements of a person about the markers; none may accompany a proposal."""
    if propose is not None:
        if any(one is not None for one in (kind, diameter_mm, count, layout)):
            allowed = "--propose alone, or options of the markers that are there"
            refuse("markers are to be found and proposed", "--propose", allowed, "conflicting_options")
        check_count(propose)
    return Stated(kind, diameter_mm, count)


@dataclass(frozen=True, eq=False)
class SourceCt:
    """A CT in which markers are looked for, HU, axes to the left, back and head; `space` is that of its reader."""

    name: str
    volume: Volume
    skin: Skin
    space: Space
    inputs: tuple[Input, ...]


def read_source(source: Path, watcher: Watcher) -> SourceCt:
    """The CT of a folder, a file, or a case, with its skin."""
    path = source / CASE if is_plain_file(source / CASE) else source
    if path.suffix.lower() == ".toml":
        case = load_case(path)
        anatomy = load_anatomy(case, partial(watcher.step, "anatomy"), user_cache())
        if anatomy.scan is None:
            refuse("the case has no CT", path, ALLOWED, "no_ct")
        values, T = anatomy.scan.measured
        return SourceCt(case.name, Volume(values, T, path), anatomy.skin, case.space, case.inputs)
    folder, name = (source, None) if is_folder(source) else (source.parent, source.name)
    place = Place(folder, user_cache(), partial(watcher.step, "reading"))
    if name is not None:
        surfaces = place.volume(name)
    else:
        contents = find(place, Wanted(Space.LPS))
        if not contents.cts and contents.problems:
            raise contents.problems[0]
        if not contents.cts:
            refuse("no CT in Hounsfield units", source, ALLOWED, "no_ct")
        if len(contents.cts) > 1:
            refuse(f"several CTs: {', '.join(one.source for one in contents.cts)}", source, ALLOWED, "several_cts")
        surfaces = contents.cts[0].surfaces
    watcher.step("reading", "skin")
    imaged = surfaces.imaged()
    skin, image = imaged.skin(), imaged.image
    return SourceCt(source.name, Volume(image.hu, image.T_ct_index, source), skin, Space.LPS, place.files.inputs)


@dataclass(frozen=True, eq=False, repr=False)
class MarkersRun(Shown):
    """Markers that were found, and the files that were written."""

    source: SourceCt
    seen: Seen
    layout: NamedPoints | None
    files: tuple[Path, ...] = ()

    @property
    def points(self) -> NamedPoints:
        """Names and centres of the markers, LPS mm (or the case's local frame)."""
        markers = self.seen.fiducials
        space = Space.LOCAL if self.source.space is Space.LOCAL else Space.LPS
        return NamedPoints(tuple(one.name for one in markers), np.array([one.position_ct for one in markers]), space)

    @property
    def not_seen(self) -> list[str]:
        """The names of the layout that no marker has: hidden, or moved since."""
        seen = {one.name for one in self.seen.fiducials}
        return [] if self.layout is None else [name for name in self.layout.names if name not in seen]

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON: mm, in the stated space."""
        return {
            "source": self.source.name,
            "space": str(self.source.space),
            "markers": [_row(one, self.source.space) for one in self.seen.fiducials],
            "distances_mm": distances_mm([one.position_ct for one in self.seen.fiducials]).tolist(),
            "not_seen": self.not_seen,
            "doubtful": [
                {"position_mm": to_lps(one.point_ct[None], self.source.space)[0].tolist(), "why": one.why}
                for one in self.seen.doubtful
            ],
            "passed_over": dict(Counter(one.why for one in self.seen.passed)),
            "inputs": inputs_document(self.source.inputs),
            "files": [str(path) for path in self.files],
        }

    def text(self) -> str:
        """For the terminal."""
        document = self.summary()
        rows = document["markers"]
        head = f"{len(rows)} markers in {self.source.name}, mm {self.source.space}"
        warnings = [f"{one} of the layout is not seen, or has moved" for one in self.not_seen]
        if doubtful := document["doubtful"]:
            each = [f"{vector(one['position_mm'], 1)} {one['why']}" for one in doubtful]
            warnings.append(f"may be a marker too: {first_few(each)}")
        return text([Section(head, [grid(FIELDS, rows)]), *footer(self.files, warnings)])


def _row(one: Fiducial, space: Space) -> dict[str, Any]:
    shape, signs = one.reading.shape, np.diag(to_lps(np.ones((1, 3)), space)[0])
    return {
        "name": one.name,
        "position_mm": to_lps(one.position_ct[None], space)[0].tolist(),
        "sd_mm": one.sd_mm.tolist(),
        "covariance_mm2": (signs @ one.reading.cov_ct @ signs).tolist(),
        "kind": shape.kind,
        "diameter_mm": shape.diameter_mm,
        "contrast_hu": one.reading.contrast_hu,
        "clipped": one.reading.clipped,
        "misfit": one.reading.misfit,
        "off_skin_mm": one.gap_mm,
    }


def distances_mm(points: Sequence[Floats]) -> Floats:
    """Straight distances of each to each, mm, shape (n, n)."""
    stacked = np.array(points)
    return np.asarray(np.linalg.norm(stacked[:, None] - stacked, axis=2))


FIELDS = (
    Field("name", "name"),
    Field("position", lambda one: " ".join(number(mm, 1) for mm in one["position_mm"])),
    Field("sd", lambda one: " ".join(number(mm, 2) for mm in one["sd_mm"])),
    Field("kind", "kind"),
    Field("diameter", "diameter_mm", 1, "mm"),
    Field("density", lambda one: "clipped" if one["clipped"] else number(one["contrast_hu"], 0, "HU")),
)


def look_for_markers(
    source: Path, stated: Stated, layout: NamedPoints | None, where: str | Path, watcher: Watcher
) -> MarkersRun:
    """Find the markers of a CT; `where` names the layout in a refusal."""
    ct = read_source(source, watcher)
    watcher.step("markers", "looking")
    return MarkersRun(ct, find_fiducials(ct.volume, ct.skin, stated, layout, where=where), layout)


def find_markers(source: Path, out: Path, stated: Stated, layout: Path | None, watcher: Watcher) -> MarkersRun:
    """`look_for_markers`; write their list, the list for Slicer, a picture and the report."""
    wanted = None if layout is None else read_points(layout, default_unit=Unit.MM)
    run = look_for_markers(source, stated, wanted, layout or source, watcher)
    ct, volume = run.source, run.source.volume
    hu_at = partial(nearest, volume.values, np.asarray(np.linalg.inv(volume.T_ct_index)))
    lines = [f"{one.reading.shape.kind} {one.reading.shape.diameter_mm:.1f} mm" for one in run.seen.fiducials]
    sheet = _Sheet(ct.name, replace(run.points, space=ct.space), lines, hu_at, ct.skin, NEAR_MM)
    return _written(run, sheet, out, FOUND, ct.inputs, watcher)


class _Sheet(NamedTuple):
    """Points that are drawn and listed, in LPS, or the local frame, whose ``space`` is that of the CSV."""

    name: str
    points: NamedPoints
    lines: Sequence[str]
    hu_at: Callable[[Floats], Floats] | None
    skin: Skin
    half_mm: float


def _written(run: Run, sheet: _Sheet, out: Path, csv: str, inputs: tuple[Input, ...], watcher: Watcher) -> Run:
    """A run with its files written; Slicer knows no space of a case's own, and gets no list of it."""
    from puncture_twin.twin.report.slices.sheet import Mark, write_points_sheet  # with matplotlib

    names, points, space = sheet.points.names, sheet.points.points, sheet.points.space or Space.LPS
    markups: list[str] = [] if space is Space.LOCAL else [csv.replace(".csv", MARKUPS)]
    files = (csv, *markups, PICTURE, REPORT)
    with writing(out, "markers", inputs=inputs, names=files, note=watcher.note) as draft:
        write_points(draft.folder / csv, replace(sheet.points, points=to_lps(points, space)))
        for name in markups:
            (draft.folder / name).write_text(markups_text("Fiducial", "markers", names, points), encoding="utf-8")
        marks = [Mark(*one) for one in zip(names, points, sheet.lines, strict=True)]
        title = f"{sheet.name}: {len(marks)} markers"
        write_points_sheet(draft.folder / PICTURE, title, marks, sheet.hu_at, sheet.skin.mesh, sheet.half_mm)
        run = replace(run, files=draft.final([draft.folder / name for name in files]))
        write_result(run.summary(), draft.folder / REPORT, out)
    return run


@dataclass(frozen=True, eq=False)
class ProposalRun:
    """Places for markers, and the files that were written."""

    context: CaseContext
    proposal: Proposal
    files: tuple[Path, ...] = ()

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON: mm, in the case's space."""
        case, proposal = self.context.case, self.proposal
        return {
            "case": case.name,
            "space": str(case.space),
            "proposed": [self._row(one) for one in proposal.places],
            "distances_mm": distances_mm([one.point_ct for one in proposal.places]).tolist(),
            "expected_error_mm": proposal.expected_mm,
            "errors": "declared" if proposal.declared else "1 mm a marker",
            "arm": proposal.arm,
            "nearest_entry_mm": proposal.near_window_mm,
            "unmet": list(proposal.unmet),
            "inputs": inputs_document(case.inputs),
            "files": [str(path) for path in self.files],
        }

    def _row(self, one: MarkerPlace) -> dict[str, Any]:
        space = self.context.case.space
        position = to_lps(one.point_ct[None], space)[0].tolist()
        measured: dict[str, Any] = {}
        if space is not Space.LOCAL:
            measured = {"toward_head_mm": one.head_mm}
            if one.tape is not None:
                measured |= {"along_skin_mm": one.tape.length_mm, "along_skin_to": one.tape.toward}
        if self.context.anatomy.scan is not None:
            number, _ = slice_numbers(self.context.anatomy.scan.grid)
            measured["slice"] = int(np.rint(number @ [*one.point_ct, 1.0]))
        return {"name": one.name, "position_mm": position, **measured, "text": one.words(space)}

    def text(self) -> str:
        """For the terminal."""
        found = self.summary()
        names = [one["name"] for one in found["proposed"]]
        slices = [f"; slice {one['slice']} from the feet" if "slice" in one else "" for one in found["proposed"]]
        places = [(one["name"], one["text"] + at) for one, at in zip(found["proposed"], slices, strict=True)]
        known = [
            ("expected error", f"{found['expected_error_mm']:.2f} mm (rms) at the target, of the markers alone"),
            ("errors", found["errors"]),
            ("arm", found["arm"]),
            ("nearest entry", f"{found['nearest_entry_mm']:.0f} mm from a marker"),
        ]
        apart = [(name, *(number(mm, 0) for mm in row)) for name, row in zip(names, found["distances_mm"], strict=True)]
        return text([
            Section(f"where to put {len(names)} markers, {self.context.case.name}", [facts(places), facts(known)]),
            Section("straight distances, mm", [Table(("", *names), tuple(apart))]),
            *footer(self.files, self.proposal.unmet),
        ])  # fmt: skip


def propose_places(context: CaseContext, out: Path, count: int) -> ProposalRun:
    """Search the case, propose places for markers beside its windows, and write them."""
    candidates = context.search()
    with context.stages.time("marker places"):
        run = ProposalRun(context, propose_markers(context, candidates, count))
    case, anatomy, places = context.case, context.anatomy, run.proposal.places
    points = NamedPoints(tuple(one.name for one in places), np.array([one.point_ct for one in places]), case.space)
    hu_at = None if anatomy.scan is None else anatomy.scan.hu_at
    sheet = _Sheet(case.name, points, ["proposed"] * len(places), hu_at, anatomy.skin, WIDE_MM)
    return _written(run, sheet, out, PROPOSED, case.inputs, context.watcher)
