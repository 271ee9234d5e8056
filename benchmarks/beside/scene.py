"""One drawn patient: scanned with arms, bed and lines, made a case by `init`, searched, judged against the truth."""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.beside.judge import lacks, passed
from puncture_twin.planning.base.progress import Silent
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.planning.init.finder import Wanted
from puncture_twin.planning.init.start import Request
from puncture_twin.planning.reach.standoff import standoffs
from puncture_twin.planning.search.context import prepare
from puncture_twin.twin.jobs.experiment.scan_job import ScanRequest, scan_case
from puncture_twin.twin.jobs.patient.init_job import init_case
from puncture_twin.twin.plant.scanner.image import ScanSettings
from tools.phantoms.drawn.trunk import draw_trunk
from tools.phantoms.drawn.trunk_case import CASE, write_trunk_case
from tools.phantoms.outside_objects import OutsideObjects

NEEDLE_AND_SEARCH = CASE[CASE.index("[needle]") :]


class Asked(NamedTuple):
    """What is scanned: a seed of the anatomy and of what lies beside it, and how."""

    seed: int
    beside: OutsideObjects
    settings: ScanSettings


@dataclass(frozen=True, eq=False)
class Judged:
    """What a search on the scan said, and what is true.

    Attributes:
        passed: What safe needles truly pass outside of the trunk.
        blind: What those pass that are safe for the meshes alone, which know of nothing beside the patient.
        lacks: Name of a structure to the clearance that its safe needles lack at most, mm.
    """

    asked: Asked
    context: object
    found: object
    passed: list
    blind: list
    lacks: dict

    @property
    def voxel_mm(self):
        """The voxel's diagonal."""
        return float(np.linalg.norm([self.asked.settings.pixel_mm] * 2 + [self.asked.settings.spacing_mm]))


def scanned(folder: Path, asked: Asked):
    """The case of the meshes, what was scanned, and the case of the scan."""
    trunk = draw_trunk(np.random.default_rng(asked.seed))
    write_trunk_case(folder / "truth", trunk, f"drawn_{asked.seed}")
    truth = prepare(folder / "truth", arm=False)
    out = folder / "ct"
    run = scan_case(truth, out, ScanRequest(asked.settings, "none", None, asked.beside.placed))
    target = ",".join(f"{one:.3f}" for one in run.scene.target)
    init_case(
        Request(out, target, None, None, Wanted(Space.LPS, None, None, "dicom", None)), force=True, watcher=Silent()
    )
    text = (out / "case.toml").read_text()
    rest = text[text.index("[search]") :]
    rest = rest[rest.index("\n[") :] if "\n[" in rest else ""
    (out / "case.toml").write_text(text[: text.index("[needle]")] + NEEDLE_AND_SEARCH + rest)
    return truth, run


def judged(folder: Path, asked: Asked) -> Judged:
    """Scan, search, and hold every safe direction against the truth."""
    truth, run = scanned(folder, asked)
    context = prepare(folder / "ct", arm=False)
    found = context.search()
    parts = {one.name: one.mesh for one in run.scene.outside_objects if is_outer(one)}
    through, blind = (_passed(one, parts, run.scene, context.case.needle) for one in (found, truth.search()))
    safe = np.flatnonzero(found.safe)
    case, directions, length = context.case, found.outward_ct[safe], found.path.length[safe]
    short = {
        one.name: float(
            lacks(one.mesh, run.scene.target, directions, length, one.margin_mm + case.needle.radius_mm).max(initial=0)
        )
        for one in truth.anatomy.structures
        if one.demands_margin
    }
    return Judged(asked, context, found, through, blind, short)


def is_outer(part):
    """Whether a part is no other's bone, core or foam."""
    return part.place != "within" and not part.name.endswith(("_core", "_foam"))


def _passed(found, parts, scene, needle):
    """What the safe needles of a search pass, from the target to the flange while the tip waits at its standoff."""
    safe = np.flatnonzero(found.safe)
    ends = standoffs(needle, found.path.length[safe], found.path.skin_angle[safe]) + needle.length_mm
    return passed(parts, scene.skin, scene.target, found.outward_ct[safe], ends)
