"""When Python looks for circles of objects: late, then seldom, and as it was before once a command is over."""

import gc
import subprocess
import sys
import weakref

from puncture_twin.twin.jobs import collector
from puncture_twin.twin.jobs.collector import LATER_EVERY, late_collection


class Holder:
    """Holds itself."""

    def __init__(self):
        self.me = self


def test_what_was_in_force_is_so_again_afterwards():
    """Thresholds, callbacks, and what is looked through."""
    before = gc.get_threshold(), list(gc.callbacks), gc.get_freeze_count()
    with late_collection():
        assert gc.get_threshold()[0] == collector.FIRST_AT
    assert (gc.get_threshold(), list(gc.callbacks), gc.get_freeze_count()) == before


def test_after_the_first_look_circles_are_looked_for_at_every_so_many_objects():
    """A command that runs for hours holds the garbage of 20,000 objects, not of all."""
    with late_collection():
        gc.collect()
        assert gc.get_threshold()[0] == LATER_EVERY
        assert gc.get_freeze_count() > 0
        gone = weakref.ref(Holder())
        kept = [[] for _ in range(LATER_EVERY + 100)]
        assert gone() is None
    assert len(kept) == LATER_EVERY + 100


def test_the_first_look_comes_by_itself(monkeypatch):
    """As soon as so many objects are there."""
    monkeypatch.setattr(collector, "FIRST_AT", 5_000)
    with late_collection():
        gone = weakref.ref(Holder())
        kept = [[] for _ in range(6_000)]
        assert gc.get_threshold()[0] == LATER_EVERY
        assert gone() is None
    assert len(kept) == 6_000


AT_EXIT = """
import atexit, gc
from puncture_twin.run_twin import main
atexit.register(lambda: print(gc.get_freeze_count() > len(gc.get_objects())))
main(["--version"])
main(["--version"])
"""


def test_at_the_end_nothing_that_a_command_loaded_is_looked_through():
    """It is set aside, after however many commands."""
    done = subprocess.run([sys.executable, "-c", AT_EXIT], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "True"


def test_a_library_that_counts_what_is_left_of_it_has_nothing_to_say():
    """OMPL prints a list of its functions where Python does not look for them at the end."""
    code = "import ompl.base; from puncture_twin.run_twin import main; main(['--version'])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == ""
