"""The arrows of the house: who may import whom."""

import ast
import importlib
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

from puncture_twin import planning, twin

ROOT = Path(__file__).parents[1]
FILES = sorted(path for folder in ("planning", "twin") for path in (ROOT / folder).rglob("*.py"))


def imported(path):
    """Every module that a file imports, by full name."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports hide the arrows"
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def within(module, package):
    """Whether a module is a package or lies in it."""
    return module == package or module.startswith(package + ".")


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_run_one_way(path):
    """planning never imports twin or pybullet; pybullet is met only in twin/world; the guidances do not meet."""
    here = path.relative_to(ROOT).with_suffix("").as_posix().replace("/", ".")
    forbidden = ["run_twin"]
    if within(here, "planning"):
        forbidden += ["twin", "pybullet"]
    if not within(here, "twin.world"):
        forbidden += ["pybullet", "pybullet_data"]
    guidances = [f"twin.{name}" for name in ("ct", "stereo", "ultrasound")]
    for own in guidances:
        if within(here, own):
            forbidden += [other for other in guidances if other != own]
    broken = [name for name in imported(path) if any(within(name, wall) for wall in forbidden)]
    assert broken == []


def test_planning_does_not_load_pybullet():
    """Importing every module of the planner leaves pybullet out of the process."""
    modules = [m.name for m in pkgutil.walk_packages(planning.__path__, "planning.")]
    code = f"import sys\nfor name in {modules!r}: __import__(name)\nassert 'pybullet' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


def test_no_import_cycles():
    """Modules import each other without a circle."""
    names = {
        p.relative_to(ROOT).with_suffix("").as_posix().replace("/", ".").removesuffix(".__init__"): p for p in FILES
    }
    arrows = {name: {m for m in imported(path) if m in names and m != name} for name, path in names.items()}
    packages = {name for name, path in names.items() if path.name == "__init__.py"}
    done, path = set(), []

    def visit(name):
        assert name not in path, " -> ".join([*path, name])
        if name in done:
            return
        path.append(name)
        for other in arrows[name] - packages:
            visit(other)
        path.pop()
        done.add(name)

    for name in names:
        visit(name)


@pytest.mark.parametrize("package", [planning, twin])
def test_every_exported_name_resolves(package):
    """What a package lists in ``__all__`` is there."""
    for info in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        module = importlib.import_module(info.name)
        for name in getattr(module, "__all__", ()):
            assert hasattr(module, name), f"{info.name}.{name}"
