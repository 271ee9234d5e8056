"""The page's slices: one block of the CT about target and entries, and how to draw a needle there.

A script of the page (``slices.js``) cuts it and the surfaces in any plane, as `slices.panel` does for ``slices.png``.
"""

import gzip
import io
import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.reasons import css
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.search.bedside import slice_numbers
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.twin.report.page.page_surfaces import LEVEL, Packed, surfaces
from puncture_twin.twin.report.palette import SKIN
from puncture_twin.twin.report.slices.panel import BESIDE, KNOTS_BYTE, KNOTS_HU, TONES, Subject, stored
from puncture_twin.twin.report.slices.planes import letters, toward_text

AROUND_MM = 60.0  # what the block holds beyond target and entries, to every side
FINE_MM = 1.0  # where the CT's own voxels do not fit the page, finer ones become means over this
MOST_CT, MOST_TOGETHER = 1_600_000, 2_800_000  # bytes of packed CT; with surfaces: 3.7 MB in base64
MOST_VOXELS = 30_000_000  # a browser holds a byte for each; more of them are not tried as they are
SAMPLE = 16  # slices by which it is seen at once that all will not fit
WORST, BEST = 15, 95  # qualities of a JPEG. Below the first, edges ring; then voxels grow by a quarter
STRIP = 4096  # rows of a JPEG at most: browsers on phones read no larger canvas
JPEG_BLOCK = 8  # rows of a slice are filled up to a multiple, so that no block of the JPEG holds two slices
SOFT_HU = (-160.0, 240.0)  # where the page states the error of a lossy CT


def slices_data(
    subject: Subject, candidates: Candidates, picked: int, regions_ct: Floats | None
) -> tuple[dict[str, Any], bytes, bytes]:
    """Data of the page's slices: facts, and the bytes of CT and surfaces.

    Entries of the search's candidates say how far the block reaches; `picked` is the direction's row on the page. The
    regions of the tip are (n, 3, 3), mm^2, NaN where not known; None without declared errors.
    """
    case, anatomy = subject.case, subject.anatomy
    box = block_box(case.target_ct, candidates)
    skin = ("skin", "skin", anatomy.skin.mesh)
    shapes = surfaces([*((one.name, str(one.role), one.mesh) for one in anatomy.checked), skin], case.target_ct, box)
    ct = numbers = None
    if anatomy.scan is not None:
        of_point, count = slice_numbers(anatomy.scan.grid)
        numbers = [of_point.tolist(), count]
        hu, T_ct_index = anatomy.scan.measured
        ct = ct_block(hu, T_ct_index, box, min(MOST_CT, MOST_TOGETHER - len(shapes.content)))
    colours = {**subject.colours, "skin": SKIN}
    for one in shapes.facts["parts"]:
        one |= {"colour": css(colours[one["name"]]), "target": one["name"] == case.target_structure}
    axes = np.concatenate([np.eye(3), 0.0 - np.eye(3)])
    bent = None if picked < 0 or subject.bent_mm is None else np.round(subject.bent_mm, 2).tolist()
    facts = {
        "ct": None if ct is None else ct.facts,
        "box": np.round(box - case.target_ct, 3).tolist(),
        "surfaces": shapes.facts,
        "knots": [KNOTS_HU, KNOTS_BYTE],
        "tones": dict(TONES),
        "letters": [[letters(case.space, one), toward_text(case.space, one), one.tolist()] for one in axes],
        "needle": {"shaft": case.needle.shaft_mm, "radius": case.needle.radius_mm},
        "numbers": numbers,
        "catalogue": [[mm, case.needle.of_length(mm).longest_path_mm] for mm in sorted(case.needle.lengths_mm)],
        "names": {name: text for name, (text, _) in BESIDE.items()},
        "bent": {} if bent is None else {picked: bent},
        "regions": {} if regions_ct is None else _regions(regions_ct, picked, subject.region_ct),
        "margins": {
            name: float(mm)
            for searched in (candidates, *(() if subject.pick is None else (subject.pick.candidates,)))
            for name, mm in zip(searched.clearance.structures, searched.clearance.margins, strict=True)
            if np.isfinite(mm)
        },
    }
    return facts, b"" if ct is None else ct.content, shapes.content


def _regions(regions_ct: Floats, picked: int, of_picked: Floats | None) -> dict[int, list[float]]:
    """The upper triangle of each direction's region, mm^2; of the picked one as it is planned."""
    upper = np.triu_indices(3)
    known = np.flatnonzero(np.isfinite(regions_ct).all(axis=(1, 2)))
    regions = dict(zip(known.tolist(), np.round(regions_ct[known][:, *upper], 3).tolist(), strict=True))
    return regions if of_picked is None else regions | {picked: np.round(of_picked[upper], 3).tolist()}


def block_box(target_ct: Floats, candidates: Candidates) -> Floats:
    """Box of the block, (2, 3), mm, about target, the safe entries, or all if none is, and `AROUND_MM` about them."""
    entries = candidates.path.entry_ct[candidates.safe if candidates.safe.any() else slice(None)]
    points = np.concatenate([np.asarray(target_ct)[None], entries[np.isfinite(entries).all(axis=1)]])
    return np.stack([points.min(axis=0) - AROUND_MM, points.max(axis=0) + AROUND_MM])


def ct_block(hu: NDArray[Any], T_ct_index: Floats, box_ct: Floats, most: int = MOST_CT) -> Packed:
    """The CT in a box, in bytes of `stored`: its own voxels without loss, or where these are too many as JPEG.

    Voxels of a JPEG are means over at least `FINE_MM`; its quality is the best that fits. HU (nx, ny, nz), voxel index
    to LPS mm (4, 4), and the box's low and high corner (2, 3), mm.
    """
    corners = np.array(list(itertools.product(*box_ct.T)))
    index = apply(np.linalg.inv(T_ct_index), corners)
    low = np.clip(np.floor(index.min(axis=0)), 0, hu.shape).astype(int)
    high = np.clip(np.ceil(index.max(axis=0)) + 1, 0, hu.shape).astype(int)
    part = hu[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
    spacing = np.linalg.norm(T_ct_index[:3, :3], axis=0)
    factor, packed = np.ones(3), None
    middle = max(0, part.shape[2] - SAMPLE) // 2
    sample = _exact(stored(part[:, :, middle : middle + SAMPLE])).content
    if part.size <= MOST_VOXELS and len(sample) * part.shape[2] < 2 * SAMPLE * most:
        packed = _exact(stored(part))
    grain = FINE_MM
    while packed is None or len(packed.content) > most:
        factor = np.clip(grain / spacing, 1.0, np.maximum(1, part.shape))
        packed = _lossy(stored(_means(part, factor)), most)
        grain *= 1.25
    T_index_block = np.diag([*factor, 1.0])
    T_index_block[:3, 3] = low + (factor - 1) / 2
    T = T_ct_index @ T_index_block
    facts = {
        **packed.facts,
        "T": T[:3].ravel().tolist(),
        "image": [
            ((edge - T_index_block[:3, 3]) / factor).tolist() for edge in (np.full(3, -0.5), np.array(hu.shape) - 0.5)
        ],
        "voxel_mm": np.round(spacing, 3).tolist(),
        "shown_mm": np.round(spacing * factor, 3).tolist(),
    }
    return Packed(facts, packed.content)


def _exact(values: NDArray[np.uint8]) -> Packed:
    """Bytes less the mean of their three neighbours before, x fastest: they pack to two thirds."""
    padded = np.pad(values, ((1, 0),) * 3).astype(np.int16)
    before = (padded[:-1, 1:, 1:] + padded[1:, :-1, 1:] + padded[1:, 1:, :-1]) // 3
    content = (values - before).astype(np.uint8).transpose(2, 1, 0).tobytes()
    return Packed({"shape": values.shape}, gzip.compress(content, LEVEL, mtime=0))


def _means(values: NDArray[Any], factor: Floats) -> NDArray[Any]:
    """Means over so many voxels along each axis, also parts of voxels; a rest at the end is left out."""
    for axis, (step, count) in enumerate(zip(factor, values.shape, strict=True)):
        if step > 1.0:
            start, voxel = step * np.arange(int(count / step + 1e-9))[:, None], np.arange(count)
            shared = np.minimum(start + step, voxel + 1) - np.maximum(start, voxel)
            weights = (np.maximum(shared, 0.0) / step).astype(np.float32)
            values = np.moveaxis(np.tensordot(weights, values.astype(np.float32), (1, axis)), 0, axis)
    return values


def _lossy(values: NDArray[np.uint8], most: int) -> Packed:
    """Slices below one another as grey JPEGs, of the best quality that takes no more than so many bytes.

    The facts hold each JPEG's bytes, slices and mean, by which a browser that alters pictures is found out, and the
    errors: rms in bytes; rms and greatest where the CT has `SOFT_HU`.
    """
    slices = np.pad(values.transpose(2, 1, 0), ((0, 0), (0, -values.shape[1] % JPEG_BLOCK), (0, 0)), mode="edge")
    each = max(1, STRIP // slices.shape[1])
    strips = [slices[k : k + each].reshape(-1, slices.shape[2]) for k in range(0, len(slices), each)]
    low, high = WORST, BEST
    while low < high:
        middle = (low + high + 1) // 2
        fits = sum(len(_jpeg(one, middle)) for one in strips) <= most
        low, high = (middle, high) if fits else (low, middle - 1)
    packed = [_jpeg(one, low) for one in strips]
    shown = [np.asarray(Image.open(io.BytesIO(one))) for one in packed]
    decoded = np.concatenate(shown).reshape(slices.shape)[:, : values.shape[1]].transpose(2, 1, 0)
    hu_of = np.interp(np.arange(256), KNOTS_BYTE, KNOTS_HU).astype(np.float32)
    true = hu_of[values]
    soft = (hu_of[decoded] - true)[(true > SOFT_HU[0]) & (true < SOFT_HU[1])]
    facts = {
        "shape": values.shape,
        "strips": [
            [len(one), len(rows) // slices.shape[1], rows.mean()] for one, rows in zip(packed, shown, strict=True)
        ],
        "rows": slices.shape[1],
        "rms_bytes": float(np.sqrt(np.square(decoded - values.astype(np.float32)).mean())),
        "rms_hu": float(np.sqrt(np.square(soft).mean())) if len(soft) else 0.0,
        "worst_hu": float(np.abs(soft).max(initial=0.0)),
    }
    return Packed(facts, b"".join(packed))


def _jpeg(rows: NDArray[np.uint8], quality: int) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(rows).save(stream, "JPEG", quality=quality, optimize=True)
    return stream.getvalue()
