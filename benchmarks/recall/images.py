"""The images, fixed by name: which are ambiguous, how each is made, and what is true in it. All seeds are here.

*Ambiguous* is what a person could not tell from the image either: arms pressed flat against the flanks, a narrow field
of view in which arms and table are half seen, a pad under the back that is as dense as the body. Real images are the
3 mm abdomen, whole and cut in three along the bed, and the chest of 10 mm slices. Body in them: above -300 HU, opened
by 6 mm, the largest part, holes filled slice by slice. Beside it: above -300 HU, two voxels away from the body, 200 mm3
or more. Doubtful: 200 HU and more, or gas, within the body and in no label dilated by a voxel, 100 mm3 or more.
"""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from benchmarks.beside.scene import Asked, is_outer, scanned
from benchmarks.recall.oracle import Grid, Scene, filled
from puncture_twin.planning.base.progress import Silent
from puncture_twin.planning.formats.volumes.volume_files import canonical, read_volume
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.planning.init.finder import Wanted
from puncture_twin.planning.init.overrides import with_keys
from puncture_twin.planning.init.start import Request
from puncture_twin.twin.jobs.patient.init_job import init_case
from puncture_twin.twin.plant.scanner.image import ScanSettings
from puncture_twin.twin.plant.scanner.writers import write_nifti
from tools.phantoms.outside_objects import OutsideObjects
from tools.phantoms.supine import LESION_LPS_MM, cradle_parts, trunk_parts

NEEDLE = "[needle]\nlength_mm = 200.0\nshaft_mm = 150.0\ndiameter_mm = 1.2\n"
SEARCH = '[search]\ntheta_deg = [0, 180]\nstep_deg = 6.0\nmax_skin_angle_deg = 60.0\nframe = "bed"\n'
AIR = -1000.0


class Image(NamedTuple):
    """One image.

    Attributes:
        make: Writes CT, labels and case into a folder, given that of the real data, and gives what is true.
        fine: Finer than 2 mm: asked for by `--fine`.
        arms: What a person who looks at it states of ``[ct] arms``; None where the region says it.
    """

    name: str
    make: Callable[[Path, Path | None], Scene]
    ambiguous: bool = False
    fine: bool = False
    real: bool = False
    arms: str | None = "none"


def asked_alike(folder: Path) -> None:
    """Give a case that `init` wrote the needle and the grid of all."""
    path = folder / "case.toml"
    text = path.read_text(encoding="utf-8")
    rest = text[text.index("[search]") :]
    rest = rest[rest.index("\n[") :]
    path.write_text(text[: text.index("[needle]")] + NEEDLE + "\n" + SEARCH + rest, encoding="utf-8")


def declare(folder: Path, arms: str) -> None:
    """State what a person sees of arms in the image, as `init --set` does."""
    path = folder / "case.toml"
    path.write_text(with_keys(path.read_text(encoding="utf-8"), {"ct.arms": f'"{arms}"'}), encoding="utf-8")


def start(folder: Path, target, region=None) -> None:
    """The case as `init` makes it."""
    text = ",".join(f"{one:.3f}" for one in target)
    wanted = Wanted(Space.LPS, None, None, None, None)
    init_case(Request(folder, text, None, region, wanted), force=True, watcher=Silent())
    asked_alike(folder)


def _matrix(grid: Grid):
    T = np.diag([*grid.step, 1.0])
    T[:3, 3] = grid.low
    return T


# --- laboratory phantoms ----------------------------------------------------------------------------------------------


class Phantom(NamedTuple):
    """A block about the origin, mm: how deep a point lies in it (negative outside), and where its lowest side is."""

    depth: Callable
    bottom: float
    others: Mapping[str, tuple[float, Callable]] = MappingProxyType({})


VESSEL = (np.array([15.0, -30.0, 0.0]), 6.0)
BLOCKS = {
    "cylinder": Phantom(lambda x, y, z: np.minimum(80 - np.hypot(x, y), 100 - abs(z)), 80.0),
    "box": Phantom(lambda x, y, z: np.minimum(np.minimum(90 - abs(x), 70 - abs(y)), 100 - abs(z)), 70.0),
    "half_cylinder": Phantom(
        lambda x, y, z: np.minimum(np.minimum(110 - np.hypot(x, y - 60), 60 - y), 120 - abs(z)),
        60.0,
        {"spine": (700.0, lambda x, y, z: np.hypot(x, y - 40) + 0 * z <= 12)},
    ),
    "agar_plate": Phantom(
        lambda x, y, z: np.minimum(np.minimum(75 - abs(x), 60 - abs(y)), 90 - abs(z)),
        60.0,
        {"plate": (400.0, lambda x, y, z: (abs(x) <= 60) & (abs(y - 45) <= 5) & (abs(z) <= 75))},
    ),
}
"""The plate lies in the agar, 10 mm above its bottom."""


def phantom(name: str, table: bool, step: float = 2.0) -> Callable[[Path, Path | None], Scene]:
    """A phantom in air, or on a table: 20 mm of foam on a plate of 4 mm, 280 mm wide, longer than the image."""

    def make(folder: Path, data: Path | None) -> Scene:
        block, image = BLOCKS[name], Grid.of((-150, -120, -160), (150, 120, 160), step)
        truth = Grid.of((-300, -300, -300), (300, 300, 300), 3.0)
        hu, labels = np.full(image.shape, AIR), np.zeros(image.shape, np.uint8)
        names = ["lesion", "vessel", *block.others]
        scenes = []
        for grid in (image, truth):
            x, y, z = grid.axes()
            inside = block.depth(x, y, z) >= 0
            masks = {"lesion": x**2 + y**2 + z**2 <= 8**2}
            (a, b, c), radius = VESSEL
            masks["vessel"] = (x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2 <= radius**2
            for one, (_, where) in block.others.items():
                masks[one] = np.broadcast_to(where(x, y, z), grid.shape) & inside
            below = y - block.bottom
            bed = np.broadcast_to((below > 0) & (below <= 24) & (abs(x) < 140) & (table & (abs(z) < 1e3)), grid.shape)
            plate = bed & (below > 20)
            scenes.append((inside, masks, bed, plate))
        inside, masks, bed, plate = scenes[0]
        hu[bed], hu[plate], hu[inside] = -150.0, 200.0, 40.0
        for number, one in enumerate(names, start=1):
            labels[masks[one]] = number
            hu[masks[one]] = {"lesion": 90.0, "vessel": 200.0}.get(one) or block.others[one][0]
        hu += np.random.default_rng(11).normal(0.0, 10.0, image.shape)
        write_lab(folder, image, hu, labels, names)
        inside, masks, bed, _ = scenes[1]
        return Scene(truth, image, inside, bed, {n: m for n, m in masks.items() if n != "lesion"}, np.zeros(3))

    return make


def write_lab(folder: Path, image: Grid, hu, labels, names, target=(0.0, 0.0, 0.0), region="phantom") -> None:
    """CT, labels and a case written by hand."""
    write_nifti(folder / "ct.nii.gz", np.round(hu).astype(np.int16), _matrix(image))
    write_nifti(folder / "labels.nii.gz", labels, _matrix(image))
    text = f'schema = 2\nregion = "{region}"\nname = "lab"\nspace = "LPS"\n\n[target]\n'
    text += f'position_mm = {list(map(float, target))}\nstructure = "lesion"\n\n{NEEDLE}\n{SEARCH}\n'
    text += '[[structure]]\nname = "skin"\nct = "ct.nii.gz"\nrole = "skin"\n'
    for number, name in enumerate(names, start=1):
        role = 'role = "target"' if name == "lesion" else 'role = "avoid"\nmargin_mm = 2.0'
        text += f'\n[[structure]]\nname = "{name}"\nlabelmap = "labels.nii.gz"\nlabel = {number}\n{role}\n'
    (folder / "case.toml").write_text(text + f"\n[end]\nstructures = {len(names) + 1}\n", encoding="utf-8")


def cradled(folder: Path, data: Path | None) -> Scene:
    """The embedded torso pressed into a curved table as dense as itself; the image cuts it at head and feet."""
    image = Grid.of((-300, -190, -90), (300, 190, 90), 3.0)
    truth = Grid.of((-330, -240, -270), (330, 240, 270), 3.0)
    parts = [*cradle_parts(), *trunk_parts()]
    found = []
    for grid in (image, truth):
        points = np.stack(np.broadcast_arrays(*grid.axes()), axis=-1).reshape(-1, 3)
        found.append({one.name: (one.field(points) <= 0).reshape(grid.shape) for one in parts})
    hu, labels, names = np.full(image.shape, AIR), np.zeros(image.shape, np.uint8), ["lesion", "spine"]
    for one in parts:
        hu[found[0][one.name]] = one.hu
    for number, name in enumerate(names, start=1):
        labels[found[0][name]] = number
    hu += np.random.default_rng(12).normal(0.0, 15.0, image.shape)
    write_lab(folder, image, hu, labels, names, LESION_LPS_MM, "abdomen")
    true = found[1]
    table = true["cradle"] & ~true["trunk"]
    return Scene(truth, image, true["trunk"], table, {"spine": true["spine"]}, np.array(LESION_LPS_MM))


# --- virtual CTs ------------------------------------------------------------------------------------------------------


def drawn(seed: int, arms: str, bed: str, lines: int, settings: ScanSettings) -> Callable[[Path, Path | None], Scene]:
    """A drawn trunk with arms, bed and lines, scanned by the product's scanner."""

    def make(folder: Path, data: Path | None) -> Scene:
        truth, run = scanned(folder, Asked(seed, OutsideObjects(arms, bed, lines), settings))
        asked_alike(folder / "ct")
        for one in (folder / "ct").iterdir():
            one.rename(folder / one.name)
        target, image = run.scene.target, run.image.grid
        grid = Grid.of(target - (330, 240, 400), target + (330, 240, 400), 2.5)
        body = filled(run.scene.skin, grid)
        foreign, limbs = np.zeros(grid.shape, bool), np.zeros(grid.shape, bool)
        for one in filter(is_outer, run.scene.outside_objects):
            mask = filled(one.mesh, grid) & ~body
            foreign |= mask
            if one.name.startswith("arm"):
                limbs |= mask
        shown = Grid(image.T_ct_index[:3, 3], np.asarray(image.spacing_mm), image.shape)
        structures = {one.name: filled(one.mesh, grid) for one in truth.anatomy.structures if one.demands_margin}
        return Scene(grid, shown, body, foreign, structures, target, limbs=limbs, lies_unseen=bed == "none")

    return make


# --- real CTs ---------------------------------------------------------------------------------------------------------


def abdomen(target, low=None, high=None, step=None) -> Callable[[Path, Path | None], Scene]:
    """The real abdomen between two heights, mm, as it is or on finer steps, with its v2 labels and noise of 12 HU."""

    def make(folder: Path, data: Path | None) -> Scene:
        source = data / "totalseg_abdomen_3mm"
        hu, labels, grid = _pair(source / "ct.nii.gz", source / "labels_v2_fast.nii.gz")
        if step is not None:
            factor = grid.step / step
            hu = ndimage.zoom(hu.astype(np.float32), factor, order=1, grid_mode=False)
            sizes = zip(labels.shape, hu.shape, strict=True)
            labels = labels[np.ix_(*(np.round(np.linspace(0, n - 1, m)).astype(int) for n, m in sizes))]
            real = grid.step * (np.array(grid.shape) - 1) / (np.array(hu.shape) - 1)
            grid = Grid(grid.low, real, hu.shape)
        z = grid.low[2] + grid.step[2] * np.arange(grid.shape[2])
        kept = np.flatnonzero((z >= (low or -1e9)) & (z < (high or 1e9)))
        hu, labels = hu[..., kept], labels[..., kept]
        grid = Grid(np.array([*grid.low[:2], z[kept[0]]]), grid.step, hu.shape)
        hu = hu + np.random.default_rng(0).normal(0.0, 12.0, hu.shape)
        write_nifti(folder / "ct.nii.gz", np.round(hu).astype(np.int16), _matrix(grid))
        write_nifti(folder / "labels.nii.gz", labels.astype(np.uint8), _matrix(grid))
        names = json.loads((source / "labels_v2_fast.json").read_text())
        (folder / "labels.json").write_text(json.dumps(names))
        start(folder, target)
        return _real(hu, labels, {name: int(number) for number, name in names.items()}, grid, target, GASES)

    return make


GASES = ("lung", "stomach", "bowel", "colon", "duodenum", "esophagus", "trachea")
COLUMNS = ("cervical vertebral column", "thoracic vertebral column", "lumbar vertebral column")
CHEST = {name: number for number, name in enumerate(("ribs", *COLUMNS, "right lung", "left lung", "tissue"), start=1)}
CHEST_CASE = """schema = 2
region = "chest"
name = "chest"
space = "LPS"

[target]
position_mm = {target}
structure = "{holds}"

{asked}
[[structure]]
name = "skin"
ct = "CTChest4.nrrd"
role = "skin"

[[structures]]
labelmap = "Segmentation.seg.nrrd"
target = ["{holds}"]
{crossed}avoid = {{ "ribs" = 1, "*vertebral column" = 2, {lungs} }}

[end]
structures = 8
"""


def chest(target, holds: str) -> Callable[[Path, Path | None], Scene]:
    """The real chest, with a case written by hand; the lungs that do not hold the target are avoided."""

    def make(folder: Path, data: Path | None) -> Scene:
        source = data / "slicer_chest_ct4"
        for name in ("CTChest4.nrrd", "Segmentation.seg.nrrd"):
            (folder / name).write_bytes((source / name).read_bytes())
        lungs = ", ".join(f'"{one}" = 2' for one in ("right lung", "left lung") if one != holds)
        crossed = "" if holds == "tissue" else 'traverse = ["tissue"]\n'
        named = {"target": list(target), "holds": holds, "crossed": crossed, "lungs": lungs}
        text = CHEST_CASE.format(**named, asked=NEEDLE + "\n" + SEARCH)
        (folder / "case.toml").write_text(text, encoding="utf-8")
        hu, labels, grid = _pair(source / "CTChest4.nrrd", source / "Segmentation.seg.nrrd")
        return _real(hu, labels, CHEST, grid, np.array(target), ("lung",))

    return make


def _pair(ct: Path, labels: Path):
    """Hounsfield units and labels on the CT's grid, axes along LPS."""
    one, other = (canonical(volume.values, volume.T_ct_index) for volume in map(read_volume, (ct, labels)))
    T = one.T_ct_index
    grid = Grid(T[:3, 3].copy(), np.diag(T)[:3].copy(), one.values.shape)
    offset = np.round((other.T_ct_index[:3, 3] - grid.low) / grid.step).astype(int)
    found = np.zeros(grid.shape, np.uint8)
    found[tuple(slice(o, o + n) for o, n in zip(offset, other.values.shape, strict=True))] = other.values
    return np.asarray(one.values), found, grid


def _real(hu, labels, names, grid: Grid, target, gases) -> Scene:
    """What can be known of a real image, by the simple means of the module's first lines."""
    ball = np.ceil(6.0 / grid.step).astype(int)
    axes = (np.arange(-n, n + 1) * s for n, s in zip(ball, grid.step, strict=True))
    rod = np.linalg.norm(np.stack(np.meshgrid(*axes, indexing="ij")), axis=0) <= 6.0
    dense = np.pad(hu > -300, [(n, n) for n in ball], mode="edge")
    opened = ndimage.binary_opening(dense, rod)[tuple(slice(n, -n) for n in ball)] | (labels > 0)
    parts, _ = ndimage.label(opened)
    body = parts == np.bincount(parts[parts > 0]).argmax()
    for k in range(body.shape[2]):
        body[..., k] = ndimage.binary_fill_holes(body[..., k])
    near = ndimage.binary_dilation(body, iterations=2)
    foreign = _large((hu > -300) & ~near, 200.0, grid)
    named = ndimage.binary_dilation(np.isin(labels, [n for one, n in names.items() if one != "tissue"]))
    gas = ndimage.binary_dilation(np.isin(labels, [n for one, n in names.items() if any(g in one for g in gases)]))
    inner = ndimage.binary_erosion(body, iterations=2)
    doubtful = _large((hu >= 200) & body & ~named, 100.0, grid) | _large((hu < -300) & inner & ~gas, 100.0, grid)
    masks = {name: labels == number for name, number in names.items()}
    unscanned = hu < -1500
    return Scene(
        grid,
        grid,
        body,
        foreign,
        masks,
        np.asarray(target, float),
        doubtful=doubtful,
        unscanned=unscanned if unscanned.any() else None,
        real=True,
        lies_unseen=True,
    )


def _large(mask, mm3: float, grid: Grid):
    parts, count = ndimage.label(mask)
    sizes = np.bincount(parts.ravel(), minlength=count + 1) * np.prod(grid.step)
    sizes[0] = 0.0
    return (sizes >= mm3)[parts]


def _scan(spacing=2.5, pixel=2.0, noise=15.0, seed=0, fov=None, length=180.0) -> ScanSettings:
    return ScanSettings(spacing, pixel, noise, seed=seed, fov_mm=fov, length_mm=length)


LIVER_SIDE, LIVER_FRONT, PSOAS = (-110, -131, 352), (-8, -233, 382), (106, -194, 157)
IMAGES = (
    Image("abdomen_liver_side", abdomen(LIVER_SIDE), real=True),
    Image("abdomen_liver_front", abdomen(LIVER_FRONT), real=True),
    Image("abdomen_psoas", abdomen(PSOAS), real=True),
    Image("abdomen_head_third", abdomen((-41, -224, 397), low=318), real=True),
    Image("abdomen_middle_third", abdomen((-122, -119, 226), low=206, high=318), real=True),
    Image("abdomen_feet_third", abdomen((-26, -200, 145), high=206), real=True),
    Image("chest_front", chest((25.5, -60.9, -250.2), "tissue"), real=True),
    Image("chest_lung", chest((-56.7, -24.3, -220.2), "right lung"), real=True),
    *(
        Image(f"{name}_{where}", phantom(name, where == "table"), arms=None)
        for name in BLOCKS
        for where in ("air", "table")
    ),
    Image("torso_cradle", cradled),
    Image("trunk1_up_flat", drawn(1, "none", "flat", 0, _scan(seed=1))),
    Image("trunk1_beside_none", drawn(1, "beside", "none", 3, _scan(3.0, 2.5, 20.0, 2)), arms="present"),
    Image(
        "trunk1_pressed_curved",
        drawn(1, "pressed", "curved", 0, _scan(3.0, 2.5, 20.0, 3)),
        ambiguous=True,
        arms="present",
    ),
    Image("trunk2_up_none", drawn(2, "none", "none", 2, _scan(3.0, 2.5, 20.0, 4))),
    Image("trunk2_across_pad", drawn(2, "across", "pad", 0, _scan(4.0, 3.0, 20.0, 5)), ambiguous=True, arms="present"),
    Image("trunk3_up_narrow", drawn(3, "none", "curved", 0, _scan(3.0, 2.0, 20.0, 6, fov=300.0)), ambiguous=True),
    Image("trunk3_beside_flat", drawn(3, "beside", "flat", 2, _scan(seed=7)), arms="present"),
    Image("abdomen_fine_liver", abdomen(LIVER_SIDE, step=(0.78, 0.78, 1.0)), fine=True, real=True),
    Image("abdomen_fine_psoas", abdomen(PSOAS, step=(0.78, 0.78, 1.0)), fine=True, real=True),
    Image("trunk2_fine_beside", drawn(2, "beside", "flat", 2, _scan(1.5, 0.9, 25.0, 8)), fine=True, arms="present"),
)
