"""A folder of meshes as a segmentation: the unit is guessed by their extent, and told."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from puncture_twin.planning.anatomy.skin import Skin, flat_ends, skin_from_mesh
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.formats.meshes.mesh_files import MESH_SUFFIXES, UP_NOT_STATED, mesh_extent, read_mesh
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.spaces import Space, Unit, Up
from puncture_twin.planning.init.segmentation import Assigned, Place, margin_line, quoted

LEAST_EXTENT = ((Unit.MM, 130.0), (Unit.CM, 5.0), (Unit.M, 0.0))
"""From which diagonal of all meshes together on a unit is guessed. A body in mm, with its skin, is seldom smaller than
130 mm, and in cm (13 to 130) seldom larger; in metres it is smaller than 5."""

BOTH_MM_AND_CM = (130.0, 250.0)
"""A diagonal between these is a child's or a limb's in mm, or an adult's in cm, ten times as wide."""


@dataclass(frozen=True, eq=False)
class MeshFolder:
    """Meshes of one folder, one file a structure.

    Attributes:
        place: The case's folder.
        source: The folder of the meshes.
        files: By number, relative to the case's folder.
        unit: Of all of them.
        space: Of all of them that do not state one.
        up: The axis of all of them that is up; None where nobody says.
        voxel_ct: None: meshes do not tell what they were made of.
    """

    place: Place
    source: str
    files: Mapping[int, str]
    unit: Unit
    space: Space
    up: Up | None = None
    notes: tuple[str, ...] = ()
    voxel_ct: Floats | None = None
    names: Mapping[int, str] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", {number: mesh_name(file) for number, file in self.files.items()})

    @cached_property
    def meshes(self) -> Mapping[int, TriangleMesh]:
        """Each mesh in LPS mm."""
        files = {number: self.place.folder / file for number, file in self.files.items()}
        return {
            number: read_mesh(file, unit=self.unit, space=self.space, space_is_default=True, up=self.up)
            for number, file in files.items()
        }

    def near(self, point_ct: Floats) -> tuple[int, ...]:
        """The meshes whose box holds a point (3,), LPS mm."""
        boxes = {number: mesh.bounds for number, mesh in self.meshes.items()}
        return tuple(n for n, (low, high) in boxes.items() if np.all((low <= point_ct) & (point_ct <= high)))

    def surface(self, label: int) -> TriangleMesh:
        """One mesh, LPS mm."""
        return self.meshes[label]

    def skin(self, label: int) -> Skin:
        """One mesh as the skin, with flat ends as cuts."""
        return skin_from_mesh(self.meshes[label], flat_ends(self.meshes[label]))

    def section(self, rows: Sequence[Assigned]) -> str:
        """A ``[[structure]]`` for each mesh."""
        return "\n".join(self._single(row) for row in rows if row.kind != "ignore")

    def _single(self, row: Assigned) -> str:
        ends = flat_ends(self.meshes[row.label]) if row.kind == "skin" else ()
        cut = (
            f"cut = [{', '.join(map(quoted, ends))}]  # flat there: the scan ended; [] if all of it is skin\n"
            if ends
            else ""
        )
        up = "" if self.up is None else f'up = "{self.up}"\n'
        return (
            f"[[structure]]\nname = {quoted(row.name)}\nmesh = {quoted(self.files[row.label])}\n"
            f'unit = "{self.unit}"\n{up}role = "{row.kind}"\n{margin_line(row)}{cut}'
        )


def mesh_name(file: str) -> str:
    """The name of the structure in a file: the file's own, without its ending.

    >>> mesh_name("organs/right lung.stl")
    'right lung'
    """
    return file.rpartition("/")[2].rpartition(".")[0]


def mesh_folder(
    place: Place, source: str, names: Sequence[str], space: Space, stated: Unit | None, up: Up | None
) -> MeshFolder:
    """The meshes of a folder, in the unit that their extent tells.

    Args:
        place: The case's folder.
        source: The folder of the meshes.
        names: Of the files in it.
        space: Of their coordinates.
        stated: Their unit where the user says it, or None.
        up: Their axis that is up where the user says it; of GLB it must.

    Raises:
        InputError: A mesh that cannot be read, two of one name, or a unit that is not told by their extent.
    """
    if len({mesh_name(one) for one in names}) < len(names):
        raise InputError("two meshes have one name", where=place.folder / source, allowed="one mesh a structure")
    if up is None and any(name.lower().endswith(".glb") for name in names):
        what = f"GLB: {UP_NOT_STATED} (--up y turns them to z up, --up z keeps them)"
        raise InputError(what, where=place.folder / source, allowed="--up y or --up z", code="up_not_stated")
    extents = [mesh_extent(place.folder / name) for name in names]
    boxes = np.stack([one.box for one in extents])
    diagonal = float(np.linalg.norm(boxes[:, 1].max(axis=0) - boxes[:, 0].min(axis=0)))
    if stated is None and BOTH_MM_AND_CM[0] <= diagonal < BOTH_MM_AND_CM[1]:
        what = f"{diagonal:.0f} units from corner to corner: a small body in mm, or a large one in cm"
        raise InputError(what, where=place.folder / source, allowed="--unit mm or --unit cm")
    unit = stated or next(one for one, least in LEAST_EXTENT if diagonal >= least)
    guess = "as stated" if stated else "guessed by their extent (--unit says otherwise)"
    said = (
        f"{source}: {len(names)} meshes in {unit} ({guess}) and {_spaces([one.space for one in extents], space)}, "
        f"together {diagonal * unit.mm:.0f} mm from corner to corner; no mesh file says its unit"
    )
    return MeshFolder(place, source, dict(enumerate(sorted(names), start=1)), unit, space, up, (said,))


def _spaces(stated: Sequence[Space | None], space: Space) -> str:
    """Of what space meshes are: of what their files state, else of what the user does."""
    counts = Counter(stated)
    parts = [f"{one}, as {count} of their files state" for one, count in counts.items() if one]
    return " and ".join([*parts, f"{space}, which {counts[None]} of them do not state"] if counts[None] else parts)


def is_mesh(name: str) -> bool:
    """Whether a file's ending is that of a mesh."""
    return name.lower().endswith(MESH_SUFFIXES)
