"""The exceptions of the planner: few, and each says what was wrong, where, and what is allowed.

Beside them what a check of plausibility found, and what is said where a part of the installation is missing.
"""

import copy
import json
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import StrEnum
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType
from typing import Any, NoReturn, Self

MOST_WHAT, MOST_WHERE, MOST_ALLOWED = 400, 300, 600
"""Characters of an error's parts: what is longer loses its middle, so that the line can still be read."""
MOST_MESSAGE = 1_500
"""Most characters of any other line."""


class PlanningError(Exception):
    """Base of everything that the planner raises on purpose."""

    code = "program_failed"
    """The kind of mistake, for those who ask a program and not a person."""

    def __reduce__(self) -> tuple[Any, ...]:
        """For pickling between processes: all parts of the error, which its message alone does not hold."""
        return _error_again, (type(self), self.args, vars(self))


def _error_again(kind: type[PlanningError], arguments: tuple[Any, ...], parts: dict[str, Any]) -> PlanningError:
    error = kind.__new__(kind, *arguments)
    error.args = arguments
    vars(error).update(parts)
    return error


class InputError(PlanningError):
    """Input that cannot be used. The command line prints it as one line and exits with code 2.

    Args:
        where: The file, and the place in it (key, line, marker name).
        code: What kind of mistake it is, in snake_case: the same kind has one code, wherever it is found.
        numbers: What was measured, by name with its unit.
    """

    most_what = MOST_WHAT
    """Characters of what is wrong."""

    def __init__(
        self,
        what: str,
        *,
        where: str | Path,
        allowed: str,
        code: str,
        numbers: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        self.code, self.numbers = code, dict(numbers)
        self.what = one_line(what, self.most_what)
        self.where = one_line(str(where), MOST_WHERE)
        self.allowed = one_line(allowed, MOST_ALLOWED)
        super().__init__(self.what)

    def __str__(self) -> str:
        """One line: where, what, and what is allowed."""
        return f"{self.where}: {self.what}; allowed: {self.allowed}"

    def at(self, where: str | Path) -> Self:
        """A copy of the error, located at another place."""
        relocated = copy.copy(self)
        relocated.where = one_line(str(where), MOST_WHERE)
        return relocated


def refuse(what: str, where: str | Path, allowed: str, code: str) -> NoReturn:
    """Raise an `InputError` of these parts: the usual way, where no other error is its cause."""
    raise InputError(what, where=where, allowed=allowed, code=code)


@contextmanager
def refusing(
    kinds: type[Exception] | tuple[type[Exception], ...], what: str, where: str | Path, allowed: str, code: str
) -> Iterator[None]:
    """Refuse what raises one of these errors within: ``what``, and in brackets what the error says."""
    try:
        yield
    except kinds as error:
        raise InputError(f"{what} ({error})", where=where, allowed=allowed, code=code) from error


class InputListError(InputError):
    """Several faults of one input, in one line."""

    most_what = 900


class SchemaError(ValueError):
    """A fault that a file's schema refuses: a sentence about keys, and its code."""

    def __init__(self, what: str, code: str) -> None:
        self.code = code
        super().__init__(what)


class NoAnswerError(PlanningError):
    """The work was done and the answer is no. The command line exits with code 1."""

    def __init__(self, message: str, *, code: str, counts: Mapping[str, int] = MappingProxyType({})) -> None:
        self.code, self.counts = code, dict(counts)
        super().__init__(message)


MUST_BE = MappingProxyType(
    {
        "bool_type": "true or false",
        "int_type": "a whole number",
        "int_parsing": "a whole number",
        "float_type": "a number",
        "float_parsing": "a number",
        "finite_number": "a finite number",
        "string_type": "a text in quotes",
        "tuple_type": "a list in brackets, [ ]",
        "list_type": "a list in brackets, [ ]",
        "dict_type": "a table",
        "model_type": "a table",
        "literal_error": "{expected}",
        "enum": "{expected}",
        "greater_than": "above {gt}",
        "greater_than_equal": "{ge} or more",
        "less_than": "below {lt}",
        "less_than_equal": "{le} or less",
        "too_short": "a list of {min_length} or more",
        "too_long": "a list of {max_length} at most",
        "string_too_short": "a text of {min_length} or more characters",
        "string_too_long": "a text of {max_length} characters at most",
        "string_pattern_mismatch": "a text of the pattern {pattern}",
    }
)
"""Text of what a value must be, by Pydantic's name of its fault."""


def schema_words(error: Mapping[str, Any]) -> str:
    """A key's fault in this project's words, from one of Pydantic's ``ValidationError.errors()``.

    >>> schema_words({"type": "less_than_equal", "msg": "Input should be ...", "ctx": {"le": 10.0}})
    'must be 10 or less'
    """
    if error["type"] == "missing":
        return "missing"
    words = MUST_BE.get(error["type"])
    given = {name: f"{value:g}" if isinstance(value, float) else value for name, value in error.get("ctx", {}).items()}
    return str(error["msg"]).removeprefix("Value error, ") if words is None else "must be " + words.format(**given)


class CacheWarning(UserWarning):
    """Something kept from an earlier run could not be trusted and was made anew: the answer is the same."""


def one_line(text: str, most: int = MOST_MESSAGE) -> str:
    """A text as one printable line; one of more than so many characters, from 3 on, loses its middle."""
    line = " ".join(text.split())
    if len(line) > most:
        head = (most - 3) // 2
        line = line[:head] + "..." + line[len(line) - (most - 3 - head) :]
    return "".join(c if c.isprintable() else "?" for c in line)


class Severity(StrEnum):
    """Weight of a finding."""

    NOTE = "note"
    WARNING = "warning"
    REFUSAL = "refusal"


@dataclass(frozen=True)
class Finding:
    """One observation from inputs that are checked against each other."""

    code: str
    severity: Severity  # a refusal stops the work, a warning stands in every result, a note is for those who look
    sentence: str
    # what was measured, by name with its unit
    numbers: Mapping[str, float | list[float] | str] = field(default_factory=dict)
    way_out: str = ""  # of a refusal, what would be accepted

    def document(self) -> dict[str, object]:
        """The finding as it is listed under ``findings`` of ``--json``."""
        measured = {"code": self.code, "severity": str(self.severity), "numbers": dict(self.numbers)}
        return {**measured, "sentence": self.sentence}


MODULES: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "twin": ("pybullet", "cv2", "imageio_ffmpeg"),
        "mirror": ("rtde_receive",),
        "dask": ("distributed",),
        "dicom": ("highdicom",),
        "hdf5": ("h5py",),
        "pandas": ("pandas",),
    }
)
"""Extra to the modules that it installs: the simulator, the cameras' pictures, the film; a running robot; and so on."""
NO_WHEEL_FROM: Mapping[str, tuple[str, tuple[int, int]]] = MappingProxyType(
    {"pybullet": ("pybullet", (3, 12)), "rtde_receive": ("ur-rtde", (3, 13))}
)
"""Parts that an extra leaves out of later Pythons, which have to build it: its name, and the first of them."""


def require_extra(extra: str, where: str, *, else_allowed: str = "") -> None:
    """Refuse what needs a missing part of the installation, before it works for minutes."""
    missing = [name for name in MODULES[extra] if find_spec(name) is None]
    if missing:
        what = f"it needs the extra '{extra}', which is not installed (no {', '.join(missing)})"
        allowed = f"{_install_line(extra, missing)}{else_allowed}"
        raise InputError(what, where=where, allowed=allowed, code="missing_extra")


def _install_line(extra: str, missing: list[str]) -> str:
    """Command that installs an extra, from where this package was installed: it is on no index."""
    if all(name in NO_WHEEL_FROM and sys.version_info >= NO_WHEEL_FROM[name][1] for name in missing):
        names = " ".join(NO_WHEEL_FROM[name][0] for name in missing)
        version = ".".join(map(str, sys.version_info[:2]))
        return (
            f"pip install {names} (no wheel for Python {version}: it is built in some minutes and needs a C++ compiler)"
        )
    parts = Path(__file__).parents[2]
    if (parts / "pyproject.toml").is_file():
        return f"pip install --editable '{parts}[{extra}]'"
    from importlib.metadata import PackageNotFoundError, distribution

    try:
        origin = json.loads(distribution("puncture-twin").read_text("direct_url.json") or "{}")
    except PackageNotFoundError:
        origin = {}
    folder = origin.get("url", "FOLDER").removeprefix("file://")
    return f"pip install '{folder}[{extra}]'" + ("" if origin else " (FOLDER: with this project's pyproject.toml)")
