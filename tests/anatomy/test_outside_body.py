"""What the border of an image cuts goes on beyond it: against closed forms, and a body that does go on."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy

from puncture_twin.planning.anatomy.anatomy import ball
from puncture_twin.planning.anatomy.body.cut_ends import FieldOfView
from puncture_twin.planning.anatomy.body.tables import TableSide
from puncture_twin.planning.anatomy.scan import (
    BEYOND_MM,
    BLOCK_MM,
    BULKY_ML,
    CUT_AT_MM,
    OutsideImage,
    outside_mask,
    outside_surface,
)
from puncture_twin.planning.anatomy.unseen import OUTLINE_MM, REACH_MM, USUAL_MM, assumed, beyond_image
from puncture_twin.planning.case.settings import CtSettings
from puncture_twin.planning.geometry.containment import Side, inside_each, side_of
from puncture_twin.planning.geometry.mesh import TriangleMesh, joined
from puncture_twin.planning.geometry.rigid import exp_rotation

SPACING = np.array([2.0, 2.0, 3.0])
SHAPE = (40, 30, 20)
BAR = (slice(10, 16), slice(20, 24))
"""A bar along the bed: 20 to 30 mm, and 40 to 46 mm, by its voxels' centres."""


def image_of(hu, spacing_mm=SPACING, **keys) -> OutsideImage:
    nothing, spacing_mm = np.zeros(hu.shape, bool), np.broadcast_to(spacing_mm, 3)
    return OutsideImage(hu, nothing, nothing, np.diag([*spacing_mm, 1.0]), spacing_mm, **keys)


def in_air(slopes=(0.0, 0.0)) -> OutsideImage:
    return image_of(np.full(SHAPE, -1000.0, np.float32), slopes=slopes)


@pytest.fixture
def bar() -> TriangleMesh:
    mask = np.zeros(SHAPE, bool)
    mask[BAR] = True
    return outside_surface(in_air(), mask, where="bar")


@pytest.mark.parametrize(
    ("hu", "voxels", "seen"), [(-270.0, 12, False), (-230.0, 12, True), (-230.0, 6, False), (-400.0, 18, False)]
)
def test_a_fold_of_cloth_is_air_and_what_is_solid_is_not(hu, voxels, seen):
    """Of 12 mm3 a voxel: cloth of half of water's density; one voxel of a line's middle; noise; a longer fold."""
    image = in_air()
    image.hu[20, 15, :voxels] = -420.0
    image.hu[20, 15, voxels // 2] = hu
    assert outside_mask(image, -900.0).any() == seen


def test_a_line_between_voxels_is_seen_by_its_length():
    """Nowhere denser than -400 HU, in 60 mm of its length; 24 mm of it may be cloth."""
    image = in_air()
    image.hu[20:22, 15:17] = -400.0
    assert outside_mask(image, -900.0)[20:22, 15:17].all()
    image.hu[20:22, 15:17, 8:] = -1000.0
    assert not outside_mask(image, -900.0).any()


@pytest.mark.parametrize("air_hu", [-1000.0, -950.0])
def test_noise_of_air_is_air_and_foam_in_it_is_not(air_hu):
    """Of 60 HU in voxels of 3 mm a fifth is denser than -900; a foam of -800 HU is told by wider means."""
    hu = np.random.default_rng(4).normal(air_hu, 60.0, (48, 40, 30))
    image = image_of(hu, 3.0)
    assert not outside_mask(image, -900.0).any()
    hu[:, 20:28] += -800.0 - air_hu
    mask = outside_mask(image, -900.0)
    assert mask[:, 21:27].all()
    assert not mask[:, :17].any()
    assert not mask[:, 31:].any()


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("end", [0, -1])
def test_it_is_as_wide_beyond_every_other_side(axis, end):
    """A flat piece that a side of the image cuts: 6 mm thick to the end of what is drawn out there."""
    mask = np.zeros(SHAPE, bool)
    mask[(slice(0, 20), slice(10, 20))[axis], (slice(10, 20), slice(0, 20))[axis], 9:11] = True
    mask = mask if end == 0 else np.flip(mask, axis)
    surface = outside_surface(in_air(), mask, where="plate")
    just = np.array([[0, 0, 2.99], [0, 0, -2.99], [0, 0, 3.01], [0, 0, -3.01]])
    for beyond_mm in (1.0, 50.0, 99.0):
        point = np.array([29.0, 29.0, 28.5])
        point[axis] = -beyond_mm if end == 0 else (SHAPE[axis] - 1) * SPACING[axis] + beyond_mm
        assert inside_each(surface, point + just).tolist() == [True, True, False, False]


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("end", [0, -1])
def test_between_cut_sections_of_a_bulky_piece_nothing_is_free(axis, end):
    """A table that sags below the image: both ends of it are seen, and between them it goes on."""
    mask = np.zeros(SHAPE, bool)
    mask[(slice(0, 30), slice(5, 25))[axis], (slice(5, 25), slice(0, 25))[axis], 5:15] = True
    mask = mask if end == 0 else np.flip(mask, axis)
    assert mask.sum() * SPACING.prod() / 1000.0 > BULKY_ML
    surface = outside_surface(in_air(), mask, where="table")
    assert surface.closed and surface.wound_alike
    point = np.array([29.0, 29.0, 28.5])
    point[axis] = -50.0 if end == 0 else (SHAPE[axis] - 1) * SPACING[axis] + 50.0
    assert inside_each(surface, point[None]).tolist() == [True]
    assert side_of(surface, point) is Side.INSIDE


@pytest.mark.parametrize("rises", [True, False])
def test_a_cradle_goes_on_rising_beyond_the_sides(rises):
    """A shell of 20 mm about an arc of 215 mm, cut at 140 mm of its 205: all of it is covered. A flat one is flat."""
    step = 3.0
    x, y, z = np.meshgrid(*(np.arange(a, b, step) for a, b in ((-140, 141), (-60, 131), (-30, 31))), indexing="ij")
    shell = np.abs(np.hypot(x, y + 110.0) - 215.0) <= 10.0 if rises else np.abs(y - 53.0) <= 10.0
    shell &= y > -50.0
    image = image_of(np.where(shell, 100.0, -1000.0), step)
    image.T_ct_index[:3, 3] = x.flat[0], y.flat[0], z.flat[0]
    surface = outside_surface(image, shell, where="cradle")
    turn = np.radians(np.arange(45.0, 73.0, 2.0))
    for sign in (-1.0, 1.0):
        arc = np.column_stack([sign * 215.0 * np.sin(turn), 215.0 * np.cos(turn) - 110.0, 0.0 * turn])
        above = np.column_stack([np.full(3, sign * 200.0), [-40.0, 0.0, 30.0], np.zeros(3)])
        assert inside_each(surface, arc).all() == rises
        assert not rises or not inside_each(surface, arc - [0.0, 130.0, 0.0]).any()
        assert rises or not inside_each(surface, above).any()


def test_it_goes_on_as_far_as_is_said(bar):
    """Along the bed, from the outer face of the last voxels; it is closed."""
    ends = -0.5 * SPACING[2] - BEYOND_MM[2], (SHAPE[2] - 0.5) * SPACING[2] + BEYOND_MM[2]
    np.testing.assert_allclose(bar.bounds[:, 2], ends, atol=1e-9)
    assert bar.closed


@pytest.mark.parametrize("beyond_mm", [1.0, 29.0, 100.0, 400.0, 479.0])
def test_it_is_as_wide_beyond_the_image_as_at_its_border(bar, beyond_mm):
    """Points just within and just outside of each side, as far beyond as a needle reaches."""
    sides = np.array([[6.0, 0.0, 0.0], [-6.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, -4.0, 0.0]])
    for z in ((SHAPE[2] - 1) * SPACING[2] + beyond_mm, -beyond_mm):
        assert inside_each(bar, [25.0, 43.0, z] + 0.999 * sides).all()
        assert not inside_each(bar, [25.0, 43.0, z] + 1.001 * sides).any()


@pytest.fixture
def table() -> TriangleMesh:
    """Beyond a curved section behind the body, of a bed that runs at an angle to the slices' axis."""
    section = 20.0 + 0.01 * (np.arange(40.0) - 20.0) ** 2
    line = section[:, None] - 0.05 * np.arange(SHAPE[2])
    side = TableSide((1, -1), line, np.ones(40, bool), -0.05 * SPACING[1] / SPACING[2], 60.0, firm=True)
    return outside_surface(in_air((0.0, side.slope)), side.beyond(SHAPE), where="table")


@pytest.mark.parametrize("z_mm", [-1999.0, -480.0, -75.0, 0.0, 28.5, 57.0, 300.0, 2050.0])
def test_a_table_goes_on_along_its_own_direction(table, z_mm):
    """A voxel before and behind its section in any slice, in the middle of its width."""
    x, y = 20.0 * SPACING[0], (20.0 - 0.05 * z_mm / SPACING[2]) * SPACING[1]
    assert table.closed and table.wound_alike
    assert inside_each(table, np.array([[x, y + 2.5, z_mm], [x, y - 2.5, z_mm]])).tolist() == [True, False]


@pytest.mark.parametrize("name", ["bar", "table"])
def test_no_triangle_near_the_image_is_long(name, request):
    """Those that begin before a cut end there."""
    bar = request.getfixturevalue(name)
    last = (SHAPE[2] - 1) * SPACING[2]
    z = np.sort(bar.vertices[bar.faces][..., 2], axis=1)
    for cut, following in zip((0.0, *CUT_AT_MM[:-1]), CUT_AT_MM, strict=True):
        for low, high in ((last + cut, last + following), (-following, -cut)):
            crossing = (z[:, 0] < high - 1e-9) & (z[:, 2] > low + 1e-9)
            assert crossing.any()
            assert np.all((z[crossing, 0] >= low - 1e-9) & (z[crossing, 2] <= high + 1e-9))


@pytest.mark.parametrize("shape", [(61, 48, 37), (60, 47, 38)])
def test_of_fine_voxels_it_is_drawn_about_blocks(shape):
    """It holds every voxel that is dense, also a wire of one, and lies never farther from them than two blocks."""
    rng, spacing_mm = np.random.default_rng(5), np.array([0.8, 0.6, 1.0])
    mask = np.zeros(shape, bool)
    for low in rng.integers(0, np.array(shape) - 12, (6, 3)):
        mask[tuple(slice(a, a + 12) for a in low)] = True
    mask[:10, :, -9:] = True  # at two faces of the image and in a corner
    for place in rng.integers(1, np.array(shape) - 1, (20, 3)):
        mask[tuple(place)] = mask[place[0], place[1], :] = True
    image = image_of(mask, spacing_mm, beyond_mm=(5.0, 5.0, 500.0))
    surface = outside_surface(image, mask, where="fine")
    assert surface.closed
    gap_mm = scipy.ndimage.distance_transform_edt(~mask, sampling=spacing_mm)
    far, some = np.argwhere(gap_mm > 3.0**0.5 * 1.5 * BLOCK_MM), ~scipy.ndimage.binary_erosion(mask)
    some |= rng.random(shape) < 0.1
    assert inside_each(surface, np.argwhere(mask & some) * spacing_mm).all()
    assert len(far) > 1000 and not inside_each(surface, far[:: len(far) // 500] * spacing_mm).any()
    finest = outside_surface(replace(image, spacing_mm=np.full(3, BLOCK_MM)), mask, where="coarse")
    assert len(surface.faces) < 0.5 * len(finest.faces)


SIZE = np.array([300.0, 240.0, 180.0])
HEAD, LEFT = (2, 1), (0, 1)
TRUNK, RIGHT_ARM, LEFT_ARM = [((0, 0, 0), 150)], ((-350, 0, 0), 50), ((350, 40, 0), 50)
"""Balls."""


def box_with(*faces, T_ct_box=None):
    """An image of 300 x 240 x 180 mm that cuts the body at these faces."""
    cut = np.zeros((3, 2), bool)
    for axis, end in faces:
        cut[axis, end] = True
    return FieldOfView(np.eye(4) if T_ct_box is None else T_ct_box, SIZE, cut)


def cylinder(radius=80.0, middle=(150.0, 120.0)):
    """Points on a round body along z, as a fine surface has them; box frame."""
    angles = np.linspace(0, 2 * np.pi, 721)
    ring = np.stack([middle[0] + radius * np.cos(angles), middle[1] + radius * np.sin(angles)], axis=1)
    return np.concatenate([np.insert(ring, 2, z, axis=1) for z in np.arange(0.0, SIZE[2] + 1, 5.0)])


def inside(mesh, points):
    """Which points lie in a closed solid whose parts may overlap."""
    return np.array([side_of(mesh, point) is Side.INSIDE for point in points])


@pytest.mark.parametrize("wider", [0.0, 150.0])
def test_a_round_body_goes_on_as_a_wider_cylinder(rng, wider):
    """Beyond the plane, and there alone; nearer to the axis than radius and growth, and no farther by 1 %."""
    mesh = beyond_image(box_with(HEAD), cylinder(), wider)
    assert mesh.closed
    far = rng.uniform([-400, -400, SIZE[2] - 50], [700, 640, SIZE[2] + REACH_MM + 50], (3000, 3))
    beyond = (far[:, 2] > SIZE[2]) & (far[:, 2] < SIZE[2] + REACH_MM)
    away = np.hypot(far[:, 0] - 150.0, far[:, 1] - 120.0)
    found, limit = inside(mesh, far), 80.0 + wider
    assert found[beyond & (away < limit)].all()
    assert not found[~beyond | (away > limit / np.cos(np.pi / 32) + 1e-6)].any()
    assert found.sum() > 30


def test_without_a_bound_all_beyond_the_plane_is_unknown(rng):
    """The half space, as far as a needle and its arm reach, and nothing before the plane."""
    mesh = beyond_image(box_with(HEAD, LEFT), cylinder(), np.inf)
    points = rng.uniform(-1500, 1700, (2000, 3))
    expected = (points[:, 2] > SIZE[2]) | (points[:, 0] > SIZE[0])
    np.testing.assert_array_equal(inside(mesh, points), expected)


def test_where_two_neighbouring_faces_cut_the_body_the_corner_is_unknown_too():
    """A body that leaves at the left and at the head goes on beyond both, also without any growth."""
    points = cylinder(middle=(260.0, 120.0))
    points = points[points[:, 0] <= SIZE[0]]
    points = np.concatenate([points, [[SIZE[0], y, z] for y in (60.0, 180.0) for z in (0.0, 90.0, SIZE[2])]])
    corner = np.array([[SIZE[0] + 380, 120.0, SIZE[2] + 300], [SIZE[0] + 20, 120.0, SIZE[2] + 1500]])
    assert inside(beyond_image(box_with(HEAD, LEFT), points, 0.0), corner).all()
    alone = inside(beyond_image(box_with(HEAD), points, 0.0), corner)
    assert not alone.any()


def test_a_turned_image_turns_its_solid(rng):
    """An image whose axes are not those of the bed: the same solid in its own frame, normals outward."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = exp_rotation(np.array([0.3, -0.4, 0.5])), [10.0, -20.0, 30.0]
    turned = beyond_image(box_with(HEAD, (1, 0), T_ct_box=T), cylinder() @ T[:3, :3].T + T[:3, 3], 50.0)
    straight = beyond_image(box_with(HEAD, (1, 0)), cylinder(), 50.0)
    np.testing.assert_allclose(turned.vertices, straight.vertices @ T[:3, :3].T + T[:3, 3], atol=1e-9)
    a, b, c = np.moveaxis(straight.triangles, 1, 0)
    assert np.einsum("ij,ij->", a, np.cross(b, c)) > 0


def test_less_air_beside_the_body_changes_nothing():
    """Rows of air cut off the image: the outline is the body's, not the image's."""
    view, points = box_with(HEAD, (2, 0)), cylinder()
    whole = beyond_image(view, points, 40.0)
    narrow = beyond_image(replace(view, size_mm=SIZE - [0.0, 30.0, 0.0]), points, 40.0)
    np.testing.assert_allclose(narrow.vertices, whole.vertices)


def test_a_body_that_narrows_is_taken_as_wide_as_in_its_last_slices():
    """A cone: the widest of the last 10 mm counts, so that a slice thinner than the outline never narrows it."""
    points = cylinder()
    narrowing = 1.0 - 0.5 * points[:, 2:] / SIZE[2]
    points[:, :2] = [150.0, 120.0] + narrowing * (points[:, :2] - [150.0, 120.0])
    reach = beyond_image(box_with(HEAD), points, 0.0).vertices[:, 0].max() - 150.0
    assert 80.0 * (1 - 0.5) <= reach <= 80.0 * (1 - 0.5 * (SIZE[2] - OUTLINE_MM) / SIZE[2]) + 0.5


def test_a_breath_brings_it_nearer():
    """What moves by up to 12 mm along the bed may come 12 mm nearer, and be as much wider."""
    still, moved = (beyond_image(box_with(HEAD), cylinder(), 0.0, by) for by in (None, np.array([0.0, 0.0, 12.0])))
    assert moved.vertices[:, 2].min() == pytest.approx(still.vertices[:, 2].min() - 12.0)
    assert moved.vertices[:, 0].max() == pytest.approx(still.vertices[:, 0].max() + 12.0)


@pytest.mark.parametrize(
    ("stated", "region", "cut", "parts", "wider"),
    [
        ({}, "abdomen", [HEAD], TRUNK, np.inf),
        ({}, "abdomen", [HEAD], [*TRUNK, RIGHT_ARM], np.inf),
        ({}, "abdomen", [HEAD], [*TRUNK, RIGHT_ARM, ((350, 0, 0), 20)], np.inf),
        ({}, "abdomen", [HEAD], [*TRUNK, RIGHT_ARM, ((0, 250, 0), 50)], np.inf),
        ({}, "abdomen", [HEAD], [*TRUNK, RIGHT_ARM, LEFT_ARM], USUAL_MM),
        ({}, "abdomen", [HEAD, LEFT], [*TRUNK, RIGHT_ARM, LEFT_ARM], np.inf),
        ({"arms": "none"}, "abdomen", [HEAD], TRUNK, USUAL_MM),
        ({}, "phantom", [HEAD], TRUNK, USUAL_MM),
        ({"arms": "present"}, "abdomen", [HEAD], TRUNK, USUAL_MM),
        ({"arms": "present"}, "abdomen", [HEAD, LEFT], TRUNK, np.inf),
        ({"arms": "none", "beyond_mm": np.inf}, "phantom", [HEAD], TRUNK, np.inf),
        ({"beyond_mm": 0.0}, "abdomen", [HEAD, LEFT], TRUNK, 0.0),
    ],
)
def test_what_is_assumed(stated, region, cut, parts, wider):
    """A person's word first; the usual where no arm can lie beyond, or both are seen; else nothing is excluded."""
    case = SimpleNamespace(ct=CtSettings(**stated), region=region)
    skin = SimpleNamespace(mesh=joined([ball(np.array(middle, float), radius) for middle, radius in parts]))
    assert assumed(case, box_with(*cut), skin).wider_mm == wider
