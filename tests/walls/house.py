"""The product's modules, their imports and their names, read from the sources alone."""

import ast
from collections import defaultdict
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
NAME = "puncture_twin"
PARTS = ("planning", "twin", "meshes")


@cache
def modules():
    """Full name to file, of every module and package of the product."""
    files = [*sorted((ROOT / NAME).glob("_*.py")), ROOT / NAME / "api.py", ROOT / "run_twin.py"]
    files += [path for part in PARTS for path in sorted((ROOT / part).rglob("*.py"))]
    return {name_of(path): path for path in files}


def name_of(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join([NAME, *(part for part in parts if part not in ("__init__", NAME))])


@cache
def tree(path):
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def imported(path):
    """Every module, and every name of a module, that a file imports, anywhere in it, by full name."""
    return tuple(_imports(path))


def _imports(path):
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports hide the arrows"
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@cache
def arrows():
    """Module to the modules of the product that it imports; packages count where nothing below them is named."""
    known = modules()
    found = {}
    for name, path in known.items():
        targets = {target for target in imported(path) if target in known and target != name}
        below = {target for target in targets if any(other.startswith(target + ".") for other in targets)}
        found[name] = targets - below
    return found


def is_package(name):
    return modules()[name].name == "__init__.py"


def room_of(name):
    return name if is_package(name) else name.rpartition(".")[0]


@cache
def room_arrows():
    """Room to room, each with the imports behind it; parent and child are one household."""
    found = defaultdict(list)
    for name, targets in arrows().items():
        for target in targets:
            one, other = room_of(name), room_of(target)
            if one != other and one not in (other, other.rpartition(".")[0]) and other != one.rpartition(".")[0]:
                found[one, other].append((name, target))
    return dict(found)


def cycle(graph):
    """One circle in a graph (node to nodes), as a list of its nodes, or an empty list."""
    done, path = set(), []

    def visit(node):
        if node in path:
            return path[path.index(node) :] + [node]
        if node in done:
            return []
        path.append(node)
        for other in sorted(graph.get(node, ())):
            found = visit(other)
            if found:
                return found
        path.pop()
        done.add(node)
        return []

    return next((found for node in sorted(graph) if (found := visit(node))), [])
