"""What one process keeps of values that cost time to make, from one case to the next."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, TypeVar

Value = TypeVar("Value")

MEMORY_BYTES = 500_000_000
"""What is kept of patients, also beside a search: the meshes and trees of some ten whole bodies."""


class Memory:
    """Values by key, bounded in size: the least recently used goes first.

    A key holds the maker's name, the hashes of all bytes that the value is made from, and every option that decides it;
    never a path. A value is not changed after it was made. What raises is not kept.

    Args:
        most_bytes: What the values may hold together; 0 keeps nothing.
    """

    def __init__(self, most_bytes: int = 0) -> None:
        self._most = most_bytes
        self._held = 0
        self._kept: OrderedDict[tuple[Hashable, ...], tuple[Any, int]] = OrderedDict()

    @property
    def held_bytes(self) -> int:
        """What the values hold now."""
        return self._held

    def get(self, key: tuple[Hashable, ...], make: Callable[[], Value], size: Callable[[Value], int]) -> Value:
        """The value of a key, made where it is not there.

        Args:
            key: All that decides the value.
            make: Makes it.
            size: About how many bytes it holds.
        """
        if key in self._kept:
            self._kept.move_to_end(key)
            return self._kept[key][0]
        value = make()
        self._keep(key, value, size(value))
        return value

    @property
    def most_bytes(self) -> int:
        """What the values may hold."""
        return self._most

    def limit(self, most_bytes: int) -> None:
        """Hold no more than so much from now on."""
        self._most = min(self._most, most_bytes)
        self._shrink()

    def _keep(self, key: tuple[Hashable, ...], value: Any, size: int) -> None:
        if size > self._most:
            return
        self._kept[key] = value, size
        self._held += size
        self._shrink()

    def _shrink(self) -> None:
        while self._held > self._most:
            _, (_, gone) = self._kept.popitem(last=False)
            self._held -= gone


NO_MEMORY = Memory()
"""Makes everything anew."""
