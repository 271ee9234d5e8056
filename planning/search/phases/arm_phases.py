"""The arm at every phase that the gate lets through: the target, the skin and what lies on it are elsewhere there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.structure import Structure
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.breathing.breathing import Breathing
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.settings import Obstacle
from puncture_twin.planning.collision.surroundings import GANTRY
from puncture_twin.planning.collision.workcell import case_checker
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.planning.reach.standoff import own_paths
from puncture_twin.planning.search.arm_reach import ArmReach, with_reach
from puncture_twin.planning.search.candidates import ArmColumns, Candidates
from puncture_twin.planning.search.phases.moving_weights import MovingWeights, moving_weights
from puncture_twin.planning.search.phases.one_phase import rejected_at


def with_breathing_reach(case: Case, anatomy: Anatomy, found: Candidates, reach: ArmReach) -> Candidates:
    """Reject what the arm cannot reach and insert along at a phase that the gate lets through.

    Args:
        case: The case; nothing is done where it declares no breathing.
        anatomy: Its structures.
        found: Checked with the arm where the CT shows the body.
        reach: Who checked it.
    """
    breathing = case.breathing
    if breathing is None:
        return found
    weights = moving_weights(case, breathing, anatomy)
    for s in breathing.positions[breathing.in_window].tolist():
        if np.any(breathing.moved_ct(s)) and found.safe.any():
            found = _at_phase(case, breathing, anatomy, weights, found, reach, s)
    return found


def _at_phase(
    case: Case,
    breathing: Breathing,
    anatomy: Anatomy,
    weights: MovingWeights,
    found: Candidates,
    reach: ArmReach,
    s: float,
) -> Candidates:
    rows, moved = np.flatnonzero(found.safe), breathing.moved_ct(s)
    displaced = _displaced(anatomy, weights, breathing, s)
    solids = _with_moved_solids(case, anatomy, weights, breathing, s, reach.T_base_ct)
    there = ArmReach(case_checker(solids, displaced, reach.T_base_ct), reach.T_base_ct)
    paths = own_paths(case, anatomy.skin, found.outward_ct, (1 - weights.skin) * moved)
    path = replace(found.path, length=paths.path_length, skin_angle=paths.skin_angle)
    shifted = replace(found, path=path, arm=ArmColumns.unknown(len(found)))
    answered = with_reach(replace(case, target_ct=case.target_ct + moved), shifted, there)
    at_phase = answered.verdict.of(rows)
    return replace(found, verdict=rejected_at(found.verdict, rows, at_phase, breathing, s))


def _displaced(anatomy: Anatomy, weights: MovingWeights, breathing: Breathing, s: float) -> Anatomy:
    """The anatomy with what an arm may touch, the skin and what lies outside of the body, where the breath puts it."""
    inside, outside = np.split(weights.structures, [len(anatomy.structures)])
    del inside  # an arm does not come to it
    return replace(
        anatomy,
        skin=replace(anatomy.skin, mesh=_moved(anatomy.skin.mesh, breathing.moved_ct(s, weights.skin))),
        surroundings=tuple(
            _moved_structure(one, breathing.moved_ct(s, float(weight)))
            for one, weight in zip(anatomy.surroundings, outside, strict=True)
        ),
    )


def _with_moved_solids(
    case: Case, anatomy: Anatomy, weights: MovingWeights, breathing: Breathing, s: float, T_base_ct: Floats
) -> Case:
    """The case with its obstacles and gantry, which the arm's checker takes from there, where their weights say."""
    names = [one.name for one in anatomy.checked]
    of = dict(zip(names, weights.structures.tolist(), strict=True))

    def moved(obstacle: Obstacle) -> Obstacle:
        by_ct = breathing.moved_ct(s, of[obstacle.name])
        by = T_base_ct[:3, :3] @ by_ct if obstacle.frame == "base" else by_ct
        return replace(obstacle, center_mm=obstacle.center_mm + by)

    gantry = case.gantry
    if gantry is not None:
        gantry = replace(gantry, T_ct_gantry=pose(np.eye(3), breathing.moved_ct(s, of[GANTRY])) @ gantry.T_ct_gantry)
    return replace(case, obstacles=tuple(moved(one) for one in case.obstacles), gantry=gantry)


def _moved_structure(structure: Structure, by_ct: Floats) -> Structure:
    return replace(structure, mesh=_moved(structure.mesh, by_ct))


def _moved(mesh: TriangleMesh, by_ct: Floats) -> TriangleMesh:
    return mesh.transformed(pose(np.eye(3), by_ct)) if np.any(by_ct) else mesh
