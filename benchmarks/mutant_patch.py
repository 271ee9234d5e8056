"""A mutant put into a module that is already imported everywhere, and taken out again.

Whoever has imported a function holds the function itself, so its code is exchanged within; numbers of the module are
set in its namespace, where its functions look them up. Nothing is imported again, and no other module knows.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from types import CodeType, FunctionType, MappingProxyType, ModuleType
from typing import Any

PLAIN = (int, float, str, tuple, MappingProxyType)
"""Values of a module's namespace that a mutant may change."""


@contextmanager
def mutated(module: ModuleType, code: CodeType) -> Iterator[None]:
    """Let a module behave as its mutant does.

    Args:
        module: The original, imported.
        code: The mutant's, of the whole module.

    Raises:
        Exception: Whatever the mutant raises when it is loaded; the original is untouched then.
    """
    space: dict[str, Any] = {
        "__name__": module.__name__,
        "__package__": module.__package__,
        "__file__": module.__file__,
    }
    exec(code, space)
    undo: list[tuple[Any, str, Any]] = []
    try:
        for name, value in space.items():
            _exchange(module, name, value, undo)
        yield
    finally:
        for owner, name, value in reversed(undo):
            _set(owner, name, value)


def _exchange(module: ModuleType, name: str, new: Any, undo: list[tuple[Any, str, Any]]) -> None:
    """One name of the module's namespace."""
    old = getattr(module, name, None)
    if isinstance(new, type) and isinstance(old, type) and old.__module__ == module.__name__:
        for attribute, value in vars(new).items():
            _exchange_code(_function(vars(old).get(attribute)), _function(value), undo)
    elif isinstance(new, PLAIN) and not name.startswith("__"):
        undo.append((module, name, old))
        _set(module, name, new)
    elif getattr(old, "__module__", None) == module.__name__:
        _exchange_code(_function(old), _function(new), undo)


def _function(value: Any) -> FunctionType | None:
    """The plain function within a method, a property or a wrapper."""
    if isinstance(value, property):
        value = value.fget
    elif isinstance(value, cached_property):
        value = value.func
    value = getattr(value, "__wrapped__", getattr(value, "__func__", value))
    return value if isinstance(value, FunctionType) else None


def _exchange_code(old: FunctionType | None, new: FunctionType | None, undo: list[tuple[Any, str, Any]]) -> None:
    if old is None or new is None or old.__code__.co_freevars != new.__code__.co_freevars:
        return
    if old.__code__.co_filename != new.__code__.co_filename:
        return  # what dataclass has written
    for name in ("__code__", "__defaults__", "__kwdefaults__"):
        undo.append((old, name, getattr(old, name)))
        setattr(old, name, getattr(new, name))


def _set(owner: Any, name: str, value: Any) -> None:
    setattr(owner, name, value)
