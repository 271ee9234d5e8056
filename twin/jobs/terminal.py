"""What a person sees: lines on stdout that no width breaks, and a reader who went away."""

from __future__ import annotations

import json
import os
import select
import sys
from pathlib import Path
from typing import Any, TextIO

from puncture_twin.twin.jobs.interrupt import raise_dropped

UNNAMED_CASES = frozenset({"case.toml", "servo.toml", "selfcal.toml", "plan.json"})
"""Files that are named by their folder."""


def default_out(source: Path, command: str) -> Path:
    """The folder for a command's files where none is named, such as ``out/abdomen-search``.

    Args:
        source: What the command reads: a case, its folder, or a plan.
        command: Its name.
    """
    place = source.absolute()
    if place.suffix.lower() not in {".toml", ".json"}:
        name = place.name
    elif place.name in UNNAMED_CASES:
        name = place.parent.name
    else:
        name = f"{place.parent.name}-{place.stem}"
    return Path("out") / f"{name or 'case'}-{command}"


def print_answer(summary: dict[str, Any], text: str, as_json: bool) -> None:
    """Print what a command found: one JSON object, or the text for a person; nothing, where it was interrupted."""
    raise_dropped()
    sys.stdout.write((json.dumps(summary, allow_nan=False) if as_json else text) + "\n")


def reader_is_gone(stream: TextIO) -> bool:
    """Whether a stream is a pipe that nobody reads any more, as after ``| head -1``."""
    try:
        number = stream.fileno()
        waiting = select.poll()
        waiting.register(number, select.POLLOUT)
        return any(events & select.POLLERR for _, events in waiting.poll(0))
    except (OSError, ValueError):  # a stream without a file, or a closed one
        return False


def refusal_of(stream: TextIO | None) -> str | None:
    """Why a stream does not take a line end, as where the disk is full; None where it does, and has it then."""
    try:
        if stream is not None and not stream.closed:
            stream.write("\n")
            stream.flush()
    except OSError as error:
        return error.strerror
    return None


def leave_unread(stream: TextIO) -> None:
    """Send whatever a stream still holds nowhere, so that the end of the program does not fail by it."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


def flush_output() -> None:
    """Hand over everything that was printed.

    Raises:
        BrokenPipeError: Nobody reads it.
    """
    if sys.stdout is not None and not sys.stdout.closed:
        sys.stdout.flush()
