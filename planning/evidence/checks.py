"""Every check of what the inputs of a case say of each other, in the order in which their findings are shown."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.base.cache.array_cache import NO_CACHE, Cache
from puncture_twin.planning.base.errors import InputError, InputListError
from puncture_twin.planning.base.findings import Finding, Severity
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.evidence.coverage import absent_usual_organs, ignored_organs, short_grid, thick_slices
from puncture_twin.planning.evidence.inside_skin import outside_skin
from puncture_twin.planning.evidence.label_placement import label_placement
from puncture_twin.planning.evidence.named_places import densities, order_of_organs
from puncture_twin.planning.evidence.neighbours import odd_units, overlaps
from puncture_twin.planning.evidence.target import (
    needle_too_short,
    open_around_target,
    target_in_other_space,
    target_in_vessel,
    target_place,
)
from puncture_twin.planning.registration.checks.checked_placement import placement_findings
from puncture_twin.planning.registration.checks.markers import Surroundings
from puncture_twin.planning.registration.placement import Placement


def findings(case: Case, anatomy: Anatomy, placement: Placement | None, cache: Cache = NO_CACHE) -> tuple[Finding, ...]:
    """Hold the inputs of a case against each other.

    Args:
        case: The validated case.
        anatomy: What was read of its structures.
        placement: Where the patient lies for the robot, or None.
        cache: Where what takes long is kept.

    Returns:
        Warnings and notes, in the order in which they are shown.

    Raises:
        InputError: Everything that is refused, in one line; its code and numbers are those of the first.
    """
    places = tuple(label_placement(case, anatomy))
    on_edges = {one.code for one in places} == {"labels_on_edges"}
    placed = (
        *places,
        *target_place(case, anatomy),
        *target_in_vessel(case),
        *target_in_other_space(case, anatomy),
        *order_of_organs(case, anatomy),
        *densities(case, anatomy, on_edges=on_edges),
        *overlaps(case, anatomy, cache),
        *odd_units(anatomy),
    )
    _refuse(case, placed)  # what follows looks from the target, which must lie in the body
    if anatomy.scan is not None:
        anatomy.scan.release()  # and asks no voxel
    rest = (
        *declared(case),
        *outside_skin(case, anatomy, cache),
        *open_around_target(case, anatomy),
        *markers(case, anatomy, placement, cache),
        *needle_too_short(case, anatomy),
        *thick_slices(case, anatomy),
        *short_grid(case),
        *ignored_organs(case, anatomy),
        *absent_usual_organs(case, anatomy),
    )
    _refuse(case, rest)
    return placed + rest


def declared(case: Case) -> Iterator[Finding]:
    """What a person states of the image: no rule guesses it, and every result repeats it."""
    for sentence in case.ct.declared:
        yield Finding("declared", Severity.WARNING, sentence)


def _refuse(case: Case, found: Sequence[Finding]) -> None:
    """One line for all refusals; nothing where there are none."""
    refused = [one for one in found if one.severity is Severity.REFUSAL]
    if not refused:
        return
    kind = InputError if len(refused) == 1 else InputListError
    raise kind(
        "; ".join(one.sentence for one in refused),
        where=case.path,
        allowed="; ".join(dict.fromkeys(one.way_out for one in refused)),
        code=refused[0].code,
        numbers=refused[0].numbers,
    )


def markers(case: Case, anatomy: Anatomy, placement: Placement | None, cache: Cache) -> Iterator[Finding]:
    """What weakens the markers, or the stated transform, and what they leave open.

    Raises:
        InputError: Names or axes that have likely slipped, or a transform that cannot be; see `placement_findings`.
    """
    if placement is None:
        return
    weak = () if placement.registration is None else placement.registration.flags
    found = placement_findings(case, Surroundings(anatomy.skin, anatomy.couch), placement, cache)
    for sentence in (*(f"registration: {flag}" for flag in weak), *found.warnings):
        yield Finding("registration", Severity.WARNING, sentence)
