"""The sources of a needle's pose error: their names for people, and the key of ``[errors]`` of each."""

from collections.abc import Collection, Mapping
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.errors import ErrorModel

NOT_MODELLED: Mapping[str, tuple[str, str]] = {
    "breathing": ("breathing", "breathing in the chances (they are for the body as in the CT)"),
    "bending": ("needle bending", "needle bending in the chances (the greatest deflection is added to the margins)"),
}
"""Effects that no source models, which does not make them 0; and where the case declares them, what is done instead."""
NAMED = 3
"""Meshes that are named; of more their number is stated."""


def not_modelled(case: Case, *, counted: Collection[str] = ()) -> str:
    """Sentences on what the chances of a case leave out, but for what is counted: of breathing, bending, motion."""
    declared = {"breathing": case.breathing, "bending": case.bending}
    left_out = [texts[declared[name] is not None] for name, texts in NOT_MODELLED.items() if name not in counted]
    moving = [] if "motion" in counted else ["tissue motion"]
    return ", ".join([*left_out, *moving, *_unknown_contours(case)])


def _unknown_contours(case: Case) -> list[str]:
    if case.errors is None or case.errors.surface_mm is not None:
        return []
    hit = case.target_structure if case.hit_radius_mm is None else None
    meshes = [one for one in case.structure if one.mesh is not None]
    names = [one.name for one in meshes if one.role in {"avoid", "unknown"} or one.name == hit]
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return [f"errors of the meshes ({', '.join(names[:NAMED])}{more}: errors.surface_mm)"] if names else []


ISOTROPIC = 1e-9
"""Relative difference of variances below which a marker is read equally well along all axes."""


class Source(NamedTuple):
    """Name of a source, the key of ``[errors]`` that states it, and that key's unit."""

    text: str
    key: str
    unit: str


SOURCES: Mapping[str, Source] = {
    "ct_slice": Source("reading across the CT slices", "ct_slice_mm", "mm"),
    "ct_in_plane": Source("reading within the CT slices", "ct_in_plane_mm", "mm"),
    "markers_ct": Source("reading in the CT", "ct_in_plane_mm and ct_slice_mm", "mm"),
    "touch": Source("touch noise", "touch_mm", "mm"),
    "target": Source("reading of the target", "target_mm", "mm"),
    "link": Source("the arm's lengths", "link_mm", "mm"),
    "twist": Source("the arm's twists", "twist_deg", "deg"),
    "joint": Source("zeros of the joints", "joint_deg", "deg"),
    "repeatability": Source("repeatability", "repeatability_deg", "deg"),
    "drift": Source("drift since the touch", "joint_drift_deg", "deg"),
    "jitter": Source("jitter of the joints", "jitter_deg", "deg"),
    "tip_offset": Source("offset of the needle's tip", "tip_offset_mm", "mm"),
    "needle_direction": Source("direction of the needle", "needle_direction_deg", "deg"),
    "bend": Source("bending of the needle", "bevel_deg", "deg"),
    "breathing": Source("breathing while it is inserted", "amplitude_mm", "mm"),
    "motion": Source("target's motion, breath and push", "motion.target_sd_mm, [breathing], tissue held_n_mm", "mm"),
    "cameras": Source("points seen by the cameras", "stereo.sd_mm", "mm"),
    "pictures": Source("ultrasound pictures", "ultrasound.target_sd_mm, tip_sd_mm, calibration_sd_mm", "mm"),
    "scans": Source("readings of the control scans", "control_scan.slice_mm and [errors] target_mm", "mm"),
    "surface": Source("surfaces of the structures", "surface_mm", "mm"),
}
"""By the names under which `PoseError.parts` and `ErrorBudget.share` give their parts, and the surfaces' own."""


def reading_parts(cov_ct: Floats) -> dict[str, Floats]:
    """A reading's covariance (3, 3), split into across and within the slices where the two differ."""
    values, axes = np.linalg.eigh(cov_ct)
    if values[2] - values[0] <= ISOTROPIC * values[2]:
        return {"markers_ct": cov_ct}
    across = 0 if values[1] - values[0] > values[2] - values[1] else 2
    slices = values[across] * np.outer(axes[:, across], axes[:, across])
    return {"ct_slice": slices, "ct_in_plane": cov_ct - slices}


def deviation(errors: ErrorModel, source: str) -> float:
    """Declared deviation of a source, in the unit of its key."""
    if source in ("ct_slice", "ct_in_plane", "markers_ct"):
        return float(np.sqrt(np.linalg.eigvalsh(reading_parts(errors.marker_cov_ct)[source])[2]))
    if source == "target":
        return float(np.sqrt(np.linalg.eigvalsh(errors.target_cov_ct)[2]))
    declared = errors.arm if hasattr(errors.arm, _attribute(source)) else errors
    value = float(getattr(declared, _attribute(source)))
    return float(np.degrees(value)) if SOURCES[source].unit == "deg" else value


def _attribute(source: str) -> str:
    return f"{source}_mm" if SOURCES[source].unit == "mm" else source
