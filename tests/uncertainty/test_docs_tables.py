"""The table of docs/concepts/uncertainty.md is what its command prints."""

from itertools import islice

import numpy as np
import pytest
from places import ROOT

from benchmarks.fit_methods import FITS, rows

PAGE = ROOT / "docs" / "concepts" / "uncertainty.md"


def test_everything_that_is_predicted_stands_there_and_a_sample_comes_again():
    lines = [line for line in PAGE.read_text("utf-8").splitlines() if line.startswith("| ") and " / " in line]
    told = {}
    for name, how, *cells in (line.strip("| ").split(" | ") for line in lines):
        told[name, how] = np.array([cell.split(" / ") for cell in cells], dtype=float)
    found = {(name, how): [one.predicted for one in cells] for name, how, cells in rows(0)}
    assert told.keys() == found.keys() and len(told) == 9
    for row, values in found.items():
        np.testing.assert_allclose(told[row][:, 0], values, atol=0.006, err_msg=str(row))
    for name, how, cells in islice(rows(1500), 2):
        assert len(cells) == len(FITS)
        assert [one.realised for one in cells] == pytest.approx(told[name, how][:, 1].tolist(), rel=0.07)
