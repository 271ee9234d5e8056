"""Output folders of versions that kept no manifest: which of their files were written by a command."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple


class _OldFiles(NamedTuple):
    """Files that were written together."""

    signs: tuple[str, ...]
    """One of these shows that a command has written here."""
    names: tuple[str, ...]


FAMILIES = (
    _OldFiles(
        ("candidates.parquet", "plan.json", "rehearsal.json"),
        (
            *("candidates.parquet", "certificate.json", "map.png", "scene.png", "report.html", "timings.json"),
            *("plan.json", "plan.script", "plan.ros2.yaml", "plan.csv"),
            *("rehearsal.json", "rehearsal.mp4", "rehearsal.gif"),
        ),
    ),
    _OldFiles(
        ("place.json",), ("placements.csv", "place.json", "placements.png", "map_best_place.png", "timings.json")
    ),
    _OldFiles(("calibration.json",), ("calibration.json", "report.html", "bmode.png", "room.png", "timings.json")),
    _OldFiles(("servo.html",), ("servo.html", "convergence.png", "camera_1.png", "camera_2.png", "timings.json")),
    _OldFiles(("batch.csv",), ("batch.csv", "timings.json")),
)
"""``recording.csv`` is not among them: it may be somebody's own."""

BATCH_FOLDERS = "[0-9][0-9][0-9][0-9]/candidates.parquet"
"""What a batch wrote beside its ``batch.csv``."""


def files_of_older_versions(folder: Path) -> tuple[str, ...]:
    """The files in a folder without a manifest that an older version has written, sorted."""
    found = set()
    for family in FAMILIES:
        if any((folder / sign).is_file() for sign in family.signs):
            found |= {name for name in family.names if (folder / name).is_file()}
    if (folder / "batch.csv").is_file():
        found |= {path.relative_to(folder).as_posix() for path in folder.glob(BATCH_FOLDERS)}
    return tuple(sorted(found))
