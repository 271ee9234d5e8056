"""The twin touches what FCL says: needles and structures of the collision cards, in PyBullet beside FCL.

Every needle of the cards, bare and with each structure's margin about it, is put into a world of PyBullet together with
the structures' whole surfaces, and its contacts are compared with FCL's collision of the same capsule.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import pybullet
import pytest
from places import TESTS

from puncture_twin.planning.anatomy.structure import Structure
from puncture_twin.planning.case.entry import outward
from puncture_twin.planning.clearance.fcl_engine import FclEngine
from puncture_twin.planning.collision_cases.checks_file import read_checks
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import frame_about, pose
from puncture_twin.planning.search.context import CaseContext, prepare
from puncture_twin.twin.world.client import physics_client, pose_to_m, to_m, to_mm
from puncture_twin.twin.world.workcell import load_surface, remove

CARDS = TESTS / "collision"
TOLERANCE_MM = 1e-3
"""PyBullet reads surfaces from text, whose coordinates are rounded to 1e-4 mm: its gaps on these cards differ from the
exact ones by 6e-5 mm at most. Ten times the rounding."""
FEW = 0.01
"""Fraction of the pairs that may lie within the tolerance of contact, and say nothing."""
WIDER_MM = (4.3, 9.7, 21.1)
"""Margins beside those of the cases, so that many pairs touch; none is a clearance of the carton, which are round."""
WITHIN_MM = 1.0
"""How far PyBullet looks around the capsule."""


@dataclass
class Compared:
    """Pairs of needle and structure: how many, how many touch to FCL, what was left out, and where PyBullet differs."""

    pairs: int = 0
    touching: int = 0
    close: int = 0
    differ: list[str] = field(default_factory=list)


class Card(NamedTuple):
    """One card's case, the directions (n, 3) of its needles in the CT frame, and structures that demand a margin."""

    context: CaseContext
    directions: np.ndarray
    structures: list


@pytest.fixture(scope="module", params=["abdomen", "carton"])
def card(request: pytest.FixtureRequest) -> Card:
    path = CARDS / f"{request.param}.collision.toml"
    checks = read_checks(path).content
    assert checks.case is not None
    context = prepare(path.parent / checks.case, arm=False)
    theta, beta = np.radians([[check.theta_deg, check.beta_deg] for check in checks.check]).T
    demanding = [one for one in context.anatomy.structures if one.demands_margin]
    return Card(context, outward(theta, beta) @ context.case.T_ct_entry[:3, :3].T, demanding)


def gap_mm(client, first, second, within_mm):
    """How far two bodies are apart, mm; negative where they overlap, infinite beyond ``within_mm``.

    Of a surface triangle by triangle: a body wholly inside a closed one is apart from it.
    """
    points = pybullet.getClosestPoints(first, second, float(to_m(within_mm)), physicsClientId=client)
    return min((float(to_mm(point[8])) for point in points), default=float("inf"))


def compare(card: Card, shift_mm: dict[str, np.ndarray] | None = None) -> Compared:
    """Contacts of every needle with every structure, to PyBullet and to FCL."""
    case, found = card.context.case, Compared()
    margins = (0.0, *(one.margin_mm for one in card.structures), *WIDER_MM)
    structures = tuple(s for s in card.structures if shift_mm is None or s.name in shift_mm)
    judge = FclEngine([s.mesh for s in structures])
    axes = judge.measure(case.target_ct, card.directions, case.needle.length_mm).distance
    with physics_client() as client:
        bodies = [_surface(client, s, (shift_mm or {}).get(s.name, np.zeros(3))) for s in structures]
        for radius in sorted({case.needle.radius_mm + margin for margin in margins}):
            for row, direction in enumerate(card.directions):
                T = pose(frame_about(direction), case.target_ct + 0.5 * case.needle.length_mm * direction)
                needle = _capsule(client, case.needle.length_mm, radius, T)
                for column, body in enumerate(bodies):
                    touches = judge.collides(column, case.target_ct, direction, case.needle.length_mm, radius)
                    found.pairs += 1
                    found.touching += touches
                    if abs(axes[row, column] - radius) <= TOLERANCE_MM:
                        found.close += 1
                    elif (gap_mm(client, needle, body, WITHIN_MM) <= 0.0) != touches:
                        found.differ.append(f"{structures[column].name}, needle {row}, radius {radius:g} mm")
                remove(client, needle)
    return found


def _capsule(client, length_mm, radius_mm, T_world_capsule):
    """All points within a radius of a segment along z, its middle at the pose's origin; the body's id."""
    sizes = {"radius": float(to_m(radius_mm)), "height": float(to_m(length_mm))}
    shape = pybullet.createCollisionShape(pybullet.GEOM_CAPSULE, **sizes, physicsClientId=client)
    return int(pybullet.createMultiBody(0.0, shape, -1, *pose_to_m(T_world_capsule), physicsClientId=client))


def _surface(client: int, structure: Structure, shift: np.ndarray) -> int:
    mesh = TriangleMesh(structure.mesh.vertices + shift, structure.mesh.faces)
    return load_surface(client, mesh, np.eye(4), max_faces=len(mesh.faces))


def test_contacts_are_fcls(card: Card) -> None:
    """Every needle touches in the twin what it touches to FCL, and nothing else; few pairs are too close to tell."""
    found = compare(card)
    assert found.differ == []
    assert found.touching > 20 and found.pairs - found.touching > 20
    assert found.close <= FEW * found.pairs


@pytest.mark.parametrize("card", ["carton"], indirect=True)
def test_a_structure_out_of_place_is_noticed(card: Card) -> None:
    """With a structure 3 mm beside its place in the twin, along each axis, some needle's contact differs."""
    assert all(compare(card, {"bolt_h": 3.0 * axis}).differ for axis in np.eye(3))
