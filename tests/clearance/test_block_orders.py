"""What is kept of the packing: the same blocks to the bit, of these surfaces, or found anew."""

import warnings
from pathlib import Path

import numpy as np
import pytest
import trimesh

from puncture_twin.planning.base.cache.array_cache import NO_CACHE, Cache
from puncture_twin.planning.base.cache.entry_file import Arrays, packed, unpacked
from puncture_twin.planning.base.errors import CacheWarning
from puncture_twin.planning.clearance import fast_engine as module
from puncture_twin.planning.clearance.fast_engine import FastEngine
from puncture_twin.planning.geometry.mesh import TriangleMesh


def ball(radius: float, middle: tuple[float, float, float], subdivisions: int = 3) -> TriangleMesh:
    """A ball."""
    made = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return TriangleMesh(made.vertices + np.array(middle), made.faces)


SURFACES = (ball(20.0, (60.0, 0.0, 0.0)), ball(8.0, (0.0, 30.0, 5.0), 1), ball(3.0, (0.0, 0.0, 50.0), 2))


@pytest.fixture
def cache(tmp_path: Path) -> Cache:
    """An empty folder."""
    return Cache(tmp_path)


def content(engine: FastEngine) -> list[bytes]:
    """All that an engine has packed."""
    return [array.tobytes() for blocks in engine.blocks for array in vars(blocks).values()]


def entry(cache: Cache) -> Path:
    """The one entry."""
    assert cache.folder is not None
    (path,) = cache.folder.glob("*.arrays")
    return path


def test_blocks_are_the_same_from_a_full_an_empty_and_no_cache(cache: Cache, monkeypatch: pytest.MonkeyPatch) -> None:
    """And the second time no order is looked for."""
    expected = content(FastEngine(SURFACES, cache=NO_CACHE))
    assert content(FastEngine(SURFACES, cache=cache)) == expected
    monkeypatch.delattr(module, "block_order")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert content(FastEngine(SURFACES, cache=cache)) == expected


def test_without_a_folder_nothing_is_written_and_no_surface_is_none_to_keep(tmp_path: Path) -> None:
    """The switch that is off, and a case without structures."""
    content(FastEngine(SURFACES, cache=Cache(None)))
    content(FastEngine([], cache=Cache(tmp_path)))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "others",
    [
        (SURFACES[1], SURFACES[0], SURFACES[2]),
        (SURFACES[0], SURFACES[1], ball(3.0, (0.0, 0.0, 50.001), 2)),
        (SURFACES[0], TriangleMesh(SURFACES[1].vertices, SURFACES[1].faces[::-1]), SURFACES[2]),
        SURFACES[:2],
    ],
    ids=["order", "moved", "triangles in another order", "one less"],
)
def test_other_surfaces_have_orders_of_their_own(cache: Cache, others: tuple[TriangleMesh, ...]) -> None:
    """A hundredth of a hair is another surface, whatever its name and its number of triangles."""
    content(FastEngine(SURFACES, cache=cache))
    assert content(FastEngine(others, cache=cache)) == content(FastEngine(others))


def twice(orders: np.ndarray) -> np.ndarray:
    """One triangle stands twice, so another does not."""
    orders[5] = orders[6]
    return orders


WRONG = {
    "a triangle left out": lambda orders: {"orders": twice(orders)},
    "beyond the surface": lambda orders: {"orders": orders + np.int32(1)},
    "below zero": lambda orders: {"orders": orders - np.int32(1)},
    "too few": lambda orders: {"orders": orders[:-1]},
    "another type": lambda orders: {"orders": orders.astype(np.int64)},
    "another name": lambda orders: {"order": orders},
    "two columns": lambda orders: {"orders": orders.reshape(-1, 2)},
}


@pytest.mark.parametrize("wrong", WRONG)
def test_an_order_that_is_none_of_the_surface_is_found_anew(cache: Cache, wrong: str) -> None:
    """Under a forged digest too: a triangle that is in no block would never be seen, and its organ be free."""
    content(FastEngine(SURFACES, cache=cache))
    path = entry(cache)
    key = path.name.split(".")[-2]
    whole = path.read_bytes()
    changed: Arrays = WRONG[wrong](unpacked(whole, key)["orders"].copy())
    path.write_bytes(packed(changed, key))
    with pytest.warns(CacheWarning, match="does not have the expected content; it is computed again and replaced"):
        assert content(FastEngine(SURFACES, cache=cache)) == content(FastEngine(SURFACES))
    assert path.read_bytes() == whole


def test_a_flipped_bit_is_seen(cache: Cache) -> None:
    """A damaged order is found anew, and it is said."""
    content(FastEngine(SURFACES, cache=cache))
    path = entry(cache)
    damaged = bytearray(path.read_bytes())
    damaged[-3] ^= 1
    path.write_bytes(damaged)
    with pytest.warns(CacheWarning, match=r"is truncated, damaged, or foreign"):
        assert content(FastEngine(SURFACES, cache=cache)) == content(FastEngine(SURFACES))
