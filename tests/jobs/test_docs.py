"""The pages name what is there: links, files, modules, classes, commands and code."""

import ast
import doctest
import importlib
import re
from functools import cache

import pytest
import typer
from places import ROOT
from walls.house import modules, tree

from puncture_twin.planning.export.exporter import GROUP
from puncture_twin.run_twin import app
from puncture_twin.twin.jobs.exit_codes import RULES

PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")])

LINK = re.compile(r"\]\(([^)\s]+)\)")
FILE = re.compile(r"`((?:planning|twin|tests|benchmarks|docs|examples|meshes|puncture_twin)/[\w./-]*\w)`")
DOTTED = re.compile(r"\bpuncture_twin(?:\.\w+)+")
DEFINED = re.compile(r"^ *class (\w+)[(:]", re.M)
CLASS = re.compile(r"`([A-Z][a-z]+(?:[A-Z][a-z]+)+|Case|Reason|Structure|Certificate|Plan|Truth)`")
CODE = re.compile(r"^( *)```python\n(.*?)^\1```", re.M | re.S)
each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))


def slug(heading):
    kept = re.sub(r"[^\w\- ]", "", heading.replace("`", "").lower())
    return re.sub(r"[ ]", "-", kept.strip())


@cache
def anchors(page):
    return {slug(line.lstrip("#")) for line in page.read_text(encoding="utf-8").splitlines() if line.startswith("#")}


@cache
def class_names():
    return {name for path in modules().values() for name in DEFINED.findall(path.read_text(encoding="utf-8"))}


@cache
def make_targets():
    return set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.M))


def names_of(path):
    found = set()
    for node in tree(path).body:
        found |= {node.name} if hasattr(node, "name") else set()
        found |= {alias.asname or alias.name for alias in getattr(node, "names", ())}
        targets = getattr(node, "targets", [getattr(node, "target", None)])
        found |= {target.id for target in targets if isinstance(target, ast.Name)}
    return found


def code_blocks(page):
    for indent, code in CODE.findall(page.read_text(encoding="utf-8")):
        yield "".join(line.removeprefix(indent) for line in code.splitlines(keepends=True))


@each_page
def test_every_link_leads_somewhere(page):
    for link in LINK.findall(page.read_text(encoding="utf-8")):
        if "://" not in link:
            name, _, anchor = link.partition("#")
            target = (page.parent / name).resolve() if name else page
            assert target.exists(), link
            assert not anchor or anchor in anchors(target), link


@each_page
def test_everything_that_is_named_exists(page):
    """Files, modules, classes and targets of make: a page that names a moved file is worse than one that names none."""
    text, known = page.read_text(encoding="utf-8"), modules()
    assert [name for name in FILE.findall(text) if not (ROOT / name).exists()] == []
    for dotted in set(DOTTED.findall(text)) - {GROUP}:  # an entry point, no module
        room, _, name = dotted.rpartition(".")
        assert dotted in known or (room in known and name in names_of(known[room])), dotted
    assert set(CLASS.findall(text)) - class_names() == set()
    assert set(re.findall(r"`make (\w+)`", text)) - make_targets() == set()


@pytest.mark.parametrize("page", [page for page in PAGES if list(code_blocks(page))], ids=lambda page: page.stem)
def test_code_is_python_whose_imports_work(page):
    """Every block compiles, and what it imports of this project is there."""
    for code in code_blocks(page):
        imports = [node for node in ast.parse(code).body if isinstance(node, ast.Import | ast.ImportFrom)]
        exec(compile(ast.Module(imports, []), str(page), "exec"), {})


def test_the_code_of_the_readme_runs(monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    for code in code_blocks(ROOT / "README.md"):
        exec(compile(code, "README.md", "exec"), {})
    assert "safe" in capsys.readouterr().out


def commands(group, before=""):
    for name, command in group.commands.items():
        below = hasattr(command, "commands")
        yield from commands(command, f"{before}{name} ") if below else [(f"{before}{name}", command)]


def test_the_command_line_is_described():
    text = (ROOT / "docs" / "reference" / "command-line.md").read_text(encoding="utf-8")
    for name, command in commands(typer.main.get_command(app)):
        section = text.split(f"## `{name}`\n")[1].split("\n## ")[0]
        options = [option for one in command.params for option in one.opts if option.startswith("--")]
        assert [option for option in options if option not in section] == [], name
        assert f"`{name.partition(' ')[0]}" in (ROOT / "README.md").read_text(encoding="utf-8"), name


def test_the_page_says_of_every_command_when_its_answer_is_no():
    """No command without a sentence, no sentence of another; what is never no has no rule."""
    page = (ROOT / "docs" / "reference" / "command-line.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `([^`]+)` \| (.+) \|$", page.split("## `demo`")[0], re.MULTILINE))
    assert {name.partition(" --")[0] for name in rows} == {name for name, _ in commands(typer.main.get_command(app))}
    assert set(RULES) <= {name for name, no in rows.items() if not no.startswith("never")}


def test_every_room_is_on_the_page_of_the_architecture():
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    rooms = {
        path.parent.relative_to(ROOT).as_posix()
        for part in ("planning", "twin")
        for path in ROOT.glob(f"{part}/*/__init__.py")
    }
    assert {room for room in rooms if f"`{room}`" not in text} == set()


def test_every_concept_has_a_picture_and_every_picture_a_page():
    texts = {page: page.read_text(encoding="utf-8") for page in PAGES}
    for page, text in texts.items():
        if page.parent.name == "concepts":
            assert len(re.findall(r"!\[.*?\]\(\.\./pictures/", text)) == 1, page.name
    shown = {name for text in texts.values() for name in re.findall(r"pictures/(\w[\w-]*\.png)", text)}
    assert {path.name for path in (ROOT / "docs" / "pictures").iterdir()} == shown


def test_every_page_is_in_the_index_and_in_the_menu():
    index, menu = ((ROOT / name).read_text(encoding="utf-8") for name in ("docs/index.md", "mkdocs.yml"))
    pages = [path.relative_to(ROOT / "docs").as_posix() for path in PAGES if ROOT / "docs" in path.parents]
    assert [page for page in pages if page != "index.md" and (f"({page})" not in index or page not in menu)] == []


WITH_DOCTESTS = sorted(name for name, path in modules().items() if "\n    >>> " in path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", WITH_DOCTESTS)
def test_what_docstrings_show_is_what_happens(name):
    found = doctest.testmod(importlib.import_module(name))
    assert found.attempted > 0
    assert found.failed == 0
