"""Structure-aware fuzzing of every reader and of the command line: a few thousand runs; `make fuzz` does 100,000.

Each run may end in an `InputError` (one line, exit 2) or in a value that is whole; in 2 s and 1 GB at most.
"""

from dataclasses import replace

import pytest
from fuzz.runner import Fuzzer
from fuzz.targets import read_case, whole_case

RUNS = 400  # of each of the four parts, which run side by side


@pytest.fixture(scope="module")
def fuzzer(tmp_path_factory):
    return Fuzzer(tmp_path_factory.mktemp("fuzz"))


def test_every_file_of_the_corpus_is_whole(fuzzer):
    fuzzer.check_corpus()


@pytest.mark.parametrize("part", range(4))
def test_mutated_files_and_command_lines(fuzzer, part):
    """Readers refuse by InputError alone, commands exit 0, 1 or 2 with one line, and what is accepted is whole."""
    wrong = [(number, fuzzer.run(number)) for number in range(part * RUNS, (part + 1) * RUNS)]
    assert not [(number, what) for number, what in wrong if what is not None]


def test_the_runs_reach_the_readers(fuzzer):
    """Some mutated files are accepted and most are refused: runs that all ended one way would show nothing."""
    before = sum(fuzzer.accepted.values()), sum(fuzzer.refused.values())
    for number in range(100_000, 100_150):
        fuzzer.run(number)
    accepted, refused = sum(fuzzer.accepted.values()) - before[0], sum(fuzzer.refused.values()) - before[1]
    assert accepted >= 5
    assert refused >= 75


def test_a_case_that_lost_a_structure_is_noticed(fuzzer):
    """The check of the case reader can fail: a stated number that is not there."""
    case, anatomy = read_case(fuzzer.corpus / "full.toml")
    whole_case((case, anatomy))
    with pytest.raises(AssertionError):
        whole_case((case, replace(anatomy, structures=anatomy.structures[1:])))
    with pytest.raises(AssertionError):
        whole_case((replace(case, stated_structures=case.stated_structures + 1), anatomy))


def test_a_run_is_decided_by_its_number(fuzzer):
    fuzzer.run(7)
    first = fuzzer.last
    fuzzer.run(8)
    fuzzer.run(7)
    assert fuzzer.last == first
