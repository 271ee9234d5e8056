"""Structures beside their image: all of them, or one among many that are right."""

import dataclasses
import re
import tempfile
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy
import trimesh
from case_world import case_text, structure

from benchmarks.placements import CHANGES, Patient, changed, meshes_of, phantoms, source_of
from puncture_twin.planning.evidence.checks import findings
from puncture_twin.planning.evidence.edges import axis_slips, edge_image, least_shift_mm
from puncture_twin.planning.evidence.label_placement import LEAST_SLIP, assess
from puncture_twin.planning.geometry.mesh import spread_on
from puncture_twin.planning.geometry.rigid import apply, exp_rotation
from puncture_twin.planning.search.context import prepare
from puncture_twin.twin.plant.scanner.writers import write_nifti
from slips.kinds import REFUSED, RIGHT, SILENT, TOLD, WARNED, Answer, Kind, answer

PHANTOMS = dict(phantoms())


@cache
def _seen(name, change):
    patient = changed(PHANTOMS[name], change, np.random.default_rng(7))
    return patient, edge_image(patient.hu, patient.T), meshes_of(patient)


def _about(point, linear):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = linear, point - linear @ point
    return T


def _shift(rng, source):
    axis, T = int(rng.integers(3)), np.eye(4)
    least = least_shift_mm(source.voxel_mm)[axis]
    T[:3, 3] = source.axes[:, axis] * least * rng.uniform(1, 4) * rng.choice([-1, 1])
    return T


def _scale(rng, source):
    about = (source.middles[0], source.first)[int(rng.integers(2))]
    return _about(about, np.eye(3) * rng.choice([0.9, 0.95, 1.05, 1.1]))


def _mirror(rng, source, axis=None, sign=1.0):
    about, axis = int(rng.integers(2)), rng.integers(3) if axis is None else axis
    return _about(source.middles[about], sign * np.diag(np.where(np.arange(3) == axis, -1.0, 1.0)))


def _turn(rng, source):
    axis = rng.normal(size=3)
    return _about(source.middles[0], exp_rotation(axis / np.linalg.norm(axis) * np.radians(rng.uniform(8, 25))))


def _permuted(rng, source):
    ways = [one for one in axis_slips(source.middles[:1], source.axes) if abs(one.T[0, 0]) + abs(one.T[1, 1]) < 1.5]
    return ways[int(rng.integers(len(ways)))].T


def _rms_off(meshes, T):
    """How far surfaces that are moved by T lie from the same surfaces as they were, rms, mm."""
    gaps = [scipy.spatial.cKDTree(one.vertices).query(apply(T, spread_on(one, 200).points))[0] for one in meshes]
    return float(np.sqrt(np.mean(np.concatenate(gaps) ** 2)))


def _whole(kind, slip_of, rng, folder, slip):
    """All structures of a phantom beside its image, in what the edges of the image say."""
    patient, image, all_meshes = _seen(str(rng.choice(list(PHANTOMS))), str(rng.choice(CHANGES)))
    count = int(rng.integers(min(4, len(all_meshes)), len(all_meshes) + 1))
    meshes = {one: all_meshes[one] for one in rng.choice(list(all_meshes), count, replace=False)}
    source = source_of(patient, meshes)
    T = np.eye(4)
    T[:3, 3] = rng.uniform(-1.0, 1.0, 3)  # what is resampled lies a part of a voxel off
    T = slip_of(rng, source) if slip else T
    found = assess(image, source_of(patient, {name: mesh.transformed(T) for name, mesh in meshes.items()}))
    if found.refuses or found.agreeing:
        return Answer(REFUSED, "labels_beside_image")
    if found.doubtful or found.odd or "shift" in found.open:
        return Answer(WARNED, "structure_beside_image" if found.odd else "edges_cannot_tell")
    if _rms_off(meshes.values(), T) < LEAST_SLIP["shift"] * least_shift_mm(source.voxel_mm).min():
        return Answer(RIGHT)
    return Answer(TOLD, "edges_cannot_tell") if kind in found.open else Answer(SILENT)


MASKS = '[[structures]]\nmasks = "masks"\ntarget = ["part_1"]\navoid = { "part_*" = 2.0 }\n'
PARTS = 16


def _full_trunk(rng):
    """A trunk that is full of parts, as bodies are: cells about seeds, each with Hounsfield units of its own."""
    step, shape = 4.0, (60, 46, 40)
    axes = [(np.arange(n) - (n - 1) / 2) * step for n in shape]
    x, y, z = np.meshgrid(*axes, indexing="ij")
    depth = 1.0 - np.hypot(x / 110.0, y / 82.0)
    seeds = np.column_stack([rng.uniform(-80, 80, PARTS), rng.uniform(-55, 55, PARTS), rng.uniform(-75, 75, PARTS)])
    gaps = np.linalg.norm(np.stack([x, y, z], axis=-1)[..., None, :] - seeds, axis=-1)
    nearest = np.sort(gaps, axis=-1)[..., :2]
    labels = np.where((depth > 0.12) & (nearest[..., 1] - nearest[..., 0] > 5.0), gaps.argmin(axis=-1) + 1, 0)
    values = np.concatenate(
        [[20.0], rng.permutation(np.r_[np.linspace(-90, -25, PARTS // 2), np.linspace(65, 230, PARTS // 2)])]
    )
    hu = np.where(depth > 0, values[labels], -1000.0) + rng.normal(0, 10, shape)
    T = np.diag([step, step, step, 1.0])
    T[:3, 3] = [axis[0] for axis in axes]
    return Patient(hu.astype(np.float32), labels.astype(np.int16), T)


@cache
def _full(seed, written):
    """Such a trunk as a case of masks or of meshes: the case, its anatomy, and what is said of it as it is."""
    patient = _full_trunk(np.random.default_rng(seed))
    meshes = {f"part_{label}": mesh for label, mesh in meshes_of(patient).items()}
    inside = scipy.ndimage.distance_transform_edt(patient.labels == 1)
    target = apply(patient.T, np.array(np.unravel_index(inside.argmax(), inside.shape), float)[None])[0]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "masks").mkdir()
        write_nifti(folder / "ct.nii.gz", patient.hu.astype(np.int16), patient.T)
        for part, mesh in meshes.items():
            if written == "masks":
                mask = patient.labels == int(part.removeprefix("part_"))
                write_nifti(folder / "masks" / f"{part}.nii.gz", mask.astype(np.uint8), patient.T)
            else:
                trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(folder / f"{part}.stl")
        skin = structure("skin", "skin", {"ct": "ct.nii.gz"})
        sections = [structure(one, "target" if one == "part_1" else "avoid") for one in meshes]
        many, listed = ([MASKS], len(meshes)) if written == "masks" else (sections, 0)
        keys = {"region": "phantom", "target": f'position_mm = {target.tolist()}\nstructure = "part_1"'}
        needle = "length_mm = 250.0\nshaft_mm = 200.0\ndiameter_mm = 1.2"
        (folder / "case.toml").write_text(case_text(skin, *many, needle=needle, search="", listed=listed, **keys))
        context = prepare(folder, arm=False)
    return context.case, context.anatomy, _said(context.case, context.anatomy).warnings


class Said(NamedTuple):
    """What the checks say of a case: each warning, once for each structure that it names, and what is not confirmed."""

    warnings: set[tuple[str, str]]
    unconfirmed: set[str]


def _said(case, anatomy):
    warnings, unconfirmed = set(), set()
    for one in findings(case, anatomy, None):
        if one.severity == "warning":
            warnings |= {(one.code, name) for name in re.findall(r"part_\d+", one.sentence) or [""]}
        elif one.code == "outline_unconfirmed":
            unconfirmed |= set(one.numbers["names"].split(", "))
    return Said(warnings, unconfirmed)


def _one_off(written, T_of, rng, folder, slip):
    """One of many structures elsewhere: whatever any check says."""
    case, anatomy, usual = _full(int(rng.integers(3)), written)
    others = [one for one in anatomy.structures if one.name.startswith("part_") and one.name != "part_1"]
    odd = others[int(rng.integers(len(others)))]
    T = np.eye(4)
    T[:3, 3] = rng.uniform(-0.8, 0.8, 3)
    T = T_of(rng) if slip else T
    moved = dataclasses.replace(odd, mesh=odd.mesh.transformed(T))
    structures = tuple(moved if one is odd else one for one in anatomy.structures)

    def call():
        found = _said(case, dataclasses.replace(anatomy, structures=structures))
        codes = sorted(code for code, name in found.warnings - usual if name in ("", odd.name))
        if codes:
            return Answer(WARNED, codes[0])
        if odd.name in found.unconfirmed:
            return Answer(TOLD, "outline_unconfirmed")
        return Answer(RIGHT if _rms_off([odd.mesh], T) < 6.0 else SILENT)

    return answer(call)


def _beside(rng):
    T, way = np.eye(4), rng.normal(size=3)
    T[:3, 3] = 15.0 * way / np.linalg.norm(way)
    return T


def _scaled(factor, rng):
    return np.diag([factor, factor, factor, 1.0])


def _other_space(rng):
    return np.diag([-1.0, -1.0, 1.0, 1.0])


MAY_PASS = 0.1
"""What is shifted into the rim of the body, or against the skin, where no other part lies, is said in a note."""

KINDS = (
    Kind("labels shifted", 40, partial(_whole, "shift", _shift)),
    Kind("labels scaled", 25, partial(_whole, "scale", _scale)),
    Kind("labels mirrored", 25, partial(_whole, "axes", _mirror)),
    Kind("labels by half a turn", 25, partial(_whole, "axes", partial(_mirror, sign=-1.0))),
    Kind("labels turned", 20, partial(_whole, "turn", _turn)),
    Kind("labels reversed", 15, partial(_whole, "axes", partial(_mirror, axis=2))),
    Kind("labels with exchanged axes", 20, partial(_whole, "axes", _permuted)),
    Kind("one mask 15 mm off", 30, partial(_one_off, "masks", _beside), may_pass=MAY_PASS),
    Kind("one mesh 15 mm off", 20, partial(_one_off, "meshes", _beside), may_pass=MAY_PASS),
    Kind("one mesh in the other space", 20, partial(_one_off, "meshes", _other_space)),
    Kind("one mesh in cm", 15, partial(_one_off, "meshes", partial(_scaled, 0.1))),
    Kind("one mesh in m", 10, partial(_one_off, "meshes", partial(_scaled, 0.001))),
)
