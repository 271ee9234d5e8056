"""Parts of the installation that planner, map and page do without, and what is said where one is missing."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType

from puncture_twin.planning.base.errors import InputError

MODULES: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "twin": ("pybullet", "cv2", "imageio_ffmpeg"),
        "mirror": ("rtde_receive",),
        "dask": ("distributed",),
        "hdf5": ("h5py",),
    }
)
"""Extra to the modules that it installs: the simulator, the cameras' pictures, the film; a running robot; and so on."""

NO_WHEEL_FROM: Mapping[str, tuple[str, tuple[int, int]]] = MappingProxyType(
    {"pybullet": ("pybullet", (3, 12)), "rtde_receive": ("ur-rtde", (3, 13))}
)
"""What an extra leaves out of later Pythons, which have to build it: its name, and the first of them."""


def require_extra(extra: str, where: str, *, else_allowed: str = "") -> None:
    """Refuse what needs a missing part of the installation, before it works for minutes.

    Args:
        extra: A key of `MODULES`.
        where: The command or file that needs it.
        else_allowed: Another way out.

    Raises:
        InputError: A module of the extra is not installed.
    """
    missing = [name for name in MODULES[extra] if find_spec(name) is None]
    if missing:
        what = f"it needs the extra '{extra}', which is not installed (no {', '.join(missing)})"
        allowed = f"{_install_line(extra, missing)}{else_allowed}"
        raise InputError(what, where=where, allowed=allowed, code="missing_extra")


def _install_line(extra: str, missing: list[str]) -> str:
    """What installs it, from where this was installed: the project is on no index."""
    if all(name in NO_WHEEL_FROM and sys.version_info >= NO_WHEEL_FROM[name][1] for name in missing):
        names = " ".join(NO_WHEEL_FROM[name][0] for name in missing)
        version = ".".join(map(str, sys.version_info[:2]))
        return f"pip install {names} (no wheel for Python {version}: built in some minutes, with a C++ compiler)"
    parts = Path(__file__).parents[2]
    if (parts / "pyproject.toml").is_file():
        return f"pip install --editable '{parts}[{extra}]'"
    from importlib.metadata import PackageNotFoundError, distribution

    try:
        origin = json.loads(distribution("puncture-twin").read_text("direct_url.json") or "{}")
    except PackageNotFoundError:
        origin = {}
    folder = origin.get("url", "FOLDER").removeprefix("file://")
    return f"pip install '{folder}[{extra}]'" + ("" if origin else " (FOLDER: with this project's pyproject.toml)")
