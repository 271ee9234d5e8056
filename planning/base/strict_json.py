"""Strict JSON reader for documents that decide a result: what the standard library lets pass is refused.

A key that stands twice has two meanings, of which a reader sees one; NaN and infinity are no JSON; 1e999 is infinite.
The readers of single values raise what `fitting` turns into one line about the file.
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError, refuse, refusing
from puncture_twin.planning.base.files import read_input

Value = TypeVar("Value")
MAX_NUMBER = 1e6
"""Largest number of millimetres, degrees, radians and seconds: products of larger ones overflow."""
SHOWN = 60
"""Characters of a damaged value that an error shows."""


def read_json(path: Path, *, max_bytes: int, allowed: str) -> Any:
    """A JSON file. Raises InputError: it cannot be read, is larger than ``max_bytes``, or see `parse_json`."""
    return parse_json(read_input(path, max_bytes=max_bytes, where=str(path)), where=path, allowed=allowed)


def parse_json(data: bytes, *, where: str | Path, allowed: str) -> Any:
    """The tree that bytes hold in UTF-8: each key once, each number finite, no endless nest. Raises InputError else."""
    with refusing((ValueError, RecursionError), "JSON cannot be read", where, allowed, "not_json"):
        text = data.decode("utf-8-sig")
        return json.loads(text, parse_constant=_refused, parse_float=_finite, object_pairs_hook=_unique_keys)


def parse_document(data: bytes, version: int, *, where: str | Path, allowed: str) -> dict[str, Any]:
    """A JSON object of this ``version``. Raises InputError: another version, no object, or see `parse_json`."""
    document = parse_json(data, where=where, allowed=allowed)
    stated = document.get("version") if isinstance(document, dict) else None
    if isinstance(stated, bool) or stated != version:
        refuse(f"version {_shown(stated)}", where, allowed, "unknown_version")
    return dict(document)


@contextmanager
def fitting(where: str | Path, allowed: str) -> Iterator[None]:
    """Context with one InputError for a missing key, or a value of another type, shape or size."""
    try:
        yield
    except KeyError as error:
        raise InputError(f"key {error} is missing", where=where, allowed=allowed, code="missing_key") from error
    except (TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        code = getattr(error.__cause__, "code", "bad_value")
        raise InputError(f"does not fit: {error}", where=where, allowed=allowed, code=code) from error


def field(document: dict[str, Any], name: str, read: Callable[[Any], Value]) -> Value:
    """A value by its key, which errors name. Raises KeyError, ValueError: it is missing, or ``read`` refuses it."""
    value = document[name]
    try:
        return read(value)
    except InputError as error:
        raise ValueError(f"{name}: {error.what}, not {error.allowed}") from error
    except KeyError as error:
        raise KeyError(f"{name}.{error.args[0]}") from error
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        raise ValueError(f"{name}: {error}") from error


def text(value: Any) -> str:
    """The value if it is a string. Raises TypeError: something else."""
    if not isinstance(value, str):
        raise TypeError(f"{_shown(value)} is not a text")
    return value


def whole(value: Any) -> int:
    """The value if it is an integer. Raises TypeError: something else."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError(f"{_shown(value)} is not a whole number")
    return value


def number(value: Any) -> float:
    """A number within ±`MAX_NUMBER`. Raises TypeError, ValueError: something else, or a larger one."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{_shown(value)} is not a number")
    if not abs(value) <= MAX_NUMBER:
        raise ValueError(f"{_shown(value)} is beyond {MAX_NUMBER:,.0f}")
    return float(value)


def number_or_nan(value: Any) -> float:
    """A number as `number` takes it, or NaN for null."""
    return float("nan") if value is None else number(value)


def array(value: Any, shape: tuple[int, ...]) -> Floats:
    """Numbers within ±`MAX_NUMBER` of a known shape, read-only. Raises ValueError: another shape, or other values."""
    if not _numbers_only(value):
        raise ValueError("an array with values other than numbers")
    try:
        numbers = np.array(value, dtype=np.float64)
    except OverflowError as error:
        raise ValueError(f"a number beyond {MAX_NUMBER:,.0f}") from error
    if numbers.shape != shape:
        raise ValueError(f"an array of shape {numbers.shape} instead of {shape}")
    if not np.all(np.abs(numbers) <= MAX_NUMBER):
        raise ValueError(f"a number beyond {MAX_NUMBER:,.0f}")
    numbers.setflags(write=False)
    return numbers


def point(value: Any) -> Floats:
    """A point, shape (3,), as `array` takes it."""
    return array(value, (3,))


def texts(value: Any) -> tuple[str, ...]:
    """A list of texts. Raises TypeError: something else."""
    if not isinstance(value, list):
        raise TypeError(f"{_shown(value)} is not a list")
    return tuple(map(text, value))


def or_null(value: float) -> float | None:
    """A number as JSON has it: null where it is not finite."""
    return float(value) if np.isfinite(value) else None


def plain(value: Any) -> Any:
    """A value as JSON has it: a record by its fields, an array as lists, null where a number is not finite.

    >>> from typing import NamedTuple
    >>> Hit = NamedTuple("Hit", [("tip_mm", Floats), ("error_mm", float)])
    >>> plain([Hit(np.zeros(2), float("nan"))])
    [{'tip_mm': [0.0, 0.0], 'error_mm': None}]
    """
    if is_dataclass(value) and not isinstance(value, type):
        return {one.name: plain(getattr(value, one.name)) for one in fields(value)}
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return {name: plain(one) for name, one in zip(value._fields, value, strict=True)}
    if isinstance(value, Mapping):
        return {key: plain(one) for key, one in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    if isinstance(value, float):
        return or_null(value)
    return str(value) if isinstance(value, Path) else value


def _refused(name: str) -> float:
    raise ValueError(f"{name} is not a finite number")


def _finite(written: str) -> float:
    value = float(written)
    return value if abs(value) < float("inf") else _refused(written[:SHOWN])


def _unique_keys(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    document = dict(pairs)
    if len(document) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"key {_shown(next(key for key in keys if keys.count(key) > 1))} appears twice")
    return document


def _numbers_only(value: Any) -> bool:
    if isinstance(value, list):
        return all(map(_numbers_only, value))
    return isinstance(value, int | float) and not isinstance(value, bool)


def _shown(value: Any) -> str:
    return ascii(value)[:SHOWN]
