"""Parameters with a default that no call of the product sets: what could be a constant, or go.

    python benchmarks/unset_parameters.py

Read from the sources alone. A call counts for every function of its name; ``**keywords`` count for all, and so do
methods that are handed on uncalled, as callbacks are.
"""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
ALL = "*"


def trees() -> Iterator[tuple[Path, ast.Module]]:
    """Every source file of the product."""
    files = [ROOT / "run_twin.py", ROOT / "puncture_twin" / "api.py"]
    for folder in ("planning", "twin", "meshes"):
        files += sorted((ROOT / folder).rglob("*.py"))
    for path in files:
        yield path, ast.parse(path.read_text(encoding="utf-8"))


def defaults(function: ast.FunctionDef) -> list[tuple[int, str]]:
    """Place (without self; -1 for keywords only) and name of each parameter that has a default."""
    arguments = function.args
    places = [*arguments.posonlyargs, *arguments.args]
    own = 1 if places and places[0].arg in ("self", "cls") else 0
    first = len(places) - len(arguments.defaults)
    found = [(at - own, one.arg) for at, one in enumerate(places) if at >= first]
    pairs = zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True)
    return found + [(-1, one.arg) for one, default in pairs if default is not None]


def called(node: ast.Call) -> tuple[str, list[ast.expr]]:
    """The name that a call calls, and its positional arguments; ``partial(f, ...)`` calls f."""
    function, given = node.func, list(node.args)
    if isinstance(function, ast.Name) and function.id == "partial" and given:
        function = given.pop(0)
    name = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
    return name, given


def uses() -> dict[str, set[int | str]]:
    """Function name to the places and keywords that some call sets."""
    found: dict[str, set[int | str]] = defaultdict(set)
    for _, tree in trees():
        for node in ast.walk(tree):
            if isinstance(node, ast.Call):
                name, given = called(node)
                found[name] |= set(range(len(given))) | {one.arg or ALL for one in node.keywords}
                if any(isinstance(one, ast.Starred) for one in given):
                    found[name].add(ALL)
    return found


def main() -> None:
    """Print each, with its file and line."""
    given, count = uses(), 0
    for path, tree in trees():
        classes = {id(one): node.name for node in ast.walk(tree) if isinstance(node, ast.ClassDef) for one in node.body}
        for node in ast.walk(tree):
            if not isinstance(node, ast.FunctionDef) or (node.decorator_list and path.name == "run_twin.py"):
                continue
            name = classes.get(id(node), node.name) if node.name == "__init__" else node.name
            for place, parameter in defaults(node):
                if not given[name] & {place if place >= 0 else parameter, parameter, ALL}:
                    count += 1
                    print(f"{path.relative_to(ROOT)}:{node.lineno}: {name}({parameter})")
    print(f"{count} parameters")


if __name__ == "__main__":
    main()
