"""The flag ``--collision-update``: light, since every run of pytest wants it."""

from __future__ import annotations

import pytest

UPDATE = "--collision-update"
SEVERAL = f"{UPDATE} rewrites files: run it in one process, without -n"


def add_flag(parser: pytest.Parser) -> None:
    """Tell pytest of it."""
    text = "rewrite the numbers that *.collision.toml files expect; never a verdict"
    parser.getgroup("collision").addoption(UPDATE, action="store_true", help=text)


def updating(config: pytest.Config) -> bool:
    """Whether numbers are to be rewritten.

    Raises:
        UsageError: By several processes at once.
    """
    wanted = bool(config.getoption(UPDATE))
    if wanted and config.getoption("numprocesses", None):
        raise pytest.UsageError(SEVERAL)
    return wanted
