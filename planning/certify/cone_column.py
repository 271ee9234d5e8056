"""The safe cone of every safe candidate, as a column and a term of the ranking."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from puncture_twin.planning.case.case import Case
from puncture_twin.planning.certify.certificate import Certificate
from puncture_twin.planning.search.candidates import CONE_CERTIFIED, Candidates
from puncture_twin.planning.search.ranking import ranked


def with_safe_cone(case: Case, found: Candidates, certificate: Certificate) -> Candidates:
    """The candidates with their safe cones, ranked again.

    Args:
        case: The case of both.
        found: A search's result.
        certificate: The case's certified map.
    """
    cone, rows = np.full(len(found), np.nan), np.flatnonzero(found.safe)
    cone[rows] = certificate.safe_cone(found.outward_ct[rows])
    return ranked(case, replace(found, safe_cone=cone, cone_source=CONE_CERTIFIED))
