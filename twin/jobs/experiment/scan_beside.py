"""What `scan` lays beside the patient: as the user asks for it, and its surfaces as files, in the scan's frame."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, get_args

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.output.manifest import FORMAT
from puncture_twin.planning.formats.meshes.ply import ply_bytes
from puncture_twin.twin.plant.outside_objects import Arms, Bed, OutsideObjects, Part

FOLDER = "beside"
LIST = "manifest.json"
"""`init` passes a folder whose list says that this program wrote it: the truth is no segmentation."""


def parse_beside(arms: str, bed: str, lines: int) -> OutsideObjects | None:
    """What shall lie beside the patient; None for nothing.

    Args:
        arms: One of `Arms`.
        bed: One of `Bed`.
        lines: How many.

    Raises:
        InputError: A word that is not known.
    """
    for option, word, known in (("--arms", arms, get_args(Arms)), ("--bed", bed, get_args(Bed))):
        if word not in known:
            raise InputError(f"'{word[:40]}' is not known", where=option, allowed=", ".join(known))
    wanted = OutsideObjects(
        next(k for k in get_args(Arms) if k == arms), next(k for k in get_args(Bed) if k == bed), lines
    )
    return None if wanted == OutsideObjects() else wanted


def beside_summary(parts: Sequence[Part]) -> list[dict[str, Any]]:
    """Plain values for JSON: name, what it is made of (HU), where it lies, and its file."""
    return [{"name": one.name, "hu": one.hu, "place": one.place, "file": f"{FOLDER}/{one.name}.ply"} for one in parts]


def write_beside(parts: Sequence[Part], folder: Path) -> Iterator[Path]:
    """Each part as a PLY in the scan's frame, LPS mm, and the list of them; nothing where there are none."""
    if not parts:
        return
    (folder / FOLDER).mkdir()
    for one in parts:
        path = folder / FOLDER / f"{one.name}.ply"
        path.write_bytes(ply_bytes(one.mesh))
        yield path
    listed = {"part_of": FORMAT, "schema": 1, "unit": "mm", "space": "LPS", "parts": beside_summary(parts)}
    (folder / FOLDER / LIST).write_text(json.dumps(listed, indent=1) + "\n", encoding="utf-8")
    yield folder / FOLDER / LIST
