"""The order of each surface's triangles in its blocks, kept: to find it takes half of the time of packing."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.cache.array_cache import Arrays, Cache
from puncture_twin.planning.base.processes import on_threads
from puncture_twin.planning.clearance.kernels.blocks import block_order
from puncture_twin.planning.geometry.mesh import TriangleMesh

Order = NDArray[np.int32]


def block_orders(meshes: Sequence[TriangleMesh], cache: Cache, threads: int) -> tuple[Order, ...]:
    """`block_order` of each surface, from the cache where all of them are there.

    The blocks themselves are not kept: they are thirty times as large, and filled sooner than read.

    Args:
        meshes: The surfaces.
        cache: Where the orders are kept, one entry for all.
        threads: How many are found side by side.
    """
    made_from = {"what": "block orders", "meshes": [mesh.digest for mesh in meshes]}
    make = partial(_found, meshes, threads)
    return cache.value(made_from, make, partial(_of_each, [len(mesh.faces) for mesh in meshes]), by=__name__)


def _found(meshes: Sequence[TriangleMesh], threads: int) -> Arrays:
    orders: dict[int, Order] = {}

    def work(k: int) -> None:
        orders[k] = block_order(meshes[k])

    for _ in on_threads(work, len(meshes), threads):
        pass
    return {"orders": np.concatenate([np.empty(0, np.int32), *(orders[k] for k in range(len(meshes)))])}


def _of_each(counts: Sequence[int], stored: Arrays) -> tuple[Order, ...]:
    """The order of each surface.

    Raises:
        KeyError, TypeError, ValueError: One leaves out a triangle, which the search would never see then.
    """
    orders = stored["orders"]
    if orders.dtype != np.int32 or orders.shape != (sum(counts),):
        raise TypeError("orders of other surfaces")
    each = np.split(orders, np.cumsum(counts)[:-1])
    for order, count in zip(each, counts, strict=True):
        found = np.zeros(count, np.bool_)
        if count and (order.min() < 0 or order.max() >= count):
            raise ValueError("no triangle of the surface")
        found[order] = True
        if not found.all():
            raise ValueError("a triangle is left out")
    return tuple(each)
