"""Markers, a lesion and a needle read off scans whose truth is known."""

import re
from pathlib import Path

import numpy as np
import pytest
from refusals import refused

from puncture_twin.planning.formats.points import NamedPoints
from puncture_twin.planning.formats.volumes.volume_files import Volume
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid
from puncture_twin.twin.guidance.ct.markers import find_markers, read_lesion
from puncture_twin.twin.guidance.ct.needle import find_needle, needle_error
from puncture_twin.twin.plant.scanner.image import ScanSettings, Solid, ball, box, rod, scan_solids

BLOCK = Solid("block", box(np.zeros(3), np.array([90.0, 60.0, 130.0])), 20.0)
PIXEL = 0.7


def scanned(solids, spacing, shift=(0.0, 0.0, 0.0), seed=0, size=(66.0, 40.0, 110.0), centre=(0.0, -30.0, 0.0)):
    """A scan about a place on the block's front (y = -30), its grid moved by ``shift`` cells."""
    cell = np.array([PIXEL, PIXEL, spacing])
    T = np.diag([*cell, 1.0])
    T[:3, 3] = np.array(centre) - np.array(size) / 2 + np.array(shift) * cell
    grid = VolumeGrid(tuple(int(n) for n in np.array(size) / cell), T, {})
    settings = ScanSettings(spacing, PIXEL)
    image = scan_solids(solids, grid, settings, np.random.default_rng(seed))
    return Volume(image.hu, T, Path("scan")), image


def marked(spacing, kind="disc", draws=3):
    """Errors (n, 3) of both readings, of markers on the front that lie evenly over a cell along the bed."""
    fine, rule = [], []
    for draw in range(draws):
        rng = np.random.default_rng(draw)
        places = np.array([(x, -30.0, z) for x in (-20.0, 20.0) for z in (-35.0, 0.0, 35.0)])
        places += np.column_stack([rng.uniform(-0.5, 0.5, 6) * PIXEL, np.zeros(6), rng.uniform(-0.5, 0.5, 6) * spacing])
        cells = (np.arange(6) + draw / draws) / 6  # of each marker, over all draws: even over its cell
        T_low = -55.0
        places[:, 2] = T_low + (np.round((places[:, 2] - T_low) / spacing) + cells - 0.5) * spacing
        normal = np.array([0.0, 0.75, 0.0])
        meshes = [rod(p - normal, p + normal, 8.0) if kind == "disc" else ball(p, 8.0) for p in places]
        solids = [BLOCK, *(Solid("marker", mesh, 8000.0) for mesh in meshes)]
        volume, _ = scanned(solids, spacing, seed=draw, shift=(rng.uniform(), rng.uniform(), 0.0))
        found = find_markers(volume, NamedPoints(tuple("abcdef"), places + 2.0, None))
        fine.append(found.fine.points - places)
        rule.append(found.rule.points - places)
    return np.concatenate(fine), np.concatenate(rule)


@pytest.mark.parametrize(("spacing", "kind"), [(1.0, "disc"), (5.0, "disc"), (2.5, "ball")])
def test_a_marker_is_found_to_a_fraction_of_a_voxel(spacing, kind):
    """Along the bed to 0.03 of the spacing, in the plane to 0.03 mm, without bias; by the rule uniform in a cell."""
    fine, rule = marked(spacing, kind)
    assert fine[:, 2].std() <= 0.03 * spacing
    assert np.sqrt(fine[:, :2].var(axis=0).mean()) <= 0.03
    assert np.abs(fine.mean(axis=0)[:2]).max() <= 0.02
    assert rule[:, 2].std() == pytest.approx(spacing / np.sqrt(12), rel=0.1)
    assert np.abs(rule[:, 2]).max() <= 0.6 * spacing
    assert rule[:, 0].std() == pytest.approx(1 / np.sqrt(12), rel=0.25)


def test_a_marker_that_is_not_there_is_named():
    """And none is taken for two names."""
    disc = Solid("marker", rod(np.array([0.0, -30.75, 0.0]), np.array([0.0, -29.25, 0.0]), 8.0), 8000.0)
    volume, _ = scanned([BLOCK, disc], 2.5, size=(30.0, 30.0, 30.0))
    expected = NamedPoints(("A", "B"), np.array([[0.0, -30.0, 0.0], [8.0, -30.0, 0.0]]), None)
    with refused("marker_not_seen"):
        find_markers(volume, expected)


def test_a_soft_lesion_is_found_by_its_values():
    """25 HU in 58, noise 20, slices of 2.5 mm: its middle to a tenth of a millimetre in the plane."""
    place = np.array([0.4, 0.3, 0.6])
    solids = [Solid("liver", BLOCK.mesh, 58.0), Solid("lesion", ball(place, 20.0), 25.0, 1)]
    volume, image = scanned(solids, 2.5, centre=(0.0, 0.0, 0.0), size=(40.0, 40.0, 40.0))
    error = read_lesion(volume, image.labels[0] == 1) - place
    assert np.abs(error[:2]).max() < 0.12 and abs(error[2]) < 0.2


@pytest.mark.parametrize("spacing", [1.0, 2.5])
@pytest.mark.parametrize("direction", [(0.3, 1.0, 0.1), (0.7, 0.6, -0.4), (0.1, 0.2, 1.0)])
def test_a_needle_is_found_by_its_image(spacing, direction):
    """1.2 mm in soft tissue, at any angle to the slices: its tip to half a millimetre, its direction to a degree.

    The first lies in fewer than two slices of 2.5 mm: what its covariance says is more, and holds.
    """
    forward = np.array(direction) / np.linalg.norm(direction)
    tip = np.array([0.3, -0.2, 0.5])
    needle = Solid("needle", rod(tip - 45.0 * forward, tip, 1.2), 8000.0)
    bone = Solid("rib", rod(np.array([-40.0, 12.0, 8.0]), np.array([40.0, 12.0, 8.0]), 9.0), 500.0)
    volume, _ = scanned([BLOCK, bone, needle], spacing, centre=(0.0, -5.0, 0.0), size=(90.0, 70.0, 100.0))
    found = find_needle(volume, np.zeros(3), 1.2)
    assert np.linalg.norm(found.tip_ct - tip) < 0.5
    assert np.arccos(found.forward_ct @ forward) < max(np.radians(1.0), found.axis_sd)
    assert found.axis_sd < np.radians(1.5) and found.sagitta_mm == 0
    seen, true = needle_error(found.tip_ct, found.forward_ct, np.zeros(3)), needle_error(tip, forward, np.zeros(3))
    assert np.allclose(seen, true, atol=0.4)
    assert seen.tip_to_target_mm == pytest.approx(np.hypot(seen.lateral_mm, seen.depth_mm))


def test_without_a_needle_none_is_found():
    """A rib is no needle."""
    bone = Solid("rib", rod(np.array([-40.0, 12.0, 8.0]), np.array([40.0, 12.0, 8.0]), 9.0), 500.0)
    volume, _ = scanned([BLOCK, bone], 2.5, size=(40.0, 40.0, 40.0), centre=(0.0, 0.0, 0.0))
    with refused("needle_not_seen"):
        find_needle(volume, np.zeros(3), 1.2)


BOLTS = [
    Solid("bolt", rod(np.array([0.0, 8.0 * side, -40.0]), np.array([0.0, 8.0 * side, top]), 8.0), 8000.0)
    for side, top in ((-1, 13.0), (0, 0.0), (1, -24.0))
]
"""Three bolts side by side, as in the embedded carton; a needle comes to the end of the middle one."""


def beside_bolts(seed, spacing, gap_mm):
    """A scan of a needle of 2 mm that ends so far from the middle bolt's end, its tip and direction."""
    rng = np.random.default_rng(seed)
    forward = np.array([0.25, -0.2, -1.0]) + rng.normal(0, 0.06, 3)
    forward /= np.linalg.norm(forward)
    tip = np.array([0.0, 0.0, 0.0]) - gap_mm * forward + rng.normal(0, 0.4, 3)
    needle = Solid("needle", rod(tip - 50.0 * forward, tip, 2.0), 8000.0)
    volume, _ = scanned([*BOLTS, needle], spacing, seed=seed, centre=(0.0, 0.0, 5.0), size=(50.0, 50.0, 90.0))
    return volume, tip, forward


@pytest.mark.parametrize("spacing", [1.0, 2.5])
@pytest.mark.parametrize("seed", range(3))
def test_a_needle_is_found_beside_bolts(spacing, seed):
    """They are larger and nearer to the target; its tip is six millimetres clear of them."""
    volume, tip, forward = beside_bolts(seed, spacing, 12.0)
    found = find_needle(volume, np.zeros(3), 2.0)
    assert np.linalg.norm(found.tip_ct - tip) < 0.5
    assert np.degrees(np.arccos(found.forward_ct @ forward)) < 1.0


@pytest.mark.parametrize("spacing", [1.0, 2.5])
@pytest.mark.parametrize("gap_mm", [0.5, 4.0])
def test_a_tip_at_a_bolt_is_refused_and_its_axis_said(spacing, gap_mm):
    """Where the metal ends nobody sees where the needle does; by how much it passes the target is seen."""
    volume, tip, forward = beside_bolts(5, spacing, gap_mm)
    beside = np.linalg.norm(tip - (tip @ forward) * forward)
    with refused("tip_hidden") as caught:
        find_needle(volume, np.zeros(3), 2.0)
    said = float(re.search(r"passes the target by ([0-9.]+) mm", str(caught.value))[1])
    assert said == pytest.approx(beside, abs=0.5)


@pytest.mark.parametrize(
    ("error", "lateral", "depth"), [((0, 0, 2), 0, 2), ((3, 4, 0), 5, 0), ((3, 4, -12), 5, -12), ((0, 0, 0), 0, 0)]
)
def test_a_needles_error_is_split(error, lateral, depth):
    """Along the needle is depth with its sign, across it is lateral."""
    split = needle_error(np.array(error) + 40.0, np.array([0.0, 0.0, 1.0]), np.full(3, 40.0))
    assert (split.lateral_mm, split.depth_mm) == pytest.approx((lateral, depth))
    assert split.tip_to_target_mm == pytest.approx(np.hypot(lateral, depth))
