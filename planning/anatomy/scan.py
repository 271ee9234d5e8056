"""A cross-check by the CT of a case: what it shows outside of the body, and what inside that no structure names.

What the voxels hold in which points lie.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.body.body_mask import CtImage
from puncture_twin.planning.anatomy.body.cut_ends import FieldOfView
from puncture_twin.planning.anatomy.body.limbs import LimbSearch, limb_search
from puncture_twin.planning.anatomy.body.outside_body import BEYOND_LONG_MM, OutsideImage, outside_mask, outside_surface
from puncture_twin.planning.anatomy.body.tables import FACES, Face, TableSide, find_support
from puncture_twin.planning.anatomy.skin import Skin, field_of_view
from puncture_twin.planning.anatomy.surfaces import Imaged, cached_mesh, mesh_arrays
from puncture_twin.planning.anatomy.unnamed import Named, Unnamed, unnamed_surfaces
from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.base.cache.entry_file import Arrays
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.formats.guard import fits
from puncture_twin.planning.formats.labels.labelmaps import mask_surface
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid
from puncture_twin.planning.geometry.containment import contains
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.parts import voxels_inside
from puncture_twin.planning.geometry.rigid import apply

SKIN_TOLERANCE_MM = 3.0
"""A skin from elsewhere (a label, a mesh) is off the CT's by so much, or by one voxel and a half: nearer to it what is
dense counts as body. Beyond, it is outside, as an arm is that the skin lacks."""


class Outside(NamedTuple):
    """What a CT shows outside of the body."""

    mesh: TriangleMesh | None
    """The surface of what is not known to be free, LPS mm; None for air alone."""
    couch: TriangleMesh | None
    """What lies beyond the far side of what the body lies on, where the image shows that; else None. Closed."""
    open_faces: tuple[Face, ...]
    """Faces of the image near the body, beyond which nothing is known."""


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

    def attached_limbs(self, target_ct: NDArray[np.float64], structures: Sequence[Named] = ()) -> TriangleMesh | None:
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

    def unnamed(self, structures: Sequence[Named], dense_hu: float) -> Unnamed:
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
    found = np.empty(len(points))
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        i = np.rint(T[0, 0] * x + T[0, 2] * z + T[0, 1] * y + T[0, 3])
        j = np.rint(T[1, 0] * x + T[1, 2] * z + T[1, 1] * y + T[1, 3])
        k = np.rint(T[2, 0] * x + T[2, 2] * z + T[2, 1] * y + T[2, 3])
        if 0 <= i < values.shape[0] and 0 <= j < values.shape[1] and 0 <= k < values.shape[2]:
            found[n] = values[int(i), int(j), int(k)]
        else:
            found[n] = np.nan
    return found
