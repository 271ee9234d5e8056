"""The patient's skin, and where it is not known because the field of view cuts the body.

Where each path from the target crosses the skin, at which angle, and whether what it leaves is known.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.body.body_mask import BODY_HU, BodyMask, CtImage, filled_slices
from puncture_twin.planning.anatomy.body.cut_ends import SIDES, WIDE, Box, FieldOfView, shifted, spacing_of
from puncture_twin.planning.anatomy.skin_normals import broad_normals
from puncture_twin.planning.base.arrays import Floats, read_only
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.formats.labels.labelmaps import LabelMap, box_in, frame, framed_surface, mask_surface
from puncture_twin.planning.formats.volumes.volume_files import canonical
from puncture_twin.planning.geometry.containment import consistent_crossings
from puncture_twin.planning.geometry.mesh import TriangleMesh, blended_normals, smooth_normals, split_at_creases
from puncture_twin.planning.geometry.rigid import pose

HU_RANGE, HU_LEAST = 500.0, 50.0
"""Values further from the threshold say no more about where the surface is: bone under the skin is as inside as water.
The least keeps every vertex at least 1/11 of a voxel away from voxel centres, so that no triangle is a sliver."""
CUT_PLANE_MM, FLAT_END_MM2, FLAT_STEP = 0.5, 3000.0, 1.0 - 1e-9
"""A triangle this close to the plane of a cut belongs to it: half a voxel of a fine scan. No skin is flat and square to
the scanner over such an area; even a belly pressed on a table is rounder. The last is the cosine to its side's axis of
a triangle that is a face of voxels."""


@dataclass(frozen=True, eq=False)
class Skin:
    """The closed surface of the body, LPS mm, normals outward, and which of its triangles are skin."""

    mesh: TriangleMesh
    cut_faces: NDArray[np.bool_]
    """Shape (m,), triangles that are not skin: there the field of view ends, and the body goes on."""
    field_of_view: FieldOfView | None
    """The imaged box; None for a mesh, which states none."""
    warnings: tuple[str, ...]
    normals: Floats | None = None
    """Shape (n, 3), unit normal at each vertex, without the voxels' stairs; None for a mesh, whose own are its."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "cut_faces", read_only(self.cut_faces, np.bool_))
        if self.normals is not None:
            object.__setattr__(self, "normals", read_only(self.normals, np.float64))

    @property
    def nbytes(self) -> int:
        """Bytes of mesh and flags."""
        return self.mesh.nbytes + self.cut_faces.nbytes + (0 if self.normals is None else self.normals.nbytes)


def skin_of_image(image: CtImage) -> Skin:
    """The body's surface at ``BODY_HU``, between voxels, where air touches the body.

    Every vertex lies between the centres of a voxel inside the body mask and one outside, so the surface is never more
    than half a voxel (along any axis) from the mask's boundary, like that of a label.

    Raises InputError: If no body is found, or no air around it.
    """
    box = box_in(image.found.body, margin=1)  # beyond it the field is negative
    framed, field = frame([one.stop - one.start for one in box])
    for plane, hu, body in zip(field, image.hu[box], image.found.body[box], strict=True):
        np.subtract(hu, BODY_HU, out=plane, dtype=np.float32)
        unlike = ((plane > 0) != body) | (plane == 0)  # what counts as body, or as air, whatever its value
        np.clip(np.abs(plane), HU_LEAST, HU_RANGE, out=plane)
        np.copyto(plane, HU_RANGE, where=unlike)
        np.negative(plane, out=plane, where=~body)
    mesh = framed_surface(framed, image.T_ct_index, where=image.where, first=[one.start for one in box])
    return _skin(mesh, image.found, image.T_ct_index)


def skin_from_label(labelmap: LabelMap, label: int, box: Box | None = None) -> Skin:
    """The outer surface of one label in a box, holes filled in each axial slice (it may be a shell of skin only).

    Raises InputError: If no voxel has this label, or every voxel is inside.
    """
    where = f"{labelmap.path}, label {label}"
    if label not in labelmap.boxes:
        allowed = f"labels present: {', '.join(map(str, labelmap.labels_present()))}"
        refuse("no voxel has the label of the skin", where, allowed, "label_absent")
    oriented = canonical(labelmap.labels, labelmap.T_ct_index)
    box = box or tuple((0, n) for n in oriented.values.shape)
    body = filled_slices(oriented.values[tuple(slice(*ends) for ends in box)] == label)
    if body.all():
        refuse("no air around the body", where, "a label whose border lies inside the image", "no_air")
    T_ct_box = shifted(oriented.T_ct_index, box)
    return _skin(mask_surface(body, T_ct_box, where=where), BodyMask(body, np.zeros_like(body), ()), T_ct_box)


def skin_from_mesh(mesh: TriangleMesh, cut: Sequence[str] = ()) -> Skin:
    """The skin of a mesh, LPS mm: of a whole body (local mm too), or of one cut flat at some sides, as in `SIDES`.

    Raises InputError: If no triangle lies in the plane where a side was cut.
    """
    mesh = split_at_creases(mesh)
    warnings = () if mesh.closed else ("the skin mesh is open: its inside, and where skin is missing, are not known",)
    if not cut:
        return Skin(mesh, np.zeros(len(mesh.faces), dtype=np.bool_), None, warnings)
    low, high = mesh.bounds
    sides = np.zeros((3, 2), dtype=np.bool_)
    cut_faces = np.zeros(len(mesh.faces), dtype=np.bool_)
    for name in cut:
        axis, end = SIDES[name]
        sides[axis, end] = True
        in_plane = np.all(np.abs(mesh.triangles[:, :, axis] - (low, high)[end][axis]) < CUT_PLANE_MM, axis=1)
        if not in_plane.any():
            refuse(f"no flat end at side {name}", "skin mesh", "a side at which the body was cut", "no_flat_end")
        cut_faces |= in_plane
    return Skin(mesh, cut_faces, FieldOfView(pose(np.eye(3), low), high - low, sides), warnings)


def flat_ends(mesh: TriangleMesh) -> tuple[str, ...]:
    """The sides at which a surface, LPS mm, ends in a plane of its bounding box, as a body does that a scan has cut.

    A round body of straight voxel steps ends so too, but half as wide again one step before; across the bed, where
    bodies end seldom and are cut mostly, that is not asked.
    """
    corners = mesh.triangles
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    areas = np.linalg.norm(normals, axis=1)
    ends = []
    for name, (axis, end) in SIDES.items():
        depth_mm = np.abs(corners[:, :, axis] - mesh.bounds[end][axis]).max(axis=1)
        in_plane, outward = depth_mm < CUT_PLANE_MM, normals[:, axis] * (2 * end - 1) > FLAT_STEP * areas
        before = outward & ~in_plane
        step = before & (depth_mm < depth_mm[before].min(initial=np.inf) + CUT_PLANE_MM)
        alone = axis == 2 or areas[in_plane].sum() > WIDE * areas[in_plane | step].sum()
        if areas[in_plane].sum() > FLAT_END_MM2 and alone:
            ends.append(name)
    return tuple(ends)


def _skin(mesh: TriangleMesh, body: BodyMask, T_ct_index: Floats) -> Skin:
    view, centres = field_of_view(body.body, T_ct_index), mesh.triangles.mean(axis=1)
    low = view.to_box(centres)
    from_faces = np.stack([low, view.size_mm - low], axis=2)  # the cap and its chamfer lie within half a voxel
    cut = np.any((from_faces < 0.5 * spacing_of(T_ct_index)[:, None]) & view.cut, axis=(1, 2))
    if body.unscanned.any():  # and triangles in whose cell of eight voxels one was not scanned
        index = np.floor(np.linalg.solve(T_ct_index[:3, :3], (centres - T_ct_index[:3, 3]).T).T).astype(int)
        for step in itertools.product((0, 1), repeat=3):
            cell = tuple(np.clip(index + step, 0, np.array(body.body.shape) - 1).T)
            cut |= body.unscanned[cell] & ~body.body[cell]
    return Skin(mesh, cut, view, body.warnings, broad_normals(mesh, ~cut))


def field_of_view(body: NDArray[np.bool_], T_ct_index: Floats) -> FieldOfView:
    """The box that was imaged, up to the outer faces of the border voxels that the body reaches."""
    spacing = spacing_of(T_ct_index)
    axes, origin = T_ct_index[:3, :3], T_ct_index[:3, 3]
    T_ct_image = pose(axes / spacing, origin - 0.5 * axes.sum(axis=1))
    cut = [[bool(body.take(side, axis=axis).any()) for side in (0, -1)] for axis in range(3)]
    return FieldOfView(T_ct_image, spacing * body.shape, np.array(cut))


@dataclass(frozen=True, eq=False)
class SkinPaths:
    """The skin along n paths; mm, radians, NaN where there is none."""

    entry_ct: Floats
    """Shape (n, 3), where the path from outside first meets the skin for good, seen from the target."""
    path_length: Floats  # shape (n,), target to entry
    skin_angle: Floats  # shape (n,), between the path and the skin's inward normal, over some 2 cm of one from voxels
    reentry_depth: Floats  # shape (n,), where the needle would meet skin again, before where its flange waits
    unknown_depth: Floats
    """Shape (n,), where the path leaves the body through a cut, 0 where crossings of a closed skin are inconsistent."""


def skin_paths(skin: Skin, target_ct: Floats, outward_ct: Floats, farthest: float) -> SkinPaths:
    """Follow every path from the target (3,) outward along unit vectors (n, 3), as far as the flange can be, mm."""
    crossed, consistent = consistent_crossings(skin.mesh, target_ct, outward_ct)
    has = crossed.count > 0
    first = crossed.first[has]
    depth, face = np.full(len(outward_ct), np.nan), np.zeros(len(outward_ct), np.int64)
    depth[has], face[has] = crossed.depth[first], crossed.face[first]
    again = crossed.count > 1
    reentry = np.full(len(outward_ct), np.nan)
    reentry[again] = crossed.depth[crossed.first[again] + 1]
    reentry[reentry > farthest] = np.nan
    cut = has & skin.cut_faces[face]
    unknown = np.where(cut, depth, np.nan)
    if skin.mesh.closed:  # of an open one inconsistent rays are not rejected: the case warns of it
        unknown[~consistent] = 0.0
    depth[cut] = np.nan
    entry = target_ct + depth[:, None] * outward_ct
    if skin.normals is None:
        normals = smooth_normals(skin.mesh, face, entry)
    else:
        corners = skin.mesh.faces[face]
        normals = blended_normals(skin.mesh.vertices[corners], skin.normals[corners], entry)
    cosine = np.abs(np.einsum("ij,ij->i", normals, outward_ct))
    angle = np.where(np.isnan(depth), np.nan, np.arccos(np.minimum(cosine, 1)))
    return SkinPaths(entry, depth, angle, reentry, unknown)
