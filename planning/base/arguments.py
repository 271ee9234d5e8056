"""Arguments of public functions, held against annotations and ranges: one `InputError` for what cannot be used.

A function says what it takes in its signature; `checked` makes it true before the function is called.
"""

import functools
import inspect
import math
import numbers
import os
from collections.abc import Callable, Mapping
from enum import StrEnum
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, ParamSpec, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from puncture_twin.planning.base.arrays import Floats, any_masked
from puncture_twin.planning.base.errors import InputError, refuse

Parameters = ParamSpec("Parameters")
Returned = TypeVar("Returned")
Word = TypeVar("Word", bound=StrEnum)
RANGES: Mapping[str, tuple[float, float]] = MappingProxyType({
    "seed": (0, 2**31 - 1), "seeds": (1, 1_000_000), "jobs": (1, 1024), "points": (1, 100_000), "size_deg": (0.05, 10),
    "fle_mm": (0.001, 1e3), "physics": (0, 10_000), "touch": (0, 1), "quick_s": (1, 1e9), "tolerance_mm": (0, 1e3),
})  # fmt: skip
"""Least and greatest of an argument, by its name."""


def checked(function: Callable[Parameters, Returned]) -> Callable[Parameters, Returned]:
    """The function, with each argument checked against its annotation and `RANGES` before the call.

    Annotations are read as words: whoever only registers markers loads no simulator for the sake of a type.
    """
    signature = inspect.signature(function)
    words = {name: one.annotation.split(" | ") for name, one in signature.parameters.items()}

    @functools.wraps(function)
    def guarded(*arguments: Parameters.args, **named: Parameters.kwargs) -> Returned:
        bound = signature.bind(*arguments, **named)
        for name, given in bound.arguments.items():
            value = given[()] if isinstance(given, np.ndarray) and given.ndim == 0 else given
            if not any(is_kind(word, value) for word in words[name]):
                allowed = " or ".join(KINDS[word].text if word in KINDS else word for word in words[name])
                refuse(f"{name} is {shown_value(value)}", function.__name__, allowed, "wrong_type")
            if isinstance(value, numbers.Real):
                low, high = RANGES.get(name, (-math.inf, math.inf))
                if not math.isfinite(value):
                    refuse(f"{name} is {float(value)}", function.__name__, "a finite number", "not_finite")
                if not low <= float(value) <= high:
                    refuse(f"{name} is {float(value):g}", function.__name__, f"{low:g} to {high:g}", "out_of_range")
                if not isinstance(value, bool | int):  # half precision counts no further
                    bound.arguments[name] = int(value) if isinstance(value, numbers.Integral) else float(value)
        return function(*bound.args, **bound.kwargs)

    return guarded


def is_kind(word: str, value: object) -> bool:
    """Whether a value is of the kind that one word of an annotation names."""
    if word in KINDS:
        return KINDS[word].accepts(value)
    return word.partition("[")[0] in {kind.__name__ for kind in type(value).__mro__}


def _is_path(value: object) -> bool:
    """Whether a file may have this name, whether or not there is one."""
    if not isinstance(value, str | Path):
        return False
    try:
        name = os.fsencode(value)
    except UnicodeEncodeError:
        return False
    return b"\0" not in name and len(name) < MOST_PATH and max(map(len, name.split(b"/"))) <= MOST_NAME


MOST_PATH, MOST_NAME = 4096, 255
"""Bytes of a path and of a name in it, of Linux."""


class Kind(NamedTuple):
    """A word of an annotation that is no class of this project: its text in errors, and the check of a value."""

    text: str
    accepts: Callable[[Any], bool]


KINDS: Mapping[str, Kind] = MappingProxyType(
    {
        "None": Kind("None", lambda value: value is None),
        "bool": Kind("True or False", lambda value: isinstance(value, bool)),
        "int": Kind("a whole number", lambda one: isinstance(one, numbers.Integral) and not isinstance(one, bool)),
        "float": Kind("a number", lambda value: isinstance(value, numbers.Real) and not isinstance(value, bool)),
        "str": Kind("text", _is_path),
        "Path": Kind("a path", _is_path),
        "Method": Kind("rigid or triad", lambda value: isinstance(value, str)),
        "EngineChoice": Kind(
            "a class with measure, collides and of",
            lambda value: isinstance(value, type) and all(hasattr(value, one) for one in ("measure", "collides", "of")),
        ),
        "ArrayLike": Kind("an array", lambda value: value is not None),
        "Sequence[str]": Kind("a list of texts", lambda value: isinstance(value, list | tuple)),
        "Points": Kind(
            "points by their names", lambda value: isinstance(value, Mapping) or is_kind("NamedPoints", value)
        ),
    }
)


def shown_value(value: object) -> str:
    """Text of a value in an error: a number or text itself, else its type."""
    return repr(value)[:80] if isinstance(value, int | float | complex | str) else f"of type {type(value).__name__}"


def word_of(kind: type[Word], word: str | None) -> Word | None:
    """The member of an enumeration that a word names; None for None. Raises InputError: another word."""
    try:
        return None if word is None else kind(word)
    except ValueError as error:
        allowed = ", ".join(kind)
        raise InputError(f"{word!r}", where=kind.__name__.lower(), allowed=allowed, code="unknown_choice") from error


def checked_degrees(angles_deg: ArrayLike, most: float, where: str) -> Floats:
    """Angles in degrees, shape (n,), each from 0 to ``most``. Raises InputError: another shape, none, or no number."""
    allowed = f"numbers of degrees from 0 to {most:g}, shape (n,)"
    given = real_numbers(angles_deg, where, allowed)
    if not len(given):
        refuse("no angle", where, allowed, "empty")
    wrong = ~((given >= 0.0) & (given <= most))  # NaN too
    if wrong.any():
        refuse(f"{float(given[wrong][0])!r}", where, allowed, "out_of_range")
    return given


def real_numbers(values: ArrayLike, where: str, allowed: str) -> Floats:
    """Real numbers, shape (n,). Raises InputError: another shape, or values that are no real numbers."""
    try:
        given = np.asarray(values)
    except ValueError as error:
        raise InputError("rows of different length", where=where, allowed=allowed, code="wrong_shape") from error
    if given.dtype.kind not in "iuf":
        refuse(f"values of type {given.dtype}", where, allowed, "wrong_type")
    if any_masked(values):
        refuse("a masked value", where, allowed, "not_finite")
    if given.ndim != 1:
        refuse(f"shape {given.shape}", where, allowed, "wrong_shape")
    return np.asarray(given, dtype=np.float64)
