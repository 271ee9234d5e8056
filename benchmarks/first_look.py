"""How long the first look at a scan takes, and for what: ``python -m benchmarks.first_look``.

`init` and then `search` run each in a new process, with an empty cache folder and compiled kernels. A row is processor
time (user and system, all threads) of the innermost of what was going on. Beside it, in the same run, stands the floor:
reading both files and marching cubes in the box of every label, without which nobody can look; and the most memory that
was in use. With ``--growth``: how the time of `init` grows when voxels, labels or triangles are doubled. With
``--batch``: what ten targets in one CT take as a cohort, beside one, with nothing kept and again.

The scans: the abdomen at .78 x .78 x 1.0 mm, where the shared data are on this machine, and two that are drawn here,
with a seed: ellipsoids, ribs and a table, of 512 x 512 x 133 voxels with 89 labels and 512 x 512 x 600 with 100.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from math import log2
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import SimpleITK
from numpy.typing import NDArray
from skimage.measure import marching_cubes

from benchmarks import wait_probe
from benchmarks.shared import options
from puncture_twin.planning.formats.labels.labelmaps import labelmap_of
from puncture_twin.planning.formats.labels.naming import V2
from puncture_twin.planning.formats.volumes.volume_files import read_volume

REPOSITORY = Path(__file__).resolve().parents[1]
MAKER = REPOSITORY.parent / "shared" / "cases" / "make_cases.py"

STAGES = {
    "planning.formats.volumes.volume_files": {"VolumeFile.volume": "reading"},
    "planning.base.provenance": {"InputFiles.read": "reading", "InputFiles.content": "reading"},
    "planning.formats.dicom.ct_series": {"CtSeries.volume": "reading"},
    "planning.init.finder": {"volume_kind": "kind of file"},
    "planning.anatomy.body.body_mask": {"ct_image": "CT in order", "find_unscanned": "unscanned", "body_mask": "body"},
    "planning.anatomy.body.cut_ends": {"content_of": "ends", "cut_ends": "ends"},
    "planning.anatomy.skin": {"skin_of_image": "skin", "skin_from_label": "skin"},
    "planning.formats.labels.labelmaps": {"label_mesh": "label surfaces"},
    "planning.init.segmentation": {"carved_notes": "what goes round"},
    "planning.anatomy.scan": {"Scan.outside": "outside", "Scan.attached_limbs": "limbs", "Scan.unnamed": "unnamed"},
    "planning.anatomy.unseen": {"beyond_labels": "beyond labels"},
    "planning.evidence.checks": {"findings": "evidence"},
    "planning.clearance.fast_engine": {"_packed": "engine's blocks", "_remembered": "engine's blocks"},
    "planning.search.search": {"search": "search"},
}
"""By module: what of it is timed under which row; a name that a checkout lacks is left out."""
WIDE_MM, ACROSS = 400.0, 512
TRUNK_MM = (165.0, 112.0)
AIR_HU, FAT_HU, SOFT_HU, BONE_HU, LUNG_HU, TABLE_HU, NOISE_HU = -1000, -95, 45, 420, -860, -250, 12
WALL_MM, INNER_HU = 26.0, 46
"""Nothing that is drawn lies so near to the skin: a thinner wall about a lung would count as a sheet."""
SEED = 7
APART_MM = 6.0
"""So far from the first the other targets of a batch lie, along each axis."""


@dataclass(frozen=True)
class Scan:
    """A folder with a CT and labels, and the options of `init` that name the target."""

    folder: Path
    target: tuple[str, ...]


class Drawn(NamedTuple):
    """A scan that is drawn here; `size` is a multiple of the usual of small organs: triangles grow with its square."""

    slices: int
    step_mm: float
    labels: int
    size: float = 1.0
    across: int = ACROSS

    @property
    def length_mm(self) -> float:
        """Along the bed."""
        return self.slices * self.step_mm


DRAWN = {"trunk_133": Drawn(133, 2.5, 89), "trunk_600": Drawn(600, 1.0, 100)}
SMALL = Drawn(150, 2.0, 40, across=384)
GROWN = {
    "voxels": SMALL._replace(slices=300, step_mm=1.0),
    "labels": SMALL._replace(labels=80),
    "triangles": SMALL._replace(size=2**0.5),
}
"""`SMALL` with twice as many of each; a finer scan has more triangles too."""


class Ellipsoid(NamedTuple):
    """A part of the drawn body: its middle and half axes, mm, from the middle of the image."""

    middle: tuple[float, float, float]
    half: tuple[float, float, float]
    hu: float


def drawn(folder: Path, scan: Drawn) -> Scan:
    """Write a trunk on a table, with labels numbered as TotalSegmentator's."""
    folder.mkdir(exist_ok=True)
    rng = np.random.default_rng(SEED)
    hu = np.full((scan.slices, scan.across, scan.across), AIR_HU, np.int16)
    labels = np.zeros(hu.shape, np.uint8)
    spacing = np.array([scan.step_mm, WIDE_MM / scan.across, WIDE_MM / scan.across])
    origin = -(np.array(hu.shape) - 1) / 2 * spacing
    z, y, x = (o + s * np.arange(n) for o, s, n in zip(origin, spacing, hu.shape, strict=True))
    for k, at in enumerate(z):  # no two slices are alike, as of a patient
        waist = 1.0 - 0.12 * (2 * at / scan.length_mm) ** 2 + 0.03 * np.sin(at / 17.0)
        for rim_mm, value in ((0.0, FAT_HU), (9.0, SOFT_HU), (WALL_MM, INNER_HU)):
            half = np.array(TRUNK_MM) * waist - rim_mm
            hu[k][np.hypot(x / half[0], (y / half[1])[:, None]) < 1.0] = value
    hu[:, (y > TRUNK_MM[1] + 12.0) & (y < TRUNK_MM[1] + 36.0), across_table(x)] = TABLE_HU
    within = hu == INNER_HU
    names = [name for name in V2.values() if name != "skull"][: scan.labels]
    numbers = {name: number for number, name in V2.items()}
    for name in names:
        for part in parts_of(name, scan, rng):
            draw(part, (z, y, x), hu, labels, numbers[name], within)
    hu += np.rint(rng.standard_normal(hu.shape, np.float32) * NOISE_HU).astype(np.int16)
    for file, values in (("ct", hu), ("labels", labels)):
        image = SimpleITK.GetImageFromArray(values)
        image.SetSpacing(spacing[::-1].tolist())
        image.SetOrigin(origin[::-1].tolist())
        SimpleITK.WriteImage(image, str(folder / f"{file}.nii.gz"), useCompression=True, compressionLevel=1)
    lines = [f"{numbers[name]},{name}" for name in names]
    (folder / "labels.csv").write_text("\n".join(["id,name", *lines, ""]))
    return Scan(folder, ("--target-label", "liver"))


def across_table(x: NDArray[np.float64]) -> slice:
    """The columns that a table covers."""
    inside = np.flatnonzero(np.abs(x) < 0.45 * WIDE_MM)
    return slice(int(inside[0]), int(inside[-1]) + 1)


def parts_of(name: str, scan: Drawn, rng: np.random.Generator) -> Iterator[Ellipsoid]:
    """What one structure is made of, of a scan that is ``length_mm`` long."""
    half = scan.length_mm / 2
    if name == "liver":
        yield Ellipsoid((-70.0, -15.0, 0.0), (62.0, 68.0, 0.35 * half), 110)
    elif name.startswith("lung"):
        side = 1.0 if name.endswith("left") else -1.0
        low = "lower" in name
        middle = (side * 75.0, 25.0 if low else -25.0, half * (0.62 if low else 0.75))
        yield Ellipsoid(middle, (52.0, 55.0, 0.3 * half), LUNG_HU)
    elif name.startswith("vertebrae"):
        yield Ellipsoid((0.0, 62.0, rng.uniform(-0.95, 0.95) * half), (24.0, 20.0, 14.0), BONE_HU)
    elif name.startswith("rib"):
        side, at = (1.0 if "left" in name else -1.0), rng.uniform(-0.7, 0.85) * half
        for angle in np.linspace(0.3, 2.6, 60):
            place = (side * 112.0 * np.sin(angle), 64.0 * np.cos(angle), at - 14.0 * angle)
            yield Ellipsoid(place, (6.0, 6.0, 5.0), BONE_HU)
    else:
        middle = (rng.uniform(-95, 95), rng.uniform(-60, 45), rng.uniform(-0.85, 0.5) * half)
        size = rng.uniform(16.0, 45.0, 3) * scan.size
        yield Ellipsoid(middle, tuple(size.tolist()), rng.uniform(20.0, 160.0))


def draw(
    part: Ellipsoid, axes: tuple[NDArray[np.float64], ...], hu: NDArray[Any], labels: NDArray[Any], number: int,
    within: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Fill the voxels of a part, in its box, as far as it lies within the trunk; axes run z, y, x."""
    middle, half = part.middle[::-1], part.half[::-1]
    box = tuple(slice(*np.searchsorted(a, (m - h, m + h))) for a, m, h in zip(axes, middle, half, strict=True))
    away = [((a[b] - m) / h) ** 2 for a, b, m, h in zip(axes, box, middle, half, strict=True)]
    inside = (away[0][:, None, None] + away[1][:, None] + away[2] < 1.0) & within[box]
    hu[box][inside], labels[box][inside] = part.hu, number


def makers(folder: Path) -> dict[str, Callable[[], Scan]]:
    """What writes each scan, by its name."""
    found: dict[str, Callable[[], Scan]] = {"abdomen_fine": partial(resampled, folder)} if MAKER.is_file() else {}
    return found | {name: partial(drawn, folder / name, scan) for name, scan in DRAWN.items()}


def resampled(folder: Path) -> Scan:
    """The real abdomen, on finer voxels."""
    subprocess.run([sys.executable, str(MAKER), str(folder), "abdomen_fine"], check=True, capture_output=True)
    return Scan(folder / "abdomen_fine", ("--target", "85,200,372"))


def floor(scan: Scan) -> dict[str, float]:
    """Processor seconds of what nobody can leave out: reading, and marching cubes in the box of every label."""
    start = wait_probe.used()
    read_volume(scan.folder / "ct.nii.gz")
    labels = labelmap_of(read_volume(scan.folder / "labels.nii.gz"))
    boxes = labels.boxes
    read = wait_probe.used() - start
    triangles = 0
    for label, box in boxes.items():
        mask = np.pad(labels.labels[box] == label, 1).astype(np.float32) - 0.5
        triangles += len(marching_cubes(mask, level=0.0, method="lorensen")[1])
    return {"reading": read, "marching cubes": wait_probe.used() - start - read, "triangles": float(triangles)}


class Run(NamedTuple):
    """Of one process: processor seconds by row, seconds of the clock, and the most memory, MB."""

    seconds: dict[str, float]
    clock: float
    memory_mb: float


def run(words: tuple[str, ...], kept: Path, answer: Path) -> Run:
    """One command in a new process."""
    code = "import sys; from benchmarks import first_look as f; f.wait_probe.FUNCTIONS = f.STAGES; f.wait_probe.main()"
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "PUNCTURE_TWIN_CACHE": str(kept)}
    start = time.perf_counter()
    with answer.with_suffix(".err").open("w+") as errors:
        command = [sys.executable, "-c", code, str(REPOSITORY), str(answer), *words]
        child = subprocess.Popen(command, env=environment, stderr=errors)
        _, status, used = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        errors.seek(0)
        found = json.loads(answer.read_text()) if child.returncode == 0 else {"exit_code": 3}
        if found["exit_code"] > 1:
            raise SystemExit(f"{' '.join(words)}: {errors.read()}")
    return Run(found["seconds"], time.perf_counter() - start, used.ru_maxrss / 1024.0)


def looked(scan: Scan, kept: Path, *, search: bool = True) -> tuple[Run, Run | None]:
    """`init` and `search` of a scan, with nothing kept before."""
    answer = kept.with_suffix(".json")
    first = run(("init", str(scan.folder), "--space", "RAS", "--force", *scan.target), kept, answer)
    words = ("search", str(scan.folder), "--no-arm", "--no-pictures", "--out", str(kept.with_suffix(".out")))
    return first, run(words, kept, answer) if search else None


def print_table(name: str, scan: Scan, folder: Path) -> None:
    """A row a stage, and the floor below."""
    first, then = looked(scan, folder / f"kept_{name}")
    assert then is not None  # it was asked for
    least = floor(scan)
    print(f"\n{name}, {least['triangles'] / 1e6:.2f} million triangles\n")
    print("| processor, s | init | search |\n|---|---|---|")
    for stage in dict.fromkeys((*first.seconds, *then.seconds)):
        values = [one.seconds.get(stage, 0.0) for one in (first, then)]
        if max(values) >= 0.05:
            print(f"| {stage} | {values[0]:.1f} | {values[1]:.1f} |")
    print(f"| by the clock | {first.clock:.1f} | {then.clock:.1f} |")
    print(f"| most memory, MB | {first.memory_mb:.0f} | {then.memory_mb:.0f} |")
    total = least["reading"] + least["marching cubes"]
    print(f"| floor (reading {least['reading']:.1f}, marching cubes {least['marching cubes']:.1f}) | {total:.1f} | |")
    print(f"| init / floor | {first.seconds['all'] / total:.2f} | |", flush=True)


def print_growth(folder: Path) -> None:
    """How `init` grows where one of the three is doubled: seconds ~ n^exponent."""
    base = looked(drawn(folder / "small", SMALL), folder / "kept_small", search=False)[0].seconds["all"]
    print(f"\n| doubled | init, s | exponent |\n|---|---|---|\n| nothing | {base:.1f} | |")
    for name, scan in GROWN.items():
        seconds = looked(drawn(folder / name, scan), folder / f"kept_{name}", search=False)[0].seconds["all"]
        print(f"| {name} | {seconds:.1f} | {log2(seconds / base):.2f} |", flush=True)


def print_batch(name: str, scan: Scan, folder: Path) -> None:
    """What ten targets in one CT take beside one, processor seconds of the whole command; cold, and once more."""
    looked(scan, folder / f"kept_{name}", search=False)
    target = tomllib.loads((scan.folder / "case.toml").read_text())["target"]["position_mm"]
    apart = np.random.default_rng(SEED).uniform(-APART_MM, APART_MM, (9, 3))
    targets = [target, *np.round(np.add(target, apart), 1).tolist()]
    print(f"\n| {name}, batch, processor s | one | ten | ratio |\n|---|---|---|---|")
    kept = {count: folder / f"kept_{name}_{count}" for count in (1, 10)}
    for state in ("cold", "warm"):
        seconds = [cohort(scan, targets[:count], kept[count], folder / f"{name}_{count}_{state}") for count in kept]
        print(f"| {state} | {seconds[0]:.1f} | {seconds[1]:.1f} | {seconds[1] / seconds[0]:.2f} |", flush=True)


def cohort(scan: Scan, targets: list[list[float]], kept: Path, out: Path) -> float:
    """Processor seconds of one worker's `batch run` of some targets."""
    listed = out.with_suffix(".toml")
    listed.write_text(f"cases = ['{scan.folder / 'case.toml'}']\ntargets = {targets}\n")
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "PUNCTURE_TWIN_CACHE": str(kept)}
    for words in (("plan", str(listed), "--no-arm"), ("run", "--jobs", "1")):
        before = wait_probe.used()
        command = [sys.executable, str(REPOSITORY / "run_twin.py"), "batch", *words, "--out", str(out)]
        ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        if ended.returncode:
            raise SystemExit(f"{' '.join(words)}: {ended.stderr}{ended.stdout}")
    return wait_probe.used() - before


def main() -> None:
    """Parse, run, print."""
    chosen = options(__doc__, only=str, growth=False, batch=False)
    only = None if chosen.only is None else set(chosen.only.split(","))
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        print(f"load of the machine {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors")
        for name, make in makers(folder).items():
            if only is None or name in only:
                scan = make()
                print_table(name, scan, folder)
                if chosen.batch:
                    print_batch(name, scan, folder)
        if chosen.growth:
            print_growth(folder)


if __name__ == "__main__":
    main()
