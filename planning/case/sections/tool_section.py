"""The body of the user's own that the flange carries beside the needle and its holder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import scipy
from pydantic import Field

from puncture_twin.planning.arm.tool import ToolBody
from puncture_twin.planning.base.provenance import InputFiles
from puncture_twin.planning.case.toml_types import Number, Section
from puncture_twin.planning.formats.meshes import mesh_files as meshes
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.planning.geometry.spaces import Space, Up
from puncture_twin.planning.geometry.units import parse_unit

TOOL_ROLE = "tool mesh"
"""Of the file that decides a tool."""

Beside = Annotated[Number, Field(ge=-1000, le=1000)]
Turn = Annotated[Number, Field(ge=-360, le=360)]


class ToolSection(Section):
    """A mesh and where it is on the flange: z along the needle, as the controller has it."""

    mesh: str
    unit: str
    up: Up | None = None
    position_mm: tuple[Beside, Beside, Beside] = (0.0, 0.0, 0.0)
    rotation_deg: tuple[Turn, Turn, Turn] = (0.0, 0.0, 0.0)


def tool_of(section: ToolSection | None, files: InputFiles, path: Path) -> ToolBody | None:
    """The tool's body; its file becomes an input of the case. None where the case names none.

    Args:
        section: As the case states it. It is turned about the flange's x, y and z, in this order, then moved.
        files: The case's files.
        path: The case file, for errors.

    Raises:
        InputError: A file that cannot be used, or a unit that is not known.
    """
    if section is None:
        return None
    unit, file = parse_unit(section.unit, where=f"{path}: tool.unit"), path.parent / section.mesh
    data = files.read(TOOL_ROLE, section.mesh, max_bytes=meshes.MAX_FILE_BYTES, key="tool.mesh", where=path)
    turn = scipy.spatial.transform.Rotation.from_euler("xyz", section.rotation_deg, degrees=True).as_matrix()
    T = pose(turn, np.array(section.position_mm))
    mesh = meshes.parse_mesh(data, file, unit=unit, space=Space.LOCAL, up=section.up).transformed(T)
    return ToolBody(mesh, file, unit.mm, T, f"{path}: tool")
