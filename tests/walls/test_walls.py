"""The walls of the house: who may import whom, how full a room may be, and that nothing in it is unused."""

import ast
import importlib
import re
import subprocess
import sys
import tomllib
import types
from collections import defaultdict
from importlib.metadata import packages_distributions

import pytest
from packaging.requirements import Requirement
from walls.house import NAME, ROOT, arrows, cycle, imported, is_package, modules, room_arrows, tree

from puncture_twin.planning.base.errors import MODULES


@pytest.fixture(scope="module", autouse=True)
def sources():
    """Read once, for all walls."""
    for path in modules().values():
        imported(path)


def within(module, package):
    return module == package or module.startswith(package + ".")


def broken(inside, forbidden, but=frozenset()):
    """Imports of something forbidden from modules inside a package."""
    return [
        f"{name} imports {target}"
        for name, path in modules().items()
        if within(name, inside) and name not in but
        for target in imported(path)
        if any(within(target, wall) for wall in forbidden)
    ]


def names_in(path):
    """Every name that a file uses or gives."""
    for node in ast.walk(tree(path)):
        yield from (
            getattr(node, key) for key in ("id", "attr", "arg", "name") if isinstance(getattr(node, key, 0), str)
        )


def of_truth(name):
    return bool({"true", "truth"} & set(re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower().split("_")))


def test_planning_never_imports_the_twin_or_the_physics():
    assert broken(f"{NAME}.planning", [f"{NAME}.twin", f"{NAME}.run_twin", "pybullet", "matplotlib"]) == []


def test_the_physics_is_met_in_one_room():
    assert [line for line in broken(NAME, ["pybullet", "pybullet_data"]) if ".twin.world." not in line] == []


def test_nobody_imports_the_command_line():
    assert broken(NAME, [f"{NAME}.run_twin"], but={f"{NAME}.__main__"}) == []


def test_guidance_never_sees_the_plant():
    """It speaks to devices, and nothing in it is named after the truth but what a case file says of the plant."""
    guidance = f"{NAME}.twin.guidance"
    assert broken(guidance, [f"{NAME}.twin.plant", f"{NAME}.twin.rehearsal", f"{NAME}.twin.world"]) == []
    inside = {name: path for name, path in modules().items() if within(name, guidance)}
    files = [path for name, path in inside.items() if not name.endswith("_case")]
    assert len(files) < len(inside)
    assert [f"{path.name}: {name}" for path in files for name in names_in(path) if of_truth(name)] == []


def test_the_ways_of_guidance_do_not_meet():
    kinds = [name for name in modules() if name.count(".") == 3 and within(name, f"{NAME}.twin.guidance")]
    assert len(kinds) >= 2
    for kind in kinds:
        assert broken(kind, [other for other in kinds if other != kind]) == []


def test_kernels_are_compiled_in_one_way():
    """What imports numba by itself is kept by numba's rule, which misses edits of other files."""
    own = f"{NAME}.planning.base.numba_kernels"
    lines = [line for line in broken(NAME, ["numba"]) if not line.startswith(own)]
    allowed = ("numba.extending", "numba.types")  # intrinsics and types compile nothing
    assert [line for line in lines if not f"{line}.".endswith((" numba.", *(f" {name}." for name in allowed)))] == []


PUBLIC = re.compile(r"numba(\.extending|\.types|\.njit)?(\.[a-z]+)?|llvmlite(\.ir|\.binding)?(\.[A-Z]\w+|\.[a-z_]+)?")
PRIVATE = re.compile(r"numba[._]core|\bnb\._|\bffi\b|_(overloads|cache_file|compile_for_args|getvalue|dispatcher)\b")
"""Names in numba and llvmlite that their documents speak of, and names that change from one version to the next."""


def test_numba_and_llvmlite_are_used_by_their_public_names():
    """Any version of them will do, then; the rules themselves name what is not allowed."""
    beside = [path for part in ("tests", "benchmarks") for path in (ROOT / part).rglob("*.py")]
    files = [path for path in (*modules().values(), *beside) if path.name != "test_walls.py"]
    names = {name for path in files for name in imported(path) if name.split(".")[0] in ("numba", "llvmlite")}
    assert [name for name in names if not PUBLIC.fullmatch(name) or PRIVATE.search(name)] == []
    assert [str(path) for path in files if PRIVATE.search(path.read_text("utf-8"))] == []
    option = [path.name for path in files if re.search(r"\b_nrt\b", path.read_text("utf-8"))]
    assert option == ["numba_kernels.py"]  # the one private option; without it the answers are the same


def test_no_private_part_of_a_library_is_imported():
    """A module or name with an underscore before it is moved without a word, by any version."""
    files = [
        *modules().values(),
        *(path for part in ("tests", "benchmarks", "docs", "tools") for path in (ROOT / part).rglob("*.py")),
    ]
    others = {(path.name, name) for path in files for name in imported(path) if not within(name, NAME)}
    assert sorted(pair for pair in others if re.search(r"\._[^_]", f".{pair[1]}")) == []


def test_everything_is_imported_under_one_name():
    """A second way to the same file would be a second copy of every class."""
    folders = ("tests", "benchmarks", "docs", "examples")
    files = [*modules().values(), *(path for folder in folders for path in (ROOT / folder).rglob("*.py"))]
    tops = ("planning", "twin", "meshes", "run_twin")
    assert [f"{path}: {name}" for path in files for name in imported(path) if name.split(".")[0] in tops] == []


def test_modules_form_no_cycle():
    assert (
        cycle({name: {other for other in targets if not is_package(other)} for name, targets in arrows().items()}) == []
    )


def test_rooms_form_no_cycle():
    """No folder imports itself through others, parent and child apart."""
    graph = defaultdict(set)
    for one, other in room_arrows():
        graph[one].add(other)
    assert cycle(graph) == []


def test_every_room_says_what_lives_in_it():
    for name, path in modules().items():
        if is_package(name) and name not in (NAME, f"{NAME}.meshes"):
            assert len(ast.get_docstring(tree(path)) or "") > 50, name
            assert tree(path).body[1:] == [], name


def test_every_name_that_the_package_hands_on_is_there():
    """And is the thing itself, not the module that has its name."""
    package = importlib.import_module(NAME)
    assert package.__all__
    for public in package.__all__:
        assert not isinstance(getattr(package, public), types.ModuleType), public


def test_every_module_is_reached_from_a_command_or_the_api():
    """Code that only tests use is not the product's."""
    reached, waiting = set(), [f"{NAME}.__main__", f"{NAME}.api", f"{NAME}.planning.collision_cases.pytest_plugin"]
    while waiting:
        name = waiting.pop()
        if name not in reached:
            reached.add(name)
            waiting += arrows()[name]
    assert {name for name in modules() if not is_package(name)} - reached == set()


def public_names():
    """Every public function and class at the top of a module: (module, name)."""
    kinds = (ast.FunctionDef, ast.ClassDef)
    for name, path in modules().items():
        yield from (
            (name, node.name) for node in tree(path).body if isinstance(node, kinds) and not node.name.startswith("_")
        )


def used_names():
    """Every word by which the product and the examples name something, counted."""
    files = [*modules().values(), *(ROOT / "examples").glob("*.py")]
    for path in files:
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.Name):
                yield node.id
            elif isinstance(node, ast.Attribute):
                yield node.attr
            elif isinstance(node, ast.alias):
                yield node.name.rpartition(".")[2]


REGISTERED = {"run_twin", "collision_cases.pytest_plugin"}
"""Their functions are called by typer and by pytest."""


def test_every_public_function_is_used():
    """By a command, the public API or an example; never by tests alone."""
    used = set(used_names())
    unused = {f"{module}.{name}" for module, name in public_names() if name not in used}
    kept = {f"{NAME}.planning.{name}" for name in REGISTERED} | {f"{NAME}.run_twin", f"{NAME}.api"}
    assert {name for name in unused if name.rpartition(".")[0] not in kept} == set()


HEAVY = {"pybullet", "matplotlib", "numba", "trimesh", "SimpleITK", "ompl"}


def test_importing_the_planner_loads_nothing_heavy():
    code = f"import sys, {NAME}, {NAME}.planning\nassert not {HEAVY!r} & set(sys.modules), {HEAVY!r} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


def test_every_runtime_part_is_imported_by_the_product():
    """What only tests use is in the extra ``test``: nobody installs it to plan."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    tops = {name.split(".")[0] for path in modules().values() for name in imported(path)}
    known = packages_distributions()
    used = {part.lower().replace("_", "-") for top in tops for part in (top, *known.get(top, ()))}
    parts = [*project["dependencies"], *project["optional-dependencies"]["twin"]]
    assert {Requirement(part).name for part in parts} <= used
    assert tops.issuperset(MODULES["twin"])
