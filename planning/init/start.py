"""The text of a new case from a folder: what is in it, whether it fits together, and what a person should check."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from puncture_twin.planning.anatomy.skin import Skin
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import Cache
from puncture_twin.planning.base.cache.entry_file import Arrays
from puncture_twin.planning.base.errors import InputListError, NoAnswerError, refuse
from puncture_twin.planning.base.progress import Names
from puncture_twin.planning.base.text import first_few
from puncture_twin.planning.evidence.target import readings_inside
from puncture_twin.planning.formats.points import NamedPoints
from puncture_twin.planning.formats.volumes.volume_files import Volume
from puncture_twin.planning.geometry.containment import Side, side_of
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.spaces import Space, point_text
from puncture_twin.planning.init import segmentation, target as targets
from puncture_twin.planning.init.case_text import CaseParts, case_text
from puncture_twin.planning.init.finder import AIR_HU, LEFT_OUT, Contents, Ct, Markers, Wanted, find
from puncture_twin.planning.registration.fiducials import Stated, find_fiducials

ALLOWED = (
    "a folder with a segmentation, and a CT (NIfTI, NRRD or a DICOM series) or a structure named skin or body, see "
    "docs/how-to/your-own-ct.md"
)
SEEN = "markers_ct.csv"
"""File of the markers that the CT shows."""
OUTSIDE_WAYS = "a point in the body, mm, in the space given by --space; or --skin NAME for another skin"
PHANTOM = (
    'region = "phantom": no limbs are searched for, and of several connected objects the one with the target is the '
    "phantom; it has no support unless [ct] table says so or a separate object is below it"
)


@dataclass(frozen=True)
class Request:
    """A user's request for a new case."""

    folder: Path
    target: str | None  # ``X,Y,Z`` in mm, or None for ``target_label``
    target_label: str | None
    region: str | None  # as a case states it, or None to be told by the structures
    wanted: Wanted
    space_stated: bool = True  # whether the user said in which space the target is
    # of the ball that the target is, if the user says that it lies in no structure; else None
    hit_radius_mm: float | None = None


@dataclass(frozen=True, eq=False)
class Start:
    """A new case, not yet written."""

    text: str
    parts: CaseParts
    notes: tuple[str, ...]
    # markers that the CT shows where no list of them is given, as they are to be written beside the case
    seen: Markers | None = None


def start_case(request: Request, cache: Cache, progress: Names) -> Start:
    """The text of a case with the files of a folder. Raises InputError: all that keeps it from being made, in one."""
    space, overrides = request.wanted.space, request.wanted.overrides
    point = None if request.target is None else targets.parse_point(request.target, space)
    folder = find(segmentation.Place(request.folder, cache, progress), request.wanted)
    names = [name for one in folder.segmentations for name in one.names.values()]
    if not folder.problems:
        overrides.check_names(names, [name for name, _ in folder.passed])
    ct, own = _checked(folder, names, point, request)
    progress("skin")
    if own is None:
        assert ct is not None  # one of the two is there
        skin, skin_source = ct.surfaces.imaged().skin(), ct.source
    else:
        skin, skin_source = own.segmentation.skin(own.label), f"'{own.name}' of {own.segmentation.source}"
    seen, marker_notes = _seen_in_ct(request.folder, folder, ct, skin)
    progress("structures")
    if point is not None and ct is not None:
        _refuse_outside(point, space, ct, skin.mesh)
    stated = dict(overrides.roles) | ({} if own is None else {own.name: "skin"})
    gone = frozenset(name for name, kind in stated.items() if kind != "unknown")
    outlines = segmentation.Outlines(folder.segmentations, skin, gone)
    if point is None:
        target = targets.label_target(str(request.target_label), outlines, space)
    else:
        hit_radius_mm, space_stated = request.hit_radius_mm, request.space_stated
        target = targets.typed_target(point, outlines, space, space_stated=space_stated, hit_radius_mm=hit_radius_mm)
    region = request.region or targets.likely_region(names, target.holding.target)
    left_out = outlines.at(target.point_ct)
    border = segmentation.bordering(target.holding.target, folder.segmentations)
    carved = {name for name, fraction in border.items() if fraction >= segmentation.ALL_ROUND}
    holding = target.holding._replace(others=target.holding.others | carved)
    roles = [targets.assign(one.names, region, holding, left_out, stated) for one in folder.segmentations]
    parts = CaseParts(
        name=request.folder.resolve().name,
        space=space,
        region=region,
        target_ct=target.point_ct,
        structure=holding.target,
        hit_radius_mm=target.hit_radius_mm,
        ct=None if ct is None else ct.source,
        skin=skin_source,
        sources=tuple(zip(folder.segmentations, roles, strict=True)),
        markers=_in_order(folder.markers, ct) or tuple(filter(None, [seen])),
        left_out=tuple(name for name, why in folder.passed if why == LEFT_OUT),
        keys=overrides.keys,
    )
    notes = [*_notes(request, folder, target.notes, parts, holding), *marker_notes]
    notes += segmentation.carved_notes(parts.rows, holding.target, border)
    return Start(case_text(parts), parts, (*notes, *outlines.notes(target.point_ct)), seen)


def _in_order(markers: Sequence[Markers], ct: Ct | None) -> tuple[Markers, ...]:
    """Lists whose points lie in the CT first, then by the names of their files."""
    within = [ct is None or all(map(ct.surfaces.source.grid.contains, one.points.points)) for one in markers]
    order = sorted(zip(within, markers, strict=True), key=lambda pair: (not pair[0], pair[1].source))
    return tuple(one for _, one in order)


def _refuse_outside(point: Floats, space: Space, ct: Ct, skin: TriangleMesh) -> None:
    """Refuse a typed target that the CT or its body does not hold."""
    grid = ct.surfaces.source.grid

    def in_body(one: Floats) -> bool:
        return grid.contains(one) and side_of(skin, one) is not Side.OUTSIDE

    if not in_body(point):
        place = "the body in" if grid.contains(point) else "the CT"
        hint = readings_inside(point, space, in_body)
        what = f"target ({point_text(point, space)}) lies outside {place} {ct.source}{hint}"
        refuse(what, "--target", OUTSIDE_WAYS, "target_outside_body")


def _checked(
    folder: Contents, names: Sequence[str], point: Floats | None, request: Request
) -> tuple[Ct | None, segmentation.Structure | None]:
    """The one CT, and the structure that is the skin where the CT is not asked: one of the two is there."""
    problems, stated = list(folder.problems), request.wanted.overrides.skin

    def problem(what: str, code: str, allowed: str = ALLOWED) -> None:
        problems.append(InputListError(what, where=HERE, allowed=allowed, code=code))

    cts = [one for one in folder.cts if point is not None and one.surfaces.source.grid.contains(point)] or folder.cts
    listed = [f"{name} ({why})" for name, why in folder.passed]
    listed += [f"{one.source} (a CT)" for one in folder.cts]
    listed += [f"{one.source} (a segmentation)" for one in folder.segmentations]
    lies = f"; found here: {first_few(listed)}" if listed else "; no file here has a supported format"
    if len(cts) > 1:
        sources = ", ".join(one.source for one in cts)
        problem(f"several CTs: {sources} (choose with --ct)", "several_cts", "--ct with the intended one")
    if not folder.segmentations and not problems:
        problem(f"no segmentation (label map, masks or meshes){lies}", "no_segmentation")
    skin = None if cts and stated is None else segmentation.skin_of(folder.segmentations, stated)
    if skin is None and not cts and not folder.problems:
        no_ct = f"no CT in Hounsfield units (min below {AIR_HU}), and no structure named like the skin{lies}"
        hint = f"; --skin NAME if one of these is the skin: {first_few(names)}" if names else ""
        problem(no_ct, "no_ct", f"{ALLOWED}{hint}")
    elif skin is not None and stated is None:
        for why in segmentation.skin_problems(skin, folder.segmentations):
            problem(why, "no_skin", "--skin NAME with the structure that is the skin")
    counts = Counter(name for one in folder.segmentations for name in set(one.names.values()))
    if twice := [name for name, count in counts.items() if count > 1]:  # one of the two is meant
        sources = ", ".join(one.source for one in folder.segmentations if set(one.names.values()) & set(twice))
        doubled = f"{sources} have structures with the same name, such as '{twice[0]}' (choose with --segmentation)"
        problem(doubled, "doubled", "--segmentation with the intended one")
    if problems:
        places = ["" if one.where == HERE else f"{one.where.removeprefix(f'{request.folder}/')}: " for one in problems]
        said = "; ".join(place + one.what for place, one in zip(places, problems, strict=True))
        remedies = "; ".join(dict.fromkeys(one.allowed for one in problems))
        raise InputListError(said, where=request.folder, allowed=remedies, code=problems[0].code)
    return cts[0] if cts else None, skin


HERE = "folder"
"""Place of a problem of the folder itself."""


def _seen_in_ct(folder: Path, contents: Contents, ct: Ct | None, skin: Skin) -> tuple[Markers | None, tuple[str, ...]]:
    """Markers on the skin in the CT, where no list is given and none would be replaced; and notes for a person."""
    if contents.markers or ct is None or (folder / SEEN).exists():
        return None, ()
    imaged = ct.surfaces.imaged()

    def look() -> Arrays:
        volume = Volume(imaged.image.hu, imaged.image.T_ct_index, folder)
        try:
            seen = find_fiducials(volume, skin, Stated(), where=folder).fiducials
        except NoAnswerError as error:
            return {"points": np.zeros((0, 3)), "why": np.array("" if error.code == "no_markers" else str(error))}
        return {"points": np.array([one.position_ct for one in seen]), "why": np.array("")}

    detected = imaged.kept({"what": "markers", "skin": skin.mesh.digest}, look, dict, by=__name__)
    points, why = detected["points"], str(detected["why"])
    if not len(points):
        return None, (f"the CT may show markers ({why}): see run-twin markers {folder}",) if why else ()
    names = tuple(f"M{number}" for number in range(1, len(points) + 1))
    note = f"the CT shows {len(points)} markers, written to {SEEN}; run-twin markers {folder} draws them"
    return Markers(SEEN, NamedPoints(names, points, Space.LPS)), (note,)


def _notes(
    request: Request, folder: Contents, of_target: Sequence[str], parts: CaseParts, holding: targets.Holding
) -> Iterator[str]:
    if folder.passed:
        yield f"left out: {first_few([f'{name} ({why})' for name, why in folder.passed])}"
    others = [one.source for one in folder.cts if one.source != parts.ct]
    if others and parts.ct is not None:
        yield f"the CT is {parts.ct}, which contains the target; left out: {', '.join(others)}"
    for one in folder.segmentations:
        yield from one.notes
    yield from of_target
    yield from targets.role_notes(parts.rows, holding)
    if request.region is None:
        if_phantom = ", phantom for a phantom" if parts.region == "other" else ""
        yield f'region = "{parts.region}" was inferred from the structures; use --region to change it{if_phantom}'
    if parts.region == "phantom":
        yield PHANTOM
    if parts.markers:
        names = ", ".join(one.source for one in parts.markers)
        yield f"{names}: possibly markers (see the comments in the case); without [registration] the arm is not checked"
