"""Small faults put into a module's source, one at a time: what a suite of tests must notice.

A mutant differs from its module in one place of its syntax tree: a comparison, an operator, a number, a truth value, a
condition, a call's twin (min and max), a return value, or a statement that is left out. Left alone are strings,
annotations, decorators and what names imports.

A mutant is put into a module that is already imported everywhere, and taken out again. Whoever has imported a function
holds the function itself, so its code is exchanged within; numbers of the module are set in its namespace, where its
functions look them up. Nothing is imported again, and no other module knows.
"""

from __future__ import annotations

import ast
import copy
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from types import CodeType, FunctionType, MappingProxyType, ModuleType
from typing import Any

COMPARISONS: MappingProxyType[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = MappingProxyType(
    {
        ast.Lt: (ast.LtE, ast.GtE),
        ast.LtE: (ast.Lt, ast.Gt),
        ast.Gt: (ast.GtE, ast.LtE),
        ast.GtE: (ast.Gt, ast.Lt),
        ast.Eq: (ast.NotEq,),
        ast.NotEq: (ast.Eq,),
        ast.Is: (ast.IsNot,),
        ast.IsNot: (ast.Is,),
        ast.In: (ast.NotIn,),
        ast.NotIn: (ast.In,),
    }
)
"""Its boundary, and its opposite."""

OPERATORS: MappingProxyType[type[ast.operator], type[ast.operator]] = MappingProxyType(
    {
        ast.Add: ast.Sub,
        ast.Sub: ast.Add,
        ast.Mult: ast.Div,
        ast.Div: ast.Mult,
        ast.FloorDiv: ast.Mult,
        ast.Mod: ast.Mult,
        ast.Pow: ast.Mult,
        ast.BitAnd: ast.BitOr,
        ast.BitOr: ast.BitAnd,
    }
)

TWINS = MappingProxyType(
    {
        "min": "max",
        "max": "min",
        "any": "all",
        "all": "any",
        "sin": "cos",
        "cos": "sin",
        "minimum": "maximum",
        "maximum": "minimum",
        "argmin": "argmax",
        "argmax": "argmin",
        "floor": "ceil",
        "zeros": "ones",
        "ones": "zeros",
    }
)
"""Functions and methods that are easily taken for each other."""

Edit = Callable[[ast.AST], ast.AST]


@dataclass(frozen=True)
class Mutant:
    """One fault.

    Attributes:
        number: Among its module's mutants, from 0.
        line: Of the source.
        change: What was done, as ``before -> after``.
        code: The whole module's, compiled.
    """

    number: int
    line: int
    change: str
    code: CodeType


def mutants(source: str, filename: str) -> Iterator[Mutant]:
    """Every mutant of a module's source, in the order of the source."""
    tree = ast.parse(source)
    number = 0
    for path in _paths(tree):
        for edit in _edits(_at(tree, path)):
            changed = copy.deepcopy(tree)
            before = _at(changed, path)
            after = ast.copy_location(edit(copy.deepcopy(before)), before)
            _put(changed, path, after)
            code = compile(ast.fix_missing_locations(changed), filename, "exec")
            yield Mutant(number, getattr(before, "lineno", 0), _change(before, after), code)
            number += 1


Path = tuple[tuple[str, int | None], ...]
"""From a tree's root to a node: field names, with a place where the field is a list."""


def _paths(tree: ast.AST, path: Path = ()) -> Iterator[Path]:
    """Every node that may be changed."""
    for name, value in ast.iter_fields(tree):
        if name in {"annotation", "returns", "decorator_list", "bases", "type_comment"}:
            continue
        for place, child in enumerate(value) if isinstance(value, list) else [(None, value)]:
            if isinstance(child, ast.AST) and not isinstance(child, ast.Import | ast.ImportFrom | ast.JoinedStr):
                yield (*path, (name, place))
                yield from _paths(child, (*path, (name, place)))


def _at(tree: ast.AST, path: Path) -> ast.AST:
    for name, place in path:
        value = getattr(tree, name)
        tree = value if place is None else value[place]
    return tree


def _put(tree: ast.AST, path: Path, node: ast.AST) -> None:
    parent, (name, place) = _at(tree, path[:-1]), path[-1]
    if place is None:
        setattr(parent, name, node)
    else:
        getattr(parent, name)[place] = node


def _edits(node: ast.AST) -> Iterator[Edit]:
    """What can be done to a node."""
    for kind, maker in MAKERS:
        if isinstance(node, kind):
            yield from maker(node)


def _compared(node: ast.Compare) -> Iterator[Edit]:
    for place, operator in enumerate(node.ops):
        for other in COMPARISONS[type(operator)]:
            yield lambda n, place=place, other=other: _with(n, ops=[*n.ops[:place], other(), *n.ops[place + 1 :]])


def _operated(node: ast.BinOp | ast.AugAssign) -> Iterator[Edit]:
    if type(node.op) in OPERATORS:
        yield lambda n: _with(n, op=OPERATORS[type(n.op)]())


def _joined(node: ast.BoolOp) -> Iterator[Edit]:
    yield lambda n: _with(n, op=ast.Or() if isinstance(n.op, ast.And) else ast.And())


def _signed(node: ast.UnaryOp) -> Iterator[Edit]:
    yield lambda n: n.operand


def _constant(node: ast.Constant) -> Iterator[Edit]:
    value = node.value
    if isinstance(value, bool):
        yield lambda n: _with(n, value=not value)
    elif isinstance(value, int):
        yield lambda n: _with(n, value=value + 1)
        yield lambda n: _with(n, value=value - 1)
    elif isinstance(value, float):
        yield lambda n: _with(n, value=2.0 * value if value else 1.0)
        yield lambda n: _with(n, value=0.5 * value if value else -1.0)


def _called(node: ast.Call) -> Iterator[Edit]:
    name = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
    if name not in TWINS:
        return
    if isinstance(node.func, ast.Name):
        yield lambda n: _with(n, func=ast.copy_location(ast.Name(TWINS[name], ast.Load()), n))
    else:
        yield lambda n: _with(n, func=_with(n.func, attr=TWINS[name]))


def _conditional(node: ast.If | ast.IfExp | ast.While) -> Iterator[Edit]:
    yield lambda n: _with(n, test=ast.copy_location(ast.UnaryOp(ast.Not(), n.test), n.test))


def _returned(node: ast.Return) -> Iterator[Edit]:
    if node.value is not None and not (isinstance(node.value, ast.Constant) and node.value.value is None):
        yield lambda n: _with(n, value=ast.copy_location(ast.Constant(None), n))


def _left_out(node: ast.stmt) -> Iterator[Edit]:
    """A statement whose absence is no NameError: a call, a raise, a change in place."""
    places = isinstance(node, ast.Assign) and all(isinstance(t, ast.Subscript | ast.Attribute) for t in node.targets)
    text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    if places or isinstance(node, ast.Raise | ast.AugAssign) or (isinstance(node, ast.Expr) and not text):
        yield lambda n: ast.Pass()


def _with(node: ast.AST, **fields: object) -> ast.AST:
    for name, value in fields.items():
        setattr(node, name, value)
    return node


def _change(before: ast.AST, after: ast.AST) -> str:
    """Both as source, cut to a line."""
    first, second = (" ".join(ast.unparse(node).split()) for node in (before, after))
    return f"{first[:90]} -> {second[:90]}"


MAKERS = (
    (ast.Compare, _compared),
    ((ast.BinOp, ast.AugAssign), _operated),
    (ast.BoolOp, _joined),
    (ast.UnaryOp, _signed),
    (ast.Constant, _constant),
    (ast.Call, _called),
    ((ast.If, ast.IfExp, ast.While), _conditional),
    (ast.Return, _returned),
    (ast.stmt, _left_out),
)
"""Kinds of node, and what makes their edits."""

SETTABLE = (int, float, str, tuple, MappingProxyType)
"""Values of a module's namespace that a mutant may change."""


@contextmanager
def mutated(module: ModuleType, code: CodeType) -> Iterator[None]:
    """Let a module behave as its mutant does.

    Args:
        module: The original, imported.
        code: The mutant's, of the whole module.

    Raises:
        Exception: Whatever the mutant raises when it is loaded; the original is untouched then.
    """
    space: dict[str, Any] = {
        "__name__": module.__name__,
        "__package__": module.__package__,
        "__file__": module.__file__,
    }
    exec(code, space)
    undo: list[tuple[Any, str, Any]] = []
    try:
        for name, value in space.items():
            _exchange(module, name, value, undo)
        yield
    finally:
        for owner, name, value in reversed(undo):
            _set(owner, name, value)


def _exchange(module: ModuleType, name: str, new: Any, undo: list[tuple[Any, str, Any]]) -> None:
    """One name of the module's namespace."""
    old = getattr(module, name, None)
    if isinstance(new, type) and isinstance(old, type) and old.__module__ == module.__name__:
        for attribute, value in vars(new).items():
            _exchange_code(_function(vars(old).get(attribute)), _function(value), undo)
    elif isinstance(new, SETTABLE) and not name.startswith("__"):
        undo.append((module, name, old))
        _set(module, name, new)
    elif getattr(old, "__module__", None) == module.__name__:
        _exchange_code(_function(old), _function(new), undo)


def _function(value: Any) -> FunctionType | None:
    """The plain function within a method, a property or a wrapper."""
    if isinstance(value, property):
        value = value.fget
    elif isinstance(value, cached_property):
        value = value.func
    value = getattr(value, "__wrapped__", getattr(value, "__func__", value))
    return value if isinstance(value, FunctionType) else None


def _exchange_code(old: FunctionType | None, new: FunctionType | None, undo: list[tuple[Any, str, Any]]) -> None:
    if old is None or new is None or old.__code__.co_freevars != new.__code__.co_freevars:
        return
    if old.__code__.co_filename != new.__code__.co_filename:
        return  # what dataclass has written
    for name in ("__code__", "__defaults__", "__kwdefaults__"):
        undo.append((old, name, getattr(old, name)))
        setattr(old, name, getattr(new, name))


def _set(owner: Any, name: str, value: Any) -> None:
    setattr(owner, name, value)
