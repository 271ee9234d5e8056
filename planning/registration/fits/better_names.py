"""Where named markers do not fit: which permutations of their names would, so that a refusal names the slip."""

from __future__ import annotations

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.registration.fits.marker_ambiguity import Renaming, renamings
from puncture_twin.planning.registration.marker_pairs import MarkerPairs
from puncture_twin.planning.registration.residual_test import MAX_FRE_MM

BETTER = 3.0
"""So many times better than the given names a permutation must fit to be named."""

SHOWN = 3
"""Permutations that a message lists."""


def better_names(markers: MarkerPairs, target_ct: Floats, fre_mm: float) -> str:
    """All permutations of the names that fit where the given ones do not, the best first; empty for none.

    Args:
        markers: As the user named them.
        target_ct: Shape (3,), mm.
        fre_mm: Of their rigid fit.
    """
    found = renamings(markers, target_ct, min(fre_mm / BETTER, MAX_FRE_MM), moving_mm=0.0).found
    if not found:
        return ""
    best = sorted(found, key=lambda one: one.fre_mm)
    more = f" (and {len(best) - SHOWN} more)" if len(best) > SHOWN else ""
    return f"; {', or '.join(_text(one) for one in best[:SHOWN])}{more}"


def _text(one: Renaming) -> str:
    return f"with {one.slip} they would fit (FRE {one.fre_mm:.2f} mm)"
