"""Label maps, masks and files of structures that may overlap (DICOM, a layered .seg.nrrd), as segmentations.

TotalSegmentator's versions 1 and 2 give the same numbers to other organs. Under the wrong one, left organs lie on the
right, or vertebrae lie in no order: that tells the version.
"""

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy

from puncture_twin.planning.anatomy.default_roles import default_role
from puncture_twin.planning.anatomy.skin import Skin
from puncture_twin.planning.anatomy.surfaces import VolumeSurfaces
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.base.files import read_input
from puncture_twin.planning.base.text import first_few
from puncture_twin.planning.case.tables import StructuresSection
from puncture_twin.planning.formats.folder import entries
from puncture_twin.planning.formats.labels.label_sources import MAX_ENTRIES, structure_name
from puncture_twin.planning.formats.labels.labelmaps import NAME_ENDINGS, Box, LabelMap, parse_names
from puncture_twin.planning.formats.labels.naming import BUILT_IN, MAX_CSV_BYTES, names_for
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.init import segmentation
from puncture_twin.planning.init.segmentation import Assigned, Place, Segmentation, label_text, quoted, rules_text

NUMBERING_FOUND = "{source}: numbered as {naming}, inferred from the positions of its organs"
NUMBERING_UNSURE = (
    "{tables}, and the positions of its organs do not show whether totalsegmentator-v1 or -v2 numbered its labels"
)


class Mask(NamedTuple):
    """A mask that is not empty, with the box of its voxels."""

    file: str  # relative to the case's folder
    label: int
    box: Box
    T_ct_index: Floats  # shape (4, 4), voxel index to LPS mm


def masks_of(
    place: Place, source: str, listed: Sequence[Mask], notes: tuple[str, ...], *, whole_folder: bool
) -> Segmentation:
    """Masks of one folder, one file a structure; the case names the ``whole_folder`` where it holds nothing else."""
    masks = dict(enumerate(listed, start=1))

    def single(row: Assigned) -> str:
        return label_text(row, masks[row.label].file, masks[row.label].label)

    def section(rows: Sequence[Assigned]) -> str:
        if not whole_folder:
            return "\n".join(single(row) for row in rows if row.kind != "ignore")
        skins = (f"\n{single(row)}" for row in rows if row.kind == "skin")
        return f"[[structures]]\nmasks = {quoted(source)}\n{rules_text(rows)}{''.join(skins)}"

    return Segmentation(
        source,
        {number: structure_name(one.file) for number, one in masks.items()},
        near=lambda point_ct: tuple(n for n, one in masks.items() if in_box(point_ct, one.box, one.T_ct_index)),
        surface=lambda label: place.volume(masks[label].file).label(masks[label].label),
        skin=lambda label: place.volume(masks[label].file).imaged(masks[label].label).skin(),
        section=section,
        voxel_ct=listed[0].T_ct_index[:3, :3],
        notes=notes,
    )


def in_box(point_ct: Floats, box: Box, T_ct_index: Floats) -> bool:
    """Whether a point (3,), LPS mm, lies in a box of voxels, up to their outer faces."""
    index = apply(np.linalg.inv(T_ct_index), np.reshape(point_ct, (1, 3)))[0]
    return all(axis.start - 0.5 <= one <= axis.stop - 0.5 for axis, one in zip(box, index, strict=True))


def mask_of(file: str, labels: LabelMap) -> Mask | None:
    """The mask in a file; None for an empty one."""
    if not labels.boxes:
        return None
    ((label, box),) = labels.boxes.items()  # of several none may be dropped: who asks has looked
    return Mask(file, label, box, labels.T_ct_index)


def label_file(place: Place, source: str, surfaces: VolumeSurfaces, naming: str | None) -> Segmentation:
    """A label map with names: stated as ``naming``, inside the file, in a table beside it, or TotalSegmentator's.

    Raises InputError: no names are found, or they do not name every label.
    """
    present = surfaces.present().labels
    if naming is None and surfaces.names is None:
        naming, notes = _naming(place, source, surfaces.labelmap, present)
    else:
        notes = ()
    named = names_for(naming, place.folder, lambda name: _table(place.folder / name), surfaces)
    if missing := [label for label in present if label not in named]:
        what = f"labels without a name: {', '.join(map(str, missing[:10]))}"
        refuse(what, place.folder / source, "--naming with a name for each label", "labels_without_names")
    stated = "" if naming is None else f"naming = {quoted(naming)}\n"

    def near(point_ct: Floats) -> tuple[int, ...]:
        labels = surfaces.labelmap
        return tuple(label for label, box in labels.boxes.items() if in_box(point_ct, box, labels.T_ct_index))

    def section(rows: Sequence[Assigned]) -> str:
        skins = (f"\n{label_text(row, source, row.label)}" for row in rows if row.kind == "skin")
        return f"[[structures]]\nlabelmap = {quoted(source)}\n{stated}{rules_text(rows)}{''.join(skins)}"

    return Segmentation(
        source,
        {label: named[label] for label in present},
        near=near,
        surface=surfaces.label,
        skin=lambda label: surfaces.imaged(label).skin(),
        section=section,
        voxel_ct=surfaces.voxel_ct,
        notes=notes,
    )


def _naming(place: Place, source: str, labels: LabelMap, present: Sequence[int]) -> tuple[str, tuple[str, ...]]:
    table, others = _full_table(place, source, present, _tables_near(place.folder, source))
    if table is not None:
        return table[0], (f"{source}: names from {table[0]}",)
    naming = likely_numbering(labels)
    if naming is None:
        passed = f"no table next to it names all of its labels: {first_few(others)}"
        tables = passed if others else "no table of names is next to it"
        allowed = f"--naming with {', '.join(BUILT_IN)} or a table (CSV, JSON) that names every label"
        refuse(NUMBERING_UNSURE.format(tables=tables), place.folder / source, allowed, "labels_without_names")
    return naming, (NUMBERING_FOUND.format(source=source, naming=naming), *(f"{source}: {one}" for one in others))


def is_named_by_table(place: Place, source: str, label: int, only: bool) -> bool:
    """Whether a table beside a map of one label names that: not one with the file's own name in it.

    ``only``: whether no other map or mask lies beside it, so that the table may have any name. Raises InputError: it is
    one organ by the file's name, and another by a table of another name.
    """
    tables = [one for one in _tables_near(place.folder, source) if only or _is_named_like(one, source)]
    table, _ = _full_table(place, source, [label], tables)
    name = structure_name(source)
    if table is None or name in table[1].values():
        return False
    own, tabled = (default_role(one, "other") for one in (name, table[1][label]))
    if own not in (None, tabled) and not _is_named_like(table[0], source):
        what = f"is '{name}' by its own name, but '{table[1][label]}' by {table[0]}"
        allowed = "--naming with that table if it is right; otherwise move the table to another folder"
        refuse(what, place.folder / source, allowed, "label_named_twice")
    return True


def _full_table(
    place: Place, source: str, present: Sequence[int], tables: Iterable[str]
) -> tuple[tuple[str, dict[int, str]] | None, list[str]]:
    """The table beside a map that names all of its labels: the one named like the map, else the only one."""
    named, others = [], []
    for table in tables:
        try:
            names = parse_names(_table(place.folder / table), place.folder / table)
        except InputError as error:
            others.append(f"{table}: {error.what}")
            continue
        if missing := [label for label in present if label not in names]:
            others.append(f"{table} lacks {_ranges(missing)} (it names {_ranges(sorted(names))})")
        else:
            named.append((table, names))
    if not named or _is_named_like(named[0][0], source):
        return (named[0] if named else None), others
    if any([other[label] for label in present] != [named[0][1][label] for label in present] for _, other in named[1:]):
        what = f"several tables name its labels differently: {', '.join(table for table, _ in named)}"
        refuse(what, place.folder / source, "--naming with the right table", "several_namings")
    return named[0], others


def _ranges(labels: Sequence[int]) -> str:
    """Rising numbers as runs, such as ``1 to 8, 12``."""
    starts = [one for one in labels if one - 1 not in labels]
    ends = [one for one in labels if one + 1 not in labels]
    return first_few([f"{a}" if a == b else f"{a} to {b}" for a, b in zip(starts, ends, strict=True)])


def _is_named_like(table: str, source: str) -> bool:
    """Whether a table is called like a map, up to the first dot."""
    return table.rpartition("/")[2].split(".")[0] == structure_name(source).split(".")[0]


def _tables_near(folder: Path, source: str) -> Iterator[str]:
    """Files that may be tables of names, those first that are named like the map."""
    parent = (folder / source).parent
    files = [one.name for one in entries(parent, most=MAX_ENTRIES) if one.name.lower().endswith(NAME_ENDINGS)]
    for name in sorted(files, key=lambda file: (not _is_named_like(file, source), file)):
        yield (parent / name).relative_to(folder).as_posix()


def _table(path: Path) -> bytes:
    return read_input(path, max_bytes=MAX_CSV_BYTES, where=str(path))


def file_masks(place: Place, source: str, key: str, ct: str | None) -> Segmentation:
    """The structures of a file: of DICOM on the slices of the CT, or segments of Slicer, of which some overlap.

    ``key`` of the case: ``seg`` or ``rtstruct``; ``ct`` was read before, or is None. Raises InputError: they cannot be
    trusted, or were drawn on another CT.
    """
    place.content(source)
    place.volumes.read_masks(StructuresSection.model_validate({key: source}), ct)
    read = {name: place.surfaces(volume) for name, volume in place.volumes.masks(source).items()}
    parts = {name: (surfaces, value) for name, surfaces in read.items() for value in surfaces.mask().labels}
    names = dict(enumerate(parts, start=1))

    def surface(label: int) -> TriangleMesh:
        surfaces, value = parts[names[label]]
        return surfaces.label(value)

    def skin(label: int) -> Skin:
        what = f"'{names[label]}' cannot be the skin: it is one of the overlapping structures of a file"
        refuse(what, source, "a CT, a mesh, or a label of a label map", "no_skin")

    return Segmentation(
        source,
        names,
        near=lambda point_ct: segmentation.in_boxes({label: surface(label).bounds for label in names}, point_ct),
        surface=surface,
        skin=skin,
        section=lambda rows: f"[[structures]]\n{key} = {quoted(source)}\n{rules_text(rows)}",
        voxel_ct=next((surfaces.voxel_ct for surfaces, _ in parts.values()), None),
        notes=place.volumes.mask_notes(source),
    )


LEAST_RULES = 3
"""Least rules that must be checked: with fewer, chance decides."""
MOST_BROKEN, LEAST_BROKEN = 0.1, 0.15
"""Fractions of the rules: so few may be broken in the right naming (curved spines, moved organs), so many are in the
wrong."""
LEAST_WRONG = 2
"""Least broken rules of a wrong naming: one alone may be broken by a patient."""
_SPINE = [f"vertebrae_{part}{n}" for part, last in (("C", 7), ("T", 12), ("L", 5)) for n in range(1, last + 1)]
_RIBS = [[f"rib_{side}_{n}" for n in range(1, 13)] for side in ("left", "right")]
FROM_HEAD = (
    [*_SPINE, "sacrum"], *_RIBS,
    ["brain", "heart", "liver", "urinary_bladder"], ["brain", "trachea", "aorta", "sacrum", "femur_left"],
    ["heart_myocardium", "pancreas", "hip_left"], ["lung_lower_lobe_left", "stomach", "colon", "gluteus_maximus_left"],
    ["esophagus", "duodenum", "urinary_bladder"], ["brain", "kidney_left", "prostate"], ["skull", "spleen", "prostate"],
)  # fmt: skip
"""Chains of structures, each farther from the head than the one before."""
FROM_RIGHT = (["liver", "aorta", "spleen"], ["gallbladder", "stomach"], ["inferior_vena_cava", "aorta"])
"""Chains of structures from the patient's right to the left."""
BESIDE_SPINE = (
    "kidney", "adrenal", "rib", "hip", "femur", "lung", "gluteus", "iliopsoas", "autochthon",
    "scapula", "humerus", "clavicula",
)  # fmt: skip
"""Beginnings of the names of structures that lie each on its own side of the spine."""


def likely_numbering(labelmap: LabelMap) -> str | None:
    """The built-in naming in which the organs of a map lie where they do in a body; None where that is not sure."""
    centres: dict[int, Floats] = {}
    for label, box in labelmap.boxes.items():
        index = np.array(scipy.ndimage.center_of_mass(labelmap.labels[box] == label)) + [axis.start for axis in box]
        centres[label] = apply(labelmap.T_ct_index, index[None])[0]
    fitting, unsure = [], False
    for naming, table in BUILT_IN.items():
        nameless = any(label not in table for label in centres)
        rules = list(_rules({table[label]: centre for label, centre in centres.items() if label in table}))
        broken = rules.count(False)
        if not nameless and len(rules) >= LEAST_RULES and broken <= MOST_BROKEN * len(rules):
            fitting.append(naming)
        elif not nameless and broken < max(LEAST_WRONG, LEAST_BROKEN * len(rules)):
            unsure = True
    return fitting[0] if len(fitting) == 1 and not unsure else None


def _rules(at: Mapping[str, Floats]) -> Iterator[bool]:
    """Whether organs lie in the order of a body from right to left and from head to feet, by their middles, LPS mm."""
    for name in at:
        other = name.replace("left", "right")
        if other != name and other in at:
            yield bool(at[name][0] > at[other][0])
    spine = [centre[0] for name, centre in at.items() if name.startswith("vertebrae")]
    if spine:
        middle = float(np.mean(spine))
        lateral = {name: at[name][0] - middle for name in at if name.startswith(BESIDE_SPINE)}
        yield from (bool(x > 0) for name, x in lateral.items() if "left" in name)
        yield from (bool(x < 0) for name, x in lateral.items() if "right" in name)
    for chains, axis, sign in ((FROM_RIGHT, 0, 1.0), (FROM_HEAD, 2, -1.0)):
        for chain in chains:
            known = [at[name] for name in chain if name in at]
            yield from (bool(sign * (b[axis] - a[axis]) > 0) for a, b in itertools.pairwise(known))
