"""Cut a release: ``make release VERSION=0.2.0``, from a tree without changes, after ``make test``.

The version goes into pyproject.toml and CITATION.cff, the changelog's unreleased section gets its number and the day.
Linters and the quick tests run; the wheel is built into out/wheels, installed with `constraints.txt` into an empty
environment, and answers there. Then all of it is one commit with an annotated tag. Where any of that fails, the files
are as they were, and there is neither commit nor tag. Nothing is pushed.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Callable, Sequence
from datetime import date
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FILES = ("pyproject.toml", "CITATION.cff", "CHANGELOG.md")
UNRELEASED = "## [Unreleased]\n"
MOST_LINES = 120
"""Of a section: two printed pages."""

VERSION = re.compile(r"(0|[1-9]\d*)\.(0|[1-9]\d*)\.(0|[1-9]\d*)")


class RefusedError(Exception):
    """Why no release is cut, and what would be."""


def release(root: Path, version: str, day: date, checks: Callable[[Path, str], None]) -> str:
    """Cut it; returns the tag.

    Args:
        root: A clone without changes.
        version: Three numbers, higher than those of pyproject.toml.
        day: Of the changelog's heading.
        checks: Called with the clone, whose files have the version by then, and the version; raises where one fails.

    Raises:
        RefusedError: Nothing was changed.
    """
    tag, section = f"v{version}", refuse(root, version)
    try:
        _replace(root / "pyproject.toml", r'^version = ".*"$', f'version = "{version}"')
        _replace(root / "CITATION.cff", r"^version: .*$", f"version: {version}")
        _replace(root / "CHANGELOG.md", re.escape(UNRELEASED), f"{UNRELEASED}\n## [{version}] - {day}\n")
        checks(root, version)
        git(root, "commit", "--quiet", "--message", f"release: {version}", *FILES)
    except BaseException:
        git(root, "checkout", "--quiet", "HEAD", "--", *FILES)
        raise
    git(root, "tag", "--annotate", "--cleanup=verbatim", "--message", f"{version}\n\n{section}", tag)
    return tag


def refuse(root: Path, version: str) -> str:
    """The unreleased section, where a release of this version can be cut.

    Raises:
        RefusedError: The version, the tree, the tag or the changelog is not what it must be.
    """
    now = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["project"]["version"]
    if not VERSION.fullmatch(version) or _numbers(version) <= _numbers(now):
        raise RefusedError(f"version '{version}'; allowed: three numbers, higher than {now}, as in VERSION=0.2.0")
    if changed := git(root, "status", "--porcelain").splitlines():
        raise RefusedError(f"the tree has changes, such as '{changed[0].strip()}'; allowed: none (commit them)")
    if git(root, "tag", "--list", f"v{version}"):
        raise RefusedError(f"the tag v{version} is there; allowed: a version that was not released")
    section = (root / "CHANGELOG.md").read_text("utf-8").partition(UNRELEASED)[2].partition("\n## ")[0].strip()
    if not 0 < section.count("\n") + bool(section) <= MOST_LINES:
        lines = section.count("\n") + bool(section)
        raise RefusedError(f"CHANGELOG.md: [Unreleased] has {lines} lines; allowed: 1 to {MOST_LINES}")
    return section


def check_all(root: Path, version: str) -> None:
    """Linters, quick tests, and the wheel in an empty environment.

    Raises:
        RefusedError: One of them fails.
    """
    run(root, "make", "lint", "quick")
    wheels = root / "out" / "wheels"
    run(root, sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(wheels), ".")
    with tempfile.TemporaryDirectory() as scratch:
        run(root, sys.executable, "-m", "venv", scratch)
        python, wheel = f"{scratch}/bin/python", str(wheels / f"puncture_twin-{version}-py3-none-any.whl")
        run(root, python, "-m", "pip", "install", "--quiet", "--constraint", "constraints.txt", wheel)
        run(root, python, "-m", "pip", "check")
        elsewhere = Path(scratch)
        if f" {version}" not in f" {run(elsewhere, python, '-m', 'puncture_twin', '--version')}":
            raise RefusedError(f"{wheel} says another version")
        run(elsewhere, python, "-m", "puncture_twin", "check", str(root / "meshes" / "abdomen"), "--no-arm")


def run(folder: Path, *words: str) -> str:
    """What a command prints.

    Raises:
        RefusedError: It fails; with the end of what it said.
    """
    print(" ".join(words), flush=True)
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RefusedError(f"{' '.join(words)}: exit code {done.returncode}\n{(done.stdout + done.stderr)[-3000:]}")
    return done.stdout


def git(root: Path, *words: str) -> str:
    """What git prints."""
    return subprocess.run(["git", *words], cwd=root, stdout=subprocess.PIPE, text=True, check=True).stdout


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(map(int, version.split(".")))


def _replace(file: Path, pattern: str, text: str) -> None:
    """Replace the first line that fits."""
    changed, count = re.subn(pattern, lambda _: text, file.read_text("utf-8"), count=1, flags=re.MULTILINE)
    if not count:
        raise RefusedError(f"{file.name}: no line like {pattern}")
    file.write_text(changed, "utf-8")


def main(arguments: Sequence[str] | None = None) -> int:
    """Cut it, or say in a line why not."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("version", nargs="?", default="")
    try:
        tag = release(ROOT, parser.parse_args(arguments).version, date.today(), check_all)
    except RefusedError as error:
        print(error, file=sys.stderr)
        return 2
    print(f"{tag} is cut; out/wheels has its wheel. To publish: git push --follow-tags")
    return 0


if __name__ == "__main__":
    sys.exit(main())
