"""Draws of the paper's experiment: how fast, and whether the two declarations come out as they should."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

from benchmarks.experiment.row import Row
from puncture_twin.twin.experiment.chen2019 import AS_FOUND, AS_STATED, find_skew, paper_strains, run_draws

DRAWS = 100_000
LESIONS_MM = (1.28, 1.39, 1.67)


def rows() -> Iterator[Row]:
    """The figures."""
    run_draws(AS_STATED, 10, np.random.default_rng(0))
    start = time.perf_counter()
    run_draws(AS_STATED, 1000, np.random.default_rng(0))
    yield Row.at_most("1,000 draws of all tables, s", time.perf_counter() - start, 1.0)
    stated, found = (run_draws(one, DRAWS, np.random.default_rng(1)) for one in (AS_STATED, AS_FOUND))
    yield Row.at_most("p of the stated errors (chi-squared, 24 degrees)", stated.probability, 1e-6)
    for row in found.printed:
        yield Row.between(f"found errors: percentile of {row.name}", row.percentile, 5, 95, ".1f")
    for row in found.joint:
        yield Row.between(f"found errors: percentile of {row.name}", row.percentile, 2.5, 97.5, ".1f")
    gains = paper_strains()
    yield Row.between("share of the squares that y against z takes", gains["y against z"], 0.7, 0.8)
    yield Row.at_most("the next strain's share", sorted(gains.values())[-2], 0.06)
    skew = find_skew()
    yield Row.between("skew by setup 2's markers, degrees", float(np.degrees(skew.angle)), 1.83, 1.85)
    for lesion, wanted in zip(skew.lesions, LESIONS_MM, strict=False):
        yield Row.between(f"{lesion.name} without it, mm", lesion.square, wanted - 0.01, wanted + 0.01)
