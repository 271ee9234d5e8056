"""Which TotalSegmentator numbered a map, told by where its organs lie."""

import numpy as np
import pytest
from places import REAL_CT

from puncture_twin.planning.formats.labels.labelmaps import LabelMap, labelmap_of
from puncture_twin.planning.formats.labels.naming import V1, V2
from puncture_twin.planning.formats.volumes.volume_files import read_volume
from puncture_twin.planning.init.label_files import likely_numbering

PLACES = {
    "liver": (-80, 0, 30), "spleen": (90, 40, 50), "kidney_left": (60, 50, -20), "kidney_right": (-60, 50, -30),
    "vertebrae_T12": (0, 80, 60), "vertebrae_L1": (0, 80, 20), "vertebrae_L3": (0, 80, -40),
    "vertebrae_L4": (0, 80, -70), "hip_left": (80, 40, -90), "hip_right": (-80, 40, -90),
}  # fmt: skip
"""Middles of organs, LPS mm."""


def map_of(table, places):
    labels = np.zeros((24, 24, 24), np.uint8)
    T = np.diag([10.0, 10.0, 10.0, 1.0])
    T[:3, 3] = -120.0
    numbers = {name: label for label, name in table.items()}
    for name, place in places.items():
        labels[tuple(((np.array(place) + 120) / 10).astype(int))] = numbers[name]
    return LabelMap(labels, T, None, "a.nii.gz")


@pytest.mark.parametrize(("table", "name"), [(V1, "totalsegmentator-v1"), (V2, "totalsegmentator-v2")])
def test_the_version_under_which_organs_lie_right_is_told(table, name):
    assert likely_numbering(map_of(table, PLACES)) == name


def test_what_cannot_be_told_is_not_guessed():
    """The first six numbers are alike in both versions; a mirrored map fits none."""
    few = {name: PLACES[name] for name in ("liver", "spleen", "kidney_left", "kidney_right")}
    assert likely_numbering(map_of(V1, few)) is None
    mirrored = {name: (-x, y, -z) for name, (x, y, z) in PLACES.items()}
    assert likely_numbering(map_of(V1, mirrored)) is None
    assert likely_numbering(map_of(V2, mirrored)) is None


@pytest.mark.skipif(not REAL_CT.is_dir(), reason=f"the real CT is not at {REAL_CT}")
@pytest.mark.parametrize(
    ("file", "name"),
    [("labels_v1_normal.nii.gz", "totalsegmentator-v1"), ("labels_v2_fast.nii.gz", "totalsegmentator-v2")],
)
def test_the_version_of_real_maps_is_told(file, name):
    """Of the same patient, by both versions; also of the lower half alone."""
    whole = labelmap_of(read_volume(REAL_CT / file))
    assert likely_numbering(whole) == name
    half = LabelMap(whole.labels[:, :, :60], whole.T_ct_index, None, whole.path)
    assert likely_numbering(half) == name
