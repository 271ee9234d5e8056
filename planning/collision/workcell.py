"""The workcell of a case for the arm: the needle on its flange, the patient, what stands around it, where it waits."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.structure import Role
from puncture_twin.planning.arm.tool import Tool
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import user_cache
from puncture_twin.planning.base.cache.memory import NO_MEMORY, Memory
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.collision.base_place import BaseInPatientError
from puncture_twin.planning.collision.fast_checker import FastChecker
from puncture_twin.planning.collision.surroundings import case_boxes, check_gantry
from puncture_twin.planning.geometry.mesh import TriangleMesh, joined

ARM_PADDING_MM = 5.0
"""The arm keeps this distance from all around it: more than the registration's error, and enough to prove the path
between two checked states."""

CHECKER_BYTES = 20_000_000
"""About what the arm's links, hulls and spheres hold in one checker."""

TREE_COPIES = 8
"""A surface in FCL's tree and in that of the proofs holds about so many times its vertices and faces."""


def case_tool(case: Case) -> Tool:
    """The needle, its holder, and what else the flange carries."""
    needle = case.needle
    return Tool(needle.length_mm, needle.shaft_mm, needle.diameter_mm, needle.holder_diameter_mm, case.tool)


def outside_surface(anatomy: Anatomy) -> TriangleMesh | None:
    """What the CT shows outside of the skin that the arm must not touch, CT frame; None where there is nothing."""
    outside = [one.mesh for one in anatomy.surroundings if one.role is Role.UNKNOWN]
    return joined(outside) if outside else None


def patient_surface(anatomy: Anatomy) -> TriangleMesh:
    """What the arm must not touch as the patient, CT frame: the skin, and what the CT shows outside of it."""
    outside = outside_surface(anatomy)
    return anatomy.skin.mesh if outside is None else joined([anatomy.skin.mesh, outside])


def case_checker(case: Case, anatomy: Anatomy, T_base_ct: Floats, memory: Memory = NO_MEMORY) -> FastChecker:
    """The collision checker of the case's workcell, with the patient where ``T_base_ct`` says.

    It depends on no target: of one patient and one arm it is made once where ``memory`` keeps it.

    Raises:
        InputError: The robot's base stands in the patient, or the gantry's wall does.
    """
    check_gantry(case, anatomy.skin.mesh)
    skin, outside = anatomy.skin.mesh, outside_surface(anatomy)
    boxes = case_boxes(case, T_base_ct)
    model, tool = case.robot.model, case_tool(case)

    def make() -> FastChecker:
        placed, beside = (None if mesh is None else mesh.transformed(T_base_ct) for mesh in (skin, outside))
        try:
            return FastChecker(
                model, tool, boxes, placed, outside=beside, padding_mm=ARM_PADDING_MM, cache=user_cache()
            )
        except BaseInPatientError as error:
            where = f"{case.path}: {_placing_key(case)}"
            raise BaseInPatientError(error.what, where=where, allowed=error.allowed, code=error.code) from error

    if memory is NO_MEMORY:
        return make()
    stated = tuple((box.name, box.T_base_box.tobytes(), box.size_mm) for box in boxes)
    meshes = [mesh for mesh in (skin, outside) if mesh is not None]
    place = np.ascontiguousarray(T_base_ct, np.float64).tobytes()
    key = (__name__, model, tool, stated, tuple(mesh.digest for mesh in meshes), place, ARM_PADDING_MM)
    return memory.get(key, make, lambda _: CHECKER_BYTES + TREE_COPIES * sum(mesh.nbytes for mesh in meshes))


def _placing_key(case: Case) -> str:
    """Where the case says where its robot's base is."""
    if case.registration is not None:
        return "registration"
    return "robot.mount" if case.robot.transform is None else "registration.transform"


def home_configuration(case: Case) -> Floats:
    """Where the arm waits, shape (6,), rad: the case's, or arm up and wrist down.

    Raises:
        InputError: It is beyond the arm's limits.
    """
    home = np.radians([0.0, -90.0, 0.0, -90.0, 0.0, 0.0]) if case.robot.home is None else case.robot.home
    if not case.robot.model.within_limits(home):
        what = f"robot.home_deg: home ({', '.join(f'{angle:g}' for angle in np.degrees(home))}) is beyond the limits"
        raise InputError(what, where=case.path, allowed="home_deg within the arm's limits")
    return home
