"""Strict reader of TOML files with a schema: bounded, validated, and one line for whatever is wrong."""

import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, BeforeValidator, ValidationError

from puncture_twin.planning.base.errors import InputError, SchemaError, refuse, schema_words
from puncture_twin.planning.base.files import read_input

MAX_BYTES = 1_000_000
"""Most bytes of a file: it is written by hand, and a larger one is something else."""
Model = TypeVar("Model", bound=BaseModel)
MAX_DEPTH = 20
"""Most brackets inside brackets; a case has four."""
MAX_KEY_PARTS = 8
"""Parts of a dotted key or table name; a case has three."""
MAX_WORD = 100
"""Characters of a number, a bare key or any other word outside of strings."""
MAX_LINE = 20_000
"""Characters of a line: a rule for each of a thousand organs fits."""
MAX_TABLES = 20_000
"""Lines that begin with a bracket: each may be a table of eight levels."""
_TOKEN = re.compile(
    r'(?P<text>"""(?:[^\\]|\\.)*?(?:"""|\Z)|\'\'\'.*?(?:\'\'\'|\Z)|"(?:[^"\\\n]|\\.)*"?|\'[^\'\n]*\'?)'
    r"|(?P<comment>#[^\n]*)|(?P<open>[\[{])|(?P<close>[\]}])|(?P<dot>\.)|(?P<word>[^\s\"'#\[\]{}.=,]+)"
    r"|(?P<space>[ \t]+)|(?P<other>.)",
    re.DOTALL,
)


def _one(value: object) -> object:
    if value != 1 or not isinstance(value, int) or isinstance(value, bool):
        raise SchemaError(f"schema {value!r} is not known; this version reads schema = 1", "unknown_version")
    return value


CODES = {"extra_forbidden": "unknown_key", "missing": "missing_key"}
"""Error code of each of Pydantic's faults of a key; any other is ``bad_value``."""
SchemaOne = Annotated[int, BeforeValidator(_one)]
"""The key ``schema``: 1."""


def find_toml(path: Path | str, usual_name: str) -> Path:
    """The path of a file, or of the one of the usual name in a folder. Raises InputError: no plain file, or name."""
    path = Path(path)
    allowed = f"a TOML file, or a folder that holds {usual_name}"
    try:
        path = path / usual_name if path.is_dir() else path
        if path.exists() and not path.is_file():
            refuse("is not a regular file", path, allowed, "not_a_file")
    except (OSError, ValueError) as error:
        what = f"cannot be looked up ({error})"
        raise InputError(what, where=str(path)[:80], allowed=allowed, code="unreadable") from error
    return path


def read_toml_bytes(path: Path, allowed: str) -> bytes:
    """The bytes of a TOML file. Raises InputError: unreadable, or too large."""
    return read_input(path, max_bytes=MAX_BYTES, where=str(path), allowed=allowed)


def parse_toml(
    content: bytes,
    path: Path,
    model: type[Model],
    *,
    allowed: str,
    keys: str,
    change: Callable[[dict[str, Any]], dict[str, Any]] | None = None,
) -> Model:
    """The validated document of a TOML file's bytes, after ``change`` restated some values; it is not opened again.

    Raises InputError: not TOML, or not of the schema: names the first key that is wrong.
    """
    try:
        text = content.decode("utf-8")
        check_toml_bounds(text, path, allowed)
        data = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # not TOML, not UTF-8, a number that Python does not read
        raise InputError(f"is not TOML: {error}", where=path, allowed=allowed, code="not_toml") from error
    data = data if change is None else change(data)
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place, said = _place(data, first["loc"]) or "top level", schema_words(first)
        if first["type"] == "missing" and first["loc"] and isinstance(first["loc"][-1], int):  # the list is too short
            place, said = _place(data, first["loc"][:-1]), f"number {first['loc'][-1] + 1} of the list is missing"
        value = "" if isinstance(first["input"], dict | list | tuple | None) else f" (given: {first['input']!r:.60})"
        allowed = f"the keys, types and ranges of {keys}"
        code = getattr(first.get("ctx", {}).get("error"), "code", CODES.get(first["type"], "bad_value"))
        raise InputError(f"{place}: {said}{value}", where=path, allowed=allowed, code=code) from error


def _place(data: Any, keys: tuple[str | int, ...]) -> str:
    """A key as one finds it in the file: entries of a list are counted from 1, and named where they have a name."""
    said = ""
    for key in keys:
        try:
            data = data[key]
        except (KeyError, IndexError, TypeError):  # a key that is missing, or the schema's own step, not the file's
            data = None
        if isinstance(key, int):
            name = data.get("name") if isinstance(data, dict) else None
            said += f" number {key + 1}" + (f" ('{name:.40}')" if isinstance(name, str) else "")
        else:
            said += f".{key}" if said else key
    return said


def check_toml_bounds(text: str, where: Path | str, allowed: str) -> None:
    """Refuse a text that is nested too deep, or has a key, a number or a line too long; it need not be TOML."""
    tables = 0
    for number, line in enumerate(text.split("\n"), start=1):
        tables += line.lstrip().startswith("[")
        if len(line) > MAX_LINE:
            refuse(f"line {number} has {len(line)} characters, more than {MAX_LINE}", where, allowed, "toml_bounds")
        if tables > MAX_TABLES:
            refuse(f"line {number} starts more than {MAX_TABLES} tables", where, allowed, "toml_bounds")
    depth = parts = 0
    for token in _TOKEN.finditer(text):
        kind, length, wrong = str(token.lastgroup), len(token.group()), ""
        depth += (kind == "open") - (kind == "close")
        # Parts of the key that the text is in: dots join, spaces do not part, all else ends it.
        parts = parts + (kind == "dot") if kind in {"dot", "word", "text", "space"} else 0
        if depth > MAX_DEPTH:
            wrong = f"is nested more than {MAX_DEPTH} deep"
        elif parts > MAX_KEY_PARTS:
            wrong = f"has a dotted key of more than {MAX_KEY_PARTS} parts"
        elif kind == "word" and length > MAX_WORD:
            wrong = f"has a number or a key of {length} characters, more than {MAX_WORD}"
        if wrong:
            before = text.count("\n", 0, token.start())
            refuse(f"line {before + 1} {wrong}", where, allowed, "toml_bounds")
