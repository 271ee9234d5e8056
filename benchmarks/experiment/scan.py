"""The virtual CT: how fast, how exact its volumes are, and how well markers, lesion and needle are found again."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.experiment.row import Row
from puncture_twin.meshes import folder
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.formats.points import NamedPoints
from puncture_twin.planning.formats.volumes.volume_files import Volume
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.search.context import prepare
from puncture_twin.twin.guidance.ct.markers import find_markers
from puncture_twin.twin.guidance.ct.needle import find_needle
from puncture_twin.twin.jobs.experiment.scan_job import ScanRequest, scan_case
from puncture_twin.twin.plant.scanner.coverage import cut_solids
from puncture_twin.twin.plant.scanner.image import ScanSettings, Solid, ball, box, rod, scan_solids

PIXEL_MM = 0.7
SCANS = 40
"""Each with six markers."""
NEEDLES = 40
METAL_HU = 8000.0
BLOCK = Solid("block", box(np.zeros(3), np.array([90.0, 60.0, 130.0])), 20.0)


def rows() -> Iterator[Row]:
    """The figures."""
    yield from _commands()
    yield _volumes()
    for kind in ("disc", "ball"):
        for spacing in (1.0, 2.0, 3.0, 5.0):
            yield from _markers(kind, spacing)
    for spacing in (1.0, 2.5, 5.0):
        yield from _needles(spacing)


def _commands() -> Iterator[Row]:
    """The whole command with all its files, on processor time: the machine may be shared."""
    for name, case, spacing, limit in (("abdomen", "abdomen", 2.5, 15.0), ("carton", "carton/case_m.toml", 1.0, 5.0)):
        context = prepare(folder() / case, arm=False)
        request = ScanRequest(ScanSettings(spacing))
        with tempfile.TemporaryDirectory() as out:
            scan_case(context, Path(out) / "first", replace_settings(request, spacing_mm=10.0))  # compiles
            start = time.process_time()
            run = scan_case(context, Path(out) / "scan", request)
            spent = time.process_time() - start
        shape = " x ".join(map(str, run.image.grid.shape))
        yield Row.at_most(f"scan {name}, {spacing:g} mm, {shape} voxels, with all files, processor s", spent, limit)
        found, true = run.lesion[1], run.lesion[0]
        yield Row(f"lesion of the {name}, error mm", " ".join(f"{one:+.2f}" for one in found - true), "", True)


def replace_settings(request: ScanRequest, **changes: float) -> ScanRequest:
    """A request with other settings."""
    return request._replace(settings=replace(request.settings, **changes))


def _volumes() -> Row:
    """The largest relative error of an organ's volume in slices of 2.5 mm, of what lies wholly in the image."""
    worst, spacing = 0.0, np.array([0.8, 0.8, 2.5])
    for structure in prepare(folder() / "abdomen", arm=False).anatomy.structures:
        low, high = structure.mesh.bounds
        T = np.diag([*spacing, 1.0])
        T[:3, 3] = low - 0.37
        shape = tuple(int(n) for n in np.ceil((high - low) / spacing) + 2)
        corners = apply(np.linalg.inv(T), structure.mesh.vertices)[structure.mesh.faces]
        labels, owners = np.zeros((1, 1), np.uint8), np.zeros(len(corners), np.int64)
        cut = cut_solids(corners, owners, np.ones(1), labels, shape, spacing_mm=spacing, empty=0.0)
        triangles = structure.mesh.triangles
        wanted = np.einsum("ti,ti->", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2])) / 6
        if structure.name in ("liver", "spleen", "kidney_right", "stomach", "lesion", "heart"):
            worst = max(worst, abs(float(cut.values.sum(dtype=float) * spacing.prod() / wanted - 1)))
    return Row.at_most("volumes of six organs, largest relative error", worst, 1e-4)


def _scanned(solids: list[Solid], spacing: float, size: Floats, centre: Floats, rng: np.random.Generator) -> Volume:
    """A scan about a place, whose grid falls anywhere."""
    cell = np.array([PIXEL_MM, PIXEL_MM, spacing])
    T = np.diag([*cell, 1.0])
    T[:3, 3] = centre - size / 2 + rng.uniform(0, 1, 3) * cell
    shape = tuple(int(n) for n in size / cell)
    image = scan_solids(solids, VolumeGrid(shape, T, {}), ScanSettings(spacing, PIXEL_MM), rng)
    return Volume(image.hu, T, Path("scan"))


def _markers(kind: str, spacing: float) -> Iterator[Row]:
    """Markers of 8 mm on the front of a block (discs 1.5 mm thick), each anywhere in its cell."""
    fine, rule = [], []
    rng = np.random.default_rng(20191104)
    for _ in range(SCANS):
        places = np.array([(x, -30.0, z) for x in (-20.0, 20.0) for z in (-35.0, 0.0, 35.0)])
        places += rng.uniform(-0.5, 0.5, (6, 3)) * [PIXEL_MM, 0.0, spacing]
        half = np.array([0.0, 0.75, 0.0])
        meshes = [rod(p - half, p + half, 8.0) if kind == "disc" else ball(p, 8.0) for p in places]
        solids = [BLOCK, *(Solid("marker", mesh, METAL_HU) for mesh in meshes)]
        volume = _scanned(solids, spacing, np.array([66.0, 40.0, 110.0]), np.array([0.0, -30.0, 0.0]), rng)
        found = find_markers(volume, NamedPoints(tuple("abcdef"), places + 2.0, None))
        fine.append(found.fine.points - places)
        rule.append(found.rule.points - places)
    fine_mm, rule_mm = np.concatenate(fine), np.concatenate(rule)
    name = f"{kind}, slices of {spacing:g} mm"
    yield Row.at_most(f"{name}: middle of the metal, sd along the bed, mm", fine_mm[:, 2].std(), 0.15 * spacing)
    in_plane = float(np.sqrt(fine_mm[:, :2].var(axis=0).mean()))
    yield Row.at_most(f"{name}: the same in the plane, rms of both axes, mm", in_plane, 0.05)
    yield Row.at_most(f"{name}: largest bias, mm", float(np.abs(fine_mm.mean(axis=0)).max()), 0.12)
    uniform = spacing / np.sqrt(12)
    yield Row.between(
        f"{name}: rule, sd along the bed over spacing / sqrt(12)", rule_mm[:, 2].std() / uniform, 0.9, 1.1
    )
    yield Row(f"{name}: rule, sd in the plane, mm", f"{rule_mm[:, 0].std():.3f}", "1 / sqrt(12) = 0.289", True)


def _needles(spacing: float) -> Iterator[Row]:
    """A needle of 1.2 mm, 60 mm of it in the image, at any angle within 75 degrees of the front."""
    errors, angles = [], []
    rng = np.random.default_rng(7)
    for _ in range(NEEDLES):
        theta, beta = rng.uniform(0, np.radians(75)), rng.uniform(0, 2 * np.pi)
        forward = np.array([np.sin(theta) * np.cos(beta), np.cos(theta), np.sin(theta) * np.sin(beta)])
        tip = rng.uniform(-1, 1, 3)
        needle = Solid("needle", rod(tip - 60 * forward, tip, 1.2), METAL_HU)
        volume = _scanned([BLOCK, needle], spacing, np.array([110.0, 70.0, 110.0]), np.array([0.0, -10.0, 0.0]), rng)
        found = find_needle(volume, np.zeros(3), 1.2)
        errors.append(float(np.linalg.norm(found.tip_ct - tip)))
        angles.append(float(np.degrees(np.arccos(np.clip(found.forward_ct @ forward, -1, 1)))))
    name = f"needle in a control CT, slices of {spacing:g} mm"
    shown = f"{np.sqrt(np.mean(np.square(errors))):.2f}, {max(errors):.2f}"
    yield Row(f"{name}: tip, rms and largest error, mm", shown, "", True)
    yield Row(f"{name}: direction, rms error, degrees", f"{np.sqrt(np.mean(np.square(angles))):.2f}", "", True)
