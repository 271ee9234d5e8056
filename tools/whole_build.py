"""For hatchling (pyproject.toml): the folders at the top go into the package, and a build that lacks a file fails."""

from __future__ import annotations

import tarfile
import zipfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

PACKAGE = "puncture_twin/"
FOLDERS = ("planning", "twin", "meshes", "puncture_twin")


class WholeBuild(BuildHookInterface[Any]):
    """Says what is built, and compares it with the tree; an editable install is the tree, and holds nothing."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Put the parts where a wheel has them."""
        if self.target_name == "wheel" and version == "standard":
            build_data["force_include"] |= self.config["wheel"]

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Raise a RuntimeError that names what is missing."""
        root, built = Path(self.root), Path(artifact_path)
        found = [path for folder in FOLDERS for path in (root / folder).rglob("*") if path.is_file()]
        files = [path.relative_to(root) for path in (*found, root / "run_twin.py") if not path.is_symlink()]
        names = {path.as_posix().removeprefix(PACKAGE) for path in files if "__pycache__" not in path.parts}
        missing = sorted(names - (names if version == "editable" else _names(built)))
        missing += [folder for folder in FOLDERS if not (root / folder / "__init__.py").is_file()]
        if missing:
            raise RuntimeError(f"{built.name} is not whole: {len(missing)} are missing, such as {missing[0]}")


def _names(built: Path) -> set[str]:
    """Of the files in it, as in the tree, the package's name left out."""
    if built.suffix == ".whl":
        with zipfile.ZipFile(built) as wheel:
            return {name.removeprefix(PACKAGE) for name in wheel.namelist()}
    with tarfile.open(built) as archive:
        return {name.partition("/")[2].removeprefix(PACKAGE) for name in archive.getnames()}
