"""Which reason is given, and with which numbers: paths and clearances made by hand, many rows at once."""

from types import SimpleNamespace

import numpy as np
import pytest

from puncture_twin.planning.anatomy.skin import SkinPaths
from puncture_twin.planning.anatomy.structure import Role, Structure
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.case.settings import Needle
from puncture_twin.planning.clearance.engine import MeasuredClearances
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.search.constraints import closest_miss, first_broken, worst_violation

NEEDLE = Needle(200.0, 150.0, 1.0, None, 10.0, 30.0)
DOT = TriangleMesh([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
NAN = np.nan
MAX_ANGLE = np.radians(60)


def structure(name, margin=2.0, role=Role.AVOID):
    return Structure(name, role, margin, DOT, "made")


def nothing(count):
    empty = np.empty((count, 0))
    return MeasuredClearances(empty, empty, empty.astype(bool))


def rated(skin_rows, clearances=None, structures=()):
    length, angle, reentry, unknown = np.array(skin_rows, float).T
    skin = SkinPaths(np.zeros((len(length), 3)), length, np.radians(angle), reentry, unknown)
    clearances = nothing(len(skin_rows)) if clearances is None else clearances
    found = first_broken(skin, clearances, tuple(structures), needle=NEEDLE, max_skin_angle=MAX_ANGLE)
    return list(zip(found.reason, found.structure, found.depth, found.amount, strict=True))


def same(found, expected):
    for row, wanted in zip(found, expected, strict=True):
        assert tuple(row[:2]) == tuple(wanted[:2])
        np.testing.assert_allclose(np.array(row[2:], float), wanted[2:], atol=1e-12)


def test_each_reason_of_the_skin_and_its_numbers():
    rows = [
        (100, 10, NAN, NAN),
        (100, 10, NAN, 70),
        (NAN, NAN, NAN, NAN),
        (100, 10, 130, NAN),
        (151, 10, NAN, NAN),
        (100, 61, NAN, NAN),
    ]
    same(
        rated(rows),
        [
            ("", "", NAN, NAN),
            (Reason.UNKNOWN_REGION, "skin", 70, NAN),
            (Reason.NO_SKIN_ENTRY, "skin", NAN, NAN),
            (Reason.REENTERS_SKIN, "skin", 130, NAN),
            (Reason.TOO_LONG, "skin", 151, 151),
            (Reason.SKIN_ANGLE, "skin", 100, 61),
        ],
    )


def test_the_first_broken_constraint_gives_the_reason():
    near = MeasuredClearances(np.array([[0.5]] * 6), np.array([[40.0]] * 6), np.ones((6, 1), bool))
    rows = [
        (NAN, NAN, 90, 70),
        (NAN, NAN, 90, NAN),
        (160, 70, 90, NAN),
        (160, 70, NAN, NAN),
        (100, 70, NAN, NAN),
        (100, 10, NAN, NAN),
    ]
    reasons = [row[0] for row in rated(rows, near, [structure("vessel")])]
    assert reasons == [
        Reason.UNKNOWN_REGION, Reason.NO_SKIN_ENTRY, Reason.REENTERS_SKIN, Reason.TOO_LONG, Reason.SKIN_ANGLE,
        Reason.TOO_CLOSE,
    ]  # fmt: skip
    assert [row[0] for row in rated([(150, 10, NAN, NAN), (100, 60, NAN, NAN)])] == ["", ""]


@pytest.mark.parametrize(("standoff", "longest"), [(None, 150), (100.0, 90), (170.0, 150), (160.0, 150), (159.0, 149)])
def test_the_longest_path(standoff, longest):
    assert Needle(200.0, 150.0, 1.0, standoff, 10.0, 30.0).longest_path_mm == longest


def test_the_structure_that_lacks_most_is_named():
    clearance = np.array([[1.0, 4.0, -0.5], [1.0, 4.0, 0.5], [9.0, 9.0, 9.0], [1.5, 2.0, 0.9]])
    depth = np.array([[30.0, 20, 50], [30, 20, 10], [1, 2, 3], [30, 20, 10]])
    violated = np.array([[True, True, True], [True, False, False], [False, False, False], [True, True, False]])
    structures = [structure("a", 2.0), structure("b", 7.0), structure("c", 1.0)]
    rows = [(100, 10, NAN, NAN)] * 4
    same(
        rated(rows, MeasuredClearances(clearance, depth, violated), structures),
        [
            (Reason.TOO_CLOSE, "b", 20, 4),
            (Reason.TOO_CLOSE, "a", 30, 1),
            ("", "", NAN, NAN),
            (Reason.TOO_CLOSE, "b", 20, 2),
        ],
    )
    structures = tuple(structure(name, margin) for name, margin in (("a", 2.0), ("b", 5.0), ("c", 1.0)))
    clearances = MeasuredClearances(
        np.array([[1.0, 4.0, 0.0]] * 2), np.array([[30.0, 20, 50], [5, 20, 4]]), np.ones((2, 3), bool)
    )
    assert worst_violation(clearances, structures).tolist() == [1, 2]
    assert worst_violation(nothing(3), ()).tolist() == [0, 0, 0]
    clearances = MeasuredClearances(
        np.array([[0.0, 1.0], [1.0, 0.0]]), np.array([[30.0, 20], [30, 20]]), np.ones((2, 2), bool)
    )
    structures = [structure("fog", 2.0, Role.UNKNOWN), structure("vessel", 2.0)]
    same(
        rated([(100, 10, NAN, NAN)] * 2, clearances, structures),
        [(Reason.UNKNOWN_REGION, "fog", 30, 0), (Reason.TOO_CLOSE, "vessel", 20, 0)],
    )


def rejected(reasons, distance=(), margins=()):
    wanted = np.array([reason.value for reason in reasons], dtype=object)
    clear = SimpleNamespace(by_structure=np.array(distance, float), margins=np.array(margins, float))
    return SimpleNamespace(verdict=SimpleNamespace(reason=wanted), clearance=clear)


def test_the_closest_miss():
    close, angle = Reason.TOO_CLOSE, Reason.SKIN_ANGLE
    distance = [[1.9, -9, 9.0], [1.0, -9, 4.0], [4.0, -9, 3.5], [0.5, 9, 9.0]]
    found = rejected([angle, close, close, close], distance, [2.0, NAN, 5.0])
    assert closest_miss(found) == 1
    assert closest_miss(rejected([close, close, close, close], distance, [2.0, NAN, 5.0])) == 0
    assert closest_miss(rejected([angle, close, close, angle], [[0.0], [1.0], [1.5], [1.9]], [2.0])) == 2
    found = rejected([Reason.TOO_LONG, Reason.SKIN_ANGLE, Reason.UNREACHABLE, Reason.UNREACHABLE, Reason.TOO_LONG])
    assert closest_miss(found) == 2
    assert closest_miss(rejected([Reason.UNKNOWN_REGION, Reason.REENTERS_SKIN, Reason.TOO_LONG])) == 2
    assert closest_miss(rejected([Reason.UNKNOWN_REGION])) == 0
    near = rejected([Reason.TOO_CLOSE, Reason.UNREACHABLE, Reason.ARM_COLLISION], [[1.99], [9.0], [9.0]], [2.0])
    assert closest_miss(near) == 2, "organs allow it: the arm is what is to be mended"
    assert closest_miss(rejected([])) is None
