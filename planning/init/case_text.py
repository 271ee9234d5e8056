"""The text of a new case: every section with its reason, ending in ``[end]``."""

import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.anatomy.anatomy import ATTACHED_LIMB, Anatomy, body_side
from puncture_twin.planning.anatomy.body.cut_ends import SIDES
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.errors import error_model
from puncture_twin.planning.case.tables import ErrorsSection
from puncture_twin.planning.geometry.spaces import Space, to_lps
from puncture_twin.planning.init.finder import Markers
from puncture_twin.planning.init.overrides import STATED, with_keys, with_line
from puncture_twin.planning.init.segmentation import Assigned, Segmentation, quoted

HEAD = """#:schema ./case.schema.json
# (editors complete keys with it, once `run-twin schema > case.schema.json` has written it here)

# Written by `init` as a start. Check the roles and margins below before you trust any result.
# Every key: docs/reference/case.md; source of roles and margins: docs/reference/default-roles.md.
schema = 2
region = "{region}"
name = {name}
space = "{space}"  # of the coordinates in this file

[target]
position_mm = [{position}]
{structure}

[needle]
length_mm = 200.0  # tip to flange
shaft_mm = 150.0  # usable length
diameter_mm = 1.2

[search]
theta_deg = [0, 90]
step_deg = 2.0
max_skin_angle_deg = 60.0

"""
OWN_TARGET = "hit_radius_mm = {radius!r}  # in no structure: the target is a ball of this radius"
SKIN_OF_CT = """[[structure]]
name = "skin"
ct = {ct}  # the body is found in the CT
role = "skin"

"""
CT_BESIDE = """[ct]
file = {ct}

"""
REGISTRATION = """
# Markers, for the arm: list them under the same names in markers_base, as the robot touched them.
# [registration]
# markers_ct = {ct}  # {space}
# markers_base = {base}
"""
ERRORS = """
# Errors, for the chances to hit and to touch; these need the markers too: docs/reference/case.md
# [errors]
# surface_mm = {known}  # possible error of contours; {reason}
"""
PICTURE = "see slices.png"
LEFT_OUT = f"# Left out, as {STATED}; its content counts as free: {{file}}\n"
OF_VOXELS = "of {sources}, at most, from the voxels; if omitted, every direction has its own"
OF_MESHES = "of {sources}, known only to who drew them; if omitted it counts as 0, and every result says so"
END = """
[end]
structures = {count}  # the last line: a truncated file lacks it
"""


@dataclass(frozen=True, eq=False)
class CaseParts:
    """Parts of a new case."""

    name: str
    space: Space
    region: str
    target_ct: Floats  # shape (3,), LPS mm
    structure: str | None  # which holds the target, or None
    hit_radius_mm: float  # of the ball that is hit, where none does
    ct: str | None  # the CT, or None
    skin: str  # what the skin is, for a person: the CT, or a structure
    sources: tuple[tuple[Segmentation, Sequence[Assigned]], ...]
    markers: tuple[Markers, ...]
    left_out: tuple[str, ...]  # the files that a person states to be left out
    keys: Mapping[str, str]  # key of the case to its value, where a person states it

    @property
    def rows(self) -> list[Assigned]:
        """The rows of all structures of the case."""
        return [row for _, rows in self.sources for row in rows]


def case_text(parts: CaseParts) -> str:
    """The text of the whole case file."""
    position = to_lps(parts.target_ct[None], parts.space)[0]
    own = OWN_TARGET.format(radius=parts.hit_radius_mm)
    head = HEAD.format(
        region=parts.region,
        name=quoted(case_name(parts.name)),
        space=parts.space,
        position=", ".join(repr(float(one)) for one in position),
        structure=own if parts.structure is None else f"structure = {quoted(parts.structure)}",
    )
    of_structure = any(row.kind == "skin" for row in parts.rows)
    skin = "" if parts.ct is None else (CT_BESIDE if of_structure else SKIN_OF_CT).format(ct=quoted(parts.ct))
    count = sum(row.kind != "ignore" for row in parts.rows) + (not of_structure)
    sections = "\n".join(segmentation.section(rows) for segmentation, rows in parts.sources)
    sources = [segmentation for segmentation, _ in parts.sources]
    # What may be taken for declared of contours: of voxels their own, of meshes a question.
    voxels, meshes = ([one for one in sources if (one.voxel_ct is None) == mesh] for mesh in (False, True))
    model = error_model(ErrorsSection(), space=Space.LPS)
    off = [np.sqrt(np.linalg.eigvalsh(model.surface_cov_ct(one.voxel_ct))[-1]) for one in voxels]
    stated = ((OF_VOXELS, voxels), (OF_MESHES, meshes))
    reasons = [text.format(sources=", ".join(one.source for one in some)) for text, some in stated if some]
    errors = ERRORS.format(known=f"{max(off):.2f}" if off else "0.5", reason="; ".join(reasons))
    markers = ""
    for first in parts.markers[:1]:
        same_names = (one.source for one in parts.markers[1:] if set(one.points.names) == set(first.points.names))
        json = first.source.endswith(".json")
        own = "its file states the space" if json else f"read in {parts.space}, the case's space"
        markers = REGISTRATION.format(ct=quoted(first.source), base=quoted(next(same_names, "touch.csv")), space=own)
    gone = "".join(LEFT_OUT.format(file=quoted(one)) for one in parts.left_out)
    text = head + skin + gone + sections + markers + errors + END.format(count=count)
    return with_keys(text, parts.keys)


IMAGE = """# What the image shows, as found by rules. Remove a # to state it instead.
# arms: {arms}:
# arms = "none"
# table: {table}:
# table = "none"
# beyond: {beyond}:
# beyond_mm = 150"""


def with_image_seen(text: str, anatomy: Anatomy) -> str:
    """The text of a case with what rules find in its CT, as comments that state it where a person agrees."""
    if anatomy.scan is None:
        return text
    limbs = [one.numbers for one in anatomy.findings if one.code == ATTACHED_LIMB]
    arms = [f"{float(str(one['volume_ml'])) / 1000:.1f} l at the {one['side']} side, {PICTURE}" for one in limbs]
    couch = None if anatomy.couch is None else f"at the {body_side(anatomy.couch, anatomy.skin)} side, {PICTURE}"
    view = anatomy.skin.field_of_view
    cut = [] if view is None else [name for name, (axis, end) in SIDES.items() if view.cut[axis, end]]
    seen = IMAGE.format(
        arms=f"{arms[0]}; if that is not an arm" if arms else "none found; to state it",
        table="none found; to state it" if couch is None else f"{couch}; if nothing supports the body",
        beyond=f"the image cuts the body at its {', '.join(cut)} side; the body is at most this much wider there"
        if cut
        else "the image shows the whole body; where it does not, the body is at most this much wider",
    )
    return with_line(text, "ct", seen)


def case_name(folder: str) -> str:
    """The name of a case, from its folder's."""
    return re.sub(r"[^\w.\-]+", "_", unicodedata.normalize("NFC", folder)).strip("_.-")[:80] or "case"
