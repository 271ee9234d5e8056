"""Views of the scene: the workcell with the arm, and close to the needle's path."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.entry import ANATOMICAL_LPS
from puncture_twin.planning.geometry.rigid import frame_about
from puncture_twin.twin.report.raster.camera import ViewCamera, camera_around
from puncture_twin.twin.report.raster.render import Layer

FOV = np.radians(28.0)  # a long lens: little perspective, sizes compare
UPRIGHT = 0.5
"""An entry frame whose z is within 60 degrees of the body's long axis does not say what is up on the table."""

ALONG_BODY = 0.62
"""A patient is not looked at more steeply along the body than this cosine: from head or feet little is recognised."""

ENTRY_SIDE = 0.35  # least cosine between the needle and the way to whoever looks: from behind the body no entry is seen
ELEVATIONS = (np.radians(22.0), np.radians(40.0))
AZIMUTHS = 16
TILTS = (0.0, np.radians(25.0), np.radians(-25.0))
EXTENT_WEIGHT = 0.8  # what the focus' length in the picture counts, where all of it being seen counts 1
PATH_SAMPLES = 24
TARGET_WEIGHT = 8  # the target counts as so many points of the path when one asks what a view hides


def up_ct(case: Any) -> Floats:
    """Up in the workcell, unit, CT frame: the entry frame's z; the front of a patient whose frame is along the body."""
    z = np.asarray(case.T_ct_entry)[:3, 2]
    if str(case.space) != "local" and abs(z @ np.array(ANATOMICAL_LPS["head"])) > UPRIGHT:
        return np.array(ANATOMICAL_LPS["anterior"])
    return z


def overview(
    case: Any,
    content_ct: Floats,
    focus_ct: Floats,
    blockers: Layer,
    size: tuple[int, int],
    outward_ct: Floats | None = None,
) -> ViewCamera:
    """A view of everything from above the table and from the needle's side, from where it is best seen.

    Args:
        content_ct: Shape (n, 3), what must be in the picture; focus_ct, (k, 3), should not be hidden.
        outward_ct: Shape (3,), unit, from the target out of the body along the needle; None looks from any side.
    """
    up = up_ct(case)
    options = [-one for one in _around(up, ELEVATIONS)]
    if str(case.space) != "local":
        options = [o for o in options if abs(o @ np.array(ANATOMICAL_LPS["head"])) < ALONG_BODY]
    if outward_ct is not None:
        options = [o for o in options if -o @ outward_ct > ENTRY_SIDE] or options
    return _best(options, up, content_ct, focus_ct, blockers, size)


def close_up(case: Any, path_ct: Floats, radius: float, blockers: Layer, size: tuple[int, int]) -> ViewCamera:
    """A view across the needle's path, from where the fewest structures hide it.

    Args:
        path_ct: Shape (2, 3), target and entry.
        radius: mm about the path's ends that must be in the picture.
    """
    along = (path_ct[1] - path_ct[0]) / np.linalg.norm(path_ct[1] - path_ct[0])
    up = up_ct(case)
    options = [o for o in _around(along, TILTS) if o @ up < 0.35]  # not from below the table
    steps = np.linspace(0, 1, PATH_SAMPLES)[:, None]
    focus = path_ct[0] * (1 - steps) + path_ct[1] * steps
    focus = np.concatenate([focus, np.repeat(path_ct[:1], TARGET_WEIGHT, axis=0)])
    cube = radius * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / np.sqrt(3)
    content = np.concatenate([path_ct[0] + cube, path_ct[1] + cube])
    return _best(options, up, content, focus, blockers, size)


def _around(axis: Floats, tilts: Sequence[float]) -> list[Floats]:
    """Unit vectors about a unit axis (3,), at so many azimuths, so far toward it from across, rad."""
    side = -frame_about(axis)[:, 0]
    turns = (np.arange(AZIMUTHS) + 0.5) * 2 * np.pi / AZIMUTHS
    levels = [np.cos(turn) * side + np.sin(turn) * np.cross(axis, side) for turn in turns]
    return [np.cos(tilt) * level + np.sin(tilt) * axis for tilt in tilts for level in levels]


def _best(
    options: list[Floats], up: Floats, content: Floats, focus: Floats, blockers: Layer, size: tuple[int, int]
) -> ViewCamera:
    """The option that sees most of the focus; among equals, the one that sees it longest in the picture."""
    content = content[ConvexHull(content).vertices]
    cameras = [
        camera_around(content, toward, up, fov=FOV, width=size[0], height=size[1])
        for toward in options
        if abs(toward @ up) <= 0.95
    ]
    if not cameras:
        return camera_around(content, frame_about(up)[:, 0], up, fov=FOV, width=size[0], height=size[1])
    spans = [np.ptp(camera.project(focus)[:, :2], axis=0) for camera in cameras]
    extents = [float(np.linalg.norm(span) / np.hypot(*size)) for span in spans]  # of the picture's diagonal
    best, best_score = 0, -np.inf
    for i in np.argsort(-np.array(extents), kind="stable").tolist():
        if EXTENT_WEIGHT * extents[i] + 1.0 < best_score:  # nor does one after it, were nothing hidden
            break
        score = float(blockers.sees(cameras[i].eye, focus).mean()) + EXTENT_WEIGHT * extents[i]
        if score > best_score or (score == best_score and i < best):
            best, best_score = i, score
    return cameras[best]
