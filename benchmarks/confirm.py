"""How well a control scan is read: ``python -m benchmarks.confirm [--scans N] [--json FILE]``.

Virtual scans of 120 mm about a needle in a piece of a trunk: noise, blur, streaks near metal, slices of 1 to 5 mm,
tilted grids, bent needles, a patient who has moved, and things that are no needle. Tip and axis are those of the scan's
frame; `tests/twin/ct/test_control_scans.py` ties it to a case's.
"""

import argparse
import json
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.stats import chi2

from puncture_twin.planning.anatomy.metal import spacing_mm
from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.base.errors import Finding, InputError
from puncture_twin.planning.formats.points import NamedPoints
from puncture_twin.planning.formats.volumes.volume_files import Volume
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid
from puncture_twin.planning.geometry.containment import inside_each
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, inverse, pose
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.twin.guidance.ct.needle import read_needle
from puncture_twin.twin.guidance.ct.needle_fit import FoundNeedle
from puncture_twin.twin.plant.scanner.image import ScanSettings, Solid, ball, rod, scan_solids

METAL_HU = 8000.0
DIAMETER_MM = 1.2
EXTRAS = ("none", "none", "none", "wire", "vessel", "second", "far second", "no needle", "cut", "bolt")
"""What lies in the image besides; drawn evenly."""
SLICES_MM = (1.0, 1.5, 2.0, 2.5, 3.0, 5.0)
MUST_REFUSE = frozenset({"second", "no needle", "cut", "bolt"})
"""What leaves no single needle whose tip is seen."""


@dataclass(frozen=True, eq=False)
class Control:
    """A control scan whose truth is known; LPS mm of the case, but for the volume. ``T_scan_ct`` is where they lie."""

    volume: Volume
    tip: Floats
    forward: Floats
    sagitta_mm: float
    T_scan_ct: Floats
    skin: TriangleMesh
    bones: tuple[TriangleMesh, ...]
    markers: NamedPoints
    extra: str

    @property
    def plan(self) -> tuple[Floats, Floats]:
        """A planned tip and direction near to the needle's."""
        return self.tip + np.array([2.0, -1.5, 1.0]), self.forward


@cache
def trunk() -> tuple[TriangleMesh, tuple[TriangleMesh, ...]]:
    """Skin and bones of a piece of a trunk: an ellipsoid that is not round, a spine, and two ribs that are bent."""
    skin = trimesh.creation.icosphere(5, 1.0)
    points = np.asarray(skin.vertices) * [82.0, 58.0, 95.0] + [0.0, 25.0, 0.0]
    points[:, 1] += 0.0016 * points[:, 0] ** 2 + 4.0 * np.sin(points[:, 2] / 19.0) + 2.5 * np.sin(points[:, 0] / 13.0)
    bones = [_tube(np.array([[0.0, 45.0, z] for z in (-80.0, 80.0)]), 26.0)]
    for z, side in ((-18.0, 1.0), (24.0, -1.0)):
        turn = np.linspace(-0.2, 1.3, 14)
        arc = np.column_stack([side * (8.0 + 40.0 * np.sin(turn)), 30.0 - 44.0 * np.cos(turn), z + 14.0 * turn])
        bones.append(_tube(arc, 9.0))
    return TriangleMesh(points, np.asarray(skin.faces)), tuple(bones)


def _tube(points: Floats, diameter: float) -> TriangleMesh:
    parts = [rod(a, b, diameter) for a, b in pairwise(points)]
    joints = [ball(p, diameter) for p in points[1:-1]]
    if not joints:
        return parts[0]
    meshes = (*parts, *joints)
    first = np.cumsum([0, *(len(one.vertices) for one in meshes[:-1])])
    faces = [one.faces + begin for one, begin in zip(meshes, first, strict=True)]
    return TriangleMesh(np.concatenate([one.vertices for one in meshes]), np.concatenate(faces))


def control(rng: np.random.Generator, *, extra: str | None = None, bent: bool | None = None,
            spacing: float | None = None, moved: bool = True) -> Control:  # fmt: skip
    """Draw a scan; `rng` draws what is not stated. One who has moved lies elsewhere than in the case's CT."""
    extra = str(rng.choice(EXTRAS)) if extra is None else extra
    bent = bool(rng.random() < 0.3) if bent is None else bent
    spacing = float(rng.choice(SLICES_MM)) if spacing is None else spacing
    skin, bones = trunk()
    theta, beta = rng.uniform(0, np.radians(55)), rng.uniform(0, 2 * np.pi)
    forward = np.array([np.sin(theta) * np.cos(beta), np.cos(theta), np.sin(theta) * np.sin(beta)])
    tip = np.array([rng.uniform(-15, 15), rng.uniform(-2, 8), rng.uniform(-15, 15)])
    aside = np.cross(forward, exp_rotation(rng.normal(0, 1, 3)) @ [1.0, 0.0, 0.0])
    aside /= np.linalg.norm(aside)
    sagitta = float(rng.uniform(0.8, 4.0)) if bent else 0.0
    length = 95.0
    places = np.array([(x, 0.0, z) for x, z in ((-38.0, -30.0), (34.0, -24.0), (2.0, 38.0))])
    places[:, 1] = [_front(skin, x, z) for x, _, z in places]
    solids = [Solid("skin", skin, 20.0)]
    solids += [Solid("bone", one, hu) for one, hu in zip(bones, (350.0, 550.0, 550.0), strict=True)]
    solids += [Solid("marker", ball(p - [0.0, 2.0, 0.0], 5.0), METAL_HU) for p in places]
    if extra != "no needle":
        solids += [Solid("needle", one, METAL_HU) for one in needle_rods(tip, forward, aside, sagitta, length)]
    solids += list(_extras(extra, tip, forward, aside, skin))
    shift = rng.uniform(-8, 8, 3) if moved else np.zeros(3)
    turn = exp_rotation(np.radians(rng.uniform(-4, 4, 3))) if moved else np.eye(3)
    T = pose(turn, shift)
    middle = apply(T, np.array([0.0, -18.0, 0.0]) if extra != "cut" else tip - 80.0 * forward)
    pixel, blur = float(rng.uniform(0.5, 0.9)), float(rng.uniform(0.8, 1.5))
    settings = ScanSettings(spacing, pixel, float(rng.uniform(10, 40)), blur_mm=blur)
    solids = [one._replace(mesh=one.mesh.transformed(T)) for one in solids]
    volume = _scanned(solids, settings, middle, exp_rotation([np.radians(rng.uniform(-15, 15)), 0.0, 0.0]), rng)
    at = apply(np.linalg.inv(volume.T_ct_index), apply(T, tip))
    if extra == "cut" and ((at > -0.5) & (at < np.array(volume.values.shape) - 0.5)).all():
        extra = "none"  # across a corner the tip is in the image
    names = NamedPoints(("A", "B", "C"), places - [0.0, 2.0, 0.0], Space.LPS)
    return Control(volume, tip, forward, sagitta, T, skin, bones, names, extra)


def _front(skin: TriangleMesh, x: float, z: float) -> float:
    near = np.hypot(skin.vertices[:, 0] - x, skin.vertices[:, 2] - z) < 5.0
    return float(skin.vertices[near, 1].min())


def needle_rods(tip: Floats, forward: Floats, aside: Floats, sagitta: float, length: float) -> list[TriangleMesh]:
    """A needle along a parabola that ends in a direction, of short rods; one rod where it is straight."""
    s = np.linspace(0.0, length, 2 if sagitta == 0 else 80)
    points = tip - np.outer(s, forward) + np.outer(4 * sagitta * (s / length) ** 2, aside)
    return [rod(b, a, DIAMETER_MM) for a, b in pairwise(points)]


def _extras(extra: str, tip: Floats, forward: Floats, aside: Floats, skin: TriangleMesh) -> list[Solid]:
    if extra == "wire":
        y = _front(skin, 20.0, 10.0) - 1.5
        return [Solid("wire", rod(np.array([18.0, y, -40.0]), np.array([26.0, y - 6.0, 50.0]), 1.0), METAL_HU)]
    if extra == "vessel":
        return [Solid("vessel", rod(np.array([-30.0, 20.0, -60.0]), np.array([-22.0, 12.0, 60.0]), 4.0), 420.0)]
    if extra in {"second", "far second"}:
        other = np.cross(forward, aside)
        if extra == "second":
            place, way = tip + 9.0 * aside, forward
        else:
            place, way = tip + 30.0 * other, forward + 0.6 * other
            way = way / np.linalg.norm(way)
        return [Solid("needle 2", rod(place - 95.0 * way, place, DIAMETER_MM), METAL_HU)]
    if extra == "bolt":
        return [Solid("bolt", rod(tip - 1.0 * forward, tip + 25.0 * forward, 8.0), METAL_HU)]
    return []


def _scanned(
    solids: list[Solid], settings: ScanSettings, middle: Floats, axes: Floats, rng: np.random.Generator
) -> Volume:
    """A scan of 120 mm about a place, whose grid falls anywhere, with streaks in the slices that show metal."""
    cell = np.array([settings.pixel_mm, settings.pixel_mm, settings.spacing_mm])
    shape = tuple(int(n) for n in 120.0 / cell)
    T = pose(axes @ np.diag(cell), middle)
    T[:3, 3] -= T[:3, :3] @ (np.array(shape) / 2 + rng.uniform(0, 1, 3))
    hu = scan_solids(solids, VolumeGrid(shape, T, {}), settings, rng).hu.astype(np.float32)  # type: ignore[arg-type]
    size, waves = rng.uniform(0, 120), np.arange(2, 14)
    i, j = np.meshgrid(*(np.arange(n) for n in shape[:2]), indexing="ij")
    for k in range(shape[2]):
        metal = hu[:, :, k] > 1500
        if metal.sum() >= 2:
            x, y = (i - i[metal].mean()) * cell[0], (j - j[metal].mean()) * cell[1]
            phase, parts = rng.uniform(0, 2 * np.pi, len(waves)), rng.normal(0, 1, len(waves)) / np.sqrt(len(waves))
            turn, fades = np.arctan2(y, x), np.exp(-np.hypot(x, y) / 25.0)
            around = np.polyval([*(parts * np.exp(1j * phase))[::-1], 0, 0], np.exp(1j * turn))  # sum a cos(w turn + p)
            hu[:, :, k] += size * fades * around.real
    return Volume(np.clip(np.rint(hu), -1024, 3071).astype(np.int16), T, Path("scan"))


def read(one: Control) -> FoundNeedle | str:
    """What is read in the scan, or the code of the refusal."""
    try:
        return reading(one)[0]
    except InputError as error:
        return error.code


def reading(one: Control, *, planned: bool = True) -> tuple[FoundNeedle, tuple[Finding, ...]]:
    """What is read in the scan, with a plan or without, and what is said of it."""
    tip, forward = one.plan
    plan = apply(one.T_scan_ct, tip), one.T_scan_ct[:3, :3] @ forward
    markers = apply(one.T_scan_ct, one.markers.points)
    inside = partial(_inside, one.skin, inverse(one.T_scan_ct))
    return read_needle(one.volume, plan[0], DIAMETER_MM, inside, plan if planned else None, markers)


def _inside(skin: TriangleMesh, T_ct_scan: Floats, points: Floats) -> Bools:
    return inside_each(skin, apply(T_ct_scan, points))


def errors(one: Control, found: FoundNeedle) -> dict[str, float]:
    """Errors of a reading: mm, degrees, and squares over the stated covariance."""
    tip, forward = apply(one.T_scan_ct, one.tip), one.T_scan_ct[:3, :3] @ one.forward
    off = found.tip_ct - tip
    turned, across = np.cross(forward, found.forward_ct), one.volume.T_ct_index[:3, :3] / spacing_mm(one.volume)
    return {
        "tip_mm": float(np.linalg.norm(off)),
        "plane_mm": float(np.linalg.norm(off @ across[:, :2]) / np.sqrt(2.0)),
        "across_mm": float(abs(off @ across[:, 2])),
        "depth_mm": float(off @ forward),
        "depth_sd_mm": float(np.sqrt(forward @ found.cov_ct[:3, :3] @ forward)),
        "tip_voxels": float(np.linalg.norm(np.linalg.solve(one.volume.T_ct_index[:3, :3], off))),
        "axis_deg": float(np.degrees(np.arcsin(min(1.0, float(np.linalg.norm(turned)))))),
        "tip_square": float(off @ np.linalg.solve(found.cov_ct[:3, :3], off)),
        "axis_sd_deg": float(np.degrees(found.axis_sd)),
        "axis_square": float(turned @ np.linalg.pinv(found.cov_ct[3:, 3:], rcond=1e-9) @ turned),
        "sagitta_mm": found.sagitta_mm,
    }


def main() -> None:
    """Parse, draw, read, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0, help="seed of the first")
    parser.add_argument("--json", type=Path, help="a line a scan is written to this file")
    parser.add_argument("--rows", type=Path, nargs="*", default=(), help="files of --json that are summed up instead")
    stated = parser.parse_args()
    rows: list[dict[str, Any]] = [json.loads(line) for file in stated.rows for line in file.read_text().splitlines()]
    if rows:
        print("\n".join(summary(rows)))
        return
    with nullcontext() if stated.json is None else stated.json.open("w", encoding="utf-8") as file:
        for seed in range(stated.first, stated.first + stated.scans):
            one = control(np.random.default_rng(seed))
            found = read(one)
            row = {"seed": seed, "extra": one.extra, "true_sagitta_mm": one.sagitta_mm}
            row["spacing_mm"] = float(spacing_mm(one.volume)[2])
            rows.append({**row, **({"refused": found} if isinstance(found, str) else errors(one, found))})
            if file is not None:
                print(json.dumps(rows[-1]), file=file, flush=True)
    print("\n".join(summary(rows)))


def summary(rows: list[dict[str, Any]]) -> list[str]:
    """Lines on what was read and refused, and a table of the how-to's kind."""
    seen = [row for row in rows if "tip_mm" in row]
    good = [row for row in rows if row["extra"] not in MUST_REFUSE]
    wrong = [row["seed"] for row in seen if is_wrong(row)]
    refused = [(row["seed"], row["extra"], row["refused"]) for row in good if "refused" in row]
    right = [row for row in seen if not is_wrong(row)]
    return [
        f"{len(rows)} scans, {len(seen)} read; read wrong: {wrong}; refused of {len(good)}: {refused}",
        "",
        f"| {len(rows)} scans | read | tip, voxels (rms) | along an axis of the plane, across it, mm | axis, ° "
        "| tip in its 95 % region | axis in its region | called bent |",
        "|---|---|---|---|---|---|---|---|",
        *(_line(name, [row for row in right if _is_of(row, *kind)]) for name, *kind in _kinds()),
    ]


def _is_of(row: dict[str, Any], bent: bool, low: float, high: float) -> bool:
    return bent == (row["true_sagitta_mm"] > 0) and low - 0.1 < row["spacing_mm"] < high + 0.1


def is_wrong(row: dict[str, Any]) -> bool:
    """Whether something else than the needle was read."""
    return bool(row["extra"] in {"no needle", "cut", "bolt"} or row["tip_mm"] > WRONG_MM)


WRONG_MM = 5.0


def _kinds() -> Iterator[tuple[str, bool, float, float]]:
    """What the table tells apart: a name, whether bent, and slices from and up to mm."""
    for name, bent in (("straight", False), ("bent, sagitta .8 to 4 mm", True)):
        yield name, bent, 0.0, np.inf
        yield f"{name}, slices up to 2 mm", bent, 0.0, 2.0
        for mm in SLICES_MM[2:]:
            yield f"{name}, slices of {mm:g} mm", bent, mm, mm


def _line(name: str, rows: list[dict[str, Any]]) -> str:
    def rms(key: str) -> str:
        return f"{np.sqrt(np.mean([row[key] ** 2 for row in rows])):.3f}".removeprefix("0")

    def within(key: str, freedoms: int) -> str:
        return f"{np.mean([row[key] <= chi2.ppf(0.95, freedoms) for row in rows]):.1%}".replace("%", " %")

    if not rows:
        return f"| {name} | 0 | | | | | | |"
    bent = f"{np.mean([row['sagitta_mm'] > 0 for row in rows]):.0%}".replace("%", " %")
    plane = f"{rms('plane_mm')}, {rms('across_mm')}"
    each = (rms("tip_voxels"), plane, rms("axis_deg"), within("tip_square", 3), within("axis_square", 2), bent)
    return f"| {name} | {len(rows)} | {' | '.join(each)} |"


if __name__ == "__main__":
    main()
