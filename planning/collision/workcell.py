"""The workcell of a case: the needle on its flange, the patient, obstacles and gantry, and where the arm waits.

Obstacles and gantry are boxes for the arm and solids for the needle, which is checked against them also without an arm.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from threading import get_ident

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.structure import Role, Structure
from puncture_twin.planning.arm.links import plane_crossings
from puncture_twin.planning.arm.tool import Box, Tool, gantry_boxes
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import Memory, user_cache
from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.settings import Gantry
from puncture_twin.planning.collision.fast_checker import FastChecker
from puncture_twin.planning.geometry.mesh import TriangleMesh, box, joined
from puncture_twin.planning.geometry.rigid import apply, pose

ARM_PADDING_MM = 5.0
"""The arm keeps this distance from all around it: more than the registration's error, and enough to prove the path
between two checked states."""
CHECKER_BYTES = 20_000_000
"""About what the arm's links, hulls and spheres hold in one checker."""
TREE_COPIES = 8
"""A surface in FCL's tree and in that of the proofs holds about so many times its vertices and faces."""


def case_tool(case: Case) -> Tool:
    """Tool of the case: the needle, its holder, and what else the flange carries."""
    needle = case.needle
    return Tool(needle.length_mm, needle.shaft_mm, needle.diameter_mm, needle.holder_diameter_mm, case.tool)


def outside_surface(anatomy: Anatomy) -> TriangleMesh | None:
    """Surface outside of the skin that the arm must not touch, CT frame; None where there is nothing."""
    outside = [one.mesh for one in anatomy.surroundings if one.role is Role.UNKNOWN]
    return joined(outside) if outside else None


def patient_surface(anatomy: Anatomy) -> TriangleMesh:
    """Surface that the arm must not touch as the patient, CT frame: the skin, and what lies outside of it."""
    outside = outside_surface(anatomy)
    return anatomy.skin.mesh if outside is None else joined([anatomy.skin.mesh, outside])


def case_checker(case: Case, anatomy: Anatomy, T_base_ct: Floats) -> FastChecker:
    """The collision checker of the case's workcell, with the patient where ``T_base_ct`` says.

    Raises:
        InputError: The robot's base, or the gantry's wall, is in the patient.
    """
    check_gantry(case, anatomy.skin.mesh)
    surfaces = anatomy.skin.mesh, outside_surface(anatomy)
    placed, placed_outside = (None if mesh is None else mesh.transformed(T_base_ct) for mesh in surfaces)
    model, tool, boxes = case.robot.model, case_tool(case), case_boxes(case, T_base_ct)
    try:
        return FastChecker(
            model, tool, boxes, placed, outside=placed_outside, padding_mm=ARM_PADDING_MM, cache=user_cache()
        )
    except InputError as error:
        if not error.code.startswith("base_in"):
            raise
        stated = "robot.mount" if case.robot.transform is None else "registration.transform"
        raise error.at(f"{case.path}: {stated if case.registration is None else 'registration'}") from error


def own_checker(case: Case, anatomy: Anatomy, T_base_ct: Floats, memory: Memory) -> Callable[[], FastChecker]:
    """Gives each thread a `case_checker` of its own, since none is for several: FCL's bodies are moved to be asked.

    It depends on no target: of one patient and one arm a thread's is made once, as long as ``memory`` keeps it.
    """
    stated = tuple((box.name, box.T_base_box.tobytes(), box.size_mm) for box in case_boxes(case, T_base_ct))
    meshes = [anatomy.skin.mesh, *(one.mesh for one in anatomy.surroundings if one.role is Role.UNKNOWN)]
    place, digests = np.ascontiguousarray(T_base_ct, np.float64).tobytes(), tuple(mesh.digest for mesh in meshes)
    key = (__name__, case.robot.model, case_tool(case), stated, digests, place, ARM_PADDING_MM)
    size = CHECKER_BYTES + TREE_COPIES * sum(mesh.nbytes for mesh in meshes)
    make = partial(case_checker, case, anatomy, T_base_ct)
    return lambda: memory.get((*key, get_ident()), make, lambda _: size)


def home_configuration(case: Case) -> Floats:
    """Joints of the waiting arm (6,), rad: the case's, or arm up and wrist down.

    Raises InputError: It is beyond the arm's limits.
    """
    home = np.radians([0.0, -90.0, 0.0, -90.0, 0.0, 0.0]) if case.robot.home is None else case.robot.home
    if not case.robot.model.within_limits(home):
        what = f"robot.home_deg: home ({', '.join(f'{angle:g}' for angle in np.degrees(home))}) is beyond the limits"
        refuse(what, case.path, "home_deg within the arm's limits", "home_beyond_limits")
    return home


GANTRY = "gantry"
OF_CASE_FILE = "case file"
"""Source of the solids that the case file describes."""
NOWHERE = (
    'obstacles of the frame "base" are not checked, because the case does not state where the robot\'s base is: {names}'
)


def case_boxes(case: Case, T_base_ct: Floats) -> tuple[Box, ...]:
    """The obstacles and the gantry, in the base frame; the gantry's boxes are called ``gantry_0`` ..."""
    boxes = []
    for obstacle in case.obstacles:
        T, (x, y, z) = pose(np.eye(3), obstacle.center_mm), obstacle.size_mm.tolist()
        boxes.append(Box(obstacle.name, T if obstacle.frame == "base" else T_base_ct @ T, (x, y, z)))
    return (*boxes, *(() if case.gantry is None else _gantry_boxes(case.gantry, T_base_ct)))


def _gantry_boxes(gantry: Gantry, T_base_ct: Floats) -> tuple[Box, ...]:
    bore, wall, depth = gantry.bore_diameter_mm, gantry.wall_mm, gantry.thickness_mm
    return gantry_boxes(T_base_ct @ gantry.T_ct_gantry, bore_diameter_mm=bore, wall_mm=wall, depth_mm=depth)


def gantry_in_patient_mm(gantry: Gantry, skin: TriangleMesh) -> float:
    """Depth by which the skin reaches beyond the bore within the gantry's thickness, mm; 0 where it does not.

    The wall, and all that lies outward of it, is farther from the axis than the round bore's radius, between the planes
    of its faces. The distance from the axis is convex, so of the part of a triangle between the planes a corner is
    farthest: a vertex, or where an edge passes through a plane. A body in the wall has skin there or farther outward,
    also where the wall lies wholly inside of it; where the skin is open only its surface counts.
    The checkers' boxes leave a bore up to 0.9 % narrower: a patient who fits the round one is not refused for that.
    """
    at = apply(np.linalg.inv(gantry.T_ct_gantry), skin.vertices)
    bore, half = gantry.bore_diameter_mm / 2, gantry.thickness_mm / 2
    corners = at[skin.faces[(np.hypot(at[:, 0], at[:, 1])[skin.faces] > bore).any(axis=1)]]
    start, end = corners.reshape(-1, 3), np.roll(corners, 1, axis=1).reshape(-1, 3)
    between = [start[np.abs(start[:, 2]) <= half], *(plane_crossings(start, end, 2, z) for z in (-half, half))]
    far = np.concatenate(between)
    return max(0.0, float(np.hypot(far[:, 0], far[:, 1]).max(initial=0.0)) - bore)


def check_gantry(case: Case, skin: TriangleMesh) -> None:
    """Refuse a gantry that does not go around the patient.

    The skin alone is tested against it. What the CT shows outside of the skin is not: a bed goes through the bore, and
    beyond the image its surface goes on by assumption.
    """
    deep = 0.0 if case.gantry is None else gantry_in_patient_mm(case.gantry, skin)
    if deep > 0.0:
        what = f"the gantry's wall is {np.ceil(10 * deep) / 10:g} mm inside the patient"
        refuse(what, f"{case.path}: gantry", "a bore around the body: check center_mm, tilt_deg", "gantry_in_patient")


def with_surroundings(anatomy: Anatomy, case: Case, T_base_ct: Floats | None) -> Anatomy:
    """The anatomy with the case's obstacles and gantry as further structures outside of the body.

    Raises:
        InputError: An obstacle has the name of a structure, or the gantry's wall is in the patient.
    """
    check_gantry(case, anatomy.skin.mesh)
    solids = surroundings(case, T_base_ct)
    taken = {structure.name for structure in anatomy.checked}
    for solid in solids:
        if solid.name in taken:
            what = f"obstacle '{solid.name}' has the name of a structure"
            refuse(what, case.path, "a name of its own", "duplicate_name")
    nowhere = [obstacle.name for obstacle in case.obstacles if obstacle.frame == "base"] if T_base_ct is None else []
    warnings = (*anatomy.warnings, *([NOWHERE.format(names=", ".join(nowhere))] if nowhere else []))
    return replace(anatomy, surroundings=anatomy.surroundings + solids, warnings=warnings)


def surroundings(case: Case, T_base_ct: Floats | None) -> tuple[Structure, ...]:
    """Obstacles and gantry as structures of role ``avoid`` without a margin, CT frame.

    Without ``T_base_ct`` (4, 4) obstacles of the frame ``base`` are nowhere, and are left out.
    """
    T = np.eye(4) if T_base_ct is None else T_base_ct
    fixed = {obstacle.name for obstacle in case.obstacles if obstacle.frame == "ct" or T_base_ct is not None}
    boxes = [one for one in case_boxes(case, T) if one.name in fixed]
    T_ct_base = np.asarray(np.linalg.inv(T), dtype=np.float64)
    structures = [_structure(one.name, box(T_ct_base @ one.T_base_box, one.size_mm)) for one in boxes]
    if case.gantry is not None:
        wall = [box(one.T_base_box, one.size_mm) for one in _gantry_boxes(case.gantry, np.eye(4))]
        structures.append(_structure(GANTRY, joined(wall)))
    return tuple(structures)


def _structure(name: str, mesh: TriangleMesh) -> Structure:
    return Structure(name, Role.AVOID, 0.0, mesh, OF_CASE_FILE, True, np.zeros((3, 3)))  # as stated
