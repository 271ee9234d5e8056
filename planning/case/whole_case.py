"""What a case leaves open: whether it and the lists that it names are whole, by their ends, and where its robot is."""

from __future__ import annotations

import re
from pathlib import Path

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.input_file import unfinished_warnings
from puncture_twin.planning.base.provenance import InputFiles
from puncture_twin.planning.case.case_file import CaseFile
from puncture_twin.planning.case.settings import RobotSettings

SCHEMA_ONE_NOTE = (
    "schema = 1 does not show whether the case file is whole: schema = 2 states its structures and its region "
    "(docs/how-to/case-schema-2.md)"
)

TOP_COUNT_NOTE = (
    "structures = N stands at the top of the case, so that a cut after its last structure would not be seen; "
    "state it in [end], the file's last table (docs/how-to/case-schema-2.md)"
)

NOT_LAST_NOTE = "[end] is not the last table of the case: what stands after it could be cut off unseen"

ROBOT_NOWHERE = (
    "the case names a robot ({robot}), but not where its base is: the arm is not checked "
    "([registration] or [robot.mount] says it)"
)

_HEADER = re.compile(r"^[ \t]*\[{1,2}[ \t]*([^\[\]\n]+?)[ \t]*\]{1,2}[ \t]*(?:#.*)?$", re.MULTILINE)
"""The header of a table, on a line of its own."""


LINE_FILES = (".csv", ".fcsv")
"""Endings of lists that are read line by line: one that was cut within a number is another number, and looks whole."""


def wholeness_warnings(content: CaseFile, files: InputFiles, path: Path) -> tuple[str, ...]:
    """What is left open about being whole, one sentence each.

    Args:
        content: The case file.
        files: All that it names, read.
        path: The case file, for the error.

    Raises:
        InputError: A list whose last line does not end, in schema 2.
    """
    unfinished = [said for name in _line_files(files) for said in unfinished_warnings(files.content(name), name)]
    if unfinished and content.schema_ == 2:
        raise InputError(unfinished[0], where=path, allowed="files of which every line ends with a line break")
    return (*_notes(content, files.content(path.name).decode("utf-8")), *unfinished)


def _notes(content: CaseFile, text: str) -> list[str]:
    if content.schema_ == 1:
        return [SCHEMA_ONE_NOTE]
    if content.end is None:
        return [TOP_COUNT_NOTE]
    return [] if ends_with_end(text) else [NOT_LAST_NOTE]


def _line_files(files: InputFiles) -> list[str]:
    return list(dict.fromkeys(one.path for one in files.inputs if one.path.lower().endswith(LINE_FILES)))


def ends_with_end(text: str) -> bool:
    """Whether the last table of a file is ``[end]``."""
    headers = _HEADER.findall(text)
    return bool(headers) and headers[-1] == "end"


def robot_warnings(content: CaseFile, robot: RobotSettings) -> tuple[str, ...]:
    """That nothing is said of where a robot is: no verdict is about it."""
    located = content.registration is not None or content.robot.mount is not None
    nowhere = not located and bool({"robot", "tool"} & content.model_fields_set)
    return (ROBOT_NOWHERE.format(robot=robot.model.name),) if nowhere else ()
