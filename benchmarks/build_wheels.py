"""Build the wheel, and beside it one that brings machine code: ``make wheel``, or this with ``--out DIR``.

The first is what ``pip wheel .`` builds, for every machine. The second is the same files, and what numba keeps of the
kernels when commands run from it: once for each class of processors that this machine is of
(`puncture_twin.planning.base.cache.brought_kernels`). It is for the Python and the system that it was built on.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from puncture_twin.planning.base.cache.brought_kernels import MADE_FOR, classes_of
from puncture_twin.planning.base.cache.kernel_cache import host_features

ROOT = Path(__file__).resolve().parents[1]
TAGS = f"--python-tag=cp{sys.version_info.major}{sys.version_info.minor}", "--platform-tag=linux_x86_64"
FIXED = {"NUMBA_CPU_FEATURES": "", "NUMBA_DISABLE_INTEL_SVML": "1"}
"""For numba: nothing beyond what the class can do, and no library that another machine may lack."""

Words = tuple[str, ...]
PROGRAM = ("-m", "puncture_twin.run_twin")
ABDOMEN = str(ROOT / "meshes" / "abdomen")
COMMANDS = (
    (*PROGRAM, "demo"),
    (*PROGRAM, "scan", ABDOMEN),
    (*PROGRAM, "search", ABDOMEN, "--certify"),
    (*PROGRAM, "check", ABDOMEN, "--theta", "64", "--beta", "98"),
)
"""For Python: what compiles most of what any command needs. The rest is compiled where it is first used."""

STAMP = "from puncture_twin.planning.base.cache.kernel_cache import kernels_stamp; print(kernels_stamp())"


def build(out: Path, commands: Sequence[Words], classes: Sequence[str]) -> list[Path]:
    """Both wheels, in a folder: the plain one first, then the one with code, unless there is no class to make it for.

    Args:
        out: The folder.
        commands: Words for Python, whose kernels are brought.
        classes: Of processors; this one must be of each, for it runs the code.
    """
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(temporary)
        wheels = [pure_wheel(work)]
        if classes:
            wheels.append(with_code(wheels[0], classes, commands, work))
        return [Path(shutil.copy(wheel, out)) for wheel in wheels]


def pure_wheel(work: Path) -> Path:
    """What pip builds of this checkout."""
    run("-m", "hatchling", "build", "--target", "wheel", "--directory", str(work / "plain"))
    (wheel,) = (work / "plain").iterdir()
    return wheel


def with_code(plain: Path, classes: Sequence[str], commands: Sequence[Words], work: Path) -> Path:
    """The wheel again, with the machine code that commands have left when they ran from it for each class."""
    run("-m", "wheel", "unpack", str(plain), "--dest", str(work / "unpacked"))
    (tree,) = (work / "unpacked").iterdir()
    here = {**FIXED, "PYTHONPATH": str(tree), "PUNCTURE_TWIN_CACHE": str(work / "cache")}
    for name in classes:
        for words in commands:
            run(*words, cwd=work, more={**here, "NUMBA_CPU_NAME": name})
    lay(tree / "puncture_twin", [run("-c", STAMP, cwd=work, more=here).strip(), *classes])
    run("-m", "wheel", "pack", str(tree), "--dest-dir", str(work))
    run("-m", "wheel", "tags", "--remove", *TAGS, str(work / plain.name))
    (wheel,) = work.glob("*.whl")
    return wheel


def run(*words: str, cwd: Path = ROOT, more: Mapping[str, str] = MappingProxyType({})) -> str:
    """What Python prints, with no settings of numba's but these."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("NUMBA_", "PYTHON"))}
    return subprocess.run(
        [sys.executable, *words], cwd=cwd, env={**kept, **more}, stdout=subprocess.PIPE, text=True, check=True
    ).stdout


def lay(package: Path, stated: list[str]) -> None:
    """Put what numba has kept beside the sources into the folder that is looked up, and take the rest away."""
    brought = package / "machine_code"
    for kept in sorted(package.rglob("__pycache__")):
        place = brought / kept.parent.relative_to(package)
        place.mkdir(parents=True, exist_ok=True)
        for file in kept.glob("*.nb?"):
            file.rename(place / file.name)
        shutil.rmtree(kept)
    (brought / MADE_FOR).write_text("\n".join(stated) + "\n", encoding="utf-8")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "wheels")
    for wheel in build(parser.parse_args().out, COMMANDS, classes_of(host_features())):
        print(f"{wheel} ({wheel.stat().st_size / 1e6:.1f} MB)")
