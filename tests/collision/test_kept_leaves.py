"""What is kept of the skin's tree: its leaves, of which no triangle may be missing."""

import numpy as np
import pytest
import trimesh

from puncture_twin.planning.base.cache.array_cache import Cache
from puncture_twin.planning.base.cache.entry_file import packed, unpacked
from puncture_twin.planning.base.errors import CacheWarning
from puncture_twin.planning.collision import packed as module
from puncture_twin.planning.collision.packed import TriangleTree
from puncture_twin.planning.geometry.mesh import TriangleMesh


def ball(subdivisions, stretch=1.0):
    """An egg."""
    made = trimesh.creation.icosphere(subdivisions=subdivisions, radius=80.0)
    return TriangleMesh(made.vertices * [1.0, stretch, 0.5], made.faces)


MESH = ball(3)


def content(tree):
    """All that a tree holds."""
    return [array.tobytes() for array in vars(tree).values()]


@pytest.fixture
def kept(tmp_path):
    """A cache that holds the leaves of a mesh, and the file of the entry."""
    cache = Cache(tmp_path)
    TriangleTree.of(MESH, cache)
    (path,) = tmp_path.glob("*.arrays")
    return cache, path


@pytest.mark.parametrize("mesh", [ball(0), MESH, ball(2, 3.0), TriangleMesh(MESH.vertices, MESH.faces[:1])])
def test_the_tree_is_the_same_from_the_cache_and_without(tmp_path, mesh, monkeypatch):
    """To the bit; its boxes hold all triangles below them; the second time nothing is sorted."""
    tree, made = TriangleTree.of(mesh), TriangleTree.of(mesh, Cache(tmp_path))
    monkeypatch.delattr(module, "_leaves")
    read = TriangleTree.of(mesh, Cache(tmp_path))
    assert content(tree) == content(made) == content(read)
    assert {array.flags.writeable for one in (tree, made, read) for array in vars(one).values()} == {False}
    leaves = len(tree.rows)
    for node in range(2 * leaves - 1):
        first, last = node, node
        while first < leaves - 1:
            first, last = 2 * first + 1, 2 * last + 2
        below = tree.corners[first - leaves + 1 : last - leaves + 2].reshape(-1, 3)
        assert np.array_equal(tree.lows[node], below.min(axis=0))
        assert np.array_equal(tree.highs[node], below.max(axis=0))


def test_another_mesh_has_leaves_of_its_own(kept):
    """Of as many triangles and vertices."""
    other = ball(3, 1.0001)
    assert content(TriangleTree.of(other, kept[0])) == content(TriangleTree.of(other))


def without_one(leaves):
    """One triangle is in no leaf."""
    rows = leaves["rows"].copy()
    rows[rows == 17] = 18
    return {**leaves, "rows": rows}


WRONG = {
    "a triangle left out": without_one,
    "beyond the mesh": lambda leaves: {**leaves, "rows": leaves["rows"] + np.int32(1)},
    "below zero": lambda leaves: {**leaves, "rows": leaves["rows"] - np.int32(1)},
    "half": lambda leaves: {**leaves, "rows": leaves["rows"][::2]},
    "three quarters": lambda leaves: {name: array[: 3 * len(array) // 4] for name, array in leaves.items()},
    "one row": lambda leaves: {**leaves, "rows": leaves["rows"].ravel()},
    "no boxes": lambda leaves: {"rows": leaves["rows"]},
    "boxes of another type": lambda leaves: {**leaves, "lows": leaves["lows"].astype(np.float32)},
    "rows of another type": lambda leaves: {**leaves, "rows": leaves["rows"].astype(np.int64)},
}


@pytest.mark.parametrize("wrong", WRONG)
def test_leaves_that_cannot_be_of_the_mesh_are_made_anew(kept, wrong):
    """Under a forged digest too: through a triangle that is in no leaf the arm would pass."""
    cache, path = kept
    key, whole = path.name.split(".")[-2], path.read_bytes()
    path.write_bytes(packed(WRONG[wrong](unpacked(whole, key)), key))
    with pytest.warns(CacheWarning, match="does not have the expected content; it is computed again and replaced"):
        assert content(TriangleTree.of(MESH, cache)) == content(TriangleTree.of(MESH))
    assert path.read_bytes() == whole
