"""The job ``scan``: a case scanned, its markers, its lesion and a needle found again, and how far off each was."""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.metal import METAL_HU
from puncture_twin.planning.anatomy.scan import nearest
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.base.output.manifest import read_output
from puncture_twin.planning.base.output.output_set import writing
from puncture_twin.planning.base.provenance import Input, inputs_document
from puncture_twin.planning.base.strict_json import array, fitting, parse_json
from puncture_twin.planning.formats.csv_table import table_text
from puncture_twin.planning.formats.points import write_points
from puncture_twin.planning.formats.volumes.volume_files import Volume
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.twin.guidance.ct.markers import READING_MM, Markers, find_markers, read_lesion
from puncture_twin.twin.guidance.ct.needle import find_needle, needle_error
from puncture_twin.twin.guidance.ct.needle_fit import FoundNeedle
from puncture_twin.twin.jobs.terminal import write_result
from puncture_twin.twin.plant.scanner import case_scene as scenes
from puncture_twin.twin.plant.scanner.image import CtImage, ScanSettings
from puncture_twin.twin.plant.scanner.writers import write_nifti, write_series
from puncture_twin.twin.report.present import Block, Field, Section, facts, grid, text

SERIES = "dicom"
CT, LABELS, CROSSED = "ct.nii.gz", "labels", "crossed"
FOUND, REPORT, PICTURE = "markers_ct.csv", "scan.json", "scan.png"
MAX_REHEARSAL_BYTES = 50_000_000
HALF_MM = 50.0  # of a slice's side in the picture
SUB_VOXEL_SD = 0.03  # of a drawn marker along the bed, over the spacing: the limit where metal is clipped


class ScanRequest(NamedTuple):
    """A requested scan; ``beside`` places what lies outside of the patient, nothing where None."""

    settings: ScanSettings
    marker: scenes.MarkerKind = "disc"
    rehearsal: Path | None = None
    beside: scenes.Placer | None = None


def parse_marker(text: str) -> scenes.MarkerKind:
    """The kind of marker by its name. Raises InputError: an unknown one."""
    for kind in get_args(scenes.MarkerKind):
        if text == kind:
            return kind
    what = f"marker '{text[:40]}' is not known"
    raise InputError(what, where="--marker", allowed=", ".join(get_args(scenes.MarkerKind)), code="unknown_choice")


@dataclass(frozen=True, eq=False)
class Control:
    """A needle in a control CT: its true place, the one that was read, or None and why not; its target."""

    true: scenes.TrueRod
    found: FoundNeedle | None
    target: Floats
    why_not: str = ""


@dataclass(frozen=True, eq=False)
class ScanRun:
    """A scan, what was read off it, and the files that were written. Points in the scan's frame, LPS mm."""

    context: CaseContext
    request: ScanRequest
    scene: scenes.CaseScene
    image: CtImage
    markers: Markers | None
    lesion: tuple[Floats, Floats]
    control: Control | None
    inputs: tuple[Input, ...]
    files: tuple[Path, ...] = ()

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON: mm, HU, degrees; true places beside readings."""
        grid, settings = self.image.grid, self.request.settings
        true, read = self.lesion
        return {
            "case": self.context.case.name,
            "settings": {
                **{key: value for key, value in asdict(settings).items() if key != "turn"},
                "turn_deg": float(np.degrees(settings.turn)),
                "marker": self.request.marker,
            },
            "voxels": list(grid.shape),
            "T_scan_case": self.scene.T_scan_ct.tolist(),
            "target_mm": self.scene.target.tolist(),
            "theory_mm": {  # standard deviations: of the rule uniform in its cell, of the drawn marker as held to
                "rule_along_bed": settings.spacing_mm / np.sqrt(12),
                "rule_in_plane": READING_MM / np.sqrt(12),
                "middle_along_bed": SUB_VOXEL_SD * settings.spacing_mm,
            },
            "markers": list(self._markers()),
            "lesion": {"true_mm": true.tolist(), "found_mm": read.tolist(), "error_mm": (read - true).tolist()},
            "needle": None if self.control is None else control_summary(self.control),
            "thin_voxels": dict(self.image.thin),
            "inputs": inputs_document(self.inputs),
            "files": [str(path) for path in self.files],
        }

    def _markers(self) -> Iterator[dict[str, Any]]:
        if self.markers is None or self.scene.markers is None:
            return
        fine, rule = self.markers.fine, self.markers.rule
        true = self.scene.markers.points
        for row, name in enumerate(fine.names):
            errors = {"rule_error_mm": rule.points[row] - true[row], "error_mm": fine.points[row] - true[row]}
            yield {"name": name, "true_mm": true[row].tolist(), **{key: one.tolist() for key, one in errors.items()}}


def control_summary(control: Control) -> dict[str, Any]:
    """A needle as read and as it truly is, mm and degrees; errors from the target, as clinical papers state them."""
    true, needle = needle_error(control.true.tip_ct, control.true.forward_ct, control.target), control.found
    if needle is None:
        return {"found": None, "true": true._asdict(), "why_not": control.why_not}
    cosine = np.clip(needle.forward_ct @ control.true.forward_ct, -1.0, 1.0)
    return {
        "tip_mm": needle.tip_ct.tolist(),
        "found": needle_error(needle.tip_ct, needle.forward_ct, control.target)._asdict(),
        "true": true._asdict(),
        "tip_reading_error_mm": float(np.linalg.norm(needle.tip_ct - control.true.tip_ct)),
        "angle_reading_error_deg": float(np.degrees(np.arccos(cosine))),
    }


def scan_case(context: CaseContext, out: Path, request: ScanRequest) -> ScanRun:
    """Scan a case; write the series, NIfTI, the label map of the truth, the markers as found, and the report.

    Raises InputError: An open surface, a field of view without the markers, or a rehearsal that cannot be used.
    """
    with context.stages.time("scan"):
        run = _scanned(context, request)
    names = (CT, REPORT, PICTURE, *(() if run.markers is None else (FOUND,)))
    seconds = context.stages.seconds
    with writing(out, "scan", inputs=run.inputs, seconds=seconds, names=names, note=context.watcher.note) as draft:
        with context.stages.time("files"):
            files = list(_write(run, draft.folder))
        run = replace(run, files=draft.final(files))
        report = draft.folder / REPORT
        write_result(run.summary(), report, out)
    return replace(run, files=(*run.files, out / REPORT))


def _scanned(context: CaseContext, request: ScanRequest) -> ScanRun:
    case, settings = context.case, request.settings
    rng = np.random.default_rng(settings.seed)
    needle, read = _rehearsed(request.rehearsal)
    rod = None if needle is None else needle[0]
    scene = scenes.case_scene(
        case, context.anatomy, settings, rng, marker=request.marker, needle=rod, outside=request.beside
    )
    image = scenes.VirtualScanner(scene, settings, rng).image()
    volume = Volume(image.hu, image.grid.T_ct_index, case.path)
    markers = None if scene.listed is None else find_markers(volume, scene.listed)
    lesion = _lesion(context, scene, image, volume)
    control, T = None, scene.T_scan_ct
    if needle is not None:
        true, target = scenes.TrueRod(apply(T, needle[0].tip_ct), T[:3, :3] @ needle[0].forward_ct), apply(T, needle[1])
        try:
            control = Control(true, find_needle(volume, target, case.needle.diameter_mm), target)
        except InputError as error:
            control = Control(true, None, target, error.what)
    return ScanRun(context, request, scene, image, markers, lesion, control, (*read, *case.inputs))


def _lesion(context: CaseContext, scene: scenes.CaseScene, image: CtImage, volume: Volume) -> tuple[Floats, Floats]:
    """The target's structure, where it truly is and where it was read; of a rod of metal the end, else the middle."""
    name = context.case.target_structure
    solid = next(one for one in scene.solids if one.name == name)
    if solid.hu >= METAL_HU:
        return scene.target, find_needle(volume, scene.target).tip_ct
    mask = image.labels[solid.layer] == solid.label
    if not mask.any():
        refuse(f"'{name}' is not in the image", "scan", "a field of view that contains the target", "outside_image")
    triangles = solid.mesh.triangles  # the centroid of what they enclose: of tetrahedra from the origin
    volumes = np.einsum("ti,ti->t", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2]))
    return np.asarray(volumes @ triangles.sum(axis=1) / 4 / volumes.sum()), read_lesion(volume, mask)


def _rehearsed(path: Path | None) -> tuple[tuple[scenes.TrueRod, Floats] | None, tuple[Input, ...]]:
    """The needle at the end of a rehearsal, and the true target, in the case's frame."""
    if path is None:
        return None, ()
    allowed = "a rehearsal.json of this version"
    read = read_output(path, max_bytes=MAX_REHEARSAL_BYTES)
    document = parse_json(read.data, where=path, allowed=allowed)
    with fitting(path, allowed):
        end = document["needle_end"]
        tip, forward, target = (array(end[key], (3,)) for key in ("tip_ct_mm", "direction_ct", "target_ct_mm"))
    return (scenes.TrueRod(tip, forward / np.linalg.norm(forward)), target), (read.input("rehearsal"),)


def _write(run: ScanRun, folder: Path) -> Iterator[Path]:
    image, case = run.image, run.context.case
    made_from = "\n".join([*map(str, run.inputs), str(run.request)])
    identity = hashlib.sha256(made_from.encode()).hexdigest()
    yield from write_series(folder / SERIES, image, run.request.settings, identity, case.name)
    yield write_nifti(folder / CT, image.hu, image.grid.T_ct_index)
    layers = scenes.label_layers(case, run.context.anatomy)
    for file, names, labels in zip((LABELS, CROSSED), layers, image.labels, strict=False):
        yield from _write_labels(folder, file, names, run, labels)
    if run.markers is not None:
        write_points(folder / FOUND, run.markers.fine)
        yield folder / FOUND
    yield _draw(run, folder / PICTURE)


def _draw(run: ScanRun, path: Path) -> Path:
    from puncture_twin.twin.report.slices.sheet import Mark, write_points_sheet  # with matplotlib

    marks, control = [Mark("target", run.scene.target, "true place")], run.control
    if control is not None and control.found is not None:
        marks.append(Mark("needle", control.found.tip_ct, "tip as it was read"))
    if run.markers is not None:
        fine = run.markers.fine
        marks += [Mark(name, point, "as it was read") for name, point in zip(fine.names, fine.points, strict=True)]
    T = np.asarray(np.linalg.inv(run.image.grid.T_ct_index), dtype=np.float64)
    hu = run.image.hu.astype(np.float32)
    skin = run.context.anatomy.skin.mesh.transformed(run.scene.T_scan_ct)
    return write_points_sheet(
        path, f"{run.context.case.name}, simulated", marks, partial(nearest, hu, T), skin, HALF_MM
    )


def _write_labels(folder: Path, file: str, names: Sequence[str], run: ScanRun, labels: NDArray[Any]) -> Iterator[Path]:
    """A label map with a table of its names; one structure alone is a mask, which is named by its file."""
    alone = names[0].replace("/", "_") if len(names) == 1 else None
    yield write_nifti(folder / f"{alone or file}.nii.gz", labels, run.image.grid.T_ct_index)
    if alone is None:
        rows = [(str(number), name) for number, name in enumerate(names, start=1)]
        (folder / f"{file}.csv").write_text(table_text(("label", "name"), rows), encoding="utf-8")
        yield folder / f"{file}.csv"


def scan_text(run: ScanRun) -> str:
    """Text of a scan's errors, mm, along x, y, z of the scan (left, back, head)."""
    document, folder = run.summary(), run.files[-1].parent
    settings, shape = document["settings"], " x ".join(map(str, document["voxels"]))
    target = ",".join(f"{one:.2f}" for one in document["target_mm"])
    pixel, spacing = settings["pixel_mm"], settings["spacing_mm"]
    thin = ", ".join(f"{name} ({count})" for name, count in document["thin_voxels"].items())
    rows = [
        ("scan", f"{shape} voxels of {pixel:g} x {pixel:g} x {spacing:g} mm, noise {settings['noise_hu']:g} HU, seed "
                 f"{settings['seed']}"),
        *([] if document["markers"] else [("markers", "none")]),
        ("lesion", f"{_vector(document['lesion']['error_mm'])}   read minus true"),
        *_needle_rows(document["needle"]),
        *([("thin", f"parts thinner than a voxel fill whole voxels of the label map: {thin}")] if thin else []),
    ]  # fmt: skip
    return text([
        Section(str(folder), [facts(rows), *_marker_blocks(document)]),
        Section(f"next: run-twin init {folder} --ct {SERIES} --target={target}", []),
    ])  # fmt: skip


def _marker_blocks(document: dict[str, Any]) -> list[Block]:
    markers, theory = document["markers"], document["theory_mm"]
    if not markers:
        return []
    keys = ("rule_error_mm", "error_mm")
    rms = {key: np.sqrt(np.mean(np.square([one[key] for one in markers]), axis=0)).tolist() for key in keys}
    fields = (
        Field("errors, mm", "name"),
        Field("slice and millimetre", lambda one: _vector(one["rule_error_mm"])),
        Field("drawn marker", lambda one: _vector(one["error_mm"])),
    )
    expected = "standard dev.  {rule_in_plane:.2f} in the plane, {rule_along_bed:.2f} along the bed; the drawn marker"
    held = ": limit {middle_along_bed:.2f} along the bed"
    return [grid(fields, [*markers, {"name": "rms", **rms}]), (expected + held).format(**theory)]


def _needle_rows(needle: dict[str, Any] | None) -> list[tuple[str, str]]:
    if needle is None:
        return []
    if needle["found"] is None:
        return [("needle", f"not read: {needle['why_not']}")]
    said = "tip {tip_to_target_mm:.2f} mm from the target ({lateral_mm:.2f} across, {depth_mm:+.2f} along)"
    off = "{tip_reading_error_mm:.2f} mm and {angle_reading_error_deg:.2f}°".format(**needle)
    return [
        ("needle, in the control CT", said.format(**needle["found"])),
        ("true", said.format(**needle["true"])),
        ("reading error", off),
    ]


def _vector(numbers: list[float]) -> str:
    return " ".join(f"{one:+6.2f}" for one in numbers)
