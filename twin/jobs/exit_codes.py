"""How a command ends: its exit code, and one line for what went wrong."""

from __future__ import annotations

import traceback
import warnings
from collections.abc import Callable
from typing import Any

import typer
from typer._click.exceptions import ClickException  # typer carries its own click and re-exports no base class

from puncture_twin.planning.base.errors import (
    MOST_WHAT,
    CacheWarning,
    InputError,
    NoAnswerError,
    PlanningError,
    one_line,
)

OK, ANSWER_IS_NO, BAD_INPUT, PROGRAM_FAILED, INTERRUPTED = 0, 1, 2, 3, 130


Tell = Callable[[str], None]
"""Shows one line, on stderr."""


def exit_code_of(command: Callable[[], object], tell: Tell) -> int:
    """Run a command, which returns its exit code or None; what it raises becomes a code and a line.

    Args:
        command: Such as the parser with its arguments.
        tell: Shows the line, and what was made anew.
    """
    with warnings.catch_warnings():
        warnings.showwarning = _notes(warnings.showwarning, tell)
        try:
            result = command()
        except (KeyboardInterrupt, typer.Abort):
            result = INTERRUPTED
        except (PlanningError, ClickException) as error:
            line, code = _line_and_code(error)
            tell(line)
            return code
        except Exception:  # the last line of defence: the user gets exit code 3 and the traceback, whatever broke
            traceback.print_exc()
            return PROGRAM_FAILED
    if result == INTERRUPTED:  # typer itself turns Ctrl-C into this, and says nothing
        tell("interrupted")
    return result if isinstance(result, int) else OK


def _line_and_code(error: PlanningError | ClickException) -> tuple[str, int]:
    if isinstance(error, ClickException):
        return f"command line: {one_line(error.format_message(), MOST_WHAT)}; allowed: see --help", BAD_INPUT
    if isinstance(error, NoAnswerError):
        return one_line(str(error)), ANSWER_IS_NO
    return str(error), BAD_INPUT if isinstance(error, InputError) else PROGRAM_FAILED


def _notes(usual: Callable[..., None], tell: Tell) -> Callable[..., None]:
    """Says in one line, once, what was made anew; other warnings are Python's."""
    said: set[str] = set()

    def show(message: Warning | str, category: type[Warning], *rest: Any) -> None:
        if not issubclass(category, CacheWarning):
            usual(message, category, *rest)
        elif str(message) not in said:
            said.add(str(message))
            tell(f"note: {message}")

    return show
