"""How well markers are found on the skin: ``python -m benchmarks.markers [--scans N] [--json FILE]``.

Virtual scans of a body with ribs, whose truth is known: balls, discs and rings of 1 to 15 mm, of metal and of contrast,
anywhere round the body, also on the table's side, in slices of 1 to 5 mm, tilted grids, noise; and things that are no
markers. Of each scan it counts what is found, what is only listed as doubtful, what is lost without a word, and what a
list holds that is no marker; and whether the errors are as large as their covariance says.
"""

import json
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.stats import chi2

from benchmarks.shared import options
from puncture_twin.planning.anatomy.body.body_mask import ct_image
from puncture_twin.planning.anatomy.metal import spacing_mm
from puncture_twin.planning.anatomy.skin import Skin, skin_of_image
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.formats.volumes.volume_files import Volume
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import exp_rotation, frame_about
from puncture_twin.planning.registration.fiducials import Fiducial, Stated, choose_fiducials, look_for_fiducials
from puncture_twin.twin.plant.scanner.image import ScanSettings, Solid, ball, box, rod, scan_solids

METAL_HU = 8000.0
RADII = np.array([52.0, 42.0, 70.0])
"""Half axes of the body, an ellipsoid, mm."""
HALF_MM = np.array([75.0, 72.0, 86.0])
"""Of the image."""
MATCHED_MM = 4.0
"""A thing so near to a marker's centre is that marker; or half of its size, if that is more."""


@dataclass(frozen=True)
class Markers:
    """What is on the skin: ``off_mm`` from a marker's back to the skin."""

    kind: str = "ball"
    diameter: float = 8.0
    hu: float = METAL_HU
    thick: float = 2.0
    count: int = 6
    off_mm: float = 0.3

    @property
    def group(self) -> str:
        """Of the table."""
        size = "under 4 mm" if self.diameter < 4 else "4 to 15 mm"
        return f"{self.kind}, {'metal' if self.hu > 1500 else 'contrast'}, {size}"


def on_skin(theta: float, z: float) -> tuple[Floats, Floats]:
    """A point of the body's skin (3,), mm, and its outward normal; theta from the left toward the back, rad."""
    wide = np.sqrt(1 - (z / RADII[2]) ** 2)
    point = np.array([wide * np.cos(theta), wide * np.sin(theta), z / RADII[2]]) * RADII
    normal = point / RADII**2
    return point, normal / np.linalg.norm(normal)


def body() -> Solid:
    """The patient."""
    mesh = trimesh.creation.icosphere(5, 1.0)
    return Solid("body", TriangleMesh(np.asarray(mesh.vertices) * RADII, np.asarray(mesh.faces)), 30.0)


def ring(point: Floats, normal: Floats, diameter: float, thick: float) -> TriangleMesh:
    """A washer with a hole of 0.4 of its diameter, about a point (3,), mm."""
    mesh = trimesh.creation.annulus(0.2 * diameter, diameter / 2, thick, sections=48)
    return TriangleMesh(np.asarray(mesh.vertices) @ frame_about(normal).T + point, np.asarray(mesh.faces))


def plate(point: Floats, normal: Floats, diameter: float, thick: float) -> TriangleMesh:
    """A round plate about a point (3,), mm."""
    return rod(point - thick / 2 * normal, point + thick / 2 * normal, diameter)


def marker_mesh(kind: str, point: Floats, normal: Floats, diameter: float, thick: float) -> TriangleMesh:
    """One marker's surface."""
    if kind == "ball":
        return ball(point, diameter)
    return (plate if kind == "disc" else ring)(point, normal, diameter, thick)


def line(points: list[Floats], diameter: float) -> Iterator[TriangleMesh]:
    """A wire through points, mm."""
    return (rod(a, b, diameter) for a, b in pairwise(points))


def ribs() -> Iterator[Solid]:
    """Five, 9 mm under the skin of the back."""
    for z in np.linspace(-44.0, 44.0, 5):
        bend = [on_skin(theta, z) for theta in np.linspace(0.1, np.pi - 0.1, 9)]
        yield from (Solid("rib", one, 600.0) for one in line([p - 9.0 * n for p, n in bend], 7.0))


def table() -> list[Solid]:
    """A shell about foam under the body, with bolts."""
    at, size = np.array([0.0, RADII[1] + 16.0, 0.0]), np.array([120.0, 20.0, 150.0])
    bolts = [Solid("bolt", ball(at + [x, 4.0, z], 8.0), METAL_HU) for x in (-40.0, 40.0) for z in (-40.0, 0.0, 40.0)]
    return [Solid("table", box(at, size), 60.0), Solid("foam", box(at, size - 4.0), -930.0), *bolts]


def wire(rng: np.random.Generator) -> Iterator[Solid]:
    """Across the skin."""
    way = [on_skin(theta, 1.0) for theta in np.linspace(-3.0, -1.9, 9)]
    yield from (Solid("wire", one, METAL_HU) for one in line([p + n for p, n in way], 1.2))


def needle(rng: np.random.Generator) -> Iterator[Solid]:
    """With a hub outside."""
    start, normal = on_skin(-1.2, -1.0)
    yield Solid("needle", rod(start + 40.0 * normal, start - 30.0 * normal, 1.2), METAL_HU)
    yield Solid("hub", rod(start + 25.0 * normal, start + 32.0 * normal, 6.0), 150.0)


def clips(rng: np.random.Generator) -> Iterator[Solid]:
    """Of surgery, anywhere inside, and a screw."""
    for _ in range(6):
        at, along = rng.uniform(-20, 20, 3), rng.normal(size=3)
        yield Solid("clip", rod(at, at + 6.0 * along / np.linalg.norm(along), 1.5), METAL_HU)
    yield Solid("screw", rod(np.array([0.0, 10.0, -30.0]), np.array([0.0, 10.0, 30.0]), 6.0), METAL_HU)


def staples(rng: np.random.Generator) -> Iterator[Solid]:
    """A closed wound's: eight across a line of the skin, each 6 mm of wire with two legs."""
    for z in np.linspace(-25.0, 24.0, 8):
        point, normal = on_skin(-1.7, z)
        side = np.cross(normal, [0.0, 0.0, 1.0])
        ends = [point + x * side + y * normal for x, y in ((-3.0, -2.5), (-3.0, 0.5), (3.0, 0.5), (3.0, -2.5))]
        yield from (Solid("staple", one, METAL_HU) for one in line(ends, 0.6))


def electrodes(rng: np.random.Generator) -> Iterator[Solid]:
    """Three of an ECG: a pad of gel, a snap of metal on it, and a lead."""
    for theta, z in ((-2.3, 25.0), (-0.8, 26.0), (-0.6, -28.0)):
        point, normal = on_skin(theta + rng.uniform(-0.1, 0.1), z)
        side = np.cross(normal, [0.0, 0.0, 1.0])
        yield Solid("gel", plate(point + 0.7 * normal, normal, 25.0, 1.4), 60.0)
        yield Solid("snap", plate(point + 2.6 * normal, normal, 5.0, 2.4), METAL_HU)
        way = [point + 5.0 * normal, point + 5.0 * normal + 30.0 * side]
        yield from (Solid("lead", one, 3000.0) for one in line(way, 1.5))


def buttons(rng: np.random.Generator) -> Iterator[Solid]:
    """Two of metal on a shirt, and two of plastic."""
    for number, z in enumerate((-34.0, -12.0, 12.0, 34.0)):
        point, normal = on_skin(-1.4, z)
        size, hu = (9.0, METAL_HU) if number % 2 else (11.0, 180.0)
        yield Solid("button", plate(point + 2.0 * normal, normal, size, 2.5), hu)


def coin(rng: np.random.Generator) -> Iterator[Solid]:
    """In a pocket, 20 mm wide."""
    point, normal = on_skin(-0.5, -30.0)
    yield Solid("coin", plate(point + 4.0 * normal, normal, 20.0, 1.8), METAL_HU)


def calcified(rng: np.random.Generator) -> Iterator[Solid]:
    """Grains in and under the skin."""
    for _ in range(10):
        point, normal = on_skin(rng.uniform(-3.0, -0.1), rng.uniform(-45.0, 45.0))
        size = rng.uniform(1.0, 4.0)
        at = point - (size / 2 + rng.uniform(0.3, 4.0)) * normal
        yield Solid("grain", ball(at, size), rng.uniform(300.0, 900.0))
        yield Solid("grain", ball(at + rng.normal(0, 0.4 * size, 3), 0.7 * size), rng.uniform(300.0, 900.0))


def port(rng: np.random.Generator) -> Iterator[Solid]:
    """Of titanium, 5 mm under the skin, with its catheter."""
    point, normal = on_skin(-2.0, -20.0)
    at = point - 9.0 * normal
    yield Solid("port", plate(at, normal, 18.0, 8.0), METAL_HU)
    yield Solid("septum", plate(at + 2.0 * normal, normal, 9.0, 5.0), 200.0)
    yield Solid("catheter", rod(at, at + [0.0, 0.0, 45.0], 2.5), 400.0)


def crowns(rng: np.random.Generator) -> Iterator[Solid]:
    """Of teeth, in a row 12 mm under the skin, the outermost at 7."""
    for theta, deep in zip(np.linspace(-2.0, -1.0, 5), (7.0, 10.0, 12.0, 10.0, 7.0), strict=True):
        point, normal = on_skin(theta, -38.0)
        yield Solid("crown", ball(point - (deep + 3.5) * normal, 7.0), METAL_HU)


def piercing(rng: np.random.Generator) -> Iterator[Solid]:
    """Two balls of 5 mm with a bar through the skin."""
    point, normal = on_skin(-1.6, 5.0)
    ends = [point + [0.0, 0.0, -6.0] + 2.0 * normal, point + [0.0, 0.0, 6.0] + 2.0 * normal]
    yield from (Solid("stud", ball(one, 5.0), METAL_HU) for one in ends)
    yield from (Solid("bar", one, METAL_HU) for one in line([ends[0], point - 3.0 * normal, ends[1]], 1.6))


EXTRAS: dict[str, Callable[[np.random.Generator], Iterator[Solid]]] = {
    "wire": wire, "needle": needle, "clips": clips, "staples": staples, "electrodes": electrodes, "buttons": buttons,
    "coin": coin, "calcified": calcified, "port": port, "crowns": crowns, "piercing": piercing,
}  # fmt: skip
"""What is no marker."""
TROUBLES = ("none", "none", "none", "touching", "leads", "cut")
"""Of markers: two touch each other; a lead ends at one; the image ends at one."""


@dataclass(frozen=True, eq=False)
class Scene:
    """A scan whose truth is known, and of which markers something is the matter."""

    markers: Markers
    true: Floats
    others: tuple[tuple[str, Floats], ...]
    troubled: frozenset[int]
    trouble: str
    extras: tuple[str, ...]
    volume: Volume

    @property
    def reach_mm(self) -> float:
        """So near to a marker's centre a thing is that marker."""
        return max(MATCHED_MM, self.markers.diameter / 2)


def drawn_markers(rng: np.random.Generator) -> Markers:
    """Of any kind, size and density."""
    kind = str(rng.choice(["ball", "disc", "ring"]))
    diameter = float(np.exp(rng.uniform(0.0 if kind == "ball" else np.log(4.0), np.log(15.0))))
    metal = bool(rng.random() < 0.5)
    hu = METAL_HU if metal else float(rng.uniform(300.0, 1400.0))
    thick = float(rng.uniform(1.0, min(4.0, diameter / 2))) if kind != "ball" else 2.0
    return Markers(kind, diameter, hu, thick, int(rng.integers(4, 8)), float(rng.uniform(-0.5, 1.5)))


def scene(
    rng: np.random.Generator, markers: Markers | None = None, spacing: float | None = None,
    extras: tuple[str, ...] | None = None, trouble: str | None = None,
) -> Scene:  # fmt: skip
    """Draw a scan; what is not stated is drawn too."""
    markers = drawn_markers(rng) if markers is None else markers
    spacing = float(rng.choice([1.0, 1.5, 2.0, 2.5, 3.0, 5.0])) if spacing is None else spacing
    extras = tuple(rng.choice([*EXTRAS], size=3, replace=False).tolist()) if extras is None else extras
    trouble = str(rng.choice(TROUBLES)) if trouble is None else trouble
    taken = [solid for name in extras for solid in EXTRAS[name](rng)]
    middles = [np.asarray(one.mesh.vertices).mean(axis=0) for one in taken]
    spots = _spots(markers, rng, taken)
    half = (markers.diameter if markers.kind == "ball" else markers.thick) / 2
    true = np.array([point + (half + markers.off_mm) * normal for point, normal in spots])
    normals = [normal for _, normal in spots]
    solids, troubled = list[Solid](), set[int]()
    if trouble == "touching":
        away = np.cross(normals[0], [0.0, 0.0, 1.0])
        true[1], normals[1], troubled = true[0] + markers.diameter * away / np.linalg.norm(away), normals[0], {0, 1}
    if trouble == "leads":
        ends = true[0] + half * normals[0] + np.array([[0, 0, 0], 6.0 * normals[0], 6.0 * normals[0] + [0, 0, 30.0]])
        solids += [Solid("lead", one, 3000.0) for one in line(list(ends), 1.5)]
        middles, taken = [*middles, ends.mean(axis=0)], [*taken, solids[-1]]
        troubled = {0}
    for point, normal in zip(true, normals, strict=True):
        mesh = marker_mesh(markers.kind, point, normal, markers.diameter, markers.thick)
        solids.append(Solid("marker", mesh, markers.hu))
    pixel, noise, blur = (float(rng.uniform(*ends)) for ends in ((0.6, 1.1), (8.0, 40.0), (0.8, 1.5)))
    settings = ScanSettings(spacing, pixel, noise, blur_mm=blur)
    tilt = np.radians(rng.uniform(-15, 15)) if rng.random() < 0.4 else 0.0
    volume = scanned([*table(), body(), *ribs(), *taken, *solids], settings, rng, exp_rotation([tilt, 0.0, 0.0]))
    if trouble == "cut":
        k = (np.linalg.inv(volume.T_ct_index) @ np.column_stack([true, np.ones(len(true))]).T)[2]
        last = int(np.argmax(k))
        troubled = {last}
        volume = Volume(volume.values[:, :, : max(int(k[last]) + 1, 8)], volume.T_ct_index, volume.path)
    others = tuple((one.name, middle) for one, middle in zip(taken, middles, strict=True))
    return Scene(markers, true, others, frozenset(troubled), trouble, extras, volume)


def _spots(markers: Markers, rng: np.random.Generator, taken: list[Solid]) -> list[tuple[Floats, Floats]]:
    """Points and normals of the skin, apart from each other and from what is taken."""
    cloud = np.concatenate([np.zeros((1, 3)), *(np.asarray(one.mesh.vertices) for one in taken)])
    spots: list[tuple[Floats, Floats]] = []
    while len(spots) < markers.count:
        point, normal = on_skin(rng.uniform(-np.pi, np.pi), rng.uniform(-46.0, 46.0))
        if normal[1] > 0.85:  # the patient lies on it
            continue
        at = point + markers.diameter / 2 * normal
        if all(np.linalg.norm(point - one) > markers.diameter + 14.0 for one, _ in spots) and (
            np.linalg.norm(cloud - at, axis=1).min() > markers.diameter / 2 + 9.0
        ):
            spots.append((point, normal))
        cloud = cloud[1:] if rng.random() < 0.002 and len(cloud) > 1 else cloud  # a crowded skin must end
    return spots


def scanned(
    solids: list[Solid], settings: ScanSettings, rng: np.random.Generator, axes: Floats | None = None
) -> Volume:
    """The CT of a scene, its grid anywhere within a voxel."""
    spacing = np.array([settings.pixel_mm, settings.pixel_mm, settings.spacing_mm])
    R, shape = np.eye(3) if axes is None else axes, tuple(int(n) for n in 2 * HALF_MM / spacing)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R @ np.diag(spacing), R @ (rng.uniform(0, 1, 3) * spacing - HALF_MM)
    return Volume(scan_solids(solids, VolumeGrid(shape, T, {}), settings, rng).hu, T, Path("scan"))  # type: ignore[arg-type]


def body_of(volume: Volume) -> tuple[Volume, Skin]:
    """The CT as the finder takes it, and its skin."""
    image = ct_image(volume)
    return Volume(image.hu, image.T_ct_index, volume.path), skin_of_image(image)


def counted(one: Scene) -> dict[str, Any]:
    """What became of each marker and of each thing that is none."""
    volume, skin = body_of(one.volume)
    seen = look_for_fiducials(volume, skin)
    lists, doubtful = dict[str, Any](), seen.doubtful
    for name, stated in (("alone", Stated()), ("counted", Stated(count=len(one.true)))):
        try:
            listed = choose_fiducials(seen, stated, where="scan")
        except NoAnswerError as error:
            lists[name] = {"refused": error.code}
            continue
        doubtful = listed.doubtful if name == "alone" else doubtful
        lists[name] = {"listed": len(listed.fiducials), "false": _false(one, listed.fiducials)}
    rows = [_marker(one, number, seen.fiducials, [p.point_ct for p in doubtful]) for number in range(len(one.true))]
    return {
        "group": one.markers.group, "diameter": one.markers.diameter, "thick": one.markers.thick, "hu": one.markers.hu,
        "spacing": float(spacing_mm(volume).max()), "trouble": one.trouble, "extras": one.extras, "markers": rows,
        "false": _false(one, seen.fiducials), "doubtful": len(doubtful), **lists,
    }  # fmt: skip


def _marker(one: Scene, number: int, found: tuple[Fiducial, ...], doubtful: list[Floats]) -> dict[str, Any]:
    point = one.true[number]
    mine = [f for f in found if np.linalg.norm(f.position_ct - point) <= one.reach_mm]
    row: dict[str, Any] = {"troubled": number in one.troubled, "found": len(mine)}
    if not mine:
        near = [np.linalg.norm(p - point) <= one.reach_mm + one.markers.diameter / 2 for p in doubtful]
        return {**row, "doubtful": bool(any(near))}
    off = mine[0].position_ct - point
    axes = one.volume.T_ct_index[:3, :3] / spacing_mm(one.volume)
    return {
        **row,
        "off_mm": (axes.T @ off).tolist(),
        "square": float(off @ np.linalg.solve(mine[0].reading.cov_ct, off)),
        "misfit": mine[0].reading.misfit,
        "kind": mine[0].reading.shape.kind,
        "size": mine[0].reading.shape.diameter_mm,
    }


def _false(one: Scene, found: tuple[Fiducial, ...]) -> list[str]:
    """What is listed as a marker and is none: the name of the nearest such thing."""
    names = []
    for each in found:
        if np.linalg.norm(one.true - each.position_ct, axis=1).min() > one.reach_mm:
            away = [(float(np.linalg.norm(each.position_ct - at)), name) for name, at in one.others]
            names.append(min(away)[1] if away else "nothing")
    return names


def main() -> None:
    """Parse, draw, look, print."""
    stated = options(__doc__, scans=1000, first=0, json=Path)
    rows = []
    with nullcontext() if stated.json is None else stated.json.open("w", encoding="utf-8") as file:
        for seed in range(stated.first, stated.first + stated.scans):
            rows.append({"seed": seed, **counted(scene(np.random.default_rng(seed)))})
            if file is not None:
                print(json.dumps(rows[-1]), file=file, flush=True)
    print("\n".join(summary(rows)))


def summary(rows: list[dict[str, Any]]) -> list[str]:
    """The table, and what lists hold that is no marker."""
    lines = [
        "| markers | slices, mm | found | doubtful | lost | rms in plane, along bed, mm | in the 95 % region |",
        "|---|---|---|---|---|---|---|",
    ]
    for group in sorted({row["group"] for row in rows}):
        for name, least, most in (("1 to 2", 0.0, 2.0), ("2.5 to 5", 2.1, 9.0)):
            some = [m for row in rows if row["group"] == group and least <= row["spacing"] <= most
                    for m in row["markers"] if not m["troubled"]]  # fmt: skip
            if some:
                lines.append(f"| {group} | {name} | {_cells(some)} |")
    troubled = Counter((row["trouble"], "found" if m["found"] else "doubtful" if m["doubtful"] else "lost")
                       for row in rows for m in row["markers"] if m["troubled"])  # fmt: skip
    lines.append(f"with trouble: {', '.join(f'{a} {b} {n}' for (a, b), n in sorted(troubled.items()))}")
    for name in ("alone", "counted"):
        listed = [row for row in rows if "listed" in row[name]]
        wrong = Counter(what for row in listed for what in row[name]["false"])
        short = sum(row[name]["listed"] < len(row["markers"]) for row in listed)
        lines.append(f"{name}: {len(listed)} of {len(rows)} listed; {short} lack one; false: {dict(wrong)} in "
                     f"{[row['seed'] for row in listed if row[name]['false']]}")  # fmt: skip
    looks = Counter(what for row in rows for what in row["false"])
    return [*lines, f"look like one, before kinds are told apart: {dict(looks)}"]


def _cells(some: list[dict[str, Any]]) -> str:
    found = [m for m in some if m["found"]]
    doubtful = sum(not m["found"] and m["doubtful"] for m in some)
    parts = [len(found), doubtful, len(some) - len(found) - doubtful]
    counts = " | ".join(f"{part / len(some):.1%}" for part in parts).replace("100.0%", "100%")
    if not found:
        return f"{counts} | |"
    off = np.array([m["off_mm"] for m in found])
    rms = np.sqrt(np.mean(off**2, axis=0))
    within = np.mean([m["square"] <= chi2.ppf(0.95, 3) for m in found])
    return f"{counts} | {np.sqrt((rms[0] ** 2 + rms[1] ** 2) / 2):.3f}, {rms[2]:.3f} | {within:.1%} of {len(found)}"


if __name__ == "__main__":
    main()
