"""Beyond the image the body goes on: one solid of role ``unknown`` for needle, holder, links and base.

At each face of the image that cuts the body its outline there is drawn on outward, also past neighbouring faces that
cut it, and is widened to the sides by what the case states or by what is usual. What the solid leaves free is air.

What lies in the body beyond a label map: no organ there has a label, so it is not known to be free.

TotalSegmentator and Slicer write maps that were cropped to a part of the CT, and lay them on a larger grid, with zeros
around. So a map ends at its grid's faces, and at a plane in which several labels end flat with none of the map beyond:
organs end round. Other maps on the grid may have been cropped there too, or not at all. The part of the body beyond
each such face becomes a closed surface of role ``unknown``; the air beyond it, outside of the skin, does not.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy

from puncture_twin.planning.anatomy.body.cut_ends import SIDES, FieldOfView, stated_ends
from puncture_twin.planning.anatomy.scan import Scan
from puncture_twin.planning.anatomy.skin import Skin
from puncture_twin.planning.anatomy.structure import LabelGrid, Role, Structure, label_grids
from puncture_twin.planning.base.arrays import Bools, Floats, Ints, widened
from puncture_twin.planning.base.cache.array_cache import NO_MEMORY, Memory
from puncture_twin.planning.base.errors import Finding, Severity, refuse
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.formats.labels.label_sources import on_one_grid
from puncture_twin.planning.formats.labels.labelmaps import LabelEnds, mask_surface
from puncture_twin.planning.formats.volumes.volume_files import canonical
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid
from puncture_twin.planning.geometry.mesh import TriangleMesh, box_of, joined
from puncture_twin.planning.geometry.parts import voxels_inside
from puncture_twin.planning.geometry.rigid import apply, pose

BEYOND_IMAGE = "beyond_image"
BEYOND_LABELS = "beyond_labels"
"""Names of these solids among the structures."""
REACH_MM, ASIDE_MM = 2000.0, 400.0
"""So far the body goes on along the bed, and half spaces to their sides: farther than a needle and its arm reach. And
beyond a face that cuts its side: no trunk is wider than 800 mm."""
USUAL_MM = 150.0
"""By so much a body without arms is wider than where an image cuts it: hips below a waist, shoulders above a chest."""
ARM_MM3 = 1.5e5
"""An adult's arm has this in 40 mm of its length, a child's in 100; no bottle or cushion lies at both sides."""
OUTLINE_MM, SAME_MM = 10.0, 0.01
"""So near to a face points belong to its outline (half of the thickest slice); corners of it no farther apart are one.
"""
TANGENTS = 32
"""Sides of the polygon about an outline: about a circle of 200 mm it is 1 mm too wide at most."""
VOXELS_OF_SLACK, CELL_MM = 1.0, 2.0
"""A map may end so many voxels inside the skin's box: the skin itself is found to that. And the least edge of the cells
by which the body beyond a map is found; it is widened by one cell to all sides."""
CUT_MM, ALSO_CUT_MM = 20.0, 4.0
"""Labels were cut off in a plane where flat ends, together so wide, lie with nothing beyond: labels of organs seldom
end so by themselves. And where they are so wide at the other sides of a map that was cut at one: what was cropped has
as a rule several faces."""
ENDS = (
    "label map {name} ends {voxels:.0f} voxels inside the body, within the needle's reach: the space beyond is unknown"
)
ENDS_GRID = "; a label map of a larger part of the body would show it"
ENDS_FLAT = (
    "; its grid goes on, but its labels were cut off there, as it seems (flat ends in one plane, {flat:.0f} mm wide "
    "together; if they end so by themselves, cut = [] beside the map in the case says so)"
)
STATED = "label map {name}: cut = {cut} is stated, so flat ends of labels within its grid say nothing"


class Assumed(NamedTuple):
    """By how much wider than where it is cut the body may be beyond an image (infinite for a half space), and why."""

    wider_mm: float
    because: str


class Beyond(NamedTuple):
    """The solid beyond the images of a case, if one cuts the body, and a sentence an image that does."""

    structures: tuple[Structure, ...]
    findings: tuple[Finding, ...]


def beyond_images(case: Case, skin: Skin, scan: Scan | None, memory: Memory = NO_MEMORY) -> Beyond:
    """Solids assumed beyond the image of a case's skin, and beyond a CT that is smaller than a skin from elsewhere.

    Of one patient they are the same for every target.
    """
    at_ends = skin.mesh.vertices[np.unique(skin.mesh.faces[skin.cut_faces])]  # their outlines, and nothing before them
    ends = [] if skin.field_of_view is None else [(skin.field_of_view, at_ends)]
    of_scan = None if scan is None else scan.end()
    ends = [end for end in [*ends, *([] if of_scan is None else [of_scan])] if end[0].cut.any()]
    if not ends:
        return Beyond((), ())
    widths = [assumed(case, view, skin, memory) for view, _ in ends]
    breath = _breath(case)

    def make() -> TriangleMesh:
        return joined([beyond_image(*end, one.wider_mm, breath) for end, one in zip(ends, widths, strict=True)])

    views = tuple(part.tobytes() for view, _ in ends for part in (view.T_ct_box, view.size_mm, view.cut))
    key = (__name__, BEYOND_IMAGE, skin.mesh.digest, views, *(one.wider_mm for one in widths), breath.tobytes())
    mesh = make() if of_scan is not None else memory.get(key, make, lambda solid: solid.nbytes)
    solid = Structure(BEYOND_IMAGE, Role.UNKNOWN, case.ct.margin_mm, mesh, "beyond the image", True, np.zeros((3, 3)))
    own = "; set cut in the skin's table, [] if all of it is skin" if case.skin_section.mesh else ""
    said = [_finding(view, one, own) for (view, _), one in zip(ends, widths, strict=True)]
    return Beyond((solid,), tuple({one.sentence: one for one in said}.values()))


def assumed(case: Case, view: FieldOfView, skin: Skin, memory: Memory = NO_MEMORY) -> Assumed:
    """Width assumed beyond a case's image: as a person states it, or the usual where no arm can be beyond.

    An arm that is stretched out lies farther from the trunk than anything usual: unless there is none, or the image
    shows the arms (a person says so, or they are seen at both sides) and the body's whole width, all that lies beyond a
    cut is unknown.
    """
    ct = case.ct
    if ct.beyond_mm is not None:
        return Assumed(ct.beyond_mm, "[ct] beyond_mm")
    if ct.arms == "none" or case.region == "phantom":
        return Assumed(USUAL_MM, "no arms" if ct.arms == "none" else "a phantom")
    key = (__name__, "arms", skin.mesh.digest)
    if not view.cut[0].any() and (ct.arms == "present" or memory.get(key, lambda: _shows_arms(skin.mesh), int)):
        return Assumed(USUAL_MM, "the image shows the arms and the whole width of the body")
    return Assumed(np.inf, "the position of the arms is not known")


def _shows_arms(skin: TriangleMesh) -> bool:
    """Whether beside the trunk, at its left and at its right, lie parts of the body that are as large as arms are."""
    edges = np.concatenate([skin.faces[:, :2], skin.faces[:, 1:]])
    graph = scipy.sparse.coo_array((np.ones(len(edges), bool), edges.T), (len(skin.vertices),) * 2)
    part = scipy.sparse.csgraph.connected_components(graph, directed=False)[1][skin.faces[:, 0]]
    a, b, c = np.moveaxis(skin.triangles - skin.bounds.mean(axis=0), 1, 0)
    volume = np.bincount(part, np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0)
    trunk, sides = skin.triangles[part == volume.argmax(), :, 0], set()
    for number in np.flatnonzero((volume > ARM_MM3) & (volume < volume.max())):
        aside = skin.triangles[part == number, :, 0] - trunk.mean()
        sides.add(np.sign(aside.mean()) if np.abs(aside).min() > np.ptp(trunk) / 4.0 else 0.0)
    return bool({-1.0, 1.0} <= sides)


def beyond_image(view: FieldOfView, points_ct: Floats, wider_mm: float, moved_ct: Floats | None = None) -> TriangleMesh:
    """The solid beyond a box that cuts the body at one face at least, closed, LPS mm.

    It is drawn about points (n, 3) of the body's surface, those of its outlines at the faces among them, wider to the
    sides (infinite: all beyond the faces' planes); what lies there may come toward the image by a vector (3,) as the
    body breathes.
    """
    by = np.zeros(3) if moved_ct is None else np.abs(view.T_ct_box[:3, :3].T @ moved_ct)
    points, solids, everything = view.to_box(points_ct), [], bool(np.isinf(wider_mm))
    for axis, end in np.argwhere(view.cut).tolist():
        section = _section(view, points, axis, end, everything=everything)
        outline = _outline(section, float(np.linalg.norm(by)) + (0.0 if everything else wider_mm))
        away = REACH_MM if axis == 2 or everything else ASIDE_MM
        near, far = (view.size_mm[axis] - by[axis], away) if end else (by[axis], -away)
        solids.append(prism(view.T_ct_box, outline, axis, (near, near + far)))
    return joined(solids)


def _section(view: FieldOfView, points: Floats, axis: int, end: int, *, everything: bool) -> Floats:
    """Points (n, 2) about which the outline at a face is drawn; where a side of it is cut too, on past that."""
    others = [other for other in range(3) if other != axis]
    away = np.where(everything | (np.array(others) == 2), REACH_MM, ASIDE_MM)
    ends = np.stack([-away, view.size_mm[others] + away])
    whole = np.array([[x, y] for x in ends[:, 0] for y in ends[:, 1]])
    section = points[np.abs(points[:, axis] - end * view.size_mm[axis]) <= OUTLINE_MM][:, others]
    if everything or not len(section):
        return whole
    for k, side in np.argwhere(view.cut[others]).tolist():
        last = section[np.abs(section[:, k] - side * view.size_mm[others[k]]) <= OUTLINE_MM].copy()
        last[:, k] = ends[side, k]
        section = np.concatenate([section, last])
    return section


def _outline(points: Floats, wider_mm: float) -> Floats:
    """A convex polygon (m, 2) about points (n, 2), its sides so far from them, counter-clockwise."""
    step = 2 * np.pi / TANGENTS
    normals = np.stack([np.cos(step * np.arange(TANGENTS)), np.sin(step * np.arange(TANGENTS))], axis=1)
    away = (points @ normals.T).max(axis=0) + wider_mm
    along = (np.roll(away, -1) - away * np.cos(step)) / np.sin(step)
    corners = away[:, None] * normals + along[:, None] * np.stack([-normals[:, 1], normals[:, 0]], axis=1)
    return np.asarray(corners[np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1) > SAME_MM])


def prism(T_ct_box: Floats, outline: Floats, axis: int, between: tuple[float, float]) -> TriangleMesh:
    """Prism over a convex polygon, shape (n, 2), between two planes across an axis, faces outward; mm."""
    n = len(outline)
    index = np.concatenate([np.insert(outline, axis, at, axis=1) for at in between])
    i, j = np.arange(n), np.roll(np.arange(n), -1)
    fan = np.stack([np.zeros(n - 2, int), np.arange(1, n - 1), np.arange(2, n)], axis=1)
    sides = np.concatenate([np.stack([i, i + n, j], axis=1), np.stack([j, i + n, j + n], axis=1)])
    faces = np.concatenate([fan, fan[:, ::-1] + n, sides]).astype(np.int32)
    mesh = TriangleMesh(apply(T_ct_box, index), faces)
    return mesh if mesh.volume > 0.0 else TriangleMesh(mesh.vertices, faces[:, ::-1])


def _breath(case: Case) -> Floats:
    """How far the breath moves the target at most from where the CT shows it: nobody knows how it moves the rest."""
    moved = [] if case.breathing is None else [case.breathing.moved_ct(s) for s in case.breathing.positions.tolist()]
    return max(moved, key=lambda by: float(np.linalg.norm(by)), default=np.zeros(3))


def _finding(view: FieldOfView, what: Assumed, own: str) -> Finding:
    names = ", ".join(name for name, (axis, end) in SIDES.items() if view.cut[axis, end])
    everything = bool(np.isinf(what.wider_mm))
    wide = "all space beyond it" if everything else f"the body extended, {what.wider_mm:g} mm wider on each side,"
    said = f"the body is cut at its {names} side: the skin is not known there, and {wide} is unknown to needle and arm"
    way_out = '; [ct] arms = "none" if no arm is there, or beyond_mm' if everything else ""
    numbers = {"beyond_mm": "all" if everything else what.wider_mm}
    return Finding(BEYOND_IMAGE, Severity.WARNING, f"{said} ({BEYOND_IMAGE}; {what.because}{way_out}{own})", numbers)


def beyond_labels(
    case: Case,
    skin: Skin,
    structures: Sequence[Structure],
    ends: Mapping[str, LabelEnds],
    memory: Memory = NO_MEMORY,
) -> tuple[tuple[Structure, ...], tuple[str, ...]]:
    """The body beyond the label maps that end in it, as one structure or none, and a warning for each such map.

    The ends of their labels are given by file, as the case writes its name.

    An organ that the map would have shown demands its margin of the needle's surface. So the margin of what is beyond
    is the largest that the case demands of any label of the map, and half a voxel more: a label that ends at the map's
    face has its edges cut off by so much there.

    Raises InputError: A map that does not hold the target, or one that ends in a body whose skin is open.
    """
    meshes, margins, warnings = list[TriangleMesh](), [0.0], []
    grids = label_grids(case)
    for grid in grids:
        voxels, (faces, flat) = grid.voxels, _shown(case, grid, grids, ends)
        target = apply(np.linalg.inv(voxels.T_ct_index), case.target_ct[None])[0]
        if np.any((target < faces[0]) | (target > faces[1])):
            what = f"label map {grid.name} does not contain the target, so its surroundings are unknown"
            what += ENDS_FLAT.format(flat=flat.max()) if flat.any() and voxels.contains(case.target_ct) else ""
            refuse(what, case.path, "label maps that contain the target", "labels_end")
        if grid.cut is not None:
            warnings.append(STATED.format(name=grid.name, cut=json.dumps(sorted(grid.cut))))
        sections = [one for one in case.structures if one.source == grid.name]
        named = [margin for one in sections for margin in (*one.avoid.values(), *one.unknown.values())]
        margin = max([case.ct.margin_mm, *named, *(one.margin_mm for one in grid.own(structures))])
        margin += float(voxels.spacing_mm.max()) / 2
        body = _near_body(case, skin.mesh, voxels, margin, memory)
        gaps = (faces - body) * [[1.0], [-1.0]]  # voxels by which the body goes on beyond each face of the map
        if gaps.max() <= VOXELS_OF_SLACK:
            continue
        said = ENDS.format(name=grid.name, voxels=gaps.max())
        said += ENDS_FLAT.format(flat=flat[gaps > 0.0].max()) if flat[gaps > 0.0].any() else ENDS_GRID
        if not skin.mesh.closed:
            allowed = "a label map of the whole body about the target, or a closed skin"
            refuse(f"{said} (the skin is open)", case.path, allowed, "labels_end")
        warnings.append(f"{said} ({BEYOND_LABELS})")
        margins.append(margin)
        for end, axis in np.argwhere(gaps > 0.0).tolist():
            beyond = body.copy()
            beyond[1 - end, axis] = faces[end, axis]
            meshes += _body_between(grid, skin.mesh, beyond, axis, end)
    if not meshes:
        return (), tuple(warnings)
    at_map = np.zeros((3, 3))  # where the map ends is known; the margin has half a voxel
    solid = Structure(BEYOND_LABELS, Role.UNKNOWN, max(margins), joined(meshes), BEYOND_LABELS, voxel_ct=at_map)
    return (solid,), tuple(warnings)


def _shown(
    case: Case, grid: LabelGrid, grids: Sequence[LabelGrid], ends: Mapping[str, LabelEnds]
) -> tuple[Floats, Floats]:
    """Low and high face, voxels, of what a map shows, and how wide labels were cut off there, mm; shapes (2, 3).

    Where none was, it is the grid's face. A label beyond, in the same map, says that the others end there by
    themselves; so do the case, and the rods of a phantom.
    """
    faces = np.array([np.zeros(3), grid.voxels.shape]) - 0.5
    alike = [one for one in grids if one is not grid and one.cut != () and on_one_grid(one.voxels, grid.voxels)]
    own, *others = (
        LabelEnds(*map(np.concatenate, zip(*(ends[name] for name in one.files), strict=True))) for one in (grid, *alike)
    )
    if grid.cut and len(own.last):
        return np.where(stated_cuts(grid), _outermost(own) + [[-0.5], [0.5]], faces), np.zeros((2, 3))
    if case.region == "phantom" or grid.cut is not None or not len(own.last):
        return faces, np.zeros((2, 3))
    planes, flat_mm = cut_off(own, grid.voxels.shape, [one for one in others if len(one.last)])
    return np.where(flat_mm, planes, faces), flat_mm


def stated_cuts(grid: LabelGrid) -> Bools:
    """At which low and high faces of a map's own axes the case states that it was cut, shape (2, 3)."""
    voxels = grid.voxels
    T_ct_oriented = canonical(np.broadcast_to(np.uint8(0), voxels.shape), voxels.T_ct_index).T_ct_index
    turned = np.rint(np.linalg.inv(voxels.T_ct_index) @ T_ct_oriented)[:3, :3]  # each axis by the patient's: 0, 1, -1
    sides = stated_ends(grid.cut or ())[np.abs(turned).argmax(axis=1)]
    return np.where(turned.sum(axis=1)[:, None] > 0.0, sides, sides[:, ::-1]).T


def cut_off(own: LabelEnds, shape: Sequence[int], others: Sequence[LabelEnds] = ()) -> tuple[Floats, Floats]:
    """The planes behind which no label of a map lies, voxels, and how wide labels were cut off there, mm: (2, 3) each.

    None at the faces of the grid, of this shape, where the map ends anyhow.
    ``others`` are the other maps on its grid, none empty. One whose labels end in the same plane was cut with it: of
    several maps with a label each no one shows a cut by itself. Then the ends must be wider by as much as maps go on
    beyond the plane: of many organs two may well end in one slice.
    """
    plane = _outermost(own)
    alone, beyond = _flat_mm(own, plane), np.zeros((2, 3), int)
    pooled = alone.copy()
    for other in others:
        alike = (other.last[:, None] == own.last) & (other.flat_mm[:, None] == own.flat_mm)
        twice = alike.all(axis=(2, 3)).any(axis=1)  # an organ that is in both maps is one
        if twice.all():
            continue
        rest = other.only(~twice)
        ends = _outermost(rest)
        pooled += np.where(ends == plane, _flat_mm(rest, plane), 0.0)
        beyond += (ends - plane) * [[-1], [1]] > 0
    within = plane != np.array([np.zeros(3), shape]) - [[0], [1]]
    cut = within & ((_evidence(alone) >= CUT_MM) | (_evidence(pooled) >= CUT_MM * np.maximum(1, beyond)))
    cut |= within & cut.any() & (alone.sum(axis=0) >= ALSO_CUT_MM)
    return plane + [[-0.5], [0.5]], np.where(cut, pooled.sum(axis=0), 0.0)


def _outermost(ends: LabelEnds) -> Ints:
    """A map's first and last slice with a label, shape (2, 3)."""
    return np.stack([ends.last.min(axis=0)[:, 0], ends.last.max(axis=0)[:, 1]])


def _flat_mm(ends: LabelEnds, plane: Ints) -> Floats:
    """How wide labels end flat in each plane, those that are no blocks and blocks, shape (2, 2, 3)."""
    flat_mm = np.where(ends.last == plane.T, ends.flat_mm, 0.0)
    return np.stack([flat_mm[of].sum(axis=0).T for of in (~ends.block, ends.block)])


def _evidence(flat_mm: Floats) -> Floats:
    """How much of flat ends, (2, 2, 3), says that they were cut, (2, 3).

    A block was drawn so, or is an organ that fills a crop: it counts where other labels end flat with it.
    """
    labels, blocks = flat_mm
    return labels + np.minimum(blocks, CUT_MM - ALSO_CUT_MM)


def _near_body(case: Case, skin: TriangleMesh, voxels: VolumeGrid, margin_mm: float, memory: Memory) -> Floats:
    """Low and high corner of the body within the needle's reach, in a map's voxels, which may be oblique: (2, 3)."""
    T_index_ct = np.linalg.inv(voxels.T_ct_index)
    key = (__name__, skin.digest, T_index_ct.tobytes())
    low, high = memory.get(key, lambda: box_of(apply(T_index_ct, skin.vertices)), lambda ends: ends.nbytes)
    target = apply(T_index_ct, case.target_ct[None])[0]
    # |row| is how many voxels an axis advances for a step of 1 mm along its normal
    reach = (case.needle.length_mm + margin_mm) * np.linalg.norm(T_index_ct[:3, :3], axis=1)
    return np.stack([np.maximum(low, target - reach), np.minimum(high, target + reach)])


def _body_between(grid: LabelGrid, skin: TriangleMesh, corners: Floats, axis: int, end: int) -> Iterator[TriangleMesh]:
    """The body between two corners, voxels, where there is any, in cells of which one layer ends in the map's face."""
    (low, high), step = corners, np.maximum(1.0, CELL_MM / grid.voxels.spacing_mm)
    count = np.ceil((high - low) / step).astype(int) + 2
    first = low - step / 2
    first[axis] = low[axis] + step[axis] / 2 if end else high[axis] - (count[axis] - 0.5) * step[axis]
    T_ct_cell = grid.voxels.T_ct_index @ pose(np.diag(step), first)
    inside = widened(voxels_inside(skin, T_ct_cell, tuple(count)), (1, 1, 1))
    if inside.any():
        oriented = canonical(inside, T_ct_cell)
        yield mask_surface(oriented.values, oriented.T_ct_index, where=grid.name)
