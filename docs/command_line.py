"""Write docs/reference/command-line.md from the command line's own help: ``python docs/command_line.py``."""

from pathlib import Path

import typer

from puncture_twin.run_twin import app

HEAD = """# Command line

`run-twin COMMAND` where the package is installed, `python run_twin.py COMMAND` from a checkout; without a command it
prints its help, and `--version` prints the version. Exit codes: 0 done; 1 done, and the answer is no; 2 bad input, one
line that says what, where and what is allowed; 3 the program failed; 130 interrupted; 141 the reader closed the pipe
(as in `| head -1`). With `--json` stdout holds one JSON object and nothing else; progress goes to stderr. Where bad
input is refused, or nothing is found, the object has only `error`: `code` (the kind of mistake:
[sentences.md](sentences.md)), `sentence`, `where`, `allowed`, `numbers`; the line is also on stderr. Without
`--out` files go to `out/`, into a folder named after case and command (`out/abdomen-search`). What is written:
[outputs.md](outputs.md).

`run-twin --install-completion` lets bash, zsh, fish or PowerShell, whichever it is called from, complete commands and
options from its next start on (1 from any other); `--show-completion` prints the script instead, as
`_RUN_TWIN_COMPLETE=source_bash run-twin` does wherever it is called from.

*Written by `python docs/command_line.py` from the help of each command (`run-twin COMMAND --help`).*
"""

LIMITS = "`search.min_hit`, `max_touch`, `max_touch_of` allow"
NO = {
    "demo": "as `rehearse`",
    "schema": "never: it only reports",
    "init": "never: a case is written, or refused",
    "search": "no direction is safe",
    "verify": "never: a cell without proof, or a damaged certificate, is refused",
    "check": "the candidate, or a row of the list, is rejected",
    "compare": "one of the two paths is rejected",
    "plan": "nothing is safe, the named direction is rejected, or no approach to it was found",
    "rehearse": "there is no plan; the tip misses the target or the true needle or the arm touches what it must not, "
    f"in the trial that is executed; with `--seeds`, also if fewer hit or more touch than {LIMITS}",
    "rehearse --sweep": "the sweep stops before its end",
    "rehearse --guidance A,B": f"by none of the ways the trials keep to what {LIMITS}",
    "markers": "no markers are found, too few, too many, or of several kinds; with `--propose` no places",
    "touch": "too few markers were touched for a registration",
    "pivot": "the touches contradict each other",
    "place": "no direction is safe for the organs, or no placement reaches one",
    "mirror": "never: it only reports",
    "live": "never: it answers until Ctrl-C (130)",
    "export": "there is no plan to write, or the case now rejects it",
    "register": "never: markers that contradict each other are refused",
    "selfcal": "never: a recording that does not determine the calibration is refused",
    "calibrate hand-eye": "never: poses that do not determine the calibration, or contradict it, are refused",
    "calibrate dynamics": "with `--record` the arm has no space for an exciting motion",
    "servo": "a servo did not converge",
    "scan": "never: it only reports",
    "confirm": "the line is not safe, or the needle had better be moved",
    "confirm --learn": "never: it only reports",
    "reproduce": "one of the paper's numbers is outside its limits",
    "batch plan": "never: it only reports",
    "batch run": "a case of the part has no verdict (3 if the program failed on one)",
    "batch status": "never: it only reports",
    "batch merge": "a case has no row, or differs from `--expect`",
    "batch compare": "never: it only reports",
}
"""Where a command that is done has the answer no (`twin.jobs.exit_codes.RULES`), or finds nothing to answer with."""


def option_row(parameter):
    """A row of the table: names, what it is, default."""
    names = parameter.opts + parameter.secondary_opts
    shown = parameter.metavar if parameter.param_type_name == "argument" else ", ".join(names)
    silent = parameter.default is None or isinstance(parameter.default, bool)
    default = "required" if parameter.required else "" if silent else f"`{parameter.default}`"
    default = "`out/CASE-COMMAND`" if names == ["--out"] and silent else default
    return f"| `{shown}` | {(parameter.help or '').replace('|', ' or ')} | {default} |"


def commands(group, before=""):
    """Every command with its whole name, those of a group after another."""
    for name, command in group.commands.items():
        whole = f"{before}{name}"
        if hasattr(command, "commands"):
            yield from commands(command, f"{whole} ")
        else:
            yield whole, command


def main() -> None:
    """Write the page."""
    lines = [HEAD, "| command | exit code 1, the answer is no, where |", "|---|---|"]
    lines += [*(f"| `{name}` | {no} |" for name, no in NO.items()), ""]
    for name, command in commands(typer.main.get_command(app)):
        lines += [f"## `{name}`", command.help, "", "| | | default |", "|---|---|---|"]
        lines += [*(option_row(one) for one in command.params), ""]
    path = Path(__file__).parent / "reference" / "command-line.md"
    path.write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
