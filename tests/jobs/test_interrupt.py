"""Ctrl-C where Python drops what it raises: in a callback, a destructor, a block that puts it off."""

import ctypes
import signal
import sys
import threading
import time
from contextlib import suppress
from functools import partial

import pytest
from llvmlite.binding import ModuleRef, parse_assembly

from puncture_twin.planning.base.errors import InputError
from puncture_twin.twin.jobs.exit_codes import INTERRUPTED, exit_code_of
from puncture_twin.twin.jobs.terminal import ended_by_ctrl_c, insistent_ctrl_c, print_answer


@pytest.fixture(autouse=True)
def hears(capfd):
    """As a shell in the foreground starts it; all as it was afterwards, and nothing was printed."""
    before, hook = signal.signal(signal.SIGINT, signal.default_int_handler), sys.unraisablehook
    yield
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler and sys.unraisablehook is hook
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0) and capfd.readouterr() == ("", "")
    signal.signal(signal.SIGINT, before)


def in_a_callback(work):
    ctypes.CFUNCTYPE(None)(work)()


def in_a_destructor(work):
    class Closing:
        def __del__(self):
            work()

    Closing()


@pytest.mark.parametrize("place", [in_a_callback, in_a_destructor])
def test_an_interruption_that_was_dropped_comes_again(place):
    came = []

    def swallowed():
        came.append(1)
        signal.raise_signal(signal.SIGINT)

    def command():
        place(swallowed)
        deadline = time.monotonic() + 20
        while time.monotonic() < deadline:
            time.sleep(0.01)

    told = []
    started = time.monotonic()
    assert exit_code_of(command, told.append) == INTERRUPTED and came == [1]
    assert told == ["interrupted"] and time.monotonic() - started < 10


@pytest.mark.parametrize("prints", [True, False])
def test_an_interruption_that_was_dropped_at_the_end_leaves_no_answer(prints):
    def command():
        in_a_callback(lambda: signal.raise_signal(signal.SIGINT))
        if prints:
            print_answer({}, "the answer", False)

    assert exit_code_of(command, lambda _: None) == INTERRUPTED


def test_an_error_that_a_library_makes_of_an_interruption_is_no_error():
    def command():
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        raise ValueError

    assert exit_code_of(command, lambda _: None) == INTERRUPTED


def test_what_cleans_up_is_not_interrupted_again():
    """Not by an interruption that it is the answer to, and whatever it raises and handles itself."""
    cleaned = []

    def command():
        try:
            signal.raise_signal(signal.SIGINT)
        finally:
            time.sleep(0.3)
            try:
                raise FileNotFoundError
            except FileNotFoundError:
                time.sleep(0.3)
            cleaned.append(1)

    assert exit_code_of(command, lambda _: None) == INTERRUPTED
    assert cleaned == [1]


def test_a_block_that_puts_the_signal_off_is_left_whole():
    """The renames of a folder take the signal's place while they last."""
    renamed, came = [], []

    def command():
        in_a_callback(lambda: signal.raise_signal(signal.SIGINT))
        before = signal.signal(signal.SIGINT, lambda *_: came.append(1))
        time.sleep(0.3)
        renamed.append(1)
        signal.signal(signal.SIGINT, before)
        time.sleep(5)

    assert exit_code_of(command, lambda _: None) == INTERRUPTED
    assert renamed == [1] and came


def test_a_module_is_imported_to_its_end(tmp_path, monkeypatch):
    """One that is written in C would stay half made; what imports it is not made of its failure."""
    (tmp_path / "half_imported.py").write_text(
        "import signal, time\nsignal.raise_signal(signal.SIGINT)\ntime.sleep(0.1)\nwhole = True\n"
    )
    monkeypatch.syspath_prepend(tmp_path)

    def command():
        __import__("half_imported")
        time.sleep(5)

    assert exit_code_of(command, lambda _: None) == INTERRUPTED
    assert sys.modules.pop("half_imported").whole


def test_a_program_that_is_itself_imported_can_be_interrupted(tmp_path, monkeypatch):
    (tmp_path / "started_by_import.py").write_text(
        "import signal, time\nfrom puncture_twin.twin.jobs.exit_codes import exit_code_of\n"
        "def command():\n    signal.raise_signal(signal.SIGINT)\n    time.sleep(20)\n"
        "began = time.monotonic()\ncode = exit_code_of(command, str)\nseconds = time.monotonic() - began\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    started = __import__("started_by_import")
    assert started.code == INTERRUPTED and started.seconds < 10
    del sys.modules["started_by_import"]


def test_llvms_memory_is_freed_once():
    """Wherever Ctrl-C comes while a module is made and closed; broken there, the process ended with a signal."""
    places = []

    def command(number):
        left = [number]

        def at_event(frame, *_):
            if frame.f_globals["__name__"] == ModuleRef.__base__.__module__:
                left[0] -= 1
                if left[0] == 0:
                    places.append((frame.f_code.co_name, frame.f_lineno))
                    signal.raise_signal(signal.SIGINT)

        sys.setprofile(at_event)
        module = parse_assembly("")
        module.close()
        sys.setprofile(None)
        assert module.closed
        if left[0] <= 0:
            time.sleep(5)

    number = 1
    while exit_code_of(partial(command, number), lambda _: None) == INTERRUPTED:
        number += 1
    assert {"__call__", "__enter__", "__exit__", "close", "detach"} <= {name for name, _ in places}


def test_a_command_goes_on_after_the_block_that_ctrl_c_ends():
    def command():
        with ended_by_ctrl_c():
            signal.raise_signal(signal.SIGINT)
        time.sleep(0.5)
        return 7

    assert exit_code_of(command, lambda _: None) == 7


def test_who_hears_the_signal_otherwise_keeps_it():
    heard = []
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with insistent_ctrl_c():
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    signal.signal(signal.SIGINT, signal.default_int_handler)

    def elsewhere():
        with insistent_ctrl_c():
            heard.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()
    assert heard == [signal.default_int_handler]


def test_an_interruption_while_a_refusal_is_printed_ends_the_command():
    said = []

    def print_line(line):
        said.append(line)
        if len(said) == 1:
            signal.raise_signal(signal.SIGINT)

    def command():
        raise InputError("no such file", where="joints.csv", allowed="a readable file", code="no_such_file")

    assert exit_code_of(command, print_line) == INTERRUPTED
    assert len(said) == 2 and said[0].startswith("joints.csv: ") and said[1] == "interrupted"
