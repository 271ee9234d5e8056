"""The embedded cases: meshes and point lists made by ``python -m tools.phantoms``, and their case files."""

from pathlib import Path

__all__ = ["folder"]


def folder() -> Path:
    """The folder that holds ``abdomen/``, ``carton/`` and ``manifest.json``."""
    return Path(__file__).resolve().parent
