"""What a wrong command line may say instead."""

from __future__ import annotations

from enum import Enum
from typing import Any, get_args

from typer._click.exceptions import ClickException  # typer carries its own click and re-exports no base class

NUMBERS = {int: "a whole number", float: "a number"}


def allowed_text(error: ClickException) -> str:
    """The values of the option whose value is wrong; where they cannot be listed, the help that has them."""
    option = getattr(error, "param", None)
    descriptor = getattr(option, "type_descriptor", None)  # typer's own: what is not there is not told
    kind = getattr(descriptor, "annotation", None)
    kind = next(iter(get_args(kind)), kind)  # of a list its members
    if isinstance(kind, type) and issubclass(kind, Enum):
        return ", ".join(str(one.value) for one in kind)
    if kind in NUMBERS and type(error).__name__ == "BadParameter":
        return NUMBERS[kind] + _range(option)
    context = getattr(error, "ctx", None)
    command = "" if context is None else context.command_path.removeprefix(context.find_root().command_path).strip()
    return f"see {command} --help" if command else "see --help"


def _range(option: Any) -> str:
    bounds = (("from", getattr(option, "min", None)), ("to", getattr(option, "max", None)))
    return "".join(f" {word} {bound:g}" for word, bound in bounds if bound is not None)
