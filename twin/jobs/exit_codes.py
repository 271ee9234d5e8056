"""How a command ends: its exit code, and one line for what went wrong."""

from __future__ import annotations

import sys
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
from puncture_twin.twin.jobs.interrupt import insistent_ctrl_c
from puncture_twin.twin.jobs.terminal import flush_output, leave_unread, reader_is_gone, refusal_of
from puncture_twin.twin.jobs.usage import allowed_text

OK, ANSWER_IS_NO, BAD_INPUT, PROGRAM_FAILED, INTERRUPTED, UNREAD = 0, 1, 2, 3, 130, 141
"""The last two as the shell gives them for a program that Ctrl-C, or a closed pipe, has ended."""

PrintLine = Callable[[str], None]
"""Shows one line, on stderr."""


def exit_code_of(command: Callable[[], object], print_line: PrintLine) -> int:
    """Run a command, which returns its exit code or None; what it raises becomes a code and a line.

    Args:
        command: Such as the parser with its arguments.
        print_line: Shows the line, and what was made anew.
    """
    try:
        return _exit_code_of(command, print_line)
    except KeyboardInterrupt:  # as the command's own last line was printed
        print_line("interrupted")
        return INTERRUPTED


def _exit_code_of(command: Callable[[], object], print_line: PrintLine) -> int:
    with warnings.catch_warnings():
        warnings.showwarning = _notes(warnings.showwarning, print_line)
        try:
            with insistent_ctrl_c():
                result = command()
                flush_output()
        except (KeyboardInterrupt, typer.Abort):
            result = INTERRUPTED
        except (PlanningError, ClickException) as error:
            line, code = _line_and_code(error)
            print_line(line)
            return code
        except (BrokenPipeError, SystemExit) as error:  # click and rich end the program at any broken pipe
            return _unread(error)
        except Exception as error:  # the last line of defence: the user gets exit code 3, and the traceback
            return _failed(error, print_line)
    if result == INTERRUPTED:  # typer itself turns Ctrl-C into this, and says nothing
        print_line("interrupted")
    return result if isinstance(result, int) else OK


def _unread(error: BaseException) -> int:
    """The code where nobody reads stdout; a pipe that broke elsewhere, such as a worker's, is a failure."""
    in_help = traceback.extract_tb(error.__traceback__)[-1].name == "on_broken_pipe"  # rich; stdout goes nowhere then
    if not (in_help or reader_is_gone(sys.stdout)):
        traceback.print_exc()
        return PROGRAM_FAILED
    leave_unread(sys.stdout)
    return UNREAD


def _failed(error: Exception, print_line: PrintLine) -> int:
    """What broke is shown whole, unless it is that stdout takes nothing, as where its disk is full."""
    why = refusal_of(sys.stdout) if isinstance(error, OSError) else None
    if why is None:
        traceback.print_exc()
    else:
        leave_unread(sys.stdout)
        print_line(f"stdout: {why}; allowed: a place that takes it")
    return PROGRAM_FAILED


def _line_and_code(error: PlanningError | ClickException) -> tuple[str, int]:
    if isinstance(error, ClickException):
        what = one_line(error.format_message().replace("Value error, ", ""), MOST_WHAT).rstrip(".")
        return f"command line: {what}; allowed: {allowed_text(error)}", BAD_INPUT
    if isinstance(error, NoAnswerError):
        return one_line(str(error)), ANSWER_IS_NO
    return str(error), BAD_INPUT if isinstance(error, InputError) else PROGRAM_FAILED


def _notes(usual: Callable[..., None], print_line: PrintLine) -> Callable[..., None]:
    """Says in one line, once, what was made anew; other warnings are Python's."""
    said: set[str] = set()

    def show(message: Warning | str, category: type[Warning], *rest: Any) -> None:
        if not issubclass(category, CacheWarning):
            usual(message, category, *rest)
        elif str(message) not in said:
            said.add(str(message))
            print_line(f"note: {message}")

    return show
