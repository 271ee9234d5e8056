"""A case as a scene in the scanner: its structures with Hounsfield units, markers of metal, the table, a needle."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Literal, NamedTuple

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.default_roles import default_role
from puncture_twin.planning.anatomy.structure import Structure
from puncture_twin.planning.anatomy.unseen import BEYOND_LABELS
from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.case.case import Case, bed_frame
from puncture_twin.planning.formats.points import NamedPoints
from puncture_twin.planning.formats.volumes.volume_files import Volume
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, pose
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.planning.registration.checks.markers import skin_fit
from puncture_twin.twin.devices import ControlScan
from puncture_twin.twin.plant.scanner.image import (
    CtImage,
    ScanSettings,
    Solid,
    ball,
    box,
    check_closed,
    rod,
    scan_solids,
)
from puncture_twin.twin.plant.truth import read_points

METAL_HU = 8000.0
"""Steel and titanium lie beyond what 12 bits hold; how far is declared as ours."""
SOFT_TISSUE_HU = 20.0
"""What fills the skin between the structures: fat and muscle, mixed; ours. Also of a name that no line knows."""
SHELL_HU, FOAM_HU, SHELL_MM = 60.0, -930.0, 3.0
"""Material of a table, and of every obstacle in the CT's frame: a shell so thick about foam; ours."""

HU_OF_GROUP = MappingProxyType(
    {
        "vertebrae, spine": 300.0,  # ours: cancellous bone in a thin shell, mixed
        "ribs": 500.0,  # ours
        "costal cartilages, sternum": 130.0,  # ours
        "pelvis": 400.0,  # ours
        "limbs and girdles": 700.0,
        "skull and face": 900.0,
        **dict.fromkeys(("spinal cord", "brain"), 35.0),  # as grey and white matter
        **dict.fromkeys(("aorta and venae cavae", "great vessels of the chest and neck", "portal vein"), 45.0),
        **dict.fromkeys(("iliac vessels", "other vessels", "heart"), 45.0),
        "lungs": -800.0,
        "airways": -1000.0,
        "gallbladder and bile ducts": 8.0,  # ours: nearly water
        "urinary bladder and ureters": 5.0,  # ours
        "ventricles of the brain": 8.0,  # ours
        "stomach and bowel": 25.0,  # ours: filled with fluid, no gas
        "liver": 58.0,
        "spleen": 48.0,
        "kidneys": 32.0,
        "pancreas": 38.0,  # ours
        "muscles": 55.0,  # ours
        "fat, breast": -90.0,
        "lesion": 25.0,  # ours: darker than liver
        "devices": METAL_HU,
    }
)
"""By group of the table of default roles (`planning.anatomy.default_roles`)."""
OF_NAME = MappingProxyType({"bolt": METAL_HU, "unnamed_dense": 700.0, "unnamed_gas": -1000.0})
"""By the beginning of a name, before the groups."""


def default_hu(name: str, region: str) -> float:
    """Hounsfield units of a structure by its name."""
    line = default_role(name, region)
    by_group = SOFT_TISSUE_HU if line is None else HU_OF_GROUP.get(line.group, SOFT_TISSUE_HU)
    return next((hu for start, hu in OF_NAME.items() if name.lower().startswith(start)), by_group)


MARKER_MM, MARKER_THICK_MM = 8.0, 1.5
"""A disc of metal of the size of a shirt button (ours; Chen 2019 does not state one); a ball has the diameter."""
MOST_UNIFORM = np.sqrt(12.0)
"""Width of a cell over the standard deviation of what is read to it."""
MarkerKind = Literal["disc", "ball", "none"]


@dataclass(frozen=True, eq=False)
class TrueRod:
    """A true needle in the CT's frame of the case: tip (3,), mm, and direction to the tip (3,), unit."""

    tip_ct: Floats
    forward_ct: Floats


class Part(NamedTuple):
    """One body outside of a patient; a later one fills the place of an earlier one."""

    name: str
    mesh: TriangleMesh
    hu: float
    place: Literal["beneath", "upon", "within"] = "upon"
    """``beneath`` the patient, as the bed; ``upon`` them, as arms and lines, which the body displaces; ``within`` an
    arm, as its bones, which displace the body."""


Placer = Callable[[TriangleMesh, float, np.random.Generator], tuple[Part, ...]]
"""Of a skin in the scanner's frame, and the height along the bed that the image is about, mm."""


@dataclass(frozen=True, eq=False)
class CaseScene:
    """Content of the scanner, in its frame (LPS of the scan, mm)."""

    solids: tuple[Solid, ...]
    T_scan_ct: Floats  # shape (4, 4): the case's frame to the scanner's; a rotation, never a mirror
    skin: TriangleMesh
    cut: Bools  # shape (3, 2): at which ends the body goes on beyond its surface
    tables: Floats  # shape (2, 3): the box about what the patient lies on; infinite without any
    outside_objects: tuple[Part, ...]
    markers: NamedPoints | None
    listed: NamedPoints | None
    target: Floats  # shape (3,)


def case_scene(
    case: Case, anatomy: Anatomy, settings: ScanSettings, rng: np.random.Generator, *,
    marker: MarkerKind = "disc", needle: TrueRod | None = None, outside: Placer | None = None,
) -> CaseScene:  # fmt: skip
    """Place a case in the scanner, each true marker drawn in its cell.

    Raises:
        InputError: A structure's surface is open.
    """
    T, listed = scan_frame(case, settings.turn), None
    if marker != "none" and case.registration is not None:
        listed = read_points(case, case.registration.markers_ct, case.space)
    true = None if listed is None else _drawn_in_cells(case, listed, settings, rng)
    skin = anatomy.skin.mesh.transformed(T)
    target = apply(T, case.target_ct)
    laid = () if outside is None else outside(skin, float(target[2]), rng)
    solids = _body(case, anatomy)
    if true is not None:
        solids += _markers(true, skin_fit(true.points, anatomy.skin).normals_ct, marker)
    if needle is not None:
        start = needle.tip_ct - case.needle.shaft_mm * needle.forward_ct
        solids.append(Solid("needle", rod(start, needle.tip_ct, case.needle.diameter_mm), METAL_HU))
    tables, (body, *rest) = ([s._replace(mesh=s.mesh.transformed(T)) for s in part] for part in (_tables(case), solids))
    beneath, upon, within = (
        [Solid(one.name, one.mesh, one.hu) for one in laid if one.place == place]  # no segmentation names them
        for place in ("beneath", "upon", "within")
    )
    view, around = anatomy.skin.field_of_view, _bounds([one.mesh for one in (*tables, *beneath)])
    cut = np.zeros((3, 2), np.bool_) if view is None else view.cut
    filled = (*tables, *beneath, *upon, body, *within, *rest)
    return CaseScene(filled, T, skin, cut, around, laid, _moved(true, T), _moved(listed, T), target)


def scan_frame(case: Case, turn: float) -> Floats:
    """T_scan_ct: z along the bed to the head, y down; a patient's own axes as they are.

    A frame of its own is laid on the bed by its rotation: z along `bed_frame`'s x, y against its z, x = y × z. Its
    determinant is 1, where swapping two axes would be a mirror that no distance shows.
    """
    R = np.eye(3)
    if case.space is Space.LOCAL:
        bed = bed_frame(case)[:3, :3]
        R = np.stack([-bed[:, 1], -bed[:, 2], bed[:, 0]])
    rotation = exp_rotation(np.array([0.0, 0.0, turn]))
    middle = R @ case.target_ct
    return pose(rotation @ R, middle - rotation @ middle)


def label_layers(case: Case, anatomy: Anatomy) -> tuple[tuple[str, ...], ...]:
    """The structures that a segmentation would show, in two maps; the place of a name, from 1, is its label.

    First those that demand clearance, and the one that holds the target; then those that a needle may cross: an organ
    holds its vessels and its lesion, and would have holes in one map with them.
    """
    first: list[str] = []
    crossed: list[str] = []
    for one in anatomy.structures:
        if one.name != BEYOND_LABELS:
            (first if one.demands_margin or one.name == case.target_structure else crossed).append(one.name)
    return (tuple(first), tuple(crossed)) if crossed else (tuple(first),)


def _body(case: Case, anatomy: Anatomy) -> list[Solid]:
    """The skin, then what may be crossed, then what demands clearance: the more it demands, the later.

    So where two structures overlap, the label map keeps the one whose margin is larger, and a search on it never finds
    more clearance than on both.
    """
    stated = {one.name: one.hu for one in case.structure if one.hu is not None}
    places = {
        name: (number, layer)
        for layer, names in enumerate(label_layers(case, anatomy))
        for number, name in enumerate(names, start=1)
    }
    region = case.region or "other"
    ordered = sorted((one for one in anatomy.structures if one.name in places), key=_filling)
    skin_name = next(one.name for one in case.structure if one.role == "skin")
    skin = Solid("skin", anatomy.skin.mesh, stated.get(skin_name, SOFT_TISSUE_HU))
    hu = {s.name: stated.get(s.name, default_hu(s.name, region)) for s in ordered}
    solids = [Solid(s.name, s.mesh, hu[s.name], *places[s.name], whole=s.demands_margin) for s in ordered]
    return [check_closed(one, str(case.path)) for one in (skin, *solids)]


def _filling(structure: Structure) -> tuple[bool, float, float]:
    corners = structure.mesh.triangles
    volume = np.einsum("ti,ti->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    return structure.demands_margin, structure.margin_mm, -abs(float(volume))


def _tables(case: Case) -> list[Solid]:
    solids = []
    for one in case.obstacles:
        if one.frame == "ct":
            solids.append(Solid(one.name, box(one.center_mm, one.size_mm), SHELL_HU))
            if one.size_mm.min() > 2 * SHELL_MM:
                solids.append(Solid(one.name, box(one.center_mm, one.size_mm - 2 * SHELL_MM), FOAM_HU))
    return solids


def _drawn_in_cells(case: Case, listed: NamedPoints, settings: ScanSettings, rng: np.random.Generator) -> NamedPoints:
    """True places anywhere in the cell of each reading, CT frame.

    Readings are whole cells apart: left where they stand, all markers and the target would err alike in the next scan,
    and a registration would not see it.
    """
    if case.errors is None:
        widths, axes = np.array([settings.pixel_mm, settings.pixel_mm, settings.spacing_mm]), np.eye(3)
    else:
        variances, axes = np.linalg.eigh(case.errors.marker_cov_ct)
        widths = MOST_UNIFORM * np.sqrt(variances)
    within = rng.uniform(-0.5, 0.5, listed.points.shape) * widths
    return NamedPoints(listed.names, listed.points + within @ axes.T, listed.space)


def _markers(true: NamedPoints, normals: Floats, kind: MarkerKind) -> list[Solid]:
    solids = []
    for name, point, normal in zip(true.names, true.points, normals, strict=True):
        half = MARKER_THICK_MM / 2 * normal
        mesh = ball(point, MARKER_MM) if kind == "ball" else rod(point - half, point + half, MARKER_MM)
        solids.append(Solid(f"marker {name}", mesh, METAL_HU))
    return solids


def _moved(points: NamedPoints | None, T_scan_ct: Floats) -> NamedPoints | None:
    return None if points is None else NamedPoints(points.names, apply(T_scan_ct, points.points), Space.LPS)


def _bounds(meshes: Sequence[TriangleMesh]) -> Floats:
    if not meshes:
        return np.array([np.full(3, np.inf), np.full(3, -np.inf)])
    bounds = np.stack([mesh.bounds for mesh in meshes])
    return np.stack([bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)])


AIR_MM = 15.0
"""Air around the body, and about arms and lines: a needle's entry is not at the image's edge."""
TABLE_MM = 100.0
"""Next to and behind the body, so much of a table is shown: where the image cuts it, what is beyond is not known."""


@dataclass(frozen=True, eq=False)
class VirtualScanner:
    """A `Scanner` with a scene in it; each scan draws anew where its grid falls, and its noise."""

    scene: CaseScene
    settings: ScanSettings
    rng: np.random.Generator

    def image(self) -> CtImage:
        """A new scan, with its ground truth."""
        grid = scan_grid(self.scene, self.settings, self.rng)
        return scan_solids(self.scene.solids, grid, self.settings, self.rng)

    def measured_scan(self) -> ControlScan:
        """A new scan, as guidance sees it."""
        image = self.image()
        return ControlScan(Volume(image.hu, image.grid.T_ct_index, Path("scan")))


MOST_VOXELS = 200_000_000
"""A whole trunk at 0.8 x 0.8 x 0.6 mm; each voxel takes some ten bytes while it is made."""
DECIMALS = 4
"""Decimals of positions in mm, so that DICOM's decimal strings hold them whole."""


def scan_grid(scene: CaseScene, settings: ScanSettings, rng: np.random.Generator) -> VolumeGrid:
    """The voxels of a scan, axes along LPS, the first drawn within one: a patient lies anywhere between two slices."""
    low, high = _shown(scene, settings)
    spacing = np.array([settings.pixel_mm, settings.pixel_mm, settings.spacing_mm])
    first = np.round(low + (0.5 + rng.uniform(0.0, 1.0, 3)) * spacing, DECIMALS)
    counts = np.floor((high - first) / spacing + 0.5).astype(int)
    if counts.min() < 2 or np.prod(counts, dtype=float) > MOST_VOXELS:
        shown = " x ".join(map(str, counts))
        allowed = f"2 voxels or more along each axis, {MOST_VOXELS:,} at most: larger pixels, or --fov and --length"
        refuse(f"the scan would have {shown} voxels", "scan", allowed, "out_of_range")
    T = np.diag([*spacing, 1.0])
    T[:3, 3] = first
    return VolumeGrid((int(counts[0]), int(counts[1]), int(counts[2])), T, {})


def _shown(scene: CaseScene, settings: ScanSettings) -> tuple[Floats, Floats]:
    low, high = scene.skin.bounds
    low = low - np.where(scene.cut[:, 0], 0.0, AIR_MM)
    high = high + np.where(scene.cut[:, 1], 0.0, AIR_MM)
    for one in scene.outside_objects:
        if one.place == "upon":
            low[:2] = np.minimum(low[:2], one.mesh.bounds[0, :2] - AIR_MM)
            high[:2] = np.maximum(high[:2], one.mesh.bounds[1, :2] + AIR_MM)
    for axis in (0, 1):
        low[axis] = min(low[axis], max(scene.tables[0, axis] - AIR_MM, low[axis] - TABLE_MM))
        high[axis] = max(high[axis], min(scene.tables[1, axis] + AIR_MM, high[axis] + TABLE_MM))
    if settings.fov_mm is not None:
        middle = (low + high) / 2
        low[:2], high[:2] = middle[:2] - settings.fov_mm / 2, middle[:2] + settings.fov_mm / 2
    if settings.length_mm is not None:
        low[2] = max(low[2], scene.target[2] - settings.length_mm / 2)
        high[2] = min(high[2], scene.target[2] + settings.length_mm / 2)
    return low, high
