"""How sure is the edge test? z of true and of wrong placements, on real scans and on phantoms: the limits' table.

    python -m benchmarks.placements [--real FOLDER] [--draws 20] [--seed 0] [--json FILE]

FOLDER holds totalseg_abdomen_3mm and slicer_chest_ct4; without it the phantoms alone are tried. A draw takes some
of the structures, and an image as it is, noisy, cropped, with every third slice, or blurred. Wrong placements are
shifts of max(6 mm, 1.5 voxels) and more, scales of 5 and 10 %, mirror images, half turns, and reversed arrays.
"""

import json
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy

from benchmarks.shared import options
from puncture_twin.planning.evidence.edges import edge_image
from puncture_twin.planning.evidence.label_placement import Source, assess
from puncture_twin.planning.formats.labels.labelmaps import mask_surface
from puncture_twin.planning.formats.volumes.volume_files import canonical, read_volume

COUNTS = (1, 3, 6, 15, 60)
OWN = ("odd", "agreeing", "unconfirmed", "unseen")
CHANGES = ("as it is", "noise 40 HU", "cropped", "every third slice", "blurred")


class Patient(NamedTuple):
    """A CT with its labels on one grid, LPS."""

    hu: np.ndarray
    labels: np.ndarray
    T: np.ndarray


def real(folder: Path) -> Iterator[tuple[str, Patient]]:
    """The shared scans that are there."""
    for name, ct, labels in (
        ("abdomen", "totalseg_abdomen_3mm/ct.nii.gz", "totalseg_abdomen_3mm/labels_v1_normal.nii.gz"),
        ("chest", "slicer_chest_ct4/CTChest4.nrrd", "slicer_chest_ct4/Segmentation.seg.nrrd"),
    ):
        if (folder / ct).is_file():
            image, map_ = read_volume(folder / ct), read_volume(folder / labels)
            oriented = canonical(image.values, image.T_ct_index)
            own = canonical(map_.values, map_.T_ct_index)
            yield name, Patient(oriented.values.astype(np.float32), own.values.astype(np.int16), oriented.T_ct_index)


def phantoms() -> Iterator[tuple[str, Patient]]:
    """A trunk with eight organs, a cylinder with five rods, a head with a skull and six nodes; noise of 10 HU."""
    yield "trunk", _phantom(3.0, (100, 80, 56), _trunk)
    yield "cylinder", _phantom(2.0, (100, 100, 90), _cylinder)
    yield "head", _phantom(2.0, (100, 110, 90), _head)


def _phantom(step, shape, draw):
    axes = [(np.arange(n) - (n - 1) / 2) * step for n in shape]
    x, y, z = np.meshgrid(*axes, indexing="ij")
    hu, labels = draw(x, y, z)
    T = np.diag([step, step, step, 1.0])
    T[:3, 3] = [axis[0] for axis in axes]
    return Patient((hu + np.random.default_rng(5).normal(0, 10, shape)).astype(np.float32), labels, T)


def _painted(body, organs, hu):
    labels = np.zeros(body.shape, np.int16)
    image = np.where(body, hu, -1000.0)
    for number, (inside, value) in enumerate(organs, start=1):
        labels[inside & body] = number
        image[inside & body] = value
    return image, labels


def _ball(x, y, z, middle, radii):
    return sum(((one - c) / r) ** 2 for one, c, r in zip((x, y, z), middle, radii, strict=True)) <= 1


def _trunk(x, y, z):
    waist = 1 - 0.1 * (z / 84) ** 2 + 0.03 * np.sin(z / 17)
    body = (x / (125 * waist)) ** 2 + (y / (90 * waist)) ** 2 <= 1
    spots = [
        ((-55, -10, 8), (50, 52, 55), 110), ((68, 12, 14), (26, 30, 38), 120), ((-58, 48, -24), (22, 18, 38), 150),
        ((52, 48, -18), (21, 18, 36), 150), ((-18, -46, -50), (30, 18, 20), -20), ((-68, -12, 12), (10, 10, 10), 60),
    ]  # fmt: skip
    organs = [(_ball(x, y, z, middle, radii), hu) for middle, radii, hu in spots]
    organs += [(np.hypot(x - 10, y - 30) < 11, 180), (np.hypot(x / 24, (y - 58) / 20) < 1, 450)]
    return _painted(body, organs, 20.0)


def _cylinder(x, y, z):
    body = (np.hypot(x, y) < 80) & (abs(z) < 75)
    turns = np.radians([10, 75, 150, 220, 300])
    organs = [
        (np.hypot(x - (25 + 6 * k) * np.cos(a), y - (25 + 6 * k) * np.sin(a)) < 6 + k, 150 + 60 * k)
        for k, a in enumerate(turns)
    ]
    return _painted(body, [(one & (abs(z + 9 * k) < 50), hu) for k, (one, hu) in enumerate(organs)], 40.0)


def _head(x, y, z):
    body, shell, brain = (_ball(x, y, z, (0, 0, 0), np.array([76, 92, 82]) - depth) for depth in (0, 6, 13))
    spots = [((20, -40, 12), 9), ((-30, 10, 30), 11), ((5, 45, -20), 8), ((-15, -20, -30), 12), ((38, 20, -8), 7)]
    organs = [(shell & ~brain, 800.0), (_ball(x, y, z, (12, 5, 2), (14, 30, 12)), 8.0)]
    return _painted(body, organs + [(_ball(x, y, z, c, (r, r, r)), 70.0) for c, r in spots], 35.0)


def changed(patient: Patient, change: str, rng: np.random.Generator) -> Patient:
    """The same patient in another image; labels follow."""
    hu, labels, T = patient
    if change == "noise 40 HU":
        return Patient(hu + rng.normal(0, 40, hu.shape).astype(np.float32), labels, T)
    if change == "blurred":
        return Patient(scipy.ndimage.gaussian_filter(hu, 1.0), labels, T)
    if change == "cropped":
        low = [int(rng.integers(0, n // 5 + 1)) for n in hu.shape]
        part = tuple(slice(start, start + n * 3 // 4) for start, n in zip(low, hu.shape, strict=True))
        moved = T.copy()
        moved[:3, 3] += T[:3, :3] @ low
        return Patient(hu[part], labels[part], moved)
    if change == "every third slice" and T[2, 2] < 5:
        thick = T.copy()
        thick[:3, 2] *= 3
        thick[:3, 3] += T[:3, 2]
        return Patient(hu[:, :, 1::3], labels[:, :, 1::3], thick)
    return patient


def meshes_of(patient: Patient) -> dict[str, object]:
    """A surface a label."""
    found = {}
    for label, box in enumerate(scipy.ndimage.find_objects(patient.labels.astype(np.int32)), start=1):
        if box is None or np.count_nonzero(inside := patient.labels[box] == label) < 30:
            continue
        T = patient.T.copy()
        T[:3, 3] += T[:3, :3] @ [one.start for one in box]
        found[str(label)] = mask_surface(inside, T, where=str(label))
    return found


def source_of(patient: Patient, meshes) -> Source:
    """As a label map on the image's own grid."""
    T, shape = patient.T, np.array(patient.hu.shape)
    voxel = np.linalg.norm(T[:3, :3], axis=0)
    middle = T[:3, :3] @ ((shape - 1) / 2) + T[:3, 3]
    return Source("labels", meshes, T[:3, :3] / voxel, (middle, np.zeros(3)), T[:3, 3], voxel)


def wrong(source: Source, rng: np.random.Generator) -> tuple[str, np.ndarray]:
    """A slip: its kind, and the map (4, 4) by which the surfaces are off."""
    kind = rng.choice(["shift", "scale", "mirror", "half turn", "reversed"])
    T, middle = np.eye(4), source.middles[0]
    if kind == "shift":
        axis = int(rng.integers(3))
        least = source.axes[:, axis] * max(6.0, 1.5 * source.voxel_mm[axis])
        T[:3, 3] = least * rng.uniform(1, 4) * rng.choice([-1, 1])
    elif kind == "scale":
        T[:3, :3] *= rng.choice([0.9, 0.95, 1.05, 1.1])
        about = (middle, source.first)[int(rng.integers(2))]
        T[:3, 3] = about - T[:3, :3] @ about
    else:
        signs = np.ones(3)
        axes = rng.permutation(3)[: 2 if kind == "half turn" else 1] if kind != "reversed" else [2]
        signs[axes] = -1
        about = middle if kind == "reversed" else source.middles[int(rng.integers(2))]
        T[:3, :3] = np.diag(signs)
        T[:3, 3] = about - T[:3, :3] @ about
    return str(kind), T


def rows(patients, draws: int, rng: np.random.Generator) -> Iterator[dict]:
    """One a draw: what the test says of a true placement and of a wrong one."""
    for name, patient in patients:
        for change in CHANGES:
            image_of = changed(patient, change, rng)
            image, meshes = edge_image(image_of.hu, image_of.T), meshes_of(image_of)
            for count in COUNTS:
                if count != COUNTS[-1] and count >= len(meshes):
                    continue
                for _ in range(draws if count < len(meshes) else max(1, draws // 5)):
                    chosen = rng.choice(list(meshes), min(count, len(meshes)), replace=False)
                    source = source_of(image_of, {one: meshes[one] for one in chosen})
                    kind, T = wrong(source, rng)
                    moved = {one: mesh.transformed(T) for one, mesh in source.meshes.items()}
                    off = source_of(image_of, moved)
                    yield _row(name, change, count, "true", assess(image, source)) | {"of": len(chosen)}
                    yield _row(name, change, count, kind, assess(image, off)) | {"of": len(chosen)}


def _print_own(found):
    print("\nEach structure by itself: how many are said to lie better elsewhere, and to be unconfirmed:")
    print("| structures | better elsewhere | at one place | unconfirmed | not in the image |\n|---|---|---|---|---|")
    for kind in ("true", *sorted({row["kind"] for row in found} - {"true"})):
        some = [row for row in found if row["kind"] == kind]
        count = sum(row["of"] for row in some)
        cells = [f"{sum(row[one] for row in some) / count:.3f}" for one in OWN]
        print(f"| {count} {kind} | {' | '.join(cells)} |")


def _row(name, change, count, kind, found):
    return {
        "name": name, "change": change, "structures": count, "kind": kind, "z": found.z, "named": found.T is not None,
        "told": bool(found.open), "refused": found.refuses, "doubtful": found.doubtful,
    } | {one: len(getattr(found, one)) for one in OWN}  # fmt: skip


def main() -> None:
    """Print the table of z, and write every draw."""
    arguments = options(__doc__, real=Path("../shared/data"), draws=20, seed=0, json=Path)
    start = time.perf_counter()
    found = list(rows([*real(arguments.real), *phantoms()], arguments.draws, np.random.default_rng(arguments.seed)))
    print(f"{len(found)} assessed in {time.perf_counter() - start:.0f} s")
    groups = defaultdict(list)
    for row in found:
        groups[row["name"], row["structures"]].append(row)
    print(
        "| image | structures | true: largest z | refused | warned | wrong: refused | warned | cannot tell | passed |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for (name, count), some in groups.items():
        z = np.array([row["z"] for row in some if row["kind"] == "true"])
        off = [row for row in some if row["kind"] != "true"]
        part = [np.mean([test(row) for row in off]) for test in (_refused, _warned, _open, _passed)]
        true = [row for row in some if row["kind"] == "true"]
        counted = f"{z.max():.1f} | {sum(map(_refused, true))} of {len(z)} | {sum(map(_warned, true))}"
        print(f"| {name} | {count} | {counted} | {' | '.join(f'{one:.2f}' for one in part)} |")
    _print_own(found)
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=1))


def _refused(row):
    return row["refused"]


def _warned(row):
    return row["doubtful"] and not row["refused"]


def _open(row):
    return not row["doubtful"] and row["told"]


def _passed(row):
    return not row["doubtful"] and not row["told"]


if __name__ == "__main__":
    main()
