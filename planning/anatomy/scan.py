"""A cross-check by the CT of a case: what it shows outside of the body, and what inside that no structure names.

Outside: table, mattress, clothes, lines, limbs that nobody recognised, one closed surface for needle, holder and arm.
Inside: what is dense (a rib that a segmentation lost, a stent), and gas outside of what may hold gas (a loop of bowel
that nobody labelled). All of it is of role ``unknown``.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.body.body_mask import BODY_HU, CtImage
from puncture_twin.planning.anatomy.body.cut_ends import FieldOfView
from puncture_twin.planning.anatomy.body.limbs import LimbSearch, limb_search
from puncture_twin.planning.anatomy.body.tables import DRAWN_FRACTION, FACES, Face, TableSide, find_support
from puncture_twin.planning.anatomy.skin import Skin, field_of_view
from puncture_twin.planning.anatomy.structure import Structure
from puncture_twin.planning.anatomy.surfaces import Imaged, cached_mesh, mesh_arrays
from puncture_twin.planning.base.arrays import Bools, Floats, grown, widened
from puncture_twin.planning.base.cache.entry_file import Arrays
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.formats.guard import fits
from puncture_twin.planning.formats.labels.labelmaps import box_in, mask_surface
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid
from puncture_twin.planning.geometry.containment import contains
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.parts import in_blocks, mark_inside, parts_of, voxels_inside
from puncture_twin.planning.geometry.rigid import apply, pose

SMOOTH_MM = (3.0, 6.0, 9.0, 12.0)
"""Means over a cube of such an edge are compared with air, the first in which air is quiet enough, else the first."""
QUIET, THIN = 4.5, 3
"""Air is quiet whose median is below the limit by so many times what its lower quarter is below it: three deviations,
and what is denser makes no bulky piece. Foam does not move that quarter. Asked of every third voxel along each axis."""
LEAST_HU, DENSE_HU = -1024, -700.0
"""What is below counts as this in a mean: some scanners write less than air has. A single voxel above the second is no
noise (ten times that of a low-dose image)."""
MIN_PIECE_MM3, MIN_SOFT_MM3, SOLID_HU = 100.0, 500.0, -250.0
"""Pieces that hold less above ``BODY_HU`` are noise, or cloth; where nothing in them is solid, less than the second. A
line of 4 mm has the first in 8 mm of its length, between voxels of 3 mm the second in 30. A gown on the skin of a real
chest has -850, and -260 in its folds; so has a line of 2 mm, or with a bore: it is not seen."""
BULKY_ML = 50.0
"""Pieces of this volume that the border cuts go on beyond it, also between the places where they are cut: of a table
that sags below the image both ends are seen."""
BEYOND_MM, BEYOND_LONG_MM = (100.0, 100.0, 2000.0), (100.0, 100.0, 1000.0)
"""So far what the border cuts goes on to the sides, to front and back, and along the bed: a CT table is at most 550 mm
wide and an image at least 350; along the bed it goes on farther than a needle reaches. The second where an image is so
long that the surface would be larger than any that is plausible."""
CUT_AT_MM = (30.0, 120.0, 480.0)
"""Along the bed it is cut across there: a triangle as long as all of it would lie near every needle."""
BLOCK_MM = 2.0
"""The surface is drawn about blocks of at most this edge that hold any of it, or lie less than half a block beside it:
means have no finer shape, and a table of .8 mm voxels has a million triangles."""
RISES_OVER_MM, STEEPEST, ON_AN_ARC = 20.0, 2.0, 2.25
"""How steeply a cradle rises at the border is seen so far from it; a larger step is that of another piece. Where it
rises at 40 degrees, an arc's chord up to 75 is so much steeper."""
RIM_MM = 50.0
"""Where what is dense ends at voxels that were not scanned, they count as dense so far from it."""


@dataclass(frozen=True, eq=False)
class OutsideImage:
    """A CT (nx, ny, nz), HU, its body, and what was not measured; axes running to the left, back and head."""

    hu: NDArray[Any]  # shape (nx, ny, nz), Hounsfield units
    body: Bools
    unscanned: Bools
    T_ct_index: Floats  # shape (4, 4), voxel index to LPS mm
    spacing_mm: Floats
    slopes: tuple[float, float] = (0.0, 0.0)
    """How what lies there moves along axes 0 and 1 beyond the image's ends, mm per mm along the bed."""
    beyond_mm: tuple[float, float, float] = BEYOND_MM
    """How far what the border cuts is taken to go on."""


def outside_mask(image: OutsideImage, air_hu: float) -> Bools:
    """Voxels outside of the body whose surroundings are denser than a limit.

    Beside the body's surface they are partly skin, partly air; there only what is denser than half of both counts.
    """
    hu, body, unscanned = image.hu, image.body, image.unscanned
    for edge_mm in (*SMOOTH_MM, SMOOTH_MM[0]):
        size = np.maximum(1, np.round(edge_mm / image.spacing_mm)).astype(int)
        means = scipy.ndimage.uniform_filter(np.maximum(hu, LEAST_HU), size, np.float32, mode="nearest")
        away = ~widened(body, size // 2 + 1)
        air = means[::THIN, ::THIN, ::THIN][(away & ~unscanned)[::THIN, ::THIN, ::THIN]]
        air = air[air < DENSE_HU]
        if air.size and (1.0 + QUIET) * np.median(air) - QUIET * np.percentile(air, 25) <= air_hu:
            break
    dense = away & ((means > air_hu) | (hu > max(DENSE_HU, air_hu)))
    dense |= (hu > BODY_HU) & ~body
    if not unscanned.any():
        return _stiff_pieces(dense, hu, image.spacing_mm)
    dense = _stiff_pieces(dense & ~unscanned, hu, image.spacing_mm)
    ends = widened(dense | body, (1, 1, 1)) & unscanned
    dense |= widened(ends, np.ceil(RIM_MM / image.spacing_mm).astype(int)) & unscanned
    padded = unscanned & ~unscanned.all(axis=2, keepdims=True)
    if (widened(body, (1, 1, 1)) & padded).any():  # beyond what is no circle's outside the image ends, as at a face
        dense |= padded
    dense &= ~body
    return dense


def outside_surface(
    image: OutsideImage, mask: Bools, open_faces: Sequence[Face] = (), *, where: str | Path
) -> TriangleMesh | None:
    """The closed surface of what is dense outside of the body, LPS mm; None where there is only air.

    Where the border of the image cuts it, it goes on beyond: every cut section is drawn out by ``beyond_mm``, and of
    bulky pieces also what lies between cut sections at one side. A cradle goes on rising: what is drawn out of it is a
    wedge from its back on. So does all that lies beyond an open face.
    """
    edge = np.maximum(1, (BLOCK_MM / image.spacing_mm).astype(int))
    # A surface bevels the corners of its blocks. So what it holds lies half a block deep: no voxel in a corner is lost.
    blocks, pads = in_blocks(widened(mask, edge // 2), edge) > 0, [(len(layers),) * 2 for layers in _layers_mm(image)]
    layered = np.pad(blocks, pads, mode="edge")
    seen = in_blocks(mask & ~image.unscanned, edge) > 0
    bulky = _bulky(seen, edge * image.spacing_mm)
    for axis, end in FACES:
        cut: Bools = np.asarray(bulky.take(end, axis=axis))
        between = np.maximum.accumulate(cut) & np.maximum.accumulate(cut[::-1])[::-1]
        others, count = [pads[other] for other in (1 - axis, 2)], pads[axis][0]
        beyond = np.moveaxis(layered, axis, 0)[-count:] if end else np.moveaxis(layered, axis, 0)[:count]
        beyond |= np.pad(between, others, mode="edge") | ((axis, end) in open_faces)
    if not layered.any():
        return None
    T_blocks_layered = pose(np.eye(3), [-float(count) for count, _ in pads])
    solid = bulky & (in_blocks(image.hu > DENSE_HU, edge) > 0)  # not what lies beyond a table's back
    arcs = [_arc(solid, end, edge * image.spacing_mm) for end in (0, -1)]
    return _drawn_out(mask_surface(layered, T_blocks_layered, where=where), edge, image, arcs)


def _arc(solid: Bools, end: int, block_mm: Floats) -> tuple[Floats, float]:
    """How solid pieces (nx, ny, nz) go on at one end of axis 0.

    By block along the bed (nz,) the block in which their back lies at the border; and how much it rises toward the
    front, mm per mm to the side.
    """
    steps = min(max(1, round(RISES_OVER_MM / block_mm[0])), len(solid) - 1)
    columns = solid[::-1][: steps + 1] if end else solid[: steps + 1]
    backs = columns.shape[1] - 1.0 - columns[:, ::-1].argmax(axis=1)
    level = np.abs(np.diff(backs, axis=0)) * block_mm[1] <= STEEPEST * block_mm[0]
    one = np.asarray(np.concatenate([columns.any(axis=1), level]).all(axis=0))
    if np.count_nonzero(one) < max(1.0, DRAWN_FRACTION * columns[0].any(axis=0).sum()):
        return backs[0], 0.0
    risen_mm = float(np.median((backs[-1] - backs[0])[one])) * block_mm[1]
    back = np.where(one, backs[0], np.median(backs[0, one]))
    return back, ON_AN_ARC * max(risen_mm, 0.0) / (steps * block_mm[0])


def _layers_mm(image: OutsideImage) -> tuple[tuple[float, ...], ...]:
    """How far beyond its border voxels' centres layers of blocks continue an image, along each axis, to the end."""
    to_side, to_back, along = image.beyond_mm
    return (float(image.spacing_mm[0]), to_side), (float(image.spacing_mm[1]), to_back), (*CUT_AT_MM, along)


def _drawn_out(
    surface: TriangleMesh, edge: NDArray[np.int_], image: OutsideImage, arcs: Sequence[tuple[Floats, float]]
) -> TriangleMesh:
    """A surface that counts blocks of ``edge`` voxels, in LPS mm; layers beyond the border moved outward with the bed.

    Those beyond a side, where a cradle rises, in front of its back to the front. Every vertex lies on a face between
    two blocks; caps half a voxel after the last layer's centre.
    """
    index = surface.vertices.copy()
    for axis, layers_mm in enumerate(_layers_mm(image)):
        size = image.hu.shape[axis]
        at = np.arange(0, size, edge[axis])  # first voxels of blocks
        beyond = np.array([*range(1, len(layers_mm) + 1), len(layers_mm) + 0.5])
        moved = np.array([*layers_mm, layers_mm[-1] + 0.5 * image.spacing_mm[axis]]) / image.spacing_mm[axis]
        last, ends = len(at) - 1.0, [(min(edge[axis], size) - 1) / 2.0, (at[-1] + size - 1) / 2.0]  # border centres
        index[:, axis] = np.interp(
            index[:, axis],
            np.concatenate([-beyond[::-1], [0.0], np.arange(last) + 0.5, [last], last + beyond]),
            np.concatenate([-moved[::-1], ends[:1], at[1:] - 0.5, ends[1:], size - 1.0 + moved]),
        )
    for (back, rise), beyond in zip(arcs, (-index[:, 0], index[:, 0] - (image.hu.shape[0] - 1.0)), strict=True):
        backs = np.interp(surface.vertices[:, 2], np.arange(len(back)), back)
        risen = rise * np.maximum(beyond, 0.0) * image.spacing_mm[0] / image.spacing_mm[1]
        index[:, 1] -= np.where(surface.vertices[:, 1] < backs, risen, 0.0)
    beyond = index[:, 2] - np.clip(index[:, 2], 0.0, image.hu.shape[2] - 1.0)
    index[:, :2] += beyond[:, None] * image.slopes * image.spacing_mm[2] / image.spacing_mm[:2]
    return TriangleMesh(apply(image.T_ct_index, index), surface.faces)


def _stiff_pieces(mask: Bools, hu: NDArray[Any], spacing_mm: Floats) -> Bools:
    """The pieces that are bulky, and of others what is solid with its rim: the rest is noise, or cloth on the skin."""
    stiff = _bulky(mask, spacing_mm)
    solid = hu > BODY_HU
    solid &= mask
    if not solid.any():
        return stiff
    box = box_in(solid, margin=2)
    near = parts_of(widened(solid[box], (1, 1, 1)), corners=True)
    least_mm3 = np.where(near.counts(solid[box] & (hu[box] > SOLID_HU)) > 0, MIN_PIECE_MM3, MIN_SOFT_MM3)
    large = near.counts(solid[box]) * np.prod(spacing_mm) >= least_mm3
    stiff[box] |= widened(near.painted(large), (1, 1, 1)) & mask[box]
    return stiff


def _bulky(mask: Bools, spacing_mm: Floats) -> Bools:
    pieces = parts_of(mask, corners=True)
    return pieces.painted(pieces.sizes * np.prod(spacing_mm) >= 1000.0 * BULKY_ML)


GAS_HU = -300.0
"""Half way between fat (-100) and a voxel that is half gas, half tissue (-500)."""
MIN_COMPONENT_MM3 = 100.0
"""Smaller components are noise and edges of labels: half a voxel of a 6 mm grid."""
SKIN_VOXELS = 2
"""So deep below the body's surface voxels are partly air: no gas there."""


class Unnamed(NamedTuple):
    """Closed surfaces of what no structure names, LPS mm; None where there is nothing."""

    dense: TriangleMesh | None
    gas: TriangleMesh | None


def unnamed_surfaces(
    ct: CtImage, body: Bools, structures: Sequence[Structure], *, dense_hu: float, slack_mm: float = 0.0
) -> Unnamed:
    """Find dense components and gas in a body (nx, ny, nz) outside of all structures grown by one voxel.

    Below its surface there may be ambient air down to ``slack_mm``, where the surface is from elsewhere and was
    widened.
    """
    gas, named = ct.hu < GAS_HU, np.zeros(body.shape, bool)
    if gas.any():
        gas &= ~widened(~body, (SKIN_VOXELS,) * 3)  # beyond the border the body goes on
        if slack_mm > 0.0 and not body.all():
            gas &= scipy.ndimage.distance_transform_edt(body, sampling=ct.spacing_mm) > slack_mm
    for holders in (True, False):
        for one in structures:
            if one.may_contain_gas == holders:
                mark_inside(one.mesh, ct.T_ct_index, named)
        if holders and gas.any():
            gas &= ~grown(named)
    return Unnamed(_surface(body & (ct.hu >= dense_hu) & ~grown(named), ct), _surface(gas, ct))


def _surface(mask: Bools, ct: CtImage) -> TriangleMesh | None:
    if not mask.any():
        return None
    box = box_in(mask)
    components = parts_of(mask[box], corners=True)
    large = components.sizes >= MIN_COMPONENT_MM3 / float(np.prod(ct.spacing_mm))
    mask[box] = components.painted(large)
    return mask_surface(mask, ct.T_ct_index, where=ct.where) if large.any() else None


SKIN_TOLERANCE_MM = 3.0
"""A skin from elsewhere (a label, a mesh) is off the CT's by so much, or by one voxel and a half: nearer to it what is
dense counts as body. Beyond, it is outside, as an arm is that the skin lacks."""


class Outside(NamedTuple):
    """Surfaces of objects that a CT shows outside of the body."""

    mesh: TriangleMesh | None
    """The surface of what is not known to be free, LPS mm; None for air alone."""
    couch: TriangleMesh | None
    """What lies beyond the far side of what the body lies on, where the image shows that; else None. Closed."""
    open_faces: tuple[Face, ...]  # faces of the image near the body, beyond which nothing is known


@dataclass(frozen=True, eq=False)
class Scan:
    """A CT beside the skin of its case, if that is from elsewhere. Voxels are decoded if the cache lacks something."""

    name: str
    source: Imaged
    skin: Skin | None

    def outside(self, air_hu: float) -> Outside:
        """Surfaces outside of the body denser than air, and the image's faces beyond which nothing is known."""

        def make() -> Arrays:
            ct = self._ct
            image = OutsideImage(ct.hu, self._body, ct.unscanned, ct.T_ct_index, ct.spacing_mm)
            mask = outside_mask(image, air_hu)
            meshes, faces = self._outside_meshes(image, mask)
            if not all(mesh is None or fits(mesh) for mesh in meshes):
                meshes, faces = self._outside_meshes(replace(image, beyond_mm=BEYOND_LONG_MM), mask)
            return {**_of_meshes(meshes), "open": np.array([face in faces for face in FACES])}

        def read(stored: Arrays) -> Outside:
            mesh, couch = _to_meshes(stored)
            return Outside(mesh, couch, tuple(itertools.compress(FACES, stored["open"])))

        return self.source.kept(self._of({"what": "outside", "air_hu": air_hu}), make, read, by=__name__)

    def _outside_meshes(self, image: OutsideImage, mask: Bools) -> tuple[list[TriangleMesh | None], tuple[Face, ...]]:
        """What is not known to be free; of it what lies beyond tables; and the open faces."""
        support = find_support(mask & ~image.unscanned, image.body, image.spacing_mm, self._tables, self._ct.shown)
        beyond, slopes = np.zeros_like(mask), [0.0, 0.0]
        for side in (*self._tables, *support.drawn):
            beyond |= side.beyond(mask.shape)
            slopes[side.face[0]] = side.slope
        image = replace(image, slopes=(slopes[0], slopes[1]))
        where = self._ct.where
        shown = outside_surface(image, mask | beyond, support.open_faces, where=where)
        return [shown, outside_surface(image, beyond, where=where)], support.open_faces

    def end(self) -> tuple[FieldOfView, Floats] | None:
        """Where this image cuts a body whose skin comes from elsewhere, and points (n, 3) of its outlines, LPS mm.

        None where it does nowhere, or the skin is its own and tells.
        """
        if self.skin is None:
            return None

        def make() -> Arrays:
            body, T = self._body, self._ct.T_ct_index
            view, last = field_of_view(body, T), body.copy()
            last[1:-1, 1:-1, 1:-1] = False
            corners = [np.argwhere(last) + 0.5 * np.array(to) for to in itertools.product((-1, 1), repeat=3)]
            points = apply(T, np.concatenate(corners))
            return {"T": view.T_ct_box, "size": view.size_mm, "cut": view.cut, "points": points}

        kept = self._kept_arrays({"what": "end"}, make)
        return (FieldOfView(kept["T"], kept["size"], kept["cut"]), kept["points"]) if kept["cut"].any() else None

    @property
    def _tables(self) -> tuple[TableSide, ...]:
        """Sides at which a table holds together with the body that this CT shows."""
        return () if self.skin is not None else self._ct.found.tables

    def attached_limbs(
        self, target_ct: NDArray[np.float64], structures: Sequence[Structure] = ()
    ) -> TriangleMesh | None:
        """The surface of limbs that are pressed against the body part that holds the target (3,), LPS mm, or None.

        Bones that the case's structures name are no evidence of a limb.
        """
        if not self.source.shown.limbs:
            return None
        named = [f"{one.name} {one.mesh.digest}" for one in structures]
        made_from = {"what": "attached limbs", "structures": named}
        known = f"{made_from} {self.skin and self.skin.mesh.digest} {self.source.box} {self.source.shown}"

        @cache
        def search() -> LimbSearch:
            return self.source.surfaces.held(
                known, lambda: limb_search(self._ct, self._body, structures), lambda made: 32 * made.parts.size
            )

        def choose() -> Arrays:
            return {"chosen": np.array(search().chosen(target_ct))}

        def make() -> list[TriangleMesh | None]:
            return [mask_surface(search().limbs(chosen), search().T_ct_index, where=self.source.surfaces.path)]

        if self.source.surfaces.holds(known):  # another target of the same image: nothing is decoded for it
            chosen = choose()["chosen"].tolist()
        else:
            chosen = self._kept_arrays({**made_from, "target": target_ct.tolist()}, choose)["chosen"].tolist()
        return self._kept({**made_from, "chosen": chosen}, make)[0] if any(chosen[1:]) else None

    def unnamed(self, structures: Sequence[Structure], dense_hu: float) -> Unnamed:
        """Surfaces of what is dense, from an HU on, or gas, inside the body and in no structure."""

        def make() -> list[TriangleMesh | None]:
            slack_mm = 0.0 if self.skin is None else 2.0 * self._tolerance_mm
            return [*unnamed_surfaces(self._ct, self._body, structures, dense_hu=dense_hu, slack_mm=slack_mm)]

        named = {"structures": [f"{one.name} {one.mesh.digest}" for one in structures]}
        return Unnamed(*self._kept({"what": "unnamed", "dense_hu": dense_hu, **named}, make))

    def may_hold(self, unnamed: Unnamed, mesh: TriangleMesh) -> bool:
        """Whether something of what no structure names may lie in a surface, or beside it."""
        step_mm = 2.0 * self.source.surfaces.source.grid.spacing_mm.max()
        low, high = mesh.bounds + [[-step_mm], [step_mm]]
        near = (one.vertices for one in unnamed if one is not None)
        within = any(np.all((low <= some) & (some <= high), axis=1).any() for some in near)
        return within or any(one is not None and contains(one, (low + high) / 2.0) for one in unnamed)

    def hu_at(self, points_ct: NDArray[np.float64]) -> NDArray[np.float64]:
        """Hounsfield units of the voxels nearest to points (n, 3), LPS mm; NaN outside of the image."""
        return nearest(self._ct.hu, np.asarray(np.linalg.inv(self._ct.T_ct_index), np.float64), points_ct)

    @property
    def voxels(self) -> tuple[NDArray[np.generic], NDArray[np.float64]]:
        """Hounsfield units as they are stored, shape (nx, ny, nz), and the map (4, 4) of an index to LPS mm."""
        return self._ct.stored, self._ct.T_ct_index

    @property
    def grid(self) -> VolumeGrid:
        """Where the voxels of the whole file lie."""
        return self.source.surfaces.source.grid

    @property
    def measured(self) -> tuple[NDArray[np.generic], NDArray[np.float64]]:
        """As `voxels`, with the padding far below air, as `hu_at` has it."""
        return self._ct.hu, self._ct.T_ct_index

    def release(self) -> None:
        """Let go of all voxels; what asks for them again decodes them again."""
        vars(self).pop("_body", None)
        self.source.release()

    @property
    def _ct(self) -> CtImage:
        return self.source.image

    @cached_property
    def _body(self) -> Bools:
        """The body's voxels: as found in the CT, or inside the skin that the case gives."""
        ct = self._ct
        if self.skin is None:
            return ct.found.body
        inside = voxels_inside(self.skin.mesh, ct.T_ct_index, ct.hu.shape)
        return np.asarray(scipy.ndimage.distance_transform_edt(~inside, sampling=ct.spacing_mm) <= self._tolerance_mm)

    @property
    def _tolerance_mm(self) -> float:
        return max(SKIN_TOLERANCE_MM, 1.5 * float(self._ct.spacing_mm.max()))

    def _kept(
        self, made_from: dict[str, Any], make: Callable[[], list[TriangleMesh | None]]
    ) -> list[TriangleMesh | None]:
        """Meshes from the cache, made where they are not there; None is kept too."""
        return self.source.kept(self._of(made_from), lambda: _of_meshes(make()), _to_meshes, by=__name__)

    def _kept_arrays(self, made_from: dict[str, Any], make: Callable[[], Arrays]) -> Arrays:
        return self.source.kept(self._of(made_from), make, dict, by=__name__)

    def _of(self, made_from: dict[str, Any]) -> dict[str, Any]:
        return {"skin": None if self.skin is None else self.skin.mesh.digest, **made_from}


def _of_meshes(meshes: list[TriangleMesh | None]) -> Arrays:
    arrays: Arrays = {"count": np.array(len(meshes))}
    for number, mesh in enumerate(meshes):
        if mesh is not None:
            arrays |= mesh_arrays(mesh, number)
    return arrays


def _to_meshes(stored: Arrays) -> list[TriangleMesh | None]:
    return [cached_mesh(stored, n) if f"faces{n}" in stored else None for n in range(int(stored["count"]))]


def nearest(values: NDArray[np.float32], T_index_ct: Floats, points_ct: Floats) -> Floats:
    """Values (nx, ny, nz) of the voxels nearest to points (n, 3), LPS mm, by the map (4, 4) of these to an index.

    NaN outside of the image; half way between two voxels it is the one of even index.
    """
    order = np.argsort(values.strides)[::-1]  # as it lies in memory: the kernel is compiled for one order alone
    plain = np.ascontiguousarray(values.transpose(order))
    return np.asarray(_nearest(plain, T_index_ct[order], np.ascontiguousarray(points_ct)))


@nb.njit(cache=True, error_model="numpy")
def _nearest(values: Any, T: Any, points: Any) -> Any:
    """As `nearest`, of values that lie in memory as they are numbered. The order of a sum decides half-way points."""
    values_at = np.empty(len(points))
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        i = np.rint(T[0, 0] * x + T[0, 2] * z + T[0, 1] * y + T[0, 3])
        j = np.rint(T[1, 0] * x + T[1, 2] * z + T[1, 1] * y + T[1, 3])
        k = np.rint(T[2, 0] * x + T[2, 2] * z + T[2, 1] * y + T[2, 3])
        if 0 <= i < values.shape[0] and 0 <= j < values.shape[1] and 0 <= k < values.shape[2]:
            values_at[n] = values[int(i), int(j), int(k)]
        else:
            values_at[n] = np.nan
    return values_at
