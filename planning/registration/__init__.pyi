from .checks.checked_placement import checked_placement as checked_placement
from .checks.marker_check import check_markers as check_markers
from .conditioning import Conditioning as Conditioning
from .fits.least_squares import fit_affine as fit_affine, fit_rigid as fit_rigid, fit_triad as fit_triad
from .marker_pairs import MIN_MARKERS as MIN_MARKERS, MarkerPairs as MarkerPairs, match as match
from .placement import Placement as Placement, load_placement as load_placement
from .registration import Registration as Registration, register as register
