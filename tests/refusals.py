"""What must be refused: by its code, and the one line of a command."""

import json
from contextlib import contextmanager

import pytest

from puncture_twin.planning.base.errors import InputError
from puncture_twin.run_twin import main
from puncture_twin.twin.jobs.exit_codes import BAD_INPUT


@contextmanager
def refused(code, *values, by=InputError):
    """Within, an error of this code is raised that names these values; yields it as pytest does."""
    with pytest.raises(by) as caught:
        yield caught
    assert caught.value.code == code, caught.value
    line = str(caught.value)
    assert "\n" not in line and all(str(value) in line for value in values), line


def refused_command(arguments, capfd, code, *values):
    """Run a command that must be refused with this code, in one line that names these values; returns the line."""
    assert main([*map(str, arguments), "--json"]) == BAD_INPUT
    captured = capfd.readouterr()
    error = json.loads(captured.out)["error"]
    said = (one for one in captured.err.splitlines() if one.strip() and not one.startswith("warning: "))
    (line,) = [one for one in said if ", took " not in one]  # which a slow machine says of its stages
    assert set(error) == {"code", "sentence", "where", "allowed", "numbers"}
    assert error["code"] == code and error["sentence"] in line, (error, line)
    assert error["allowed"] and f"; allowed: {error['allowed']}" in line, (error, line)
    assert all(value in line for value in values), line
    return line
