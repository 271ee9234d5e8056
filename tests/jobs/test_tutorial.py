"""The tutorial's commands, as written, one after another in an empty folder."""

import re
import shlex

import pytest
from places import ROOT

from puncture_twin.run_twin import main

PAGE = ROOT / "docs" / "how-to" / "chen-2019.md"
COMMANDS = re.findall(r"^run-twin (.+)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)

SAID = {
    "reproduce chen2019": "all within their limits",
    "reproduce chen2019 --experiment": "2.99 -> 1.28 mm",
    "scan": "standard dev.  0.29 in the plane, 1.44 along the bed",
    "touch": "5 markers touched in 6",
    "register": "1.8 degrees out of square, y against z",
    "calibrate dynamics": "rms where it is most  0.0018 mm",
    "check": "0.62 to hit; 0.05 to touch bolt_h",
    "rehearse": "virtual TCP off its point",
}
"""What the page says of each."""


def said_by(command):
    """What the page says of a command: of its longest name that is listed."""
    return SAID[max((name for name in SAID if command.startswith(name)), key=len)]


def test_the_page_has_a_command_for_each_of_its_sections():
    assert len(COMMANDS) == 8
    assert {said_by(command) for command in COMMANDS} == set(SAID.values())


@pytest.mark.usefixtures("short_film")
@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_says_what_the_page_says(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = [str(ROOT / word) if word.startswith("meshes/") else word for word in shlex.split(command)]
    assert main(words) == 0
    assert said_by(command) in capsys.readouterr().out
