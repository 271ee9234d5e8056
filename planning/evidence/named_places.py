"""What names promise: the side and the order of organs on their surfaces, and the Hounsfield units within them.

Cheaper than the edges of the CT, and of another kind: order needs no CT, and units need no sharp edge.
"""

import re
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.anatomy.anatomy import OWN_TARGET, Anatomy
from puncture_twin.planning.anatomy.default_roles import BONES, LEVEL, QUALIFIERS, default_role, plain_name
from puncture_twin.planning.anatomy.scan import Scan
from puncture_twin.planning.anatomy.structure import Structure
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.entry_file import Arrays
from puncture_twin.planning.base.errors import Finding, Severity
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.geometry.mesh import TriangleMesh, spread_on
from puncture_twin.planning.geometry.spaces import Space

SIDES = re.compile(r"(?:^|_)(left|right|l|r)(?=_|$)")
"""A side within a plain name."""

ORDER = (
    ("liver", 0, "spleen"), ("liver", 0, "stomach"), ("inferior_vena_cava", 0, "aorta"), ("gallbladder", 0, "spleen"),
    ("liver", 1, "vertebrae"), ("stomach", 1, "vertebrae"), ("aorta", 1, "vertebrae"), ("heart", 1, "vertebrae"),
    ("sternum", 1, "vertebrae"), ("urinary_bladder", 1, "sacrum"), ("liver", 1, "spine"), ("heart", 1, "spine"),
    ("urinary_bladder", 2, "liver"), ("hip", 2, "liver"), ("sacrum", 2, "liver"),
    ("liver", 2, "heart"), ("kidney", 2, "heart"), ("femur", 2, "hip"), ("prostate", 2, "kidney"), ("hip", 2, "rib"),
    ("heart", 2, "brain"), ("lung", 2, "brain"), ("mandible", 2, "brain"),
)  # fmt: skip
"""Along an LPS axis (0 to the left, 1 to the back, 2 to the head) the middle of the first organ lies before the
second's, in nearly every body: in situs inversus, one of ten thousand, sides are exchanged."""

SEVERAL = frozenset(("vertebrae", "kidney", "lung", "hip", "rib", "femur"))
"""Of these there are several, with a side or a number behind the name."""
OF_LIMBS = frozenset(("limbs and girdles", "other vessels", "iliac vessels", "nerves", "muscles"))
NOT_OF_LIMBS = re.compile(r"hepatic|renal|scapula|clavic|autochthon")
"""Groups of the table of default roles whose structures move with a limb, and what does not."""
CLEARLY_MM = 10.0
"""Middles nearer to each other along the axis say nothing: a field of view may cut off most of an organ."""
ALLOWED = (
    "structures whose names, sides and places agree; or init --trust-labels, or [search] trust_labels = true, if you "
    "checked that they do"
)

INWARD_MM = 2.0
"""So deep below its surface a point lies within the organ, and not yet in a bone's marrow."""
SAMPLES = 200
"""Points on each structure."""


class Tissue(NamedTuple):
    """Organs, by words of their names, whose HU are known: .83 to .95 of bones, .97 of lungs where labels lie right.

    A smaller fraction than ``least`` of their points is a warning.
    """

    name: str
    words: frozenset[str]
    low: float
    high: float
    least: float

    def has(self, name: str) -> bool:
        """Whether a structure is such by its whole name: lung vessels and a nodule of a lung are none."""
        words = {word for word in plain_name(name).split("_") if not LEVEL.fullmatch(word)} - QUALIFIERS
        return bool(words) and words <= self.words

    def fraction(self, hu: Floats) -> float:
        """Of some voxels, those that may be of it."""
        return float(np.mean((hu >= self.low) & (hu <= self.high))) if len(hu) else 1.0


TISSUES = (
    Tissue("bone", BONES, 100.0, np.inf, 0.5),
    Tissue("lung", frozenset(("lung", "lungs")), -np.inf, -400.0, 0.7),
    Tissue("solid organs", frozenset(("liver", "spleen", "kidney", "kidneys")), -50.0, 300.0, 0.7),
)
"""Lungs may be consolidated, and bones soft: so these fractions are far below what is usual, and none refuses."""


def order_of_organs(case: Case, anatomy: Anatomy) -> Iterator[Finding]:
    """Whether left lies left of right, and organs lie to each other as in a body; of all surfaces.

    Refused where two and more pairs of different organs contradict each other along an axis and none agrees. Things of
    a phantom may lie to any side.
    """
    if case.space is Space.LOCAL or case.region == "phantom":
        return
    boxes = {plain_name(one.name): one.mesh.bounds for one in _named(anatomy)}
    middles = {name: box.mean(axis=0) for name, box in boxes.items()}
    for axis, (one, other) in enumerate((("right", "left"), ("front", "back"), ("feet", "head"))):
        pairs = [
            (a, b)
            for a, b in _pairs(middles, axis)
            if abs(middles[b][axis] - middles[a][axis]) >= CLEARLY_MM
            # Boxes share a height along the bed: a neck tells nothing of a belly's spine.
            and (axis == 2 or (boxes[a][0, 2] <= boxes[b][1, 2] and boxes[b][0, 2] <= boxes[a][1, 2]))
        ]
        wrong = [(a, b) for a, b in pairs if middles[a][axis] > middles[b][axis]]
        if not wrong:
            continue
        said = ", ".join(f"{a} is nearer to the {other} than {b}" for a, b in wrong[:3])
        facts = max(len({_kind(pair[end]) for pair in wrong}) for end in range(2))
        all_wrong = len(wrong) == len(pairs) and facts >= 2 and not case.ct.trust_labels
        yield Finding(
            "organs_out_of_order",
            Severity.REFUSAL if all_wrong else Severity.WARNING,
            f"{said}: {len(wrong)} of {len(pairs)} pairs of organs are placed as in few bodies ({one} to "
            f"{other}); mirrored, rotated, or names swapped?",
            {"wrong": float(len(wrong)), "pairs": float(len(pairs))},
            ALLOWED,
        )


def _named(anatomy: Anatomy) -> list[Structure]:
    return [one for one in anatomy.structures if one.source != OWN_TARGET]


def _kind(name: str) -> str:
    """What is one fact beside another organ: many levels of a spine, an organ's two sides, all that a limb holds.

    Legs that are crossed or drawn up take bones, arteries and veins along, of both sides.
    """
    line = default_role(name, "other")
    if line is not None and line.group in OF_LIMBS and not NOT_OF_LIMBS.search(name):
        return "limb"
    return next((organ for organ in SEVERAL if _is(name, organ)), SIDES.sub("", name))


def _pairs(middles: dict[str, Floats], axis: int) -> Iterator[tuple[str, str]]:
    if axis == 0:
        for name in middles:
            side = SIDES.search(name)
            if side is not None and side[1].startswith("r"):
                other = name[: side.start(1)] + {"right": "left", "r": "l"}[side[1]] + name[side.end(1) :]
                if other in middles:
                    yield name, other
    for first, along, second in ORDER:
        if along == axis:
            yield from ((a, b) for a in middles if _is(a, first) for b in middles if _is(b, second))


def _is(name: str, organ: str) -> bool:
    """Whether a plain name is an organ's, or that of one of several of its kind (``vertebrae_L1``)."""
    return name == organ or (organ in SEVERAL and name.startswith(f"{organ}_"))


def densities(case: Case, anatomy: Anatomy, *, on_edges: bool) -> Iterator[Finding]:
    """Whether bones, lungs and solid organs have the Hounsfield units of such, in the case's CT.

    Where the edges say that all lies right it is a note: lungs are then full, a liver fat, a kidney full of contrast.
    """
    scan = anatomy.scan
    if scan is None or case.region == "phantom":
        return
    severity = Severity.NOTE if on_edges else Severity.WARNING
    for tissue in TISSUES:
        meshes = [one.mesh for one in _named(anatomy) if tissue.has(one.name)]
        if not meshes:
            continue
        made_from = {"what": tissue.name, "meshes": [mesh.digest for mesh in meshes]}

        def make(tissue: Tissue = tissue, meshes: list[TriangleMesh] = meshes, scan: Scan = scan) -> Arrays:
            spread = [(mesh, spread_on(mesh, SAMPLES)) for mesh in meshes]
            inner = [one.points - np.copysign(INWARD_MM, mesh.volume) * one.normals for mesh, one in spread]
            hu = scan.hu_at(np.concatenate(inner))
            return {"within": np.array(tissue.fraction(hu[np.isfinite(hu)]))}

        within = scan.source.kept(made_from, make, lambda stored: float(stored["within"]), by=__name__)
        if within < tissue.least:
            said = f"{100 * within:.0f} % of the structures named as {tissue.name} has matching Hounsfield units"
            yield Finding(
                "densities",
                severity,
                f"{scan.name}: {said} (at least {100 * tissue.least:.0f} % is usual): do labels and CT belong "
                "together?",
                {"within": round(within, 3), "least": tissue.least},
            )
