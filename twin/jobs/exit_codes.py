"""End of a command: its answer, its exit code, and one line for what went wrong."""

import errno
import sys
import traceback
import warnings
from collections.abc import Callable, Mapping
from enum import Enum
from typing import Any, get_args

import typer

from puncture_twin.planning.base import errors
from puncture_twin.twin.jobs import terminal

OK, ANSWER_IS_NO, BAD_INPUT, PROGRAM_FAILED, INTERRUPTED, UNREAD = 0, 1, 2, 3, 130, 141
"""The last two as the shell gives them for a program that Ctrl-C, or a closed pipe, has ended."""


RULES: Mapping[str, Callable[[Any], bool]] = {
    "demo": lambda run: not run.failures,
    "search": lambda run: bool(run.candidates.safe.any()),
    "check": lambda answer: answer.safe,
    "compare": lambda answer: answer.safe,
    "rehearse": lambda run: not run.failures,
    "rehearse --sweep": lambda run: run.whole,
    "rehearse --guidance A,B": lambda answer: answer.passed,
    "touch": lambda run: run.suffices,
    "pivot": lambda answer: not answer.pivot.large,
    "servo": lambda job: job.passed,
    "confirm": lambda done: done.yes,
    "reproduce": lambda result: result.passed,
    "batch run": lambda counts: counts.whole,
    "batch merge": lambda answer: answer.as_expected,
}
"""Whether a command's answer is yes, by the command's name; the others know no other. In words, where it is no:
``docs/reference/command-line.md``."""
PrintLine = Callable[[str], None]  # shows one line, on stderr
NUMBERS = {int: "a whole number", float: "a number"}


def finish(command: str, answer: Any, summary: dict[str, Any], text: str, as_json: bool) -> None:
    """Print a command's answer, and end it with the code that its rule gives, by `typer.Exit` where that is not 0."""
    terminal.print_answer(summary, text, as_json)
    if command in RULES and not RULES[command](answer):
        failed = command == "batch run" and answer.ended[PROGRAM_FAILED] > 0
        raise typer.Exit(PROGRAM_FAILED if failed else ANSWER_IS_NO)


def exit_code_of(command: Callable[[], object], print_line: PrintLine, *, as_json: bool = False) -> int:
    """Run a command, which returns its exit code or None; what it raises becomes a code and a line, or JSON too."""
    try:
        return _exit_code_of(command, print_line, as_json)
    except KeyboardInterrupt:  # as the command's own last line was printed
        print_line("interrupted")
        return INTERRUPTED


def _exit_code_of(command: Callable[[], object], print_line: PrintLine, as_json: bool) -> int:
    said: set[str] = set()
    with warnings.catch_warnings():
        usual = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *rest: Any, **more: Any) -> None:
            """What was made anew, in one line, once; other warnings are Python's."""
            if not issubclass(category, errors.CacheWarning):
                usual(message, category, *rest, **more)
            elif str(message) not in said:
                said.add(str(message))
                print_line(f"note: {message}")

        warnings.showwarning = show
        try:
            with terminal.insistent_ctrl_c():
                result = _answered(command) if as_json else command()
                terminal.flush_output()
        except (KeyboardInterrupt, typer.Abort):
            result = INTERRUPTED
        except (errors.PlanningError, typer.TyperException) as error:
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
    """Exit code where nobody reads stdout; a pipe that broke elsewhere, such as a worker's, is a failure."""
    if isinstance(error, SystemExit) and not error.code:  # typer has completed a shell's word, or said how
        return OK
    in_help = traceback.extract_tb(error.__traceback__)[-1].name == "on_broken_pipe"  # rich; stdout goes nowhere then
    if not (in_help or terminal.reader_is_gone(sys.stdout)):
        traceback.print_exc()
        return PROGRAM_FAILED
    terminal.leave_unread(sys.stdout)
    return UNREAD


def _failed(error: Exception, print_line: PrintLine) -> int:
    """Exit code of a failure, shown whole unless stdout takes nothing or the disk is full."""
    why = terminal.refusal_of(sys.stdout) if isinstance(error, OSError) else None
    if why is not None:
        terminal.leave_unread(sys.stdout)
        print_line(f"stdout: {why}; allowed: an output that can be written to")
    elif isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        place = error.filename or "a file of --out, of a cache (such as that of kernels) or in $TMPDIR"
        print_line(f"{place}: {error.strerror}; allowed: free space on that disk")
    else:
        traceback.print_exc()
    return PROGRAM_FAILED


def _line_and_code(error: errors.PlanningError | typer.TyperException) -> tuple[str, int]:
    if isinstance(error, typer.TyperException):
        what, cause = error.format_message(), error.__cause__
        for first in getattr(cause, "errors", list)():  # typer's words are Pydantic's
            what = what.replace(first["msg"], errors.schema_words(first))
        what = errors.one_line(what, errors.MOST_WHAT).rstrip(".")
        return f"command line: {what}; allowed: {allowed_text(error)}", BAD_INPUT
    if isinstance(error, errors.NoAnswerError):
        return errors.one_line(str(error)), ANSWER_IS_NO
    return str(error), BAD_INPUT if isinstance(error, errors.InputError) else PROGRAM_FAILED


def _answered(command: Callable[[], object]) -> object:
    """Run a command; what it raises on purpose stands on stdout too, as the one object that ``--json`` promises."""
    try:
        return command()
    except (errors.PlanningError, typer.TyperException) as error:
        what, _, allowed = _line_and_code(error)[0].partition("; allowed: ")
        document = {
            "code": getattr(error, "code", "command_line"),
            "sentence": getattr(error, "what", what),
            "where": getattr(error, "where", ""),
            "allowed": getattr(error, "allowed", allowed),
            "numbers": getattr(error, "numbers", None) or getattr(error, "counts", {}),
        }
        terminal.print_answer({"error": document}, "", as_json=True)
        terminal.flush_output()
        raise


def allowed_text(error: typer.TyperException) -> str:
    """The values of the option whose value is wrong; where they cannot be listed, the help that has them."""
    option = getattr(error, "param", None)
    descriptor = getattr(option, "type_descriptor", None)  # typer's own: what is not there is not told
    kind = getattr(descriptor, "annotation", None)
    kind = next(iter(get_args(kind)), kind)  # of a list its members
    if isinstance(kind, type) and issubclass(kind, Enum):
        return ", ".join(str(one.value) for one in kind)
    if kind in NUMBERS and type(error).__name__ == "BadParameter":
        bounds = (("from", getattr(option, "min", None)), ("to", getattr(option, "max", None)))
        return NUMBERS[kind] + "".join(f" {word} {bound:.10g}" for word, bound in bounds if bound is not None)
    context = getattr(error, "ctx", None)
    command = "" if context is None else context.command_path.removeprefix(context.find_root().command_path).strip()
    return f"see {command} --help" if command else "see --help"
