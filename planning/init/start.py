"""A folder in, the text of a case out: what is found, whether it fits together, and what a person should look at."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from puncture_twin.planning.anatomy.default_roles import BODY
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import Cache
from puncture_twin.planning.base.errors import InputError, InputListError
from puncture_twin.planning.base.progress import Names
from puncture_twin.planning.base.text_names import first_few
from puncture_twin.planning.evidence.target import readings_inside
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid
from puncture_twin.planning.geometry.containment import Side, side_of
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.geometry.spaces import Space, point_text
from puncture_twin.planning.init.case_text import CaseParts, case_text
from puncture_twin.planning.init.finder import AIR_HU, Ct, Found, Markers, Wanted, find
from puncture_twin.planning.init.mesh_folder import SkinMesh, skin_mesh, skin_problems
from puncture_twin.planning.init.outlines import Outlines, carved_notes
from puncture_twin.planning.init.roles import assign, likely_region, role_notes
from puncture_twin.planning.init.segmentation import Assigned, Place, Segmentation
from puncture_twin.planning.init.target import Target, label_target, parse_point, typed_target

ALLOWED = "a folder with a CT (NIfTI, NRRD or a DICOM series) and a segmentation, see docs/how-to/your-own-ct.md"


@dataclass(frozen=True)
class Request:
    """What the user wants.

    Attributes:
        folder: Where the files are, and the case will be.
        target: ``X,Y,Z`` in mm, or None for ``target_label``.
        target_label: The name of a structure.
        region: As a case states it, or None to be told by the structures.
        space_stated: Whether the user said in which space the target is.
        hit_radius_mm: Of the ball that the target is, if the user says that it lies in no structure; else None.
        wanted: What the user says of the files.
        trust_labels: Whether a person has seen that the structures lie right.
    """

    folder: Path
    target: str | None
    target_label: str | None
    region: str | None
    wanted: Wanted
    space_stated: bool = True
    hit_radius_mm: float | None = None
    trust_labels: bool = False


@dataclass(frozen=True, eq=False)
class Start:
    """A new case, not yet written.

    Attributes:
        text: The file.
        parts: What it was made of.
        notes: What a person should look at, one sentence each.
    """

    text: str
    parts: CaseParts
    notes: tuple[str, ...]


def start_case(request: Request, cache: Cache, progress: Names) -> Start:
    """Find the files of a folder, and write the text of a case with them.

    Args:
        request: What the user wants.
        cache: Where surfaces are kept.
        progress: Called with the name of each file that is read.

    Raises:
        InputError: All that keeps a case from being made, in one line.
    """
    space = request.wanted.space
    point = None if request.target is None else parse_point(request.target, space)
    found = find(Place(request.folder, cache, progress), request.wanted)
    body = _checked(found, point, request)
    ct = body if isinstance(body, Ct) else None
    if point is not None and ct is not None:
        _refuse_outside(point, ct, space)
    skin = body.surfaces.imaged().skin() if isinstance(body, Ct) else body.skin()
    outlines = Outlines(found.segmentations, skin)
    target = _target(request, point, outlines)
    names = [name for one in found.segmentations for name in one.names.values()]
    region = request.region or likely_region(names, target.holding.target)
    left_out = outlines.at(target.point_ct)
    rows = [assign(one.names, region, target.holding, left_out) for one in found.segmentations]
    if isinstance(body, SkinMesh):
        rows = [_with_skin(some, body) for some in rows]
    parts = CaseParts(
        name=request.folder.resolve().name,
        space=space,
        region=region,
        target_ct=target.point_ct,
        structure=target.holding.target,
        hit_radius_mm=target.hit_radius_mm,
        ct=None if ct is None else ct.source,
        sources=tuple(zip(found.segmentations, rows, strict=True)),
        markers=tuple(_markers_of_ct(found.markers, ct)),
        trust_labels=request.trust_labels,
    )
    notes = (*_notes(request, found, target, parts), *outlines.notes(target.point_ct))
    return Start(case_text(parts), parts, notes)


def _target(request: Request, point: Floats | None, outlines: Outlines) -> Target:
    if point is not None:
        space, radius = request.wanted.space, request.hit_radius_mm
        return typed_target(point, outlines, space, space_stated=request.space_stated, hit_radius_mm=radius)
    return label_target(str(request.target_label), outlines, request.wanted.space)


def _checked(found: Found, point: Floats | None, request: Request) -> Ct | SkinMesh:
    """The one CT, or the mesh that is the skin.

    Raises:
        InputError: Everything that is missing, doubled or could not be read.
    """
    problems = list(found.problems)
    cts = _holding(found.cts, point)
    if len(cts) > 1:
        problems.append(
            _problem(f"several CTs: {', '.join(one.source for one in cts)} (--ct says which)", "several_cts")
        )
    if not found.segmentations and not problems:
        problems.append(_problem(f"no segmentation (label map, masks or meshes){_lies(found)}", "no_segmentation"))
    mesh = None if cts else skin_mesh(found.segmentations)
    if mesh is not None:
        problems += [_problem(one, "no_skin") for one in skin_problems(mesh, found.segmentations)]
    elif not cts and not found.problems:
        what = f"no CT in Hounsfield units (min below {AIR_HU}), and no mesh named like the skin{_lies(found)}"
        problems.append(_problem(what, "no_ct"))
    problems += [_problem(one, "doubled") for one in _doubled(found.segmentations)]
    body = cts[0] if cts else mesh
    if problems or body is None:
        said = [
            one.what if one.where == HERE else f"{_below(one.where, request.folder)}: {one.what}" for one in problems
        ]
        ways = dict.fromkeys(one.allowed for one in problems)
        code = problems[0].code if problems else ""
        raise InputListError("; ".join(said), where=request.folder, allowed="; ".join(ways), code=code)
    return body


HERE = "folder"
"""Where a problem of the folder itself is."""


def _problem(what: str, code: str) -> InputListError:
    return InputListError(what, where=HERE, allowed=ALLOWED, code=code)


def _lies(found: Found) -> str:
    """What lies in the folder, and why it is neither."""
    taken = [(one.source, "a CT") for one in found.cts] + [
        (one.source, "a segmentation") for one in found.segmentations
    ]
    listed = [f"{name} ({why})" for name, why in (*found.passed, *taken)]
    return f"; here lies: {first_few(listed)}" if listed else "; nothing here is of a kind that is read"


def _below(where: str, folder: Path) -> str:
    return where.removeprefix(f"{folder}/")


def _holding(cts: Sequence[Ct], point: Floats | None) -> list[Ct]:
    """The CTs that hold a point, or all where none does."""
    holding = [one for one in cts if point is not None and _contains(one.surfaces.source.grid, point)]
    return holding or list(cts)


def _contains(grid: VolumeGrid, point_ct: Floats) -> bool:
    index = apply(np.linalg.inv(grid.T_ct_index), point_ct[None])[0]
    return bool(np.all((index >= -0.5) & (index <= np.array(grid.shape) - 0.5)))


def _doubled(segmentations: Sequence[Segmentation]) -> Iterator[str]:
    """Names that two segmentations have: one of the two is meant."""
    counts = Counter(name for one in segmentations for name in set(one.names.values()))
    twice = [name for name, count in counts.items() if count > 1]
    if twice:
        sources = ", ".join(one.source for one in segmentations if set(one.names.values()) & set(twice))
        yield f"{sources} hold structures of one name, such as '{twice[0]}' (--segmentation says which)"


def _refuse_outside(point: Floats, ct: Ct, space: Space) -> None:
    """A target outside of the CT or of the body in it."""
    grid = ct.surfaces.source.grid

    def in_body(one: Floats) -> bool:
        return _contains(grid, one) and side_of(ct.surfaces.imaged().skin().mesh, one) is not Side.OUTSIDE

    if not in_body(point):
        place = "the body in" if _contains(grid, point) else "the CT"
        hint = readings_inside(point, space, in_body)
        what = f"target ({point_text(point, space)}) lies outside {place} {ct.source}{hint}"
        raise InputError(what, where="--target", allowed="a point in the body, in mm, in the space that --space states")


def _with_skin(rows: Sequence[Assigned], skin: SkinMesh) -> list[Assigned]:
    """The same rows, with the mesh that is the skin as such; names are told apart before."""
    return [row._replace(kind="skin", line=BODY) if row.name == skin.name else row for row in rows]


def _markers_of_ct(markers: Sequence[Markers], ct: Ct | None) -> list[Markers]:
    """Lists of points, those whose points lie in the CT first; without a CT those of the patient's space first."""
    if ct is None:
        return sorted(markers, key=lambda one: one.source)
    grid = ct.surfaces.source.grid
    return sorted(markers, key=lambda one: (not all(_contains(grid, point) for point in one.points.points), one.source))


def _notes(request: Request, found: Found, target: Target, parts: CaseParts) -> Iterator[str]:
    if found.passed:
        yield f"left out: {first_few([f'{name} ({why})' for name, why in found.passed])}"
    others = [one.source for one in found.cts if one.source != parts.ct]
    if others and parts.ct is not None:
        yield f"the CT is {parts.ct}, which holds the target; left out: {', '.join(others)}"
    for one in found.segmentations:
        yield from one.notes
    yield from target.notes
    yield from role_notes(parts.rows, target.holding)
    yield from carved_notes(parts.sources)
    if request.region is None:
        yield f'region = "{parts.region}" is told by the structures; --region says otherwise'
    if parts.markers:
        names = ", ".join(one.source for one in parts.markers)
        yield f"{names}: may be markers, named in comments; without [registration] no arm is checked"
