"""A drawn trunk as the folder of a case: ``case.toml`` and a mesh for each structure."""

from __future__ import annotations

from pathlib import Path

from tools.phantoms.drawn.trunk import Trunk
from tools.phantoms.manifest import ply_bytes

HU = {"spine": 350.0, "rib": 500.0}
"""Of what is not made of what its name says: half of a drawn bone is denser than any organ."""
CUT = 'cut = ["feet", "head"]\n'
"""Of the skin: there a drawn trunk goes on beyond its mesh."""

CASE = """schema = 2
region = "other"
name = "{name}"
space = "LPS"

[target]
position_mm = [{target}]
structure = "lesion"

[needle]
length_mm = 210.0
shaft_mm = 180.0
diameter_mm = 1.2

[search]
theta_deg = [0, 180]
step_deg = 6.0
max_skin_angle_deg = 75
"""


def write_trunk_case(folder: Path, trunk: Trunk, name: str) -> Path:
    """Write ``case.toml`` and the meshes; the folder is made if it is not there, files of these names are replaced."""
    folder.mkdir(parents=True, exist_ok=True)
    text = CASE.format(name=name, target=", ".join(f"{one:.3f}" for one in trunk.target))
    text += _structure("skin", "skin", 0.0, trunk.skin_hu) + CUT
    (folder / "skin.ply").write_bytes(ply_bytes(trunk.skin))
    for one, organ in trunk.organs.items():
        (folder / f"{one}.ply").write_bytes(ply_bytes(organ.mesh))
        text += _structure(one, organ.role, organ.margin_mm, HU.get(one.split("_")[0]))
    text += f"\n[end]\nstructures = {len(trunk.organs) + 1}\n"
    (folder / "case.toml").write_text(text, encoding="utf-8")
    return folder


def _structure(name: str, role: str, margin_mm: float, hu: float | None) -> str:
    lines = ["", "[[structure]]", f'name = "{name}"', f'mesh = "{name}.ply"', 'unit = "mm"', f'role = "{role}"']
    lines += [f"margin_mm = {margin_mm:g}"] if margin_mm else []
    lines += [] if hu is None else [f"hu = {hu:g}"]
    return "\n".join([*lines, ""])
