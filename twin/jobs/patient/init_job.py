"""The job ``init``: a folder with a CT and a segmentation becomes a case that has been read as a search reads it."""

import hashlib
from collections import Counter
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, get_args

from puncture_twin.planning.base.cache.array_cache import Memory, user_cache
from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.base.files import atomic, is_folder, is_plain_file
from puncture_twin.planning.base.progress import Watcher
from puncture_twin.planning.base.provenance import Input, inputs_document
from puncture_twin.planning.base.toml_file import parse_toml
from puncture_twin.planning.case.case import ALLOWED_CASE
from puncture_twin.planning.case.case_file import CaseFile, Region
from puncture_twin.planning.formats.points import write_points
from puncture_twin.planning.geometry.spaces import Space, to_lps
from puncture_twin.planning.init.case_text import with_image_seen
from puncture_twin.planning.init.overrides import WAYS, with_keys
from puncture_twin.planning.init.start import ALLOWED, Request, Start, start_case
from puncture_twin.planning.search.context import CaseContext, prepare
from puncture_twin.planning.search.sides import grid_of, sides_text
from puncture_twin.twin.jobs.patient.run import SLICES

CASE = "case.toml"
READING_BYTES = 3_000_000_000  # what was read is read once: 1,000 slices of 512 x 512, and their labels


@dataclass(frozen=True, eq=False)
class InitRun:
    """A case that was written, and what a person should check."""

    path: Path
    start: Start
    context: CaseContext
    warnings: tuple[str, ...]
    picture: Path | None

    @property
    def markers(self) -> Path | None:
        """The list of the markers that the CT shows, where none was given."""
        return None if self.start.seen is None else self.path.parent / self.start.seen.source

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON: mm, in the case's space."""
        parts = self.start.parts
        position = to_lps(parts.target_ct[None], parts.space)[0]
        written = Input("case", CASE, hashlib.sha256(self.start.text.encode()).hexdigest())
        return {
            "case": str(self.path),
            "space": str(parts.space),
            "region": parts.region,
            "ct": parts.ct,
            "segmentations": [segmentation.source for segmentation, _ in parts.sources],
            "target_mm": [float(one) for one in position],
            "target_structure": parts.structure,
            "structures": dict(Counter(row.kind for row in parts.rows)),
            "looked": sides_text(self.context.sides),
            "sides": [side.document() for side in self.context.sides],
            "warnings": list(self.warnings),
            "findings": self.context.provenance()["findings"],
            "inputs": inputs_document(written if one.role == "case" else one for one in self.context.case.inputs),
            "files": [str(path) for path in (self.path, self.picture, self.markers) if path is not None],
        }


def init_case(request: Request, *, force: bool, watcher: Watcher) -> InitRun:
    """Make the case, read it as `search` does, and write it; what is wrong leaves nothing behind."""
    _refuse_options(request)
    folder, path = request.folder, request.folder / CASE
    if not is_folder(folder):
        refuse("is not a folder", str(folder)[:200], ALLOWED, "not_a_folder")
    if is_plain_file(path) and not force:
        refuse("a case exists already", path, "--force to replace it", "case_exists")
    if (request.target is None) == (request.target_label is None):
        refuse("two targets were given", "init", "either --target X,Y,Z or --target-label NAME", "conflicting_options")
    memory = Memory(READING_BYTES)
    start = start_case(request, replace(user_cache(), memory=memory), partial(watcher.step, "reading"))
    with atomic(path) as draft:
        draft.write_text(start.text, encoding="utf-8")
        try:
            context = prepare(draft, arm=False, watcher=watcher, memory=memory)
        except InputError as error:
            what, where = (text.replace(draft.name, CASE) for text in (error.what, error.where))
            parts = {"where": where, "allowed": f"{error.allowed}; {WAYS}", "code": error.code}
            raise type(error)(what, **parts, numbers=error.numbers) from error
        text = _with_seen(start, request, context)
        parse_toml(text.encode(), path, CaseFile, allowed=ALLOWED_CASE, keys="docs/reference/case.md")
        if start.seen is not None:
            points, space = start.seen.points, start.parts.space
            write_points(folder / start.seen.source, replace(points, points=to_lps(points.points, space), space=space))
        draft.write_text(text, encoding="utf-8")
        findings = [one.replace(draft.name, CASE) for one in context.provenance()["warnings"]]
    picture = None if context.anatomy.scan is None else folder / SLICES
    if picture is not None:
        from puncture_twin.twin.report.slices.panel import Subject
        from puncture_twin.twin.report.slices.sheet import draw_slices, write_sheet  # with matplotlib

        write_sheet(draw_slices(Subject(context.case, context.anatomy, None)), picture)
    return InitRun(path, replace(start, text=text), context, (*start.notes, *findings), picture)


def _refuse_options(request: Request) -> None:
    region, radius = request.region, request.hit_radius_mm
    if region is not None and region not in get_args(Region):
        refuse(f"region '{region[:40]}' is not known", "--region", ", ".join(get_args(Region)), "unknown_region")
    if request.wanted.space is Space.LOCAL:
        refuse("a patient's space", "--space", "LPS or RAS", "unknown_space")
    if radius is not None and (request.target is None or not 0 < radius <= 100):
        refuse(f"{radius:g}", "--hit-radius", "mm, above 0, at most 100, with --target", "out_of_range")


def _with_seen(start: Start, request: Request, context: CaseContext) -> str:
    text, where = with_image_seen(start.text, context.anatomy), grid_of(context.sides)
    looked = f"entry sides: {sides_text(context.sides)}"
    keys = {"search.frame": where.frame, "search.theta_deg": "[{:g}, {:g}]".format(*where.theta_deg)}
    if not request.wanted.overrides.keys.keys().isdisjoint(keys):
        return text
    return with_keys(text, keys, {"search.theta_deg": looked, "search.frame": "theta 0 is its z"})


def init_text(run: InitRun) -> str:
    """Text of a new case, and the next command."""
    parts, counts = run.start.parts, Counter(row.kind for row in run.start.parts.rows)
    position = ", ".join(f"{one:.1f}" for one in to_lps(parts.target_ct[None], parts.space)[0])
    needle = run.context.case.needle
    roles = ", ".join(f"{count} {kind}" for kind, count in sorted(counts.items()))
    sources = ("the meshes next to it" if one.source == "." else one.source for one, _ in parts.sources)
    lines = [
        f"{run.path}",
        f"  skin           {parts.skin}",
        f"  structures     {roles}, of {', '.join(sources)}",
        f"  target         {position} mm {parts.space}, in {parts.structure or 'no structure'}",
        f"  region         {parts.region}",
        f"  needle         {needle.length_mm:g} mm, shaft {needle.shaft_mm:g} mm, diameter {needle.diameter_mm:g} mm",
        f"  entry sides    {sides_text(run.context.sides)}",
        *([] if run.picture is None else [f"  check          {run.picture}"]),
        f"next: run-twin search {run.path.parent}",
    ]
    return "\n".join(lines)
