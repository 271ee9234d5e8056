"""The end of a process, without taking apart object by object what its memory, handed back at once, takes along.

Python's own end of a command that has planned and drawn takes 0.6 s of a processor; nobody sees what it does.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import sys
import threading
from typing import NoReturn


def leave(code: int) -> NoReturn:
    """End this process with an exit code.

    Threads are waited for and what was registered for the end is called, as at Python's own end; what was printed is
    written, and where nobody takes it, that is the code of Python's own: 120. Ctrl-C ends what is still waited for.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    threading._shutdown()  # type: ignore[attr-defined]  # Python's own, by which executors end their threads
    atexit._run_exitfuncs()
    os._exit(code if _written() else 120)


def _written() -> bool:
    """Whether all that was printed could be written."""
    for stream in (sys.stdout, sys.stderr):
        if stream is not None and not stream.closed:
            with contextlib.suppress(OSError):
                stream.flush()
                continue
            return False
    return True
