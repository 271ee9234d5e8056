"""What a case says of structures by patterns of their names, beside roles and margins."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Generic, TypeVar

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.near_names import did_you_mean
from puncture_twin.planning.formats.labels.naming import specificity

SHOWN = 8
"""Names that an error lists."""

T = TypeVar("T")


@dataclass(frozen=True)
class ByName(Generic[T]):
    """Patterns of names, and what each stands for.

    Attributes:
        of_pattern: Shell patterns; the most specific that matches a name holds.
    """

    of_pattern: Mapping[str, T]

    def of(self, name: str) -> T | None:
        """What stands for one name; None where no pattern matches it.

        >>> ByName({"*": 0.0, "rib*": 0.5}).of("rib_1"), ByName({"rib*": 0.5}).of("liver")
        (0.5, None)
        """
        matching = [pattern for pattern in self.of_pattern if fnmatchcase(name, pattern)]
        best = max(matching, key=lambda pattern: specificity(pattern, name), default=None)
        return None if best is None else self.of_pattern[best]

    def check(self, names: Iterable[str], key: str, where: str | Path, *, others: Iterable[str] = ()) -> None:
        """Refuse patterns that leave a name out, match nothing, or contradict each other.

        Args:
            names: All that a pattern must match.
            key: Of the case file, for errors.
            where: For errors.
            others: What needs none, and may be named all the same.

        Raises:
            InputError: One of the three.
        """
        names, known = list(names), [*names, *others]
        if missing := [name for name in names if self.of(name) is None]:
            message = f"{key}: nothing for {_listed(missing)}"
            raise InputError(message, where=where, allowed='a pattern for each; "*" is the rest')
        for pattern in self.of_pattern:
            if not any(fnmatchcase(name, pattern) for name in known):
                near = did_you_mean(pattern.strip("*?"), known)
                message = f"{key}: pattern '{pattern}' matches no structure{near}"
                raise InputError(message, where=where, allowed=_listed(known))
        for name in names:
            _refuse_contradiction(self.of_pattern, name, key, where)


def _refuse_contradiction(of_pattern: Mapping[str, T], name: str, key: str, where: str | Path) -> None:
    """Two equally specific patterns that give one name two meanings."""
    matching = [pattern for pattern in of_pattern if fnmatchcase(name, pattern)]
    best = max((specificity(pattern, name) for pattern in matching), default=0.0)
    equal = [pattern for pattern in matching if specificity(pattern, name) == best]
    if any(of_pattern[pattern] != of_pattern[equal[0]] for pattern in equal):
        message = f"{key}: {' and '.join(map(repr, equal))} both name '{name}', and differ"
        raise InputError(message, where=where, allowed="one pattern that is more specific than the others")


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return ", ".join(names[:SHOWN]) + more
