from .checks.marker_check import check_markers as check_markers, checked_placement as checked_placement
from .conditioning import Conditioning as Conditioning
from .placement import Placement as Placement, load_placement as load_placement
from .registration import (
    MIN_MARKERS as MIN_MARKERS,
    MarkerPairs as MarkerPairs,
    Registration as Registration,
    fit_affine as fit_affine,
    fit_rigid as fit_rigid,
    fit_triad as fit_triad,
    match as match,
    register as register,
)
