"""At the terminal: help, a reader who goes away, folders that name themselves, widths, colours, and the end."""

import errno
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from places import ROOT

from puncture_twin.meshes import folder
from puncture_twin.run_twin import main
from puncture_twin.twin.jobs.exit_codes import PROGRAM_FAILED, exit_code_of
from puncture_twin.twin.jobs.terminal import default_out

CARTON = folder() / "carton" / "case_m.toml"
ONE = ["check", str(CARTON), "--theta", "0", "--beta", "0", "--no-arm"]


def test_without_a_command_the_help_is_printed(capsys):
    assert main([]) == 0
    shown = capsys.readouterr().out
    assert {"demo", "search", "reproduce"} <= set(re.findall(r"\w+", shown))
    assert "docs/words.md" in shown


@pytest.mark.parametrize("command", [[], ["search"], ["export"]])
def test_a_narrow_terminal_gets_the_whole_help(command, monkeypatch, capsys):
    """Every option is there, in 40 columns too; without colours where nobody wants them."""
    monkeypatch.setenv("NO_COLOR", "1")
    shown = []
    for columns in ("200", "40"):
        monkeypatch.setenv("COLUMNS", columns)
        assert main([*command, "--help"]) == 0
        shown.append(capsys.readouterr().out)
    wide, narrow = shown
    options = set(re.findall(r"--[a-z][a-z-]+", wide))
    assert {"--help"} <= options <= set(re.findall(r"--[a-z][a-z-]+", narrow))
    assert len(narrow.splitlines()) > len(wide.splitlines())
    assert "\x1b" not in narrow and "…" not in narrow


def run_program(arguments, environment=(), code="", **options):
    """The program in a process of its own."""
    return subprocess.run(
        [sys.executable, "-c", f"{code}\n{PROGRAM}", *arguments],
        env={**os.environ, **dict(environment)},
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        check=False,
        **{"stdout": subprocess.PIPE, **options},
    )


PROGRAM = "from puncture_twin.run_twin import program\nprogram()"


@pytest.mark.parametrize("arguments", [["search", "--help"], [*ONE, "--json"]])
def test_an_output_that_nobody_reads_ends_as_the_shell_has_it(arguments):
    """141, never 1 (which is an answer), and no traceback."""
    reader, writer = os.pipe()
    os.close(reader)
    try:
        done = run_program(arguments, stdout=writer)
    finally:
        os.close(writer)
    assert (done.returncode, "Traceback" in done.stderr, "BrokenPipe" in done.stderr) == (141, False, False)


def test_a_pipe_that_broke_elsewhere_is_a_failure(capsys):
    """A worker or a robot that went away is not the reader of stdout."""

    def broken():
        raise BrokenPipeError(32, "Broken pipe")

    assert exit_code_of(broken, print) == PROGRAM_FAILED
    assert "BrokenPipeError" in capsys.readouterr().err


@pytest.mark.parametrize("name", [None, "out/table"])
def test_a_disk_that_takes_no_more_is_told_in_one_line(name, capsys):
    """Of whatever file, one that a library writes too: exit code 3, and no traceback."""

    def full():
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), name)

    said = []
    assert exit_code_of(full, said.append) == PROGRAM_FAILED
    (line,) = said
    assert "No space left" in line and (name or "kernels") in line
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(("words", "completed"), [(["batch", "co"], {"compare"}), (["check", "--th"], {"--theta"})])
def test_a_shell_completes_commands_and_options(words, completed):
    """As bash asks for it, by typer's own rule; nothing else is said."""
    asked = {
        "_RUN_TWIN_COMPLETE": "complete_bash",
        "COMP_WORDS": " ".join(["run-twin", *words]),
        "COMP_CWORD": str(len(words)),
    }
    done = run_as_installed(asked)
    assert (done.returncode, done.stderr, set(done.stdout.split())) == (0, "", completed)


def run_as_installed(environment):
    """The command under the name that is installed."""
    return run_program([], environment, "import sys\nsys.argv[0] = 'run-twin'")


@pytest.mark.parametrize(
    ("source", "name"),
    [
        ("liver", "liver-search"),
        ("liver/", "liver-search"),
        ("liver/case.toml", "liver-search"),
        ("carton/case_m.toml", "carton-case_m-search"),
        ("out/liver-plan/plan.json", "liver-plan-search"),
        ("chen2019", "chen2019-search"),
    ],
)
def test_a_folder_is_named_after_case_and_command(source, name):
    assert default_out(Path(source), "search") == Path("out") / name


def test_a_search_writes_there_without_out(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "carton").symlink_to(CARTON.parent)
    case = tmp_path / "coarse.toml"
    text = CARTON.read_text().replace("step_deg = 2.0", "step_deg = 15.0")
    case.write_text(re.sub(r'"([\w.]+\.(?:ply|csv))"', r'"carton/\1"', text))
    assert main(["search", str(case), "--no-arm", "--no-pictures"]) == 0
    assert [one.name for one in (tmp_path / "out").iterdir()] == [f"{tmp_path.name}-coarse-search"]
    capsys.readouterr()


def test_neither_width_nor_colour_changes_what_is_printed():
    """A narrow terminal wraps; no line and no table is broken by us, and nothing is coloured."""
    looks = ({"COLUMNS": "200", "FORCE_COLOR": "1"}, {"COLUMNS": "40", "NO_COLOR": "1"})
    wide, narrow = (run_program(ONE, look) for look in looks)
    assert (wide.returncode, wide.stdout) == (narrow.returncode, narrow.stdout)
    assert wide.returncode == 0 and wide.stdout and "\x1b" not in wide.stdout


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="/dev/full is of Linux")
@pytest.mark.parametrize(("arguments", "unbuffered"), [(["--help"], "1"), (ONE, "")])
def test_a_full_disk_under_stdout_is_told_in_one_line(arguments, unbuffered):
    with Path("/dev/full").open("w") as full:
        done = run_program(arguments, {"PYTHONUNBUFFERED": unbuffered}, stdout=full)
    told = [line for line in done.stderr.splitlines() if "stdout" in line]
    assert done.returncode == PROGRAM_FAILED
    assert told == ["stdout: No space left on device; allowed: an output that can be written to"]
    assert "Traceback" not in done.stderr


ENDS = """
import atexit, os, sys, tempfile, threading, time
from concurrent.futures import ThreadPoolExecutor
from puncture_twin.twin.jobs.terminal import leave

class Last:
    def __del__(self):
        os.write(2, b"taken apart")

kept = Last()
folder = tempfile.TemporaryDirectory()
pool = ThreadPoolExecutor(1)
pool.submit(time.sleep, 0.2).add_done_callback(lambda _: print("work is over"))
threading.Thread(target=lambda: (time.sleep(0.4), print("thread is over"))).start()
atexit.register(lambda: print("called, thread and folder there:", threading.active_count(), os.path.isdir(folder.name)))
print(folder.name)
leave(7)
"""


def test_what_others_count_on_is_done_and_nothing_more():
    """Threads, executors, what was registered, what was printed; objects are not taken apart."""
    done = subprocess.run([sys.executable, "-c", ENDS], capture_output=True, text=True, check=False, timeout=60)
    folder, *rest = done.stdout.splitlines()
    assert (done.returncode, done.stderr) == (7, "")
    assert rest == ["work is over", "thread is over", "called, thread and folder there: 1 True"]
    gone = subprocess.run(["test", "-e", folder], check=False)
    assert gone.returncode == 1


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="/dev/full is of Linux")
def test_an_output_that_cannot_be_written_is_told():
    """As by Python itself: 120."""
    code = "from puncture_twin.twin.jobs.terminal import leave; print('answer'); leave(0)"
    with Path("/dev/full").open("w") as full:
        buffered = {**os.environ, "PYTHONUNBUFFERED": ""}
        done = subprocess.run([sys.executable, "-c", code], stdout=full, env=buffered, check=False)
    assert done.returncode == 120


def test_who_does_not_wait_for_the_end_sees_no_traceback():
    """Ctrl-C once the command is over ends the process, as it does one that knows nothing of it."""
    code = (
        "import os, signal, threading, time\nfrom puncture_twin.twin.jobs.terminal import leave\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "def interrupt():\n    time.sleep(0.5)\n    os.kill(os.getpid(), signal.SIGINT)\n    time.sleep(20)\n"
        "threading.Thread(target=interrupt).start()\n"
        "leave(0)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, b"", b"")
