"""Solids outside of the body that a needle is checked against, with and without an arm: obstacles and the gantry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy, Role, Structure
from puncture_twin.planning.anatomy.body.outside_body import BOX_FACES, joined
from puncture_twin.planning.arm.tool import Box
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.collision.workcell import case_boxes, check_gantry, gantry_in_ct
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import apply

GANTRY = "gantry"
OF_CASE_FILE = "case file"
"""Source of the solids that the case file describes."""

NOWHERE = (
    'obstacles of the frame "base" are not checked, since the case does not say where the robot\'s base is: {names}'
)

CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
"""Of a cube with edges of 1."""


def with_surroundings(anatomy: Anatomy, case: Case, T_base_ct: Floats | None) -> Anatomy:
    """The anatomy with the case's obstacles and gantry beside what the CT shows outside of the body.

    Raises:
        InputError: An obstacle has the name of a structure, or the gantry's wall stands in the patient.
    """
    check_gantry(case, anatomy.skin.mesh)
    solids = surroundings(case, T_base_ct)
    taken = {structure.name for structure in anatomy.checked}
    for solid in solids:
        if solid.name in taken:
            what = f"obstacle '{solid.name}' has the name of a structure"
            raise InputError(what, where=case.path, allowed="a name of its own")
    nowhere = [obstacle.name for obstacle in case.obstacles if obstacle.frame == "base"] if T_base_ct is None else []
    warnings = (*anatomy.warnings, *([NOWHERE.format(names=", ".join(nowhere))] if nowhere else []))
    return replace(anatomy, surroundings=anatomy.surroundings + solids, warnings=warnings)


def surroundings(case: Case, T_base_ct: Floats | None) -> tuple[Structure, ...]:
    """Obstacles and gantry as structures of role ``avoid`` without a margin, CT frame.

    Args:
        case: The case.
        T_base_ct: Shape (4, 4); None where nothing says where the arm is: obstacles of the frame ``base`` are then
            nowhere, and are left out.
    """
    T = np.eye(4) if T_base_ct is None else T_base_ct
    fixed = {obstacle.name for obstacle in case.obstacles if obstacle.frame == "ct" or T_base_ct is not None}
    boxes = [box for box in case_boxes(case, T) if box.name in fixed]
    T_ct_base = np.asarray(np.linalg.inv(T), dtype=np.float64)
    structures = [_structure(box.name, _mesh(box, T_ct_base)) for box in boxes]
    if case.gantry is not None:
        structures.append(_structure(GANTRY, joined([_mesh(box, np.eye(4)) for box in gantry_in_ct(case.gantry)])))
    return tuple(structures)


def _structure(name: str, mesh: TriangleMesh) -> Structure:
    return Structure(name, Role.AVOID, 0.0, mesh, OF_CASE_FILE, outside=True)


def _mesh(box: Box, T_ct_base: Floats) -> TriangleMesh:
    T = T_ct_base @ box.T_base_box
    return TriangleMesh(apply(T, CORNERS * box.size_mm), BOX_FACES)
