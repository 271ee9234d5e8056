"""Command lines that nobody would type: numbers, paths and hosts of every bad kind, in any order."""

import contextlib
import io

from fuzz.mutate import NUMBERS, pick

COMMANDS = [
    *["search", "verify", "check", "compare", "plan", "rehearse", "place", "mirror", "live", "export", "register"],
    *["touch", "pivot", "markers"],
    *[
        "calibrate",
        "calibrate hand-eye",
        "calibrate dynamics",
        "batch",
        "batch run",
        "batch status",
        "batch merge",
        "batch compare",
    ],
    *[
        "schema",
        "init",
        "selfcal",
        "servo",
        "reproduce",
        "scan",
        "confirm",
        "",
        "serch",
        "x" * 3000,
        "--help",
        "-h",
        "--version",
    ],
]
"""Not ``demo``, which needs nothing and takes a minute, nor ``batch plan``, which takes any folder."""

OPTIONS = {
    "--theta": "number",
    "--beta": "number",
    "--rank": "number",
    "--window": "number",
    "--entry": "word",
    "--entries": "path",
    "--targets": "path",
    "--case": "path",
    "--from": "path",
    "--scan": "path",
    "--learn": "path",
    "--plan": "path",
    "--recording": "path",
    "--shots": "path",
    "--noise": "word",
    "--out": "out",
    "--picture": "out",
    "--jobs": "number",
    "--seeds": "number",
    "--seconds": "number",
    "--rate": "number",
    "--port": "number",
    "--host": "word",
    "--certify-size": "number",
    "--target": "word",
    "--target-label": "word",
    "--hit-radius": "number",
    "--space": "word",
    "--trust-labels": None,
    "--force": None,
    "--cross-check": "number",
    "--kind": "word",
    "--diameter": "number",
    "--count": "number",
    "--layout": "path",
    "--propose": "number",
    "--engine": "word",
    "--format": "word",
    "--json": None,
    "--arm": None,
    "--no-arm": None,
    "--no-pictures": None,
    "--certify": None,
    "--part": "word",
    "--expect": "path",
    "--memory-mb": "number",
    "--timeout-s": "number",
    "--nonsense": "word",
    "-": None,
    "--": None,
}
WORDS = [
    *["", "fast", "fcl", "ros2", "csv", "urscript", "x" * 3000, "\0", "\u202e", "a b", "-1", "é", "liu1999"],
    *["\udcff"],
]
PATHS = [
    *["", ".", "/", "/dev/null", "/proc/self/mem", "nothing", "no/thing.toml", "x" * 5000, "a\0b", "\udcff"],
    *["~", "*", "-", "/root/../x", "é.toml", "case.toml/x", "https://example.org/case.toml"],
]


def command_line(rng, files):
    """The arguments of one command.

    Args:
        rng: Decides everything.
        files: Paths that exist, none of which is a whole case: a command that succeeds would take minutes.
    """
    paths = [*PATHS, *files, *files]
    words = pick(rng, COMMANDS).split(" ")  # none at all would be the demo
    positional = [pick(rng, paths), pick(rng, paths), pick(rng, paths), pick(rng, WORDS), pick(rng, NUMBERS)]
    words += ["nothing"] if words == ["selfcal"] else []  # without a case it takes the embedded one, and a minute
    words += positional[: int(rng.choice([0, 1, 1, 1, 1, 2, 4]))]
    for _ in range(int(rng.integers(5))):
        option = pick(rng, list(OPTIONS))
        value = {"number": pick(rng, NUMBERS), "path": pick(rng, paths), "out": pick(rng, [*PATHS, *files]), None: None}
        given = value.get(OPTIONS[option], pick(rng, WORDS))
        words += [option] if given is None or rng.random() < 0.05 else [option, given]
    return words


def run(main, words):
    """Run a command line in this process; asserts what must hold of any."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(words)
    said = err.getvalue()
    assert code in (0, 1, 2), f"exit {code}: {said[-2000:]}"
    if code == 2:
        lines = [line for line in said.splitlines() if line.strip()]
        assert len(lines) == 1 and "allowed: " in lines[0] and len(lines[0]) <= 1500, said[:3000]
        assert lines[0].isprintable(), ascii(lines[0])
