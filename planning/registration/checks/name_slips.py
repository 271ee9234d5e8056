"""Would a slip in the marker names pass unnoticed? The case's own permutations, and whether the robot's place tells.

Names come from the user and are normally right; the danger is a slip. Permuted names that fit as well within the noise
leave no trace in the residuals, and skin and couch are blind to them: markers stay markers. Only the place where the
robot would stand can exclude a permutation; where it does not, the case is refused, or its user has checked the names.
"""

from __future__ import annotations

from collections.abc import Sequence

from puncture_twin.planning.anatomy.skin import Skin
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.registration.checks.touching import place_excluded
from puncture_twin.planning.registration.fits.marker_ambiguity import Renaming, renamings
from puncture_twin.planning.registration.registration import Registration

ALLOWED_NAMES = (
    "markers without a symmetry, fle_mm as small as it is known, or registration.accept_symmetry = true once the "
    "names have been checked at the patient"
)


def check_names(case: Case, skin: Skin, registration: Registration) -> tuple[str, ...]:
    """Compare the names with their permutations; returns warnings, one sentence each.

    Raises:
        InputError: Permuted names fit much better; or they fit as well, nothing excludes them, and the case does not
            accept that.
    """
    test, where = registration.residual_test, f"{case.path}: registration"
    found, complete = renamings(registration.markers, case.target_ct, test.alike_mm)
    better = [one for one in found if test.contradicted_by(one.fre_mm)]
    given = f"as named, FRE is {test.fre_mm:.2f} mm"
    if better:
        what = f"the marker names look permuted: {min(better, key=lambda one: one.fre_mm).text()}; {given}"
        raise InputError(what, where=where, allowed="the names as the markers were touched")
    excluded = [place_excluded(case, skin.mesh, one.T_base_ct) for one in found]
    possible = [one for one, why in zip(found, excluded, strict=True) if not why]
    if possible and not _accepted(case):
        what = f"a slip in the marker names would pass unnoticed: {_worst(possible)}; {given}"
        raise InputError(what, where=where, allowed=ALLOWED_NAMES)
    warnings = () if complete else (f"of {len(registration.markers)} markers only swaps of two names were tested",)
    if possible:
        return (*warnings, f"marker names: {_worst(possible)}; accepted by accept_symmetry, {given}")
    if found:
        return (*warnings, f"marker names: {_worst(found)}; told apart by this alone: then {excluded[0]}")
    return warnings


def _accepted(case: Case) -> bool:
    stated = case.registration or case.robot.stated
    return stated is not None and stated.accept_symmetry


def _worst(found: Sequence[Renaming]) -> str:
    """The first, which puts the target farthest away, and how many more there are."""
    more = len(found) - 1
    return found[0].text() + (f" (and {more} more permutation{'s' if more > 1 else ''})" if more else "")
