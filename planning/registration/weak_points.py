"""What weakens a registration, in words."""

from __future__ import annotations

from puncture_twin.planning.registration.fit_uncertainty import FitUncertainty
from puncture_twin.planning.registration.fits.least_squares import fit_rigid
from puncture_twin.planning.registration.marker_pairs import MarkerPairs
from puncture_twin.planning.registration.residual_test import OddMarker, ResidualTest, odd_marker


def fit_doubts(test: ResidualTest, uncertainty: FitUncertainty | None) -> tuple[str, ...]:
    """Residuals that the noise does not explain and the case accepts: of the rigid fit, or of the declared errors."""
    if uncertainty is None:
        return () if test.explained else (f"{test.text()}; accepted by the case",)
    declared = uncertainty.test
    if declared.agrees:
        return ()
    return (declared.text() + ("; all errors are scaled to them" if declared.explained else "; accepted by the case"),)


def odd_marker_of(markers: MarkerPairs, fle_mm: float | None) -> OddMarker | None:
    """The marker that does not fit the others, if there is one; ``fle_mm`` is the declared noise or None."""
    return odd_marker(fit_rigid, markers.names, markers.points_ct, markers.points_base, fle_mm)
