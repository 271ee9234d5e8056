"""Statements of a person where `init` would guess or refuse: one option each, which a refusal can name."""

import json
import re
import tomllib
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.text import did_you_mean
from puncture_twin.planning.case.case_file import CaseFile

WAYS = (
    "or with `init`: --set KEY=VALUE for a key of the case, --ignore NAME to leave a structure out, --unknown NAME "
    "for one that no path may cross, --skin NAME for another skin"
)
"""Options of `init` for what a case would state; the refusals of a case name its keys and roles."""
OWN_OPTION: Mapping[str, str] = MappingProxyType({
    "region": "--region", "space": "--space", "target.position_mm": "--target",
    "target.structure": "--target-label", "target.hit_radius_mm": "--hit-radius",
})  # fmt: skip
"""Keys by which `init` decides other things, so that each has an option of its own."""
SKIN, SKIN_ROLE = "skin", 'role = "skin"'
"""The structure whose ``cut`` is a key too, and the line after which that stands."""
LISTS = frozenset(("structure", "structures", "obstacle", "end", "schema"))
"""Keys that `--set` cannot write: tables that stand several times, and what belongs to the file."""
REASONS: Mapping[str, str] = MappingProxyType({"search.trust_labels": "a person checked the structures on the CT"})
STATED = "stated to init"


@dataclass(frozen=True)
class Overrides:
    """The statements of a person: roles, files and keys."""

    skin: str | None = None  # the structure that is the skin, or None
    # name of a structure, or of a file, to ``ignore`` or ``unknown``
    roles: Mapping[str, str] = field(default_factory=dict)
    # key of the case, as ``ct.arms``, to its value as TOML writes it
    keys: Mapping[str, str] = field(default_factory=dict)

    def leaves_out(self, file: str) -> bool:
        """Whether a file, relative to the folder, is named to be left out, by its path or its name with the ending."""
        return "ignore" in {self.roles.get(file), self.roles.get(file.rpartition("/")[2])}

    def check_names(self, structures: Collection[str], files: Iterable[str]) -> None:
        """Refuse a name of nothing that is there, or an unknown one of a file: what is in it is not read."""
        left_out = {name for file in files for name in (file, file.rpartition("/")[2])}
        for name, kind in (*self.roles.items(), *((one, "skin") for one in (self.skin,) if one is not None)):
            if name not in structures and not (kind == "ignore" and name in left_out):
                what = f"no structure is named '{name}'{did_you_mean(name, structures)}"
                refuse(what, f"--{kind}", ", ".join(sorted(structures)), "unknown_structure")


def overrides_of(skin: str | None, ignore: Iterable[str], unknown: Iterable[str], settings: Iterable[str]) -> Overrides:
    """The options as they were typed; a value that is no TOML is a text, so that ``ct.arms=none`` needs no quotes.

    Raises InputError: no ``KEY=VALUE``, a key that has an option of its own or is no key of a table.
    """
    keys = {}
    for text in settings:
        key, sign, value = (part.strip() for part in text.partition("="))
        if not sign or not re.fullmatch(r"[A-Za-z_]+(\.[A-Za-z_]+)*", key):
            refuse(f"'{text[:80]}'", "--set", "KEY=VALUE, such as ct.arms=none", "unknown_key")
        table = key.partition(".")[0]
        tables = {one.alias or name for name, one in CaseFile.model_fields.items()} - LISTS
        if key in OWN_OPTION or (table not in tables and key != f"{SKIN}.cut"):
            allowed = OWN_OPTION.get(key, "a key of the case's tables (docs/reference/case.md), such as ct.arms=none")
            refuse(f"key '{key}'", "--set", allowed, "unknown_key")
        keys[key] = value if _is_toml(value) else json.dumps(value)
    roles = dict.fromkeys(ignore, "ignore")
    if both := sorted(set(unknown) & set(roles)):
        refuse(f"'{both[0]}' is also ignored", "--unknown", "one of the two", "two_roles")
    return Overrides(skin, roles | dict.fromkeys(unknown, "unknown"), keys)


def _is_toml(value: str) -> bool:
    try:
        return "\n" not in value and len(tomllib.loads(f"value = {value}")) == 1
    except tomllib.TOMLDecodeError:
        return False


def with_keys(text: str, keys: Mapping[str, str], reasons: Mapping[str, str] = REASONS) -> str:
    """The text of a case in which keys have these values: in place of theirs, else first in their table."""
    for key, value in keys.items():
        table, _, name = key.rpartition(".")
        text = with_line(text, table, f"{name} = {value}  # {reasons.get(key, STATED)}", name)
    return text


def with_line(text: str, table: str, line: str, name: str = "") -> str:
    """The text of a case with a line of a table: in place of a key's, else first in the table, made where it is not."""
    lines = text.split("\n")
    heads = [i for i, one in enumerate(lines) if one.startswith("[")]
    head = SKIN_ROLE if table == SKIN else f"[{table}]"
    if table and head not in lines:
        lines[heads[-1] : heads[-1]] = [f"[{table}]", line, ""]  # before [end]
        return "\n".join(lines)
    start = lines.index(head) + 1 if table else 0
    stop = next((i for i in heads if i >= start), len(lines))
    there = [i for i in range(start, stop) if name and re.match(rf"{name}\s*=", lines[i])]
    at = there[0] if there else start
    lines[at : at + len(there)] = [line]
    return "\n".join(lines)
