"""The twin touches what FCL says: needles and structures of the collision cards, in PyBullet beside FCL.

Every needle of the cards, bare and with each structure's margin about it, is put into a world of PyBullet together with
the structures' whole surfaces, and its contacts are compared with FCL's collision of the same capsule.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import pybullet
import pytest
from places import TESTS

from puncture_twin.planning.anatomy.structure import Structure
from puncture_twin.planning.case.entry import outward
from puncture_twin.planning.clearance.fcl_engine import FclEngine
from puncture_twin.planning.collision_cases.checks_file import read_checks
from puncture_twin.planning.geometry.mesh import TriangleMesh
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


@dataclass(frozen=True, eq=False)
class Card:
    """One card's case, and the directions of its needles in the CT frame, shape (n, 3)."""

    context: CaseContext
    directions: np.ndarray

    @property
    def structures(self) -> tuple[Structure, ...]:
        """Those that demand a margin."""
        return tuple(s for s in self.context.anatomy.structures if s.demands_margin)


@pytest.fixture(scope="module", params=["abdomen", "carton"])
def card(request: pytest.FixtureRequest) -> Card:
    """The case of one card."""
    path = CARDS / f"{request.param}.collision.toml"
    checks = read_checks(path).content
    assert checks.case is not None
    context = prepare(path.parent / checks.case, arm=False)
    theta, beta = np.radians([[check.theta_deg, check.beta_deg] for check in checks.check]).T
    return Card(context, outward(theta, beta) @ context.case.T_ct_entry[:3, :3].T)


def gap_mm(client, first, second, within_mm):
    """How far two bodies are apart, mm; negative where they overlap, infinite beyond ``within_mm``.

    Of a surface triangle by triangle: a body wholly inside a closed one is apart from it.
    """
    points = pybullet.getClosestPoints(first, second, float(to_m(within_mm)), physicsClientId=client)
    return min((float(to_mm(point[8])) for point in points), default=float("inf"))


def pose(target: np.ndarray, direction: np.ndarray, length: float) -> np.ndarray:
    """T_ct_capsule of a needle from the target along a direction: z along it, the origin in its middle."""
    helper = np.eye(3)[np.argmin(np.abs(direction))]
    x = np.cross(helper, direction) / np.linalg.norm(np.cross(helper, direction))
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(direction, x), direction], axis=1)
    T[:3, 3] = target + 0.5 * length * direction
    return T


def radii(card: Card) -> Iterator[float]:
    """The needle's own radius, and that with each margin that the card's case has, and wider ones."""
    radius = card.context.case.needle.radius_mm
    yield from sorted({radius + margin for margin in (0.0, *(s.margin_mm for s in card.structures), *WIDER_MM)})


def compare(card: Card, shift_mm: dict[str, np.ndarray] | None = None) -> Compared:
    """Contacts of every needle with every structure, to PyBullet and to FCL.

    Args:
        card: The scene.
        shift_mm: By how much PyBullet's structures of these names are out of place, shape (3,) each; only these are
            compared then.
    """
    case, found = card.context.case, Compared()
    structures = tuple(s for s in card.structures if shift_mm is None or s.name in shift_mm)
    judge = FclEngine([s.mesh for s in structures])
    axes = judge.measure(case.target_ct, card.directions, case.needle.length_mm).distance
    with physics_client() as client:
        bodies = [_surface(client, s, (shift_mm or {}).get(s.name, np.zeros(3))) for s in structures]
        for radius in radii(card):
            for row, direction in enumerate(card.directions):
                T = pose(case.target_ct, direction, case.needle.length_mm)
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
    """A structure's whole surface, out of place by a shift."""
    mesh = TriangleMesh(structure.mesh.vertices + shift, structure.mesh.faces)
    return load_surface(client, mesh, np.eye(4), solid=True, max_faces=len(mesh.faces))


def test_contacts_are_fcls(card: Card) -> None:
    """Every needle touches in the twin what it touches to FCL, and nothing else; few pairs are too close to tell."""
    found = compare(card)
    assert found.differ == []
    assert found.touching > 20 and found.pairs - found.touching > 20
    assert found.close <= FEW * found.pairs


@pytest.mark.parametrize("axis", range(3))
def test_a_structure_out_of_place_is_noticed(card: Card, axis: int) -> None:
    """With a structure 3 mm beside its place in the twin, along each axis, some needle's contact differs."""
    name = "bolt_h" if card.context.case.name.startswith("carton") else "portal_vein"
    shift = 3.0 * np.eye(3)[axis]
    assert compare(card, {name: shift}).differ != []
    assert compare(card, {name: 0.0 * shift}).differ == []
