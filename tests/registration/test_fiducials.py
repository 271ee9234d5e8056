"""Markers found in virtual scans whose truth is known, in real CTs that hold none, and named by a layout."""

import numpy as np
import pytest
from marker_world import Markers, Stated, body_of, distractors, found_in, matched, scanned, scene
from places import DATA, REAL_CT
from refusals import refused

from benchmarks.markers import counted, scene as benchmark_scene
from puncture_twin.planning.base.errors import InputError, NoAnswerError
from puncture_twin.planning.formats.points import NamedPoints
from puncture_twin.planning.formats.volumes.volume_files import Volume, read_volume
from puncture_twin.planning.geometry.rigid import exp_rotation
from puncture_twin.planning.registration.fiducial_reading import Reading, Shape
from puncture_twin.planning.registration.fiducials import (
    Fiducial,
    Passed,
    Seen,
    choose_fiducials,
    find_fiducials,
    look_for_fiducials,
    named_by_layout,
    noise_hu,
    order_along_body,
)
from puncture_twin.twin.plant.scanner.image import ScanSettings, Solid, ball, rod

KINDS = [
    (Markers("ball", 8.0), 2.5, 0.8),
    (Markers("disc", 8.0, 8000.0, 1.5), 5.0, 0.8),
    (Markers("ring", 12.0, 8000.0, 2.0), 2.5, 1.2),
    (Markers("ball", 10.0, 300.0), 2.5, 1.0),
    (Markers("disc", 10.0, 1200.0, 3.0), 2.5, 1.4),
    (Markers("ball", 3.0, 8000.0, off_mm=-5.0), 1.5, 1.0),
]
"""Of metal, clipped, and of contrast; thick slices and thin ones; on the skin and 2 mm under it; blur, mm."""


@pytest.fixture(scope="module")
def scans():
    """True centres and what is found, of each kind, among ribs, clips, a wire, a needle, a table with bolts."""
    return [
        found_in(markers, ScanSettings(spacing, 0.9, 20.0, seed=number, blur_mm=blur))
        for number, (markers, spacing, blur) in enumerate(KINDS)
    ]


def test_all_are_found_and_nothing_else_with_kind_and_size(scans):
    """Neither bone, wire, clip, needle, calcification nor bolt; size to a tenth, the kind where four voxels show it."""
    for (markers, spacing, _), (true, seen) in zip(KINDS, scans, strict=True):
        errors, _, false = matched(true, seen.fiducials)
        assert (len(errors), false) == (len(true), 0), (markers, spacing, seen.passed)
        shapes = [one.reading.shape for one in seen.fiducials]
        assert np.allclose([one.diameter_mm for one in shapes], markers.diameter, rtol=0.1)
        assert markers.diameter <= 4 * 0.9 or {one.kind for one in shapes} == {markers.kind}


def test_centres_are_as_sure_as_they_say(scans):
    """Errors over their covariance are chi-squared: their mean is 3, few are large; none is a tenth of a slice off."""
    normalised = []
    for (_, spacing, _), (true, seen) in zip(KINDS, scans, strict=True):
        errors, covs, _ = matched(true, seen.fiducials)
        normalised += [error @ np.linalg.solve(cov, error) for error, cov in zip(errors, covs, strict=True)]
        assert np.sqrt(np.mean(errors[:, :2] ** 2)) < 0.12
        assert np.sqrt(np.mean(errors[:, 2] ** 2)) < 0.06 * spacing
    assert 0.15 < np.mean(normalised) / 3 < 1.5
    assert np.mean(np.array(normalised) < 7.815) >= 0.9  # the 95 % point of three degrees


@pytest.mark.parametrize(
    ("markers", "spacing", "most_mm"),
    [(Markers("ball", 3.0, 8000.0, off_mm=-3.5), 1.5, 0.04), (Markers("ball", 8.0, 500.0, off_mm=-4.0), 5.0, 0.25)],
)
def test_the_skin_does_not_draw_a_marker_aside(markers, spacing, most_mm):
    """Metal wholly under it and contrast half in it, whose background is skin to one side: 95 % regions hold."""
    true, seen = found_in(markers, ScanSettings(spacing, 0.85, 20.0, seed=4), others=False)
    errors, covs, false = matched(true, seen.fiducials)
    assert len(errors) >= 5 and not false
    assert np.sqrt(np.mean(errors[:, :2] ** 2)) < most_mm
    assert max(e @ np.linalg.solve(c, e) for e, c in zip(errors, covs, strict=True)) < 11.345  # 99 %


def test_a_marker_that_the_image_cuts_is_doubtful_and_a_disc_under_the_skin_is_none():
    """The image ends at the middle of one, and where another does; the disc, of contrast, is 3 mm under the skin."""
    rng = np.random.default_rng(9)
    true, solids = scene(Markers(count=5), rng, others=False)
    place, inward = true[2], -true[2] / np.linalg.norm(true[2])
    disc = Solid("disc", rod(place + 7.3 * inward, place + 9.3 * inward, 10.0), 400.0)
    solids = [one for number, one in enumerate(solids) if number != 3]  # the body first, then the markers
    volume, skin = body_of(scanned([*solids, disc], ScanSettings(1.5, 0.8), rng))
    last = int((true[4, 2] - volume.T_ct_index[2, 3]) / 1.5)
    seen = look_for_fiducials(Volume(volume.values[:, :, : last + 1], volume.T_ct_index, volume.path), skin)
    errors, _, false = matched(true[[1, 3]], seen.fiducials)
    assert (len(errors), false) == (2, 0)
    cut = [one.point_ct for one in seen.doubtful if one.why == "cut by the image"]
    assert min(np.linalg.norm(one - true[4]) for one in cut) < 6.0


def test_what_is_not_clipped_is_not_taken_for_it():
    """Balls of 2,000 HU are the densest of an image that ends far above: their size is theirs."""
    true, seen = found_in(Markers(hu=2000.0), ScanSettings(2.5, 1.0, seed=2), others=False)
    assert len(matched(true, seen.fiducials)[0]) == len(true)
    assert not any(one.reading.clipped for one in seen.fiducials)
    assert np.allclose([one.reading.shape.diameter_mm for one in seen.fiducials], 8.0, rtol=0.05)


def test_without_markers_none_is_seen():
    rng = np.random.default_rng(5)
    _, solids = scene(Markers(), rng)
    solids = [one for one in solids if one.name != "marker"]
    volume, skin = body_of(scanned(solids, ScanSettings(2.5, 0.9), rng))
    with refused("no_markers", by=NoAnswerError):
        find_fiducials(volume, skin, Stated(), where="test")


@pytest.fixture(scope="module")
def two_sizes():
    """Four balls of 8 mm and three of 4 mm on one body."""
    rng = np.random.default_rng(6)
    large, solids = scene(Markers(count=4), rng, others=False)
    small, more = scene(Markers("ball", 4.0, count=7), rng, others=False)
    away = [k for k, one in enumerate(small) if np.linalg.norm(large - one, axis=1).min() > 20.0][:3]
    solids += [one for k, one in enumerate(more[1:]) if k in away]
    return large, small[away], look_for_fiducials(*body_of(scanned(solids, ScanSettings(2.5, 0.9), rng)))


def test_several_sizes_are_not_guessed(two_sizes):
    """They are told with places and sizes; a size, or a count that one of them has, decides; a wrong one does not."""
    large, small, seen = two_sizes
    with refused("markers_unclear", "8.0 mm", "4.0 mm", by=NoAnswerError):
        choose_fiducials(seen, Stated(), where="test")
    for stated, true in ((Stated(diameter_mm=8.0), large), (Stated(count=4), large), (Stated(diameter_mm=4.0), small)):
        found = choose_fiducials(seen, stated, where="test").fiducials
        assert len(found) == len(true) and len(matched(true, found)[0]) == len(true)
        assert [one.name for one in found] == [f"M{n}" for n in range(1, len(true) + 1)]
    for stated, code in (
        (Stated(diameter_mm=8.0, count=5), "too_few_markers"),
        (Stated(diameter_mm=8.0, count=3), "too_many_markers"),
        (Stated(diameter_mm=14.0), "no_markers"),
    ):
        with refused(code, by=NoAnswerError):
            choose_fiducials(seen, stated, where="test")


@pytest.mark.parametrize(
    ("stated", "code"),
    [({"kind": "cube"}, "unknown_choice"), ({"diameter_mm": 0.5}, "out_of_range"), ({"count": 2}, "out_of_range")],
)
def test_what_no_marker_is_is_refused(stated, code):
    with refused(code):
        Stated(**stated)


def test_noise_is_that_of_the_voxels():
    hu = np.full((60, 60, 20), -1000.0)
    hu[10:50, 10:50] = 40.0
    hu[20:24, 20:24] = 900.0
    hu += 25.0 * np.random.default_rng(0).standard_normal(hu.shape)
    assert noise_hu(hu) == pytest.approx(25.0, rel=0.05)


def test_order_is_from_head_to_feet_then_from_right_to_left():
    """Less than a centimetre apart along the body counts as one row; LPS: x runs to the patient's left."""
    points = np.array([[30.0, 0, 100], [-30.0, 0, 95], [0.0, 0, 99], [5.0, 0, 160], [0.0, 0, 20]])
    assert order_along_body(points) == [3, 1, 2, 0, 4]
    assert order_along_body(np.zeros((0, 3))) == []


LAYOUT = np.array([[0.0, 0, 0], [60, 5, 0], [10, 90, 12], [75, 80, 30], [30, 40, 45]])
NAMES = tuple("ABCDE")


def fiducials(points, kind="ball", diameter=8.0):
    """Balls or discs there, read to 1 %, under other names."""
    shape = Shape(kind, diameter, 1.0, np.array([0.0, -1, 0]))
    make = (np.log([1000.0, diameter]), np.diag([0.1, 0.01]) ** 2)
    return [
        Fiducial(f"M{k}", Reading(p, np.eye(3) * 0.01, shape, 900.0, False, 0.1, *make), 4.0)
        for k, p in enumerate(points)
    ]


def moved(points, rng):
    R = exp_rotation(rng.normal(size=3))
    return points @ R.T + rng.uniform(-200, 200, 3) + rng.normal(0, 0.2, points.shape)


@pytest.mark.parametrize("seed", range(8))
def test_a_layout_names_them_in_any_order_and_frame(seed):
    """Also with things that are no part of it, and where one of it is not seen."""
    rng = np.random.default_rng(seed)
    shown = LAYOUT if seed % 2 else LAYOUT[:4]
    points = moved(np.vstack([shown, rng.uniform(-150, 150, (3, 3))]), rng)
    order = rng.permutation(len(points))
    named = named_by_layout(fiducials(points[order]), NamedPoints(NAMES, LAYOUT, None), "layout")
    assert [one.name for one in named] == list(NAMES[: len(shown)])
    assert np.allclose([one.position_ct for one in named], points[: len(shown)])


SQUARE = np.array([[0.0, 0, 0], [50, 0, 0], [50, 50, 0], [0, 50, 0]])
ZIGZAG = np.array([[0.0, 0, 0], [40, 20, 0], [90, 0, 0], [130, 20, 0], [180, 0, 0]])


@pytest.mark.parametrize(
    ("shown", "layout", "code", "by"),
    [
        (LAYOUT, LAYOUT * [1, 1, -1], "markers_mirrored", InputError),
        (SQUARE, SQUARE, "markers_ambiguous", NoAnswerError),
        (ZIGZAG, ZIGZAG[:3], "markers_ambiguous", NoAnswerError),
        (1.2 * LAYOUT, LAYOUT, "layout_not_seen", NoAnswerError),
        (LAYOUT[:3], LAYOUT, "layout_not_seen", NoAnswerError),
    ],
)
def test_a_layout_that_does_not_fit_once_is_refused(shown, layout, code, by):
    """Eight ways of a square; three of a chain of equal steps are the first or the last; mirrored names are wrong."""
    seen = fiducials(moved(shown, np.random.default_rng(1)))
    with refused(code, by=by):
        named_by_layout(seen, NamedPoints(NAMES[: len(layout)], layout, None), "layout")


def test_a_flat_layout_has_no_handedness():
    flat = LAYOUT * [1.0, 1.0, 0.0]
    layout = NamedPoints(NAMES, flat * [-1, 1, 1], None)
    named = named_by_layout(fiducials(moved(flat, np.random.default_rng(2))), layout, "layout")
    assert [one.name for one in named] == list(NAMES)


def test_a_layout_that_is_nearly_symmetric_never_names_them_wrong():
    """Where the skin gave way by 1.5 mm an axis the right names may fit less well than others."""
    names = 0
    for seed in range(80):
        rng = np.random.default_rng(seed)
        layout = np.array([[0.0, 0, 0], [60, 0, 0], [60, 80, 0], [0, 80, 0]]) + rng.normal(0, [3.0, 3.0, 0.0], (4, 3))
        R = exp_rotation(rng.normal(size=3))
        try:
            seen = fiducials((layout + rng.normal(0, 0.3 + 1.2 * (seed % 2), (4, 3))) @ R.T)
            named = named_by_layout(seen, NamedPoints(tuple("ABCD"), layout, None), "layout")
        except NoAnswerError:
            continue
        names += 1
        assert [one.position_ct.tolist() for one in named] == [one.position_ct.tolist() for one in seen]
    assert names > 30


def test_three_of_a_layout_beside_other_things_must_fit_well():
    """Three that fit to 1.5 mm are named where nothing else is seen, and are chance where something is."""
    triangle = np.array([[0.0, 0, 0], [140, 0, 0], [30, 60, 0]])
    triangle -= triangle.mean(axis=0)
    off = triangle * (1 + 1.5 / np.sqrt(np.mean(np.sum(triangle**2, axis=1))))
    layout = NamedPoints(tuple("ABC"), triangle, None)
    assert [one.name for one in named_by_layout(fiducials(off), layout, "layout")] == list("ABC")
    with refused("layout_not_seen", by=NoAnswerError):
        named_by_layout(fiducials(np.vstack([off, [[200.0, 10, 40]]])), layout, "layout")


def test_discs_as_large_as_the_balls_are_told_apart():
    """As electrodes are: not one list; what a count leaves out is doubtful."""
    both = Seen((*fiducials(LAYOUT), *fiducials(LAYOUT[:3] + 200.0, "disc")), ())
    with refused("markers_unclear", by=NoAnswerError):
        choose_fiducials(both, Stated(), where="test")
    chosen = choose_fiducials(both, Stated(count=5), where="test")
    assert [one.reading.shape.kind for one in chosen.fiducials] == ["ball"] * 5 and len(chosen.doubtful) == 3


SCENES = {
    "two that touch": (1, Markers("disc", 6.0, thick=2.5, count=5), ("staples", "wire"), "touching"),
    "rings nearly as wide as snaps": (2, Markers("ring", 5.8, thick=1.5, count=5), ("electrodes", "piercing"), "none"),
    "balls as wide as buttons": (3, Markers("ball", 9.0, count=4), ("buttons", "port"), "none"),
    "too small for the slices": (5, Markers("ball", 1.2, 900.0, count=4), ("staples", "calcified"), "none"),
}


@pytest.mark.parametrize("name", SCENES)
def test_what_is_no_marker_is_never_in_a_list(name):
    """With a count or without; what is lost beside others is doubtful, or there is no list."""
    seed, markers, extras, trouble = SCENES[name]
    row = counted(benchmark_scene(np.random.default_rng(seed), markers, 2.0, extras, trouble))
    for stated in ("alone", "counted"):
        assert not row[stated].get("false")
        if "listed" in row[stated]:
            assert all(one["found"] or one["doubtful"] for one in row["markers"])
    if trouble == "touching":
        assert row["alone"] == {"listed": 3, "false": []} and row["counted"] == {"refused": "too_few_markers"}


def test_what_differs_by_more_than_its_reading_is_another_product():
    """8 mm and 8.2 mm read to 2 % are alike, 9.5 mm are not; a count takes no group beside one that may lack some."""
    few, many = fiducials(LAYOUT[:3]), fiducials(LAYOUT + 200.0, diameter=9.5)
    near = fiducials(LAYOUT[3:] - 100.0, diameter=8.2)
    assert len(choose_fiducials(Seen((*few, *near), ()), Stated(), where="test").fiducials) == 5
    with refused("markers_unclear", by=NoAnswerError):
        choose_fiducials(Seen((*few, *many), ()), Stated(), where="test")
    assert len(choose_fiducials(Seen((*few, *many), ()), Stated(count=5), where="test").fiducials) == 5
    pair = Passed(LAYOUT[3], "long, as wires and clips are", nearly=True)
    with refused("markers_unclear", by=NoAnswerError):
        choose_fiducials(Seen((*few, *many), (pair,)), Stated(count=5), where="test")


def test_things_alike_by_one_between_them_are_no_list():
    """8 mm and 9 mm differ, 8.5 mm may be either."""
    chain = [one for mm, k in ((8.0, 0), (8.5, 2), (9.0, 3)) for one in fiducials(LAYOUT[k : k + 2], diameter=mm)]
    with refused("markers_unclear", by=NoAnswerError):
        choose_fiducials(Seen(tuple(chain), ()), Stated(), where="test")


REAL = [REAL_CT / "ct.nii.gz", DATA / "slicer_chest_ct4" / "CTChest4.nrrd"]


def drawn_into(volume, skin, diameter, hu, rng, count=5):
    """Balls drawn onto the skin of a CT: voxels cut into 6 x 6 x 6 points, blurred; centres (n, 3) and the image."""
    T, faces = volume.T_ct_index, np.flatnonzero(~skin.cut_faces)
    corners = skin.mesh.triangles[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    middles, hu_drawn, centres = corners.mean(axis=1), volume.values.astype(float), []
    inner = np.linalg.inv(T)
    spacing = np.linalg.norm(T[:3, :3], axis=0)
    while len(centres) < count:
        row = rng.integers(len(faces))
        centre = middles[row] + (diameter / 2 + 0.3) * normals[row]
        index = inner[:3, :3] @ centre + inner[:3, 3]
        low = np.floor(index - (diameter / 2 + 4.0) / spacing).astype(int)
        high = np.ceil(index + (diameter / 2 + 4.0) / spacing).astype(int) + 1
        near = centres and np.linalg.norm(np.array(centres) - centre, axis=1).min() < 50.0
        if normals[row, 1] > -0.5 or near or low.min() < 1 or np.any(high >= volume.values.shape):
            continue
        cells = [np.arange(a, b, 1 / 6) + 1 / 12 - 0.5 for a, b in zip(low, high, strict=True)]
        grid = np.stack(np.meshgrid(*cells, indexing="ij"), axis=-1) @ T[:3, :3].T + T[:3, 3]
        inside = np.linalg.norm(grid - centre, axis=-1) < diameter / 2
        size = high - low
        part = inside.reshape(size[0], 6, size[1], 6, size[2], 6).mean(axis=(1, 3, 5))
        box = tuple(map(slice, low, high))
        hu_drawn[box] = np.minimum(hu_drawn[box] + part * (hu - hu_drawn[box]), 3071.0)
        centres.append(centre)
    return np.array(centres), Volume(np.rint(hu_drawn).astype(np.int16), T, volume.path)


@pytest.mark.parametrize(("path", "diameter"), [(REAL[0], 8.0), (REAL[1], 15.0)], ids=["abdomen", "chest"])
def test_real_cts(path, diameter):
    """They hold no marker, and none is seen; balls drawn into them by another renderer are all found."""
    if not path.exists():
        pytest.skip(f"{path.name} is not on this machine")
    volume, skin = body_of(read_volume(path))
    assert look_for_fiducials(volume, skin).fiducials == ()
    true, drawn = drawn_into(volume, skin, diameter, 8000.0, np.random.default_rng(2))
    errors, covs, false = matched(true, look_for_fiducials(drawn, skin).fiducials)
    assert (len(errors), false) == (len(true), 0)
    assert np.all(np.abs(errors) < 0.12 * np.linalg.norm(volume.T_ct_index[:3, :3], axis=0))
    assert np.mean([e @ np.linalg.solve(c, e) for e, c in zip(errors, covs, strict=True)]) / 3 < 2.5


def test_a_marker_on_a_rib_is_told_from_it_and_a_calcification_is_passed_over():
    """On the skin over bone 3 mm from it; contrast 3 mm under the skin is none, whatever its size."""
    rng = np.random.default_rng(8)
    true, solids = scene(Markers("ball", 6.0, 900.0, count=4), rng, others=False)
    others = [one for one in distractors(rng) if one.name == "calcification"]
    ribs = [Solid("rib", ball(point * (1 - 11.0 / np.linalg.norm(point)), 9.0), 500.0) for point in true]
    volume, skin = body_of(scanned([*solids[:1], *ribs, *others, *solids[1:]], ScanSettings(2.0, 0.9), rng))
    errors, _, false = matched(true, find_fiducials(volume, skin, Stated(), where="test").fiducials)
    assert (len(errors), false) == (4, 0)
