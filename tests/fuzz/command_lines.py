"""Command lines that nobody would type: numbers, paths and hosts of every bad kind, in any order."""

import contextlib
import io

from fuzz.mutate import NUMBERS, pick

COMMANDS = [
    *["search", "verify", "check", "compare", "plan", "rehearse", "place", "mirror", "live", "export", "register"],
    *["touch", "pivot", "markers", "calibrate", "calibrate hand-eye", "calibrate dynamics", "batch", "batch run"],
    *["batch status", "batch merge", "batch compare", "schema", "init", "selfcal", "servo", "reproduce", "scan"],
    *["confirm", "", "serch", "x" * 3000, "--help", "-h", "--version"],
]
"""Not ``demo``, which needs nothing and takes a minute, nor ``batch plan``, which takes any folder."""

KINDS = {
    "number": (
        "--theta --beta --rank --window --jobs --seeds --seconds --rate --port --certify-size --hit-radius "
        "--cross-check --diameter --count --propose --memory-mb --timeout-s"
    ),
    "word": ("--entry --noise --host --target --target-label --space --kind --engine --format --part --nonsense"),
    "path": ("--entries --targets --case --from --scan --learn --plan --recording --shots --layout --expect"),
    "out": ("--out --picture"),
    None: ("--trust-labels --force --json --arm --no-arm --no-pictures --certify - --"),
}
OPTIONS = {option: kind for kind, options in KINDS.items() for option in options.split()}
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
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(words)
    said = err.getvalue()
    assert code in (0, 1, 2), f"exit {code}: {said[-2000:]}"
    if code == 2:
        lines = [line for line in said.splitlines() if line.strip()]
        assert len(lines) == 1 and "allowed: " in lines[0] and len(lines[0]) <= 1500, said[:3000]
        assert lines[0].isprintable(), ascii(lines[0])
