"""A folder in, the text of a case out: what is found, whether it fits together, and what a person should look at."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

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
from puncture_twin.planning.geometry.spaces import Space, point_text
from puncture_twin.planning.init import segmentation
from puncture_twin.planning.init.case_text import CaseParts, case_text
from puncture_twin.planning.init.finder import AIR_HU, LEFT_OUT, Ct, Found, Markers, Wanted, find
from puncture_twin.planning.init.target import (
    Target,
    assign,
    label_target,
    likely_region,
    parse_point,
    role_notes,
    typed_target,
)
from puncture_twin.planning.registration.fiducials import Stated, find_fiducials

ALLOWED = (
    "a folder with a segmentation, and a CT (NIfTI, NRRD or a DICOM series) or a structure named skin or body, see "
    "docs/how-to/your-own-ct.md"
)


SEEN = "markers_ct.csv"
"""Where markers are listed that the CT shows."""
OUTSIDE_WAYS = "a point in the body, mm, in the space given by --space; or --skin NAME for another skin"
PHANTOM = (
    'region = "phantom": no limbs are searched for, and of several connected objects the one with the target is the '
    "phantom; it has no support unless [ct] table says so or a separate object is below it"
)


@dataclass(frozen=True)
class Request:
    """What the user wants.

    Attributes:
        target: ``X,Y,Z`` in mm, or None for ``target_label``.
        region: As a case states it, or None to be told by the structures.
        space_stated: Whether the user said in which space the target is.
        hit_radius_mm: Of the ball that the target is, if the user says that it lies in no structure; else None.
    """

    folder: Path
    target: str | None
    target_label: str | None
    region: str | None
    wanted: Wanted
    space_stated: bool = True
    hit_radius_mm: float | None = None


@dataclass(frozen=True, eq=False)
class Start:
    """A new case, not yet written.

    Attributes:
        seen: Markers that the CT shows where no list of them is given, as they are to be written beside the case.
    """

    text: str
    parts: CaseParts
    notes: tuple[str, ...]
    seen: Markers | None = None


def start_case(request: Request, cache: Cache, progress: Names) -> Start:
    """Find the files of a folder, and write the text of a case with them.

    Raises:
        InputError: All that keeps a case from being made, in one line.
    """
    space, overrides = request.wanted.space, request.wanted.overrides
    point = None if request.target is None else parse_point(request.target, space)
    found = find(segmentation.Place(request.folder, cache, progress), request.wanted)
    names = [name for one in found.segmentations for name in one.names.values()]
    if not found.problems:
        overrides.check_names(names, [name for name, _ in found.passed])
    body = _checked(found, point, request)
    progress("skin")
    skin = body.skin()
    seen, of_seen = _seen_in_ct(request.folder, found, body, skin)
    progress("structures")
    if point is not None and body.ct is not None:
        _refuse_outside(point, body.ct, skin, space)
    stated = dict(overrides.roles) | ({} if body.structure is None else {body.structure.name: "skin"})
    gone = frozenset(name for name, kind in stated.items() if kind != "unknown")
    outlines = segmentation.Outlines(found.segmentations, skin, gone)
    target = _target(request, point, outlines)
    region = request.region or likely_region(names, target.holding.target)
    left_out = outlines.at(target.point_ct)
    border = segmentation.bordering(target.holding.target, found.segmentations)
    carved = {name for name, fraction in border.items() if fraction >= segmentation.ALL_ROUND}
    target = replace(target, holding=target.holding._replace(others=target.holding.others | carved))
    parts = CaseParts(
        name=request.folder.resolve().name,
        space=space,
        region=region,
        target_ct=target.point_ct,
        structure=target.holding.target,
        hit_radius_mm=target.hit_radius_mm,
        ct=None if body.ct is None else body.ct.source,
        skin=body.source,
        sources=tuple(
            (one, assign(one.names, region, target.holding, left_out, stated)) for one in found.segmentations
        ),
        markers=tuple(_markers_of_ct(found.markers, body.ct)) or tuple(filter(None, [seen])),
        left_out=tuple(name for name, why in found.passed if why == LEFT_OUT),
        keys=overrides.keys,
    )
    told = segmentation.carved_notes(parts.rows, target.holding.target, border)
    notes = (*_notes(request, found, target, parts), *of_seen, *told, *outlines.notes(target.point_ct))
    return Start(case_text(parts), parts, notes, seen)


def _target(request: Request, point: Floats | None, outlines: segmentation.Outlines) -> Target:
    if point is not None:
        space, radius = request.wanted.space, request.hit_radius_mm
        return typed_target(point, outlines, space, space_stated=request.space_stated, hit_radius_mm=radius)
    return label_target(str(request.target_label), outlines, request.wanted.space)


class Body(NamedTuple):
    """Where the skin comes from.

    Attributes:
        ct: The CT, where there is one.
        structure: The structure that is the skin, where the CT is not asked.
    """

    ct: Ct | None
    structure: segmentation.SkinOf | None

    def skin(self) -> Skin:
        """The body's."""
        if self.structure is not None:
            return self.structure.skin()
        assert self.ct is not None
        return self.ct.surfaces.imaged().skin()

    @property
    def source(self) -> str:
        """For a person."""
        if self.structure is not None:
            return f"'{self.structure.name}' of {self.structure.segmentation.source}"
        return "" if self.ct is None else self.ct.source


def _checked(found: Found, point: Floats | None, request: Request) -> Body:
    """The one CT, and what is the skin."""
    problems = list(found.problems)
    cts, stated = _holding(found.cts, point), request.wanted.overrides.skin
    if len(cts) > 1:
        what = f"several CTs: {', '.join(one.source for one in cts)} (choose with --ct)"
        problems.append(_problem(what, "several_cts", "--ct with the intended one"))
    if not found.segmentations and not problems:
        problems.append(_problem(f"no segmentation (label map, masks or meshes){_lies(found)}", "no_segmentation"))
    skin = None if cts and stated is None else segmentation.skin_of(found.segmentations, stated)
    if skin is None and not cts and not found.problems:
        problems.append(_no_skin(found))
    elif skin is not None and stated is None:
        wrong = segmentation.skin_problems(skin, found.segmentations)
        problems += [_problem(one, "no_skin", "--skin NAME with the structure that is the skin") for one in wrong]
    problems += [
        _problem(one, "doubled", "--segmentation with the intended one") for one in _doubled(found.segmentations)
    ]
    if problems:
        said = [
            one.what if one.where == HERE else f"{_below(one.where, request.folder)}: {one.what}" for one in problems
        ]
        ways = dict.fromkeys(one.allowed for one in problems)
        code = problems[0].code
        raise InputListError("; ".join(said), where=request.folder, allowed="; ".join(ways), code=code)
    return Body(cts[0] if cts else None, skin)


def _no_skin(found: Found) -> InputListError:
    """Nothing says where the body ends; what is there may."""
    what = f"no CT in Hounsfield units (min below {AIR_HU}), and no structure named like the skin{_lies(found)}"
    names = [name for one in found.segmentations for name in one.names.values()]
    way = f"; --skin NAME if one of these is the skin: {first_few(names)}" if names else ""
    return _problem(what, "no_ct", f"{ALLOWED}{way}")


HERE = "folder"
"""Where a problem of the folder itself is."""


def _problem(what: str, code: str, allowed: str = ALLOWED) -> InputListError:
    return InputListError(what, where=HERE, allowed=allowed, code=code)


def _lies(found: Found) -> str:
    """What lies in the folder, and why it is neither."""
    taken = [(one.source, "a CT") for one in found.cts] + [
        (one.source, "a segmentation") for one in found.segmentations
    ]
    listed = [f"{name} ({why})" for name, why in (*found.passed, *taken)]
    return f"; found here: {first_few(listed)}" if listed else "; no file here has a supported format"


def _below(where: str, folder: Path) -> str:
    return where.removeprefix(f"{folder}/")


def _holding(cts: Sequence[Ct], point: Floats | None) -> list[Ct]:
    """The CTs that hold a point, or all where none does."""
    holding = [one for one in cts if point is not None and one.surfaces.source.grid.holds(point)]
    return holding or list(cts)


def _doubled(segmentations: Sequence[segmentation.Segmentation]) -> Iterator[str]:
    """Names that two segmentations have: one of the two is meant."""
    counts = Counter(name for one in segmentations for name in set(one.names.values()))
    twice = [name for name, count in counts.items() if count > 1]
    if twice:
        sources = ", ".join(one.source for one in segmentations if set(one.names.values()) & set(twice))
        yield f"{sources} have structures with the same name, such as '{twice[0]}' (choose with --segmentation)"


def _refuse_outside(point: Floats, ct: Ct, skin: Skin, space: Space) -> None:
    """A target outside of the CT or of the body in it."""
    grid = ct.surfaces.source.grid

    def in_body(one: Floats) -> bool:
        return grid.holds(one) and side_of(skin.mesh, one) is not Side.OUTSIDE

    if not in_body(point):
        place = "the body in" if grid.holds(point) else "the CT"
        hint = readings_inside(point, space, in_body)
        what = f"target ({point_text(point, space)}) lies outside {place} {ct.source}{hint}"
        refuse(what, "--target", OUTSIDE_WAYS, "target_outside_body")


def _markers_of_ct(markers: Sequence[Markers], ct: Ct | None) -> list[Markers]:
    """Lists of points, those whose points lie in the CT first; without a CT those of the patient's space first."""
    if ct is None:
        return sorted(markers, key=lambda one: one.source)
    grid = ct.surfaces.source.grid
    return sorted(markers, key=lambda one: (not all(grid.holds(point) for point in one.points.points), one.source))


def _seen_in_ct(folder: Path, found: Found, body: Body, skin: Skin) -> tuple[Markers | None, tuple[str, ...]]:
    """Markers on the skin in the CT, where no list is given and none would be replaced; and notes for a person."""
    if found.markers or body.ct is None or (folder / SEEN).exists():
        return None, ()
    imaged = body.ct.surfaces.imaged()

    def look() -> Arrays:
        volume = Volume(imaged.image.hu, imaged.image.T_ct_index, folder)
        try:
            seen = find_fiducials(volume, skin, Stated(), where=folder).fiducials
        except NoAnswerError as error:
            return {"points": np.zeros((0, 3)), "why": np.array("" if error.code == "no_markers" else str(error))}
        return {"points": np.array([one.position_ct for one in seen]), "why": np.array("")}

    kept = imaged.kept({"what": "markers", "skin": skin.mesh.digest}, look, dict, by=__name__)
    points, why = kept["points"], str(kept["why"])
    if not len(points):
        return None, (f"the CT may show markers ({why}): see run-twin markers {folder}",) if why else ()
    names = tuple(f"M{number}" for number in range(1, len(points) + 1))
    note = f"the CT shows {len(points)} markers, written to {SEEN}; run-twin markers {folder} draws them"
    return Markers(SEEN, NamedPoints(names, points, Space.LPS)), (note,)


def _notes(request: Request, found: Found, target: Target, parts: CaseParts) -> Iterator[str]:
    if found.passed:
        yield f"left out: {first_few([f'{name} ({why})' for name, why in found.passed])}"
    others = [one.source for one in found.cts if one.source != parts.ct]
    if others and parts.ct is not None:
        yield f"the CT is {parts.ct}, which contains the target; left out: {', '.join(others)}"
    for one in found.segmentations:
        yield from one.notes
    yield from target.notes
    yield from role_notes(parts.rows, target.holding)
    if request.region is None:
        if_phantom = ", phantom for a phantom" if parts.region == "other" else ""
        yield f'region = "{parts.region}" was inferred from the structures; use --region to change it{if_phantom}'
    if parts.region == "phantom":
        yield PHANTOM
    if parts.markers:
        names = ", ".join(one.source for one in parts.markers)
        yield f"{names}: possibly markers (see the comments in the case); without [registration] the arm is not checked"
