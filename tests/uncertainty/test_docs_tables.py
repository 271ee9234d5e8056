"""The table of docs/concepts/uncertainty.md is what its command prints."""

from itertools import islice

import numpy as np
import pytest
from places import ROOT

from benchmarks.fit_methods import FITS, rows

PAGE = ROOT / "docs" / "concepts" / "uncertainty.md"


def printed():
    """(whose, how touched) to (predicted, realised) of every column."""
    lines = [line for line in PAGE.read_text("utf-8").splitlines() if line.startswith("| ") and " / " in line]
    cells = [line.strip("| ").split(" | ") for line in lines]
    return {(one[0], one[1]): np.array([cell.split(" / ") for cell in one[2:]], dtype=float) for one in cells}


def test_everything_that_is_predicted_stands_there():
    told = printed()
    found = {(name, how): [one.predicted for one in cells] for name, how, cells in rows(0)}
    assert told.keys() == found.keys() and len(told) == 9
    for row, values in found.items():
        np.testing.assert_allclose(told[row][:, 0], values, atol=0.006, err_msg=str(row))


def test_a_sample_of_what_was_realised_comes_again():
    """1,500 trials of the first two rows, all columns: to 7 % of the 20,000 that stand there."""
    told = printed()
    for name, how, cells in islice(rows(1500), 2):
        assert len(cells) == len(FITS)
        assert [one.realised for one in cells] == pytest.approx(told[name, how][:, 1].tolist(), rel=0.07)
