"""The loop on the embedded abdomen: scanned, made a case by `init`, searched; beside the search on its own meshes."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.experiment.row import Row
from puncture_twin.meshes import folder
from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.base.progress import Silent
from puncture_twin.planning.case.entry import grid
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.planning.init.finder import Wanted
from puncture_twin.planning.init.start import Request
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.context import CaseContext, prepare
from puncture_twin.planning.search.search import search
from puncture_twin.twin.jobs.experiment.scan_job import ScanRequest, scan_case
from puncture_twin.twin.jobs.patient.init_job import init_case
from puncture_twin.twin.plant.scanner.image import ScanSettings

PIXEL_MM, STEP_DEG = 2.0, 3.0
SCANS = {
    "slices of 2.5 mm": ScanSettings(2.5, PIXEL_MM),
    "slices of 5 mm": ScanSettings(5.0, PIXEL_MM),
    "turned by 25 degrees": ScanSettings(2.5, PIXEL_MM, turn=float(np.radians(25))),
}


class _Compared(NamedTuple):
    """Of every direction: what meshes and scan say, clearance beyond the margin on the meshes, and both clearances."""

    meshes: Candidates
    scanned: Candidates
    slack_mm: Floats
    apart_mm: Floats


def rows() -> Iterator[Row]:
    """The figures."""
    meshes = prepare(folder() / "abdomen", arm=False)
    for name, settings in SCANS.items():
        voxel = float(np.linalg.norm([PIXEL_MM, PIXEL_MM, settings.spacing_mm]))
        found = _compared(meshes, settings)
        wrong = found.scanned.safe & ~found.meshes.safe
        spare: Bools = found.meshes.safe & (found.slack_mm > voxel)
        close = wrong & (found.meshes.verdict.reason == "too_close")
        yield Row.at_most(
            f"{name}: largest excess of a clearance over the mesh's, voxels", found.apart_mm.max() / voxel, 1
        )
        worst = float(-found.slack_mm[close].min(initial=0.0))
        yield Row.at_most(f"{name}: wrong safe by clearance, {close.sum()} directions, at most mm", worst, voxel)
        lost = int((spare & ~found.scanned.safe).sum())
        yield Row.at_most(f"{name}: of {spare.sum()} safe by more than a voxel, not safe in the scan", lost, 0)
        others = int((wrong & ~close).sum())
        yield Row(f"{name}: safe in the scan, refused on the meshes for another reason", str(others), "", True)


def _compared(meshes: CaseContext, settings: ScanSettings) -> _Compared:
    with tempfile.TemporaryDirectory() as name:
        out = Path(name) / "ct"
        run = scan_case(meshes, out, ScanRequest(settings, "none"))
        target = ",".join(f"{one:.3f}" for one in run.scene.target)
        wanted = Wanted(Space.LPS, None, None, "dicom", None)
        init_case(Request(out, target, None, None, wanted), force=False, watcher=Silent())
        _with_needle_of(meshes, out / "case.toml")
        scanned = prepare(out, arm=False)
        R = meshes.case.T_ct_entry[:3, :3]
        pair = _found(meshes, R), _found(scanned, run.scene.T_scan_ct[:3, :3] @ R)
    names = [one.name for one in meshes.anatomy.structures]
    columns = [[one.name for one in scanned.anatomy.checked].index(name) for name in names]
    near = pair[0].clearance.distance[:, : len(names)]
    apart = pair[1].clearance.distance[:, columns] - near
    demanding = [k for k, one in enumerate(meshes.anatomy.checked) if one.demands_margin]
    margins = np.array([meshes.anatomy.checked[k].margin_mm for k in demanding])
    clearance = pair[0].clearance.distance[:, demanding] - meshes.case.needle.radius_mm
    return _Compared(*pair, (clearance - margins).min(axis=1), apart)


def _with_needle_of(meshes: CaseContext, path: Path) -> None:
    """The same needle for both."""
    text, own = path.read_text(), meshes.case.path.read_text()
    needle = own[own.index("[needle]") : own.index("[search]")]
    path.write_text(text[: text.index("[needle]")] + needle + text[text.index("[search]") :])


def _found(context: CaseContext, R_ct_entry: Floats) -> Candidates:
    directions = grid((0.0, np.pi / 2), (0.0, 2 * np.pi), np.radians(STEP_DEG), R_ct_entry)
    return search(context.case, context.anatomy, context.engine, directions)
