"""Parts of the installation that planner, map and page do without, and what is said where one is missing."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from types import MappingProxyType

from puncture_twin.planning.base.errors import InputError

MODULES: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {"twin": ("pybullet", "cv2", "imageio_ffmpeg"), "mirror": ("rtde_receive",)}
)
"""Extra to the modules that it installs: the simulator, the cameras' pictures, the film; a running robot."""


def require_extra(extra: str, command: str) -> None:
    """Refuse a command whose part of the installation is missing, before it works for minutes.

    Args:
        extra: A key of `MODULES`.
        command: What needs it.

    Raises:
        InputError: A module of the extra is not installed.
    """
    missing = [name for name in MODULES[extra] if find_spec(name) is None]
    if missing:
        what = f"it needs the extra '{extra}', which is not installed (no {', '.join(missing)})"
        raise InputError(what, where=command, allowed=f"pip install 'puncture-twin[{extra}]'")
