"""Commands that must be refused."""

from puncture_twin.run_twin import main
from puncture_twin.twin.jobs.exit_codes import BAD_INPUT


def refused(arguments, capfd):
    """Run a command that must be refused; returns its one line."""
    assert main([str(argument) for argument in arguments]) == BAD_INPUT
    captured = capfd.readouterr()
    assert captured.out == ""
    lines = [line for line in captured.err.splitlines() if line.strip() and ", took " not in line]  # a slow machine's
    assert len(lines) == 1, captured.err
    assert "allowed: " in lines[0]
    return lines[0]
