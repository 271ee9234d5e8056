"""The gate before compiled code: what it refuses, by name, and what it returns."""

import numpy as np
import pytest
from numpy.typing import ArrayLike
from refusals import refused
from scipy.spatial.transform import Rotation

from puncture_twin.planning.formats.guard import (
    MAX_COORDINATE_MM,
    MAX_DIAGONAL_MM,
    MIN_DIAGONAL_MM,
    ROTATION_TOLERANCE,
    guard_mesh,
    guard_points,
    guard_transform,
)
from puncture_twin.planning.geometry.spaces import Space, Unit, parse_space, parse_unit, to_lps

SQUARE = [[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [10.0, 10.0, 0.0], [0.0, 10.0, 0.0]]
TWO = [[0, 1, 2], [0, 2, 3]]


def rigid(**changes: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix()
    T[:3, 3] = [1.0, 2.0, 3.0]
    for name, value in changes.items():
        T[int(name[1]), int(name[2])] = value
    return T


def test_a_good_mesh_comes_back_as_it_was_and_read_only() -> None:
    """Types become float64 and int32; nobody can write into the result, the caller's array is not held on to.

    Whole indices may be floats; a triangle without an area stays; a vertex that none uses does not widen the box.
    """
    vertices = np.array(SQUARE)
    mesh = guard_mesh(vertices, np.array(TWO, dtype=float), where="square")
    vertices[0, 0] = np.nan
    assert mesh.vertices.dtype == np.float64 and mesh.faces.dtype == np.int32
    assert mesh.vertices.tolist() == SQUARE and mesh.faces.tolist() == TWO
    with pytest.raises(ValueError, match="read-only"):
        mesh.vertices[0, 0] = 1.0
    assert len(guard_mesh(SQUARE, [*TWO, [1, 1, 2]], where="square").faces) == 3
    wider = guard_mesh([[-50.0, 0.0, 0.0], *SQUARE], np.array(TWO) + 1, where="square")
    assert wider.bounds.tolist() == [[0.0, 0.0, 0.0], [10.0, 10.0, 0.0]]
    assert np.array_equal(wider.triangles, np.array(SQUARE)[TWO])


@pytest.mark.parametrize(
    ("vertices", "faces", "says"),
    [
        pytest.param([], TWO, "empty", id="no-vertex"),
        pytest.param(SQUARE, [], "empty", id="no-triangle"),
        pytest.param([*SQUARE, [np.nan] * 3], TWO, "not_finite", id="nan-in-an-unused-vertex"),
        pytest.param(SQUARE, [[0, 1, 4]], "index_out_of_range", id="index-too-high"),
        pytest.param(SQUARE, [[0, 1, 2], [0, -1, 2]], "index_out_of_range -1", id="index-negative"),
        pytest.param(SQUARE, [[0, 1, 2**32]], "index_out_of_range", id="index-that-int32-would-wrap-to-0"),
        pytest.param(SQUARE, [[0, 1, 1.5]], "not_whole", id="index-with-a-fraction"),
        pytest.param(SQUARE, [[0, 1, np.nan]], "not_whole", id="index-nan"),
        pytest.param(SQUARE, [[0, 1, 2, 3]], "wrong_shape", id="quads"),
        pytest.param(SQUARE, [[0, 1, 2], [0, 1]], "wrong_shape", id="faces-ragged"),
        pytest.param([[0.0, 0.0], [1.0, 1.0]], TWO, "wrong_shape", id="vertices-in-2d"),
        pytest.param(np.array(SQUARE) * 1j, TWO, "wrong_type", id="vertices-complex"),
        pytest.param([[0, 0, 0], [1, 1, 1], [9, 9, 9]], [[0, 1, 2]], "no_area", id="all-on-a-line"),
        pytest.param(SQUARE, [[0, 0, 1], [2, 2, 2]], "no_area", id="no-area"),
    ],
)
def test_a_bad_mesh_is_refused_by_name(vertices: ArrayLike, faces: ArrayLike, says: str) -> None:
    """Each fault gives one line that names the place, the fault and what is allowed."""
    with refused(*says.split(), "liver.stl"):
        guard_mesh(vertices, faces, where="liver.stl")


def test_the_limits_of_size_are_the_stated_ones() -> None:
    unit = np.array(SQUARE) / np.linalg.norm([10.0, 10.0])
    for inside, outside in ((MIN_DIAGONAL_MM, -1), (MAX_DIAGONAL_MM, 1)):
        guard_mesh(unit * inside * (1 - outside * 1e-9), TWO, where="x")
        with refused("implausible_size"):
            guard_mesh(unit * inside * (1 + outside * 1e-9), TWO, where="x")
    guard_mesh(np.array(SQUARE) - [0, 0, MAX_COORDINATE_MM], TWO, where="x")
    with refused("too_far"):
        guard_mesh(np.array(SQUARE) - [0, 0, MAX_COORDINATE_MM + 0.1], TWO, where="x")


@pytest.mark.parametrize(
    ("T", "says"),
    [
        pytest.param(np.eye(3), "wrong_shape", id="3x3"),
        pytest.param(np.full((4, 4), "1"), "wrong_type", id="text"),
        pytest.param(rigid(m03=np.nan), "not_finite", id="nan"),
        pytest.param(rigid(m30=0.1), "not_rigid", id="projective"),
        pytest.param(rigid(m33=2.0), "not_rigid", id="scaled-by-the-last-entry"),
        pytest.param(np.diag([-1.0, 1.0, 1.0, 1.0]), "mirrored", id="mirrored"),
        pytest.param(np.diag([2.0, 0.5, 1.0, 1.0]), "not_rigid", id="sheared-with-determinant-1"),
        pytest.param(rigid(m03=2e5), "too_far", id="far-away"),
    ],
)
def test_a_bad_transform_is_refused_by_name(T: ArrayLike, says: str) -> None:
    """A transform that is not rigid never passes, and is never repaired."""
    with refused(says):
        guard_transform(T, where="registration")


def test_a_rotation_may_be_off_by_the_digits_of_a_file_and_no_more() -> None:
    """A rigid one passes unchanged and read-only, with six written digits too; not one off by several tolerances."""
    T = guard_transform(rigid(), where="registration")
    assert np.array_equal(T, rigid())
    with pytest.raises(ValueError, match="read-only"):
        T[0, 0] = 0.0
    guard_transform(np.round(rigid(), 6), where="x")
    with refused("not_rigid"):
        guard_transform(rigid() @ np.diag([1 + 3 * ROTATION_TOLERANCE, 1, 1, 1]), where="x")


@pytest.mark.parametrize(
    ("points", "names", "says"),
    [
        pytest.param([], [], "empty", id="empty"),
        pytest.param([[0, 0, 0]], ["A", "B"], "wrong_count", id="more-names-than-points"),
        pytest.param([[0, 0, 0], [1, 1, 1]], ["A", "A"], "duplicate_name", id="name-twice"),
        pytest.param([[0, 0, 0]], ["  "], "bad_name", id="blank-name"),
        pytest.param([[0, 0, 0]], ["A\nB"], "bad_name A\\nB", id="name-with-a-line-end"),
        pytest.param([[0, 0, 0], [0, np.nan, 0]], ["A", "B"], "not_finite", id="nan"),
        pytest.param([[0, 0, 3e5]], ["A"], "too_far", id="far"),
        pytest.param([[0, 0]], ["A"], "wrong_shape", id="two-coordinates"),
    ],
)
def test_bad_points_are_refused_by_name(points: ArrayLike, names: list[str], says: str) -> None:
    with refused(*says.split()):
        guard_points(points, names, where="markers.csv")


def test_ras_differs_from_lps_in_two_signs_and_local_is_its_own() -> None:
    """Right-anterior becomes left-posterior by sign; applied twice it is the identity; local stays."""
    points = np.array([[1.0, 2.0, 3.0]])
    assert to_lps(points, Space.RAS).tolist() == [[-1.0, -2.0, 3.0]]
    assert np.array_equal(to_lps(to_lps(points, Space.RAS), Space.RAS), points)
    for space in (Space.LPS, Space.LOCAL):
        assert np.array_equal(to_lps(points, space), points)


def test_units_and_spaces_are_parsed_or_refused_with_the_list() -> None:
    assert [parse_unit(text, where="x").mm for text in ("mm", "cm", " m ")] == [1.0, 10.0, 1000.0]
    assert parse_space("ras", where="x") is Space.RAS and parse_unit("m", where="x") is Unit.M
    with refused("unknown_unit", "inch"):
        parse_unit("inch", where="x")
    with refused("unknown_space", "RPS"):
        parse_space("RPS", where="x")
