"""The bore of a CT gantry as boxes: nothing of the wall is missing, and almost all of the bore is free."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from planning.errors import InputError
from planning.robot.cell import CellChecker, Tool
from planning.robot.fast_checker import FastChecker
from planning.robot.gantry import SIDES, gantry_boxes
from planning.robot.ur import ur_model

TILT = trimesh.transformations.rotation_matrix(0.35, [1.0, 0.2, 0.0])
TILT[:3, 3] = (420.0, 30.0, 80.0)
SIZES = {"bore_diameter_mm": 700.0, "wall_mm": 150.0, "depth_mm": 300.0}


def test_the_wall_is_whole_and_the_bore_free() -> None:
    """Random points: all of the wall's are in a box; none of those within the inscribed polygon's inner circle is."""
    rng = np.random.default_rng(0)
    boxes = gantry_boxes(TILT, **SIZES)
    radius, turn = rng.uniform(0.0, 500.0, 40_000), rng.uniform(0.0, 2.0 * np.pi, 40_000)
    local = np.stack([radius * np.cos(turn), radius * np.sin(turn), rng.uniform(-149.9, 149.9, 40_000)], axis=1)
    points = local @ TILT[:3, :3].T + TILT[:3, 3]
    inside = np.zeros(len(points), bool)
    for box in boxes:
        at = (points - box.T_base_box[:3, 3]) @ box.T_base_box[:3, :3]
        inside |= (np.abs(at) <= np.asarray(box.size_mm) / 2.0).all(axis=1)
    assert inside[radius > 350.0].all()
    assert not inside[radius < 350.0 * np.cos(np.pi / SIDES) - 1e-9].any()


def test_in_a_gantry_both_checkers_agree() -> None:
    """The same contacts with and without help, some with the gantry."""
    tool = Tool(250.0, 150.0, 1.2, 30.0)
    ahead = trimesh.transformations.rotation_matrix(np.pi / 2.0 + 0.35, [1.0, 0.0, 0.0])
    ahead[:3, 3] = (0.0, 600.0, 150.0)
    boxes = gantry_boxes(ahead, **SIZES)
    slow, fast = (kind(ur_model("ur3"), tool, boxes, padding_mm=5.0) for kind in (CellChecker, FastChecker))
    met = set()
    for q in np.random.default_rng(1).uniform(-np.pi, np.pi, (300, 6)):
        contact = slow.contact(q, needle_may_touch_patient=False)
        assert fast.contact(q, needle_may_touch_patient=False) == contact
        met.add(None if contact is None else contact.other.split("_")[0])
    assert {None, "gantry"} <= met


@pytest.mark.parametrize("name", sorted(SIZES))
def test_sizes_that_make_no_sense_are_refused(name: str) -> None:
    """By name."""
    with pytest.raises(InputError, match=name):
        gantry_boxes(TILT, **{**SIZES, name: np.nan})
