"""Names of labels: which label is which organ, and which organs a case's name patterns select.

The class numbers are those of TotalSegmentator's main task, versions 1 (104 classes) and 2 (117 classes), from its
``map_to_binary.py`` (``total_v1`` and ``total``), Wasserthal et al., Radiology: Artificial Intelligence
2023;5(5):e230024. The versions number organs differently: the aorta is 7 or 52.
"""

import difflib
import math
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from fnmatch import fnmatchcase
from pathlib import Path
from types import MappingProxyType
from typing import Generic, Protocol, TypeVar

from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.text import check_name, did_you_mean, first_few
from puncture_twin.planning.formats.labels.labelmaps import NAME_ENDINGS, parse_names

_ABDOMEN = "spleen kidney_right kidney_left gallbladder liver stomach"
_LUNGS = "lung_upper_lobe_left lung_lower_lobe_left lung_upper_lobe_right lung_middle_lobe_right lung_lower_lobe_right"
_SPINE = " ".join(f"vertebrae_{part}{n}" for part, last in (("L", 5), ("T", 12), ("C", 7)) for n in range(last, 0, -1))
_RIBS = " ".join(f"rib_{side}_{n}" for side in ("left", "right") for n in range(1, 13))
_ILIAC = "iliac_artery_left iliac_artery_right iliac_vena_left iliac_vena_right"
_SHOULDERS = "humerus_left humerus_right scapula_left scapula_right clavicula_left clavicula_right"
_HIPS = "femur_left femur_right hip_left hip_right"
_GLUTEUS = " ".join(f"gluteus_{part}_{side}" for part in ("maximus", "medius", "minimus") for side in ("left", "right"))
_BACK = "autochthon_left autochthon_right iliopsoas_left iliopsoas_right"


def _numbered(*groups: str) -> Mapping[int, str]:
    return MappingProxyType(dict(enumerate(" ".join(groups).split(), start=1)))


V1: Mapping[int, str] = _numbered(
    _ABDOMEN, "aorta inferior_vena_cava portal_vein_and_splenic_vein pancreas adrenal_gland_right adrenal_gland_left",
    _LUNGS, _SPINE, "esophagus trachea heart_myocardium heart_atrium_left heart_ventricle_left heart_atrium_right",
    "heart_ventricle_right pulmonary_artery brain", _ILIAC, "small_bowel duodenum colon", _RIBS, _SHOULDERS, _HIPS,
    "sacrum face", _GLUTEUS, _BACK, "urinary_bladder",
)  # fmt: skip
"""Version 1."""
V2: Mapping[int, str] = _numbered(
    _ABDOMEN, "pancreas adrenal_gland_right adrenal_gland_left", _LUNGS,
    "esophagus trachea thyroid_gland small_bowel duodenum colon urinary_bladder prostate",
    "kidney_cyst_left kidney_cyst_right sacrum vertebrae_S1", _SPINE,
    "heart aorta pulmonary_vein brachiocephalic_trunk subclavian_artery_right subclavian_artery_left",
    "common_carotid_artery_right common_carotid_artery_left brachiocephalic_vein_left brachiocephalic_vein_right",
    "atrial_appendage_left superior_vena_cava inferior_vena_cava portal_vein_and_splenic_vein", _ILIAC, _SHOULDERS,
    _HIPS, "spinal_cord", _GLUTEUS, _BACK, "brain skull", _RIBS, "sternum costal_cartilages",
)  # fmt: skip
"""Version 2, task ``total``."""
BUILT_IN: Mapping[str, Mapping[int, str]] = {"totalsegmentator-v1": V1, "totalsegmentator-v2": V2}
OWN_NAMES = "seg.nrrd"
"""The naming that takes the names inside a .seg.nrrd."""
REST = "*"
"""The pattern of whatever no other pattern names."""
WILDCARD = re.compile(r"\[[^\]]+\]|[*?]")
"""Placeholders of characters in a shell pattern."""
MAX_CSV_BYTES = 10_000_000
"""A table of all 65,535 labels stays below 4 MB."""


class RuleKind(StrEnum):
    """Treatment of the labels that a pattern names."""

    AVOID = "avoid"
    UNKNOWN = "unknown"
    TRAVERSE = "traverse"
    TARGET = "target"
    IGNORE = "ignore"


DEMANDING = frozenset((RuleKind.AVOID, RuleKind.UNKNOWN))
"""The kinds that demand a margin."""


@dataclass(frozen=True)
class LabelRule:
    """Rule of one label that is present."""

    label: int
    name: str
    kind: RuleKind
    margin_mm: float  # the clearance that an avoided or unknown structure demands; 0 for the other kinds
    pattern: str


@dataclass(frozen=True)
class Selection:
    """Rules of a case's patterns for the labels of a map."""

    rules: tuple[LabelRule, ...]  # one per label present, by rising label, those to ignore included
    warnings: tuple[str, ...]  # patterns that match no label of this map


class OwnNames(Protocol):
    """A label map that may bring names of its own."""

    @property
    def path(self) -> Path:
        """Its file."""

    @property
    def names(self) -> Mapping[int, str] | None:
        """Label to name, or None."""


def is_naming_file(naming: str | None) -> bool:
    """Whether a naming is a file, and not a table of this package or of the label map itself."""
    return naming is not None and naming not in BUILT_IN and naming.lower().endswith(NAME_ENDINGS)


def names_for(naming: str | None, folder: Path, content: Callable[[str], bytes], labelmap: OwnNames) -> dict[int, str]:
    """The names of labels, by number. Raises InputError: an unknown naming, no names, or a table that cannot be used.

    Args:
        naming: ``"totalsegmentator-v1"``, ``"totalsegmentator-v2"``, the path of a table of names (CSV,
            JSON, ITK-SNAP's or Slicer's list), or None or ``"seg.nrrd"`` for the names that a .seg.nrrd holds.
        content: Gives the bytes of a table by its path.
    """
    allowed = f"{', '.join(BUILT_IN)}, a table of names ({', '.join(NAME_ENDINGS)}), or a .seg.nrrd with names"
    if naming is None or naming == OWN_NAMES:
        if labelmap.names is None:
            refuse("the label map has no names", labelmap.path, allowed, "labels_without_names")
        return _unique(labelmap.names, labelmap.path)
    if naming in BUILT_IN:
        return dict(BUILT_IN[naming])
    if not naming.lower().endswith(NAME_ENDINGS):
        near = difflib.get_close_matches(naming, BUILT_IN, n=1)
        hint = f" (nearest: {near[0]})" if near else ""
        refuse(f"unknown naming {naming!r}{hint}", labelmap.path, allowed, "unknown_naming")
    return _unique(parse_names(content(naming), folder / naming), folder / naming)


def select(
    names: Mapping[int, str],
    present: Collection[int],
    *,
    avoid: Mapping[str, float],
    unknown: Mapping[str, float] = MappingProxyType({}),
    traverse: Sequence[str] = (),
    target: Sequence[str] = (),
    ignore: Sequence[str] = (),
    all_named: bool = True,
    where: str | Path,
) -> Selection:
    """The rule of every label present, by the case's patterns.

    Patterns are shell patterns (``*``, ``?``, ``[...]``), capitals count. Of several that name one label the most
    specific holds: the label's own name, else the one with most characters that are no wildcards; ``"*"`` is the rest.
    Of equally specific ``avoid`` patterns the largest margin holds, and of ``unknown`` ones.

    Args:
        avoid: Pattern to margin in mm.
        unknown: The same of structures of which it is unknown whether a path may cross them.
        all_named: Whether ``names`` holds every name that can occur, so that a pattern of none is a slip.

    Raises:
        InputError: A label present that has no name or that no pattern names, or that two equally specific patterns of
            different kinds name; a pattern that matches no name although all are known; a margin out of range.
    """
    free = ([(one, 0.0) for one in listed] for listed in (traverse, target, ignore))
    tables = zip(RuleKind, (avoid.items(), unknown.items(), *free), strict=True)
    patterns = [LabelRule(0, "", kind, float(mm), one) for kind, table in tables for one, mm in table]
    for rule in patterns:
        if not 0 <= rule.margin_mm < math.inf:
            refuse(f"margin {rule.margin_mm} of pattern {rule.pattern!r}", where, "mm, 0 or more", "out_of_range")
    for rule in patterns:
        if all_named and rule.pattern != REST and not any(fnmatchcase(name, rule.pattern) for name in names.values()):
            near = difflib.get_close_matches(rule.pattern.strip("*?"), names.values(), n=3, cutoff=0.4)
            allowed = f"names like {', '.join(near)}" if near else f"one of {', '.join(sorted(names.values()))}"
            refuse(f"{rule.kind} pattern {rule.pattern!r} matches no name in the naming", where, allowed, "no_match")
    nameless = [label for label in sorted(present) if label not in names]
    if nameless:
        listed = ", ".join(map(str, nameless))
        refuse(f"labels without a name: {listed}", where, "labels of the naming", "labels_without_names")
    rules = [_rule(label, names[label], patterns, where) for label in sorted(present)]
    taken = tuple(rule for rule in rules if rule is not None)
    if missing := [names[label] for label, rule in zip(sorted(present), rules, strict=True) if rule is None]:
        allowed = "a pattern in avoid, unknown, traverse, target or ignore for each"
        refuse(f"no rule covers these labels, which are present: {', '.join(missing)}", where, allowed, "no_rule")
    unused = [p for p in patterns if not any(fnmatchcase(names[label], p.pattern) for label in present)]
    warnings = [f"{where}: {p.kind} pattern {p.pattern!r} matches no label present" for p in unused]
    for rule in taken:
        for other in patterns if rule.pattern != rule.name else ():  # else somebody wrote the label's own name
            overruled = other.kind in DEMANDING and other.pattern != REST and fnmatchcase(rule.name, other.pattern)
            if overruled and (rule.kind not in DEMANDING or other.margin_mm > rule.margin_mm):
                applies = f"{rule.kind} {rule.pattern!r}"
                warnings.append(
                    f"{where}: {rule.name!r} is matched by {applies} and by {other.kind} {other.pattern!r} = "
                    f"{other.margin_mm:g}; the more specific applies: {applies}, {rule.margin_mm:g} mm"
                )
    return Selection(taken, tuple(warnings))


def specificity(pattern: str, name: str) -> float:
    """Closeness of a pattern to one name: infinite for the name itself, else its characters that are no wildcards.

    >>> specificity("aorta", "aorta"), specificity("rib_*_7", "rib_left_7"), specificity("*", "aorta")
    (inf, 6, 0)
    """
    return math.inf if pattern == name else len(WILDCARD.sub("", pattern))


def _rule(label: int, name: str, patterns: Sequence[LabelRule], where: str | Path) -> LabelRule | None:
    matching = [p for p in patterns if fnmatchcase(name, p.pattern)]
    if not matching:
        return None
    most = max(specificity(p.pattern, name) for p in matching)
    closest = [p for p in matching if specificity(p.pattern, name) == most]
    first = max(closest, key=lambda p: p.margin_mm)
    other = next((p for p in closest if p.kind is not first.kind), None)
    if other is not None:
        what = f"label {name!r} is matched by {first.kind} {first.pattern!r} and by {other.kind} {other.pattern!r}"
        refuse(what, where, "one of the two, or its full name under the intended kind", "two_roles")
    return LabelRule(label, name, first.kind, first.margin_mm, first.pattern)


def _unique(names: Mapping[int, str], where: Path) -> dict[int, str]:
    """The names, each of one label: two structures of one name could not be distinguished in a result."""
    seen: dict[str, int] = {}
    for label, name in names.items():
        check_name(name, f"label {label}", where=where)
        if name in seen:
            what = f"labels {seen[name]} and {label} are both named {name!r}"
            refuse(what, where, "a name of its own for each label", "duplicate_name")
        seen[name] = label
    return dict(names)


T = TypeVar("T")


@dataclass(frozen=True)
class ByName(Generic[T]):
    """Values by patterns of names."""

    of_pattern: Mapping[str, T]  # shell patterns; the most specific that matches a name holds

    def of(self, name: str) -> T | None:
        """The value of one name; None where no pattern matches it.

        >>> ByName({"*": 0.0, "rib*": 0.5}).of("rib_1"), ByName({"rib*": 0.5}).of("liver")
        (0.5, None)
        """
        matching = [pattern for pattern in self.of_pattern if fnmatchcase(name, pattern)]
        best = max(matching, key=lambda pattern: specificity(pattern, name), default=None)
        return None if best is None else self.of_pattern[best]

    def check(self, names: Iterable[str], key: str, where: str | Path, *, others: Iterable[str] = ()) -> None:
        """Refuse patterns that leave a name out, match nothing, or contradict each other; ``others`` need none."""
        names, known = list(names), [*names, *others]
        if missing := [name for name in names if self.of(name) is None]:
            allowed = 'a pattern for each; "*" matches the rest'
            refuse(f"{key}: no pattern for {first_few(missing)}", where, allowed, "no_rule")
        for pattern in self.of_pattern:
            if not any(fnmatchcase(name, pattern) for name in known):
                near = did_you_mean(pattern.strip("*?"), known)
                refuse(f"{key}: pattern '{pattern}' matches no structure{near}", where, first_few(known), "no_match")
        for name in names:
            matching = [pattern for pattern in self.of_pattern if fnmatchcase(name, pattern)]
            best = max((specificity(pattern, name) for pattern in matching), default=0.0)
            equal = [pattern for pattern in matching if specificity(pattern, name) == best]
            if any(self.of_pattern[pattern] != self.of_pattern[equal[0]] for pattern in equal):
                message = f"{key}: {' and '.join(map(repr, equal))} both match '{name}', with different values"
                refuse(message, where, "one pattern that is more specific than the others", "ambiguous_patterns")
