"""A case file and all that it names, read once and validated."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from puncture_twin.planning.base.arrays import Floats, read_only
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.provenance import CASE_ROLE, InputFiles
from puncture_twin.planning.base.text import did_you_mean
from puncture_twin.planning.base.toml_file import find_toml, parse_toml, read_toml_bytes
from puncture_twin.planning.case.case import Case, view_frame
from puncture_twin.planning.case.case_file import CaseFile
from puncture_twin.planning.case.entry import entry_frame
from puncture_twin.planning.case.errors import errors_of
from puncture_twin.planning.case.named_files import CaseVolumes, read_named_files, robot_warnings
from puncture_twin.planning.case.options import NO_OPTIONS, OPTIONS_ROLE, CaseOptions
from puncture_twin.planning.case.sections import bending_of, breathing_of, robot_of
from puncture_twin.planning.case.settings import Needle, ct_of, gantry_of, obstacle_of, search_of
from puncture_twin.planning.case.tables import MarkerSection, tool_of
from puncture_twin.planning.formats.points import parse_points
from puncture_twin.planning.geometry.spaces import Space, to_lps

ALLOWED_CASE = "a TOML case file with schema = 2, or a folder with case.toml"


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


def case_of(
    content: CaseFile, path: Path, files: InputFiles, case_volumes: CaseVolumes, warnings: tuple[str, ...]
) -> Case:
    """Make a case of its file and the files that it names, in LPS (or local) mm and radians."""
    space = Space(content.space)
    target = _target_of(content, path, space, files)
    robot = robot_of(content, space, path, files)
    tool = tool_of(content.tool, files, path)
    settings, placed = content.search, content.registration
    return Case(
        path=path,
        name=content.name,
        space=space,
        target_ct=target,
        target_name=content.target.name,
        target_structure=content.target.structure or content.target.name,
        own_target=content.target.structure is None,
        needle=Needle(**content.needle.model_dump(include={*Needle.__dataclass_fields__})),
        search=search_of(settings),
        obstacles=tuple(obstacle_of(one, space) for one in content.obstacle),
        ranking=content.ranking,
        T_ct_entry=view_frame(entry_frame(settings.frame, space, where=path), target),
        structure=content.structure,
        structures=content.structures,
        registration=None if placed is None or placed.transform else MarkerSection(**placed.model_dump()),
        robot=robot,
        tool=tool,
        rehearsal=content.rehearsal,
        files=files,
        volumes=case_volumes,
        ct=ct_of(content.ct, trust_labels=settings.trust_labels),
        gantry=None if content.gantry is None else gantry_of(content.gantry, space, path),
        place=content.place,
        stated_structures=content.stated_structures,
        region=content.region,
        warnings=(*warnings, *robot_warnings(content, robot)),
        hit_radius_mm=content.target.hit_radius_mm,
        errors=errors_of(content, content.errors, case_volumes, path),
        truth_errors=errors_of(content, content.rehearsal.errors, case_volumes, path, truth=True),
        breathing=breathing_of(content.breathing, space, path),
        bending=bending_of(content.needle, content.tissue, path),
    )


def _target_of(content: CaseFile, path: Path, space: Space, files: InputFiles) -> Floats:
    """The point to reach, shape (3,), LPS (or the case's local frame) mm, read-only.

    Args:
        content: The case file.
        path: Where it is, for errors.
        space: The case's.
        files: What it names, read.

    Raises:
        InputError: A list of points that cannot be read, or that lacks the target's name.
    """
    target = content.target
    if target.position_mm is not None:
        return read_only(to_lps(np.asarray([target.position_mm]), space)[0])
    assert target.points is not None  # held by the schema
    listed = parse_points(files.content(target.points), path.parent / target.points, default_space=space)
    if target.name not in listed.names:
        names = ", ".join(listed.names)
        what = f"target.name '{target.name}' is not in {target.points}{did_you_mean(target.name, listed.names)}"
        refuse(what, path, names, "unknown_point")
    return read_only(listed.points[listed.names.index(target.name)].copy())
