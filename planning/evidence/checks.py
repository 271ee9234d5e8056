"""Every check of what the inputs of a case say of each other, in the order in which their findings are shown.

Here too is what they leave out: between two slices, between two angles of the search, and organs that nobody named.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.default_roles import default_role
from puncture_twin.planning.anatomy.regions import absent_organs
from puncture_twin.planning.anatomy.structure import label_grids
from puncture_twin.planning.base.cache.array_cache import NO_CACHE, Cache
from puncture_twin.planning.base.errors import Finding, InputError, InputListError, Severity
from puncture_twin.planning.base.text import first_few
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.collision.workcell import ARM_PADDING_MM
from puncture_twin.planning.evidence import target
from puncture_twin.planning.evidence.inside_skin import odd_units, outside_skin, overlaps
from puncture_twin.planning.evidence.label_placement import label_placement
from puncture_twin.planning.evidence.named_places import densities, order_of_organs
from puncture_twin.planning.registration.checks.checked_placement import placement_findings
from puncture_twin.planning.registration.checks.markers import Surroundings
from puncture_twin.planning.registration.placement import Placement
from puncture_twin.planning.registration.registration import weak_points

STEP_SLACK = 1e-9
"""Steps by which a range may miss a whole number of them: rounding of radians."""


def findings(case: Case, anatomy: Anatomy, placement: Placement | None, cache: Cache = NO_CACHE) -> tuple[Finding, ...]:
    """Warnings and notes from comparing the inputs of a case with each other, in the order in which they are shown.

    Raises InputError: Everything that is refused, in one line; its code and numbers are those of the first.
    """
    places = tuple(label_placement(case, anatomy))
    on_edges = {one.code for one in places} - {"outline_unconfirmed"} == {"labels_on_edges"}
    placed = (
        *places,
        *target.target_place(case, anatomy),
        *target.target_in_vessel(case),
        *target.target_in_other_space(case, anatomy),
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
        *target.open_around_target(case, anatomy),
        *markers(case, anatomy, placement, cache),
        *target.needle_too_short(case, anatomy),
        *thick_slices(case, anatomy),
        *short_grid(case),
        *ignored_organs(case, anatomy),
        *absent_usual_organs(case, anatomy),
    )
    _refuse(case, rest)
    return placed + rest


def declared(case: Case) -> Iterator[Finding]:
    """Warnings that repeat what a person states of the image, since no rule checks it."""
    for sentence in case.ct.declared:
        yield Finding("declared", Severity.WARNING, sentence)


def _refuse(case: Case, reported: Sequence[Finding]) -> None:
    refused = [one for one in reported if one.severity is Severity.REFUSAL]
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
    """Warnings on the markers or the stated transform; see `placement_findings`."""
    if placement is None:
        return
    if placement.registration is not None:
        yield from weak_points(placement.registration)
    of_placement = placement_findings(case, Surroundings(anatomy.skin, anatomy.couch), placement, cache)
    yield from (one for one in of_placement if one.severity is Severity.WARNING)


def thick_slices(case: Case, anatomy: Anatomy) -> Iterator[Finding]:
    """Label maps whose voxels lie farther apart than the least margin that is demanded from them, and such a CT."""
    for grid in label_grids(case):
        demanding = [structure for structure in grid.own(anatomy.structures) if structure.demands_margin]
        if not demanding:
            continue
        least = min(demanding, key=lambda structure: structure.margin_mm)
        spacing = float(grid.voxels.spacing_mm.max())
        if spacing > least.margin_mm:
            said = (
                f"{grid.name}: slices {spacing:.3g} mm apart, but its smallest margin is {least.margin_mm:g} mm "
                f"({least.name}): objects between two slices are not seen"
            )
            yield Finding("thick_slices", Severity.WARNING, said, {"slices_mm": spacing, "margin_mm": least.margin_mm})
    name = case.skin_section.ct
    if name is not None and (spacing := float(case.volumes.source(name).grid.spacing_mm.max())) > ARM_PADDING_MM:
        said = (
            f"{name}: slices {spacing:.3g} mm apart, but needle and arm keep only {ARM_PADDING_MM:g} mm from the "
            "skin found in it"
        )
        yield Finding("thick_slices", Severity.WARNING, said, {"slices_mm": spacing, "margin_mm": ARM_PADDING_MM})


def short_grid(case: Case) -> Iterator[Finding]:
    """Warnings on ranges of angles that the step does not divide: the grid ends before they do."""
    step = float(np.degrees(case.search.step))
    for key, limits in (("theta_deg", case.search.theta), ("beta_deg", case.search.beta)):
        low, high = np.degrees(limits).round(9)
        last = low + step * np.floor((high - low) / step + STEP_SLACK)
        if high - last > STEP_SLACK * step:
            said = (
                f"search.{key} [{low:g}, {high:g}] is not a whole number of steps of {step:g}: the last angle "
                f"checked is {last:g}"
            )
            yield Finding("short_grid", Severity.WARNING, said, {"last_deg": float(last)})


def ignored_organs(case: Case, anatomy: Anatomy) -> Iterator[Finding]:
    """A warning on ignored structures whose names are those of organs to be avoided: they count as free."""
    roles = {name: default_role(name, case.region or "other") for name in anatomy.ignored}
    avoided = [name for name, role in roles.items() if role is not None and role.kind == "avoid"]
    if avoided:
        said = f"ignored by the case, so paths may cross them: {first_few(avoided)}"
        yield Finding("organs_ignored", Severity.WARNING, said, {"count": float(len(avoided))})


def absent_usual_organs(case: Case, anatomy: Anatomy) -> Iterator[Finding]:
    """A warning on usual organs of the case's region that no structure names: they count as free."""
    absent = absent_organs(case.region, [*(structure.name for structure in anatomy.structures), *anatomy.ignored])
    if absent:
        said = f"no structure is named like {', '.join(absent)}; organs without a structure count as free"
        yield Finding("organs_absent", Severity.WARNING, f"region {case.region}: {said}")
