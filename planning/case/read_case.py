"""A case file and all that it names, read once and validated."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from puncture_twin.planning.base.provenance import CASE_ROLE, InputFiles
from puncture_twin.planning.base.toml_file import find_toml, parse_toml, read_toml_bytes
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.case_file import CaseFile
from puncture_twin.planning.case.case_volumes import CaseVolumes
from puncture_twin.planning.case.named_files import read_named_files
from puncture_twin.planning.case.options import NO_OPTIONS, OPTIONS_ROLE, CaseOptions
from puncture_twin.planning.case.stated_case import case_of

ALLOWED_CASE = "a TOML case file with schema = 1 or 2, or a folder with case.toml"


def load_case(path: Path | str, options: CaseOptions = NO_OPTIONS) -> Case:
    """Read and validate a case file, or a folder that holds ``case.toml``.

    Args:
        path: The file or the folder.
        options: What is stated in place of what the file states; they are an input of their own.

    Raises:
        InputError: Anything unreadable, unknown, missing or contradictory; names the key.
    """
    path = find_toml(path, "case.toml")
    files = InputFiles(path.parent)
    case_volumes = CaseVolumes(files, path)
    stated = files.add(CASE_ROLE, path.name, read_toml_bytes(path, ALLOWED_CASE))
    if options.sections:
        files.state(OPTIONS_ROLE, options.text.encode())
    change = partial(options.applied, where=path)
    content = parse_toml(stated, path, CaseFile, allowed=ALLOWED_CASE, keys="docs/reference/case.md", change=change)
    whole = read_named_files(content, path, files, case_volumes)
    return case_of(content, path, files, case_volumes, whole)
