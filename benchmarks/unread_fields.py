"""Fields of the product's values that nothing of the product reads: what could go.

    python benchmarks/unread_fields.py

Read from the sources alone: dataclasses and named tuples, and any ``.field`` anywhere counts as a reading, whatever it
is read of. Values whose fields are gone through by name (``asdict``, ``_asdict``, ``fields``, ``_fields``) or that are
unpacked are read by that, so each line is a place to look. Files' schemas (pydantic) are left out.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a script, beside the package

from benchmarks.unset_parameters import ROOT, trees


def decorated(node: ast.ClassDef) -> bool:
    """Whether it is a dataclass or a named tuple."""
    names = {one.id for top in node.decorator_list for one in ast.walk(top) if isinstance(one, ast.Name)}
    bases = {one.id for top in node.bases for one in ast.walk(top) if isinstance(one, ast.Name)}
    return "dataclass" in names or "NamedTuple" in bases


def fields(tree: ast.Module) -> Iterator[tuple[int, str, str]]:
    """Line, class and name of each field."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef) and decorated(node):
            for one in node.body:
                if isinstance(one, ast.AnnAssign) and isinstance(one.target, ast.Name):
                    yield one.lineno, node.name, one.target.id


def read_names(tree: ast.Module) -> Iterator[str]:
    """Every attribute that is read, and every string: a field may be named by one."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load):
            yield node.attr
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.isidentifier():
            yield node.value


def main() -> None:
    """Print each, with its file and line."""
    parsed = list(trees())
    read = {name for _, tree in parsed for name in read_names(tree)}
    found = [(path, *field) for path, tree in parsed for field in fields(tree) if field[2] not in read]
    for path, line, owner, name in found:
        print(f"{path.relative_to(ROOT)}:{line}: {owner}.{name}")
    print(f"{len(found)} fields")


if __name__ == "__main__":
    main()
