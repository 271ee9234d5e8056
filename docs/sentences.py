"""Write docs/reference/sentences.md from the source: every sentence of a refusal, an answer no or a finding.

``python docs/sentences.py``. Where a value is filled in, the page says {...}. A polished sentence changes this page
alone: the tests ask the codes.
"""

import ast
import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "reference" / "sentences.md"
ROOMS = ("planning", "twin", "puncture_twin/api.py", "run_twin.py")

HEAD = """# Sentences

Every sentence with which the program refuses an input (exit code 2), answers no (1), or reports a finding (with its
severity). The code is the kind of mistake, the same everywhere; `--json` prints it. `{...}` is a value, or words that
depend on the input. `bad_value` is also a key of another type or range ("must be 0.1 or more"). How the sentences are
written: [words](../words.md#how-texts-are-written).

*Written by `python docs/sentences.py` from the source; a test compares them.*

| code | kind | room | sentence | allowed |
|---|---|---|---|---|
"""

KINDS = {
    "refuse": "2",
    "refusing": "2",
    "InputError": "2",
    "InputListError": "2",
    "NoAnswerError": "1",
    "ValueError": "2",
    "TypeError": "2",
    "SchemaError": "2",
    "Finding": "",
}
SLOTS = ("what", "where", "allowed", "code")
"""Of `refuse`, in order; the errors name what follows the first, and what `refusing` waits for comes before them."""
FINDING_SLOTS = ("code", "severity", "what", "numbers", "allowed")
SCHEMA_SLOTS = ("what", "code")
FINDING_NAMES = {"sentence": "what", "way_out": "allowed"}
SEVERITY = re.compile(r"Severity\.(\w+)")
VALUES = {"ValueError", "TypeError"}
VALUE = "{...}"
CAUSE = "its cause's"
"""Where an error is passed on, with more words."""
STRICT = ("strict_json", "pydantic")
"""What modules import whose ValueErrors a person reads."""


Function = ast.FunctionDef | None


class Row(NamedTuple):
    """A line of the page."""

    code: str
    kind: str
    room: str
    sentence: str
    allowed: str


class Scope(NamedTuple):
    """Where a call stands: its module, its function (or None), its line, and what the parameters are bound to."""

    module: ast.Module
    function: Function
    line: int
    bound: "dict[str, tuple[ast.expr, Scope]]"

    def parameters(self) -> list[str]:
        """Names of the function's parameters."""
        arguments = self.function.args if self.function else None
        return [one.arg for one in (*arguments.args, *arguments.kwonlyargs)] if arguments else []


def name_of(call: ast.Call) -> str:
    """The last part of what is called."""
    return call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")


def texts(node: ast.expr | None, scope: Scope, depth: int = 0) -> list[str]:
    """What an expression may say: one text a branch, each value as {...}."""
    again = partial(texts, scope=scope, depth=depth)
    match node:
        case None:
            return [""]
        case ast.Constant():
            return [str(node.value)]
        case ast.JoinedStr():
            return joined([again(one) for one in node.values])
        case ast.FormattedValue(value=ast.Name() | ast.IfExp() | ast.Constant() as value, format_spec=None):
            return again(value)
        case ast.BinOp(op=ast.Add()):
            return joined([again(node.left), again(node.right)])
        case ast.IfExp():
            return [*again(node.body), *again(node.orelse)]
        case ast.Name() if depth < 4:
            return named(node.id, scope, depth + 1)
    return [VALUE]


def joined(parts: list[list[str]]) -> list[str]:
    """Every combination of the branches of some parts, while they are few; else the parts as values."""
    found = [""]
    for part in parts:
        part = list(dict.fromkeys(part)) if len(part) * len(found) <= 6 else [VALUE]
        found = [head + tail for head in found for tail in part]
    return found


def named(name: str, scope: Scope, depth: int) -> list[str]:
    """What a name holds: bound to a parameter, assigned before the line, or a constant of the module."""
    if name in scope.bound:
        value, outside = scope.bound[name]
        return texts(value, outside, depth)
    if name in scope.parameters():
        return [VALUE]
    inside = list(ast.walk(scope.function)) if scope.function else []
    for nodes in (inside, scope.module.body):
        values = assigned(name, nodes, scope.line if nodes is inside else 10**9)
        if values:
            return [text for value in values for text in texts(value, scope, depth)]
    return [VALUE]


def assigned(name: str, nodes: list[ast.stmt], line: int) -> list[ast.expr]:
    """The values of a name that may still stand at a line: those that follow the last refusal before it."""
    calls = [one for one in nodes if isinstance(one, ast.Call) and name_of(one) in KINDS and one.end_lineno < line]
    since = max((one.end_lineno for one in calls), default=0)
    found = []
    for one in nodes:
        if isinstance(one, ast.Assign | ast.AnnAssign | ast.NamedExpr) and one.value and one.lineno <= line:
            targets = one.targets if isinstance(one, ast.Assign) else [one.target]
            found += [one for target in targets if getattr(target, "id", "") == name]
    found.sort(key=lambda one: one.lineno)
    return [one.value for one in ([one for one in found if one.lineno > since] or found[-1:])]


def slots(call: ast.Call) -> dict[str, ast.expr]:
    """The parts of a refusal or a finding by their names."""
    kind = name_of(call)
    orders = {"Finding": FINDING_SLOTS, "SchemaError": SCHEMA_SLOTS, "refusing": ("kinds", *SLOTS)}
    given = dict(zip(orders.get(kind, SLOTS), call.args, strict=False))
    return given | {FINDING_NAMES.get(one.arg, one.arg): one.value for one in call.keywords if one.arg}


def calls_in(node: ast.AST, function: Function = None) -> Iterator[tuple[ast.Call, Function]]:
    """Every call, with the function that it stands in."""
    for child in ast.iter_child_nodes(node):
        inside = child if isinstance(child, ast.FunctionDef) else function
        if isinstance(child, ast.Call):
            yield child, function
        yield from calls_in(child, inside)


def rows_of(call: ast.Call, scope: Scope, room: str) -> Iterator[Row]:
    """The lines of one call; of a helper that takes the sentence or the code, those of every call of the helper."""
    parts = slots(call)
    taken = {one.id for one in (parts.get("what"), parts.get("code")) if isinstance(one, ast.Name)}
    if not scope.bound and taken.intersection(scope.parameters()) and scope.function.name != "__init__":
        yield from helper_rows(call, scope, room)
        return
    severity = SEVERITY.fullmatch(ast.unparse(parts["severity"])) if "severity" in parts else None
    kind = KINDS[name_of(call)] or (severity[1].lower() if severity else "finding")
    codes = texts(parts["code"], scope) if "code" in parts else ["bad_value"]
    for code in dict.fromkeys(codes):
        for text in dict.fromkeys(texts(parts.get("what"), scope)):
            allowed = " / ".join(dict.fromkeys(texts(parts.get("allowed"), scope)))
            cause = f" ({VALUE})" if name_of(call) == "refusing" else ""
            yield Row(code, kind, room, text + cause, allowed)


def helper_rows(call: ast.Call, scope: Scope, room: str) -> Iterator[Row]:
    """The lines of a refusal whose words a helper takes from its callers in the same module."""
    for outer, function in calls_in(scope.module):
        if name_of(outer) == scope.function.name:
            around = Scope(scope.module, function, outer.lineno, {})
            names = [one for one in scope.parameters() if one != "self"]
            defaults = dict(zip(reversed(names), reversed(scope.function.args.defaults), strict=False))
            given = defaults | dict(zip(names, outer.args, strict=False))
            given |= {one.arg: one.value for one in outer.keywords}
            bound = {name: (value, around) for name, value in given.items()}
            yield from rows_of(call, scope._replace(bound=bound), room)


def rows() -> list[Row]:
    """Every line of the page, sorted by code."""
    found = set()
    for place in ROOMS:
        path = ROOT / place
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            source = file.read_text(encoding="utf-8")
            module = ast.parse(source)
            known = set(KINDS) if any(f"{one} import" in source for one in STRICT) else set(KINDS) - VALUES
            if "class Finding" in source or "session import" in source:  # of the pytest plugin: another thing
                known -= {"Finding"}
            room = "/".join(file.relative_to(ROOT).parts[:2])
            for call, function in calls_in(module):
                own = function is None or function.name not in KINDS  # `refuse` itself says nothing
                if name_of(call) in known and own and (call.args or call.keywords):
                    found.update(rows_of(call, Scope(module, function, call.lineno, {}), room))
    return sorted(found)


def page() -> str:
    """The page as it belongs there."""
    lines = ((CAUSE if row.code == VALUE else f"`{row.code}`", *row[1:3], *map(_cell, row[3:])) for row in rows())
    return HEAD + "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*")


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
