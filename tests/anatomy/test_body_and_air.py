"""What counts as body and as air: patients on a table, with arms, mattress, sheet and line, whose truth is known."""

from collections import Counter
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import scipy
import SimpleITK as sitk  # noqa: N813
from case_world import whole
from refusals import refused

from puncture_twin.planning.anatomy.anatomy import OUTSIDE_NOT_KNOWN, ball
from puncture_twin.planning.anatomy.body.body_mask import (
    BLANK_HU,
    body_mask,
    filled_slices,
    find_unscanned,
    measured_hu,
)
from puncture_twin.planning.anatomy.structure import Role, Structure
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.certify.checker import verify
from puncture_twin.planning.certify.subdivision import certify
from puncture_twin.planning.formats.volumes import volume_header
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid
from puncture_twin.planning.reach.standoff import standoffs
from puncture_twin.planning.search.context import prepare
from puncture_twin.twin.plant.scanner.image import ScanSettings, scan_solids
from tools.phantoms import supine
from tools.phantoms.ct_image import Grid, ScannedPart, rendered
from tools.phantoms.implicit import capsule, ellipsoid

KIDNEY_FIELD = ellipsoid((75.0, 40.0, 0.0), (20, 15, 40))
CASE = """
schema = 2
region = "other"
name = "supine"
space = "LPS"
[target]
position_mm = {target}
structure = "lesion"
[needle]
length_mm = 210.0
shaft_mm = 150.0
diameter_mm = 1.2
[search]
theta_deg = [0, 180]
step_deg = 6.0
max_skin_angle_deg = 75
{search}
[[structure]]
name = "skin"
role = "skin"
{skin}
[[structure]]
name = "lesion"
labelmap = "labels.nii.gz"
label = 1
role = "target"
{structures}
{more}
"""
AVOIDED = '[[structure]]\nname = "{}"\nlabelmap = "labels.nii.gz"\nlabel = {}\nrole = "avoid"\nmargin_mm = 2.0\n'
SPINE, LEFT, RIGHT, KIDNEY = (
    AVOIDED.format(name, label)
    for label, name in enumerate(("spine", "humerus_left", "humerus_right", "kidney"), start=2)
)
TRUNK_SKIN = 'labelmap = "trunk.nii.gz"\nlabel = 1'
BESIDE = '[ct]\nfile = "{}.nii.gz"'


def write_image(path, values, grid):
    image = sitk.GetImageFromArray(values.transpose(2, 1, 0))
    image.SetSpacing(grid.spacing_mm)
    image.SetOrigin(grid.low_mm)
    sitk.WriteImage(image, str(path))


def within(field, grid):
    return (field(grid.centres()) < 0).reshape(grid.shape)


def write_scene(folder, parts, grid=None, fill=None, scanner=False):
    """``ct.nii.gz``, ``labels.nii.gz`` of lesion (1), spine (2), humeri (3, 4) and kidney (5), ``trunk.nii.gz``.

    ``fill``: the voxels that were not scanned, and the value that is written there. ``scanner``: surfaces, exact
    partial volume, blur and noise.
    """
    grid, rng = grid or supine.grid(), np.random.default_rng(3)
    if scanner:
        settings = ScanSettings(grid.spacing_mm[2], grid.spacing_mm[0], noise_hu=15.0)
        hu = scan_solids(supine.solids(parts), VolumeGrid(grid.shape, grid.affine, {}), settings, rng).hu
    else:
        hu = rendered(parts, grid, noise_hu=15.0, rng=rng)
    labels, fields = np.zeros(grid.shape, np.uint8), {part.name: part.field for part in parts}
    for label, name in enumerate(("lesion", "spine", "humerus_left", "humerus_right"), start=1):
        if name in fields:
            labels[within(fields[name], grid)] = label
    labels[within(KIDNEY_FIELD, grid)] = 5
    if fill is not None:
        labels[fill[0]], hu[fill[0]] = 0, fill[1]
    images = {"ct": hu.astype(np.int16), "labels": labels, "trunk": within(parts[0].field, grid).astype(np.uint8)}
    for name, values in images.items():
        write_image(folder / f"{name}.nii.gz", values, grid)


def write_case(folder, *, skin='ct = "ct.nii.gz"', structures=SPINE, search="", more="", target=(-55.0, 20.0, 0.0)):
    path = folder / f"case{len(list(folder.glob('*.toml')))}.toml"
    text = CASE.format(target=list(target), search=search, skin=skin, structures=structures, more=more)
    path.write_text(whole(text))
    return path


def searched(folder, **keys):
    context = prepare(write_case(folder, **keys), arm=False)
    return context, context.search()


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A function: the folder of a scene, and its parts."""
    trunk, arms, bed = supine.trunk_parts(), supine.arm_parts("down"), supine.bed_parts()
    every = [*trunk, *arms, *bed, supine.line_part(), supine.sheet_part()]
    scenes = {
        "arms": trunk + arms,
        "bed": trunk + bed,
        "all": every,
        "alone": trunk + supine.arm_parts("up"),
        "gap": [*trunk, *supine.bed_parts(gap_mm=12.0)],
        "all by the scanner": every,
    }

    @cache
    def make(name):
        folder = tmp_path_factory.mktemp(name)
        write_scene(folder, scenes[name], scanner="scanner" in name)
        return folder, scenes[name]

    return make


@pytest.fixture(scope="module")
def usual(scene):
    """A function: a scene's parts, and context and search of its usual case."""

    @cache
    def make(name):
        folder, parts = scene(name)
        return parts, *searched(folder)

    return make


def hit_parts(context, found, parts, names, beyond_mm=1.0):
    """Names of parts whose truth the axis of a safe needle enters between skin and flange at standoff."""
    case, hit = context.case, set()
    for row in np.flatnonzero(found.safe):
        standoff = float(standoffs(case.needle, found.path.length[row], found.path.skin_angle[row]))
        depths = np.arange(found.path.length[row] + beyond_mm, standoff + case.needle.length_mm, 0.5)
        points = case.target_ct + depths[:, None] * found.outward_ct[row]
        hit |= {part.name for part in parts if part.name in names and part.field(points).min() < 0.0}
    return hit


def depth_in(context, outward_ct, part, step_mm=1.0):
    """How deep straight lines from the target, as long as the needle, come into a part's truth, mm."""
    depths = np.arange(0.0, context.case.needle.length_mm, step_mm)
    points = context.case.target_ct + depths[:, None, None] * outward_ct
    return -part.field(points.reshape(-1, 3)).reshape(points.shape[:2]).min(axis=0)


def through(context, found, part, least):
    """Rows whose line passes a part's truth, at least so many; none of them is safe."""
    rows = depth_in(context, found.outward_ct, part) > 3.0
    assert rows.sum() > least
    assert not found.safe[rows].any()
    return rows


def part_of(parts, name):
    return next(part for part in parts if part.name == name)


def said(context):
    return " ".join(context.anatomy.warnings)


OUTER = ("arm_left", "arm_right", "humerus_left", "humerus_right", "mattress", "table", "line", "sheet")


@pytest.mark.parametrize("name", ["bed", "all", "all by the scanner"])
def test_no_safe_needle_passes_what_the_scan_shows_outside_of_the_trunk(usual, name):
    """Arms, table, mattress, sheet and line: none is entered by a safe needle, inserted or at its standoff."""
    parts, context, found = usual(name)
    assert hit_parts(context, found, parts, OUTER) == set()
    assert found.safe.sum() > 40


def test_a_search_inflates_each_file_once(scene, monkeypatch, tmp_path):
    """The CT gives the skin, what lies around it and what no label names; the map gives many labels: each one reading.

    The second search finds all surfaces kept: it inflates a file only where it needs voxels, and at most once.
    """
    monkeypatch.setenv("PUNCTURE_TWIN_CACHE", str(tmp_path))
    read, inflated = Counter(), volume_header.inflated

    def counted(content, promised, *, where):
        read[where.name] += 1
        return inflated(content, promised, where=where)

    monkeypatch.setattr(volume_header, "inflated", counted)
    folder, _ = scene("arms")
    for most in ({"ct.nii.gz": 1, "labels.nii.gz": 1}, {"ct.nii.gz": 1}):
        read.clear()
        searched(folder, structures=SPINE + LEFT + RIGHT)
        assert read <= Counter(most)
    assert "labels.nii.gz" not in read


def test_a_detached_arm_is_body(scene):
    """A path into an arm enters skin again; a warning names both arms, and a labelled humerus lies inside the skin."""
    folder, parts = scene("arms")
    context, found = searched(folder, structures=SPINE + LEFT + RIGHT)
    rows = through(context, found, part_of(parts, "arm_right"), 20)
    assert (found.verdict.reason[rows] == Reason.REENTERS_SKIN).sum() > 10
    assert all(one in said(context) for one in ("not connected to the trunk", "left of it", "right of it"))


def test_the_table_below_a_posterior_target_is_no_air(usual):
    """Every direction through the back meets mattress and table: none is safe, and the reason names the structure."""
    parts, context, found = usual("bed")
    rows = through(context, found, part_of(parts, "table"), 100)
    beyond_skin = rows & (found.verdict.reason == Reason.UNKNOWN_REGION) & (found.verdict.structure == "outside_body")
    assert beyond_skin.sum() > 50


def test_a_trunk_alone_has_nothing_outside_and_nothing_unnamed(usual):
    """Arms up: nothing outside of the body but beyond the image; the spine's label leaves no dense voxel and no gas."""
    _, context, _ = usual("alone")
    assert [one.name for one in context.anatomy.surroundings] == ["beyond_image"]
    assert [one.name for one in context.anatomy.structures] == ["lesion", "spine"]
    assert "not connected" not in said(context)


def test_a_skin_from_elsewhere_with_the_ct_beside_it(scene):
    """The skin is a label of the trunk alone: with ``[ct] file`` arms, table and line are unknown all the same."""
    folder, parts = scene("all")
    blind, seeing = (searched(folder, skin=TRUNK_SKIN, more=more) for more in ("", BESIDE.format("ct")))
    assert OUTSIDE_NOT_KNOWN in said(blind[0]) and OUTSIDE_NOT_KNOWN not in said(seeing[0])
    assert len(hit_parts(*blind, parts, OUTER)) > 3
    assert hit_parts(*seeing, parts, OUTER) == set()
    assert "ct.nii.gz" in str(seeing[0].case.inputs)


def test_a_bone_that_nobody_labelled_is_unknown(scene):
    """Without its label the spine is ``unnamed_dense``; ``[ct] unnamed`` takes it for free, trusted labels do not."""
    folder, parts = scene("alone")
    context, found = searched(folder, structures=KIDNEY)
    trusted, free = searched(folder, structures=KIDNEY, more='[ct]\nunnamed = "free"')
    rows = through(context, found, part_of(parts, "spine"), 20)
    assert "unnamed_dense" in found.clearance.structures
    assert free.safe[rows].any()
    assert "unnamed" in said(trusted)
    labels = searched(folder, structures=KIDNEY, search="trust_labels = true")[1]
    np.testing.assert_array_equal(labels.safe, found.safe)
    unnamed = context.anatomy.scan.unnamed(
        [replace(context.anatomy.structures[0], name="lesion")], context.case.ct.dense_hu
    )
    far, near = ball(context.case.target_ct + [0.0, 0.0, 500.0], 5.0), ball(unnamed.dense.vertices.mean(axis=0), 5.0)
    assert [context.anatomy.scan.may_hold(unnamed, one) for one in (far, near)] == [False, True]  # a target's own ball


def test_gas_outside_of_hollow_organs_is_unknown(tmp_path):
    """A bubble of gas of 30 mm in the trunk that no bowel's label covers: no safe path through it."""
    bubble = ScannedPart("bubble", ellipsoid((-55.0, -50.0, 0.0), (15, 15, 15)), -1000.0)
    write_scene(tmp_path, [*supine.trunk_parts(), bubble])
    context, found = searched(tmp_path)
    rows = through(context, found, bubble, 3)
    assert set(found.verdict.structure[rows & (found.verdict.reason == Reason.UNKNOWN_REGION)]) == {"unnamed_gas"}


def test_holes_are_filled_slice_by_slice(rng):
    """As scipy fills each; what reaches the border of a slice is no hole, whatever closes it above and below."""
    mask = rng.random((20, 17, 6)) < 0.6
    slices = [scipy.ndimage.binary_fill_holes(mask[:, :, k]) for k in range(6)]
    assert np.array_equal(filled_slices(mask), np.stack(slices, axis=2))


@pytest.mark.parametrize(("values", "lung"), [((-950, -950, -930), False), ((-950, -930, -930), True)])
def test_air_at_the_border_is_lung_by_its_median(values, lung):
    """Above -940 HU it is lung, and filled."""
    air = np.resize(np.array(values, np.float32), (60, 40, 40))
    hu = np.concatenate([air, np.full((30, 40, 40), 40.0, np.float32)])
    hu[-5:] = np.random.default_rng(1).normal(-1000.0, 5.0, (5, 40, 40))
    found = body_mask(hu, np.full(3, 2.0), where="made")
    assert found.body[:60].all() == lung


def test_air_of_much_noise_above_a_table_that_was_cut_off_is_the_room_s():
    """Air of -950 HU with noise of 60, a table of which a sixth of all voxels are: the table is none of the air."""
    hu = np.random.default_rng(1).normal(-950.0, 60.0, (60, 50, 30)).astype(np.float32)
    x, y, z = np.indices(hu.shape)
    body, table = np.hypot(x - 30, y - 22) < 12 + z / 20, (y >= 35) & (y < 43) & (abs(x - 30) < 28)
    hu[body | table] = np.random.default_rng(2).normal(30.0, 20.0, np.count_nonzero(body | table))
    found = body_mask(hu, np.full(3, 5.0), where="made")
    assert found.body.sum() < 1.3 * body.sum()


@pytest.mark.parametrize(("name", "y", "size", "least_mm"), [("monitor", -260, 60, 0.0), ("lamp", -280, 40, 210.0)])
def test_an_obstacle_stops_the_needle_without_an_arm_too(scene, usual, name, y, size, least_mm):
    """In front of the trunk, and where only the waiting needle's upper end is, 60 mm beyond the inserted flange."""
    box = f'[[obstacle]]\nname = "{name}"\nframe = "ct"\ncenter_mm = [-55, {y}, 0]\nsize_mm = {[size] * 3}'
    stopped = prepare(write_case(scene("alone")[0], more=box), arm=False).check(0.0, 0.0)
    assert usual("alone")[1].check(0.0, 0.0).safe[0]
    assert (stopped.verdict.reason[0], stopped.verdict.structure[0]) == (Reason.TOO_CLOSE, name)
    assert stopped.verdict.depth[0] > least_mm


def test_a_certificate_holds_outside_of_the_body_too(usual):
    """Between the grid points: no cell that is proven safe holds a direction that the search refuses; on one side."""
    _, context, found = usual("all")
    certificate = certify(context.case, context.anatomy, size=np.radians(6.0), beta=(0, np.pi))
    verify(certificate, context.case, context.anatomy)
    low_theta, high_theta = certificate.leaves.theta.T
    low_beta, high_beta = certificate.leaves.beta.T
    seen = Counter()
    for theta, beta, safe in zip(found.theta, found.beta, found.safe, strict=True):
        contains = (low_theta <= theta) & (theta <= high_theta) & (low_beta <= beta) & (beta <= high_beta)
        letters = set(certificate.verdict[contains])
        assert ("R" if safe else "S") not in letters
        seen.update(letters)
    assert min(seen["S"], seen["R"]) > 60


def test_two_cts_are_refused(scene):
    """``[ct] file`` beside a skin from another CT: which one is right cannot be known."""
    folder, _ = scene("alone")
    (folder / "other.nii.gz").write_bytes((folder / "ct.nii.gz").read_bytes())
    with refused("several_cts"):
        searched(folder, more=BESIDE.format("other"))


@pytest.mark.parametrize(
    "line",
    ['arms = "some"', "table = true", "beyond_mm = -1", 'beyond_mm = "none"']
    + [f"air_hu = {level}" for level in (-1000, -200, '"high"')],
)
def test_what_cannot_be_of_a_ct_is_refused(scene, line):
    """The key is named; ``air_hu`` lies between air and fat."""
    with refused("bad_value", line.split()[0]):
        load_case(write_case(scene("alone")[0], more=f"[ct]\n{line}"))


def test_what_a_person_declares_stands_in_every_result(scene):
    """Arms, table, and how far the body may go on beyond the image."""
    more = '[ct]\narms = "none"\ntable = "present"\nbeyond_mm = "all"'
    context = prepare(write_case(scene("alone")[0], more=more), arm=False)
    assert [one.sentence for one in context.anatomy.findings if one.code == "declared"] == [
        "declared: no arms in the image",
        "declared: a table in the image",
        "declared: beyond the image the body fills all",
    ]
    assert context.case.ct.beyond_mm == np.inf


def slab(half_mm):
    """A solid table on which the back lies, with nothing between, over so much of the bed."""
    low, high = (-250, supine.BACK_MM - 6, -half_mm), (250, supine.BACK_MM + 30, half_mm)
    return [ScannedPart("slab", supine.slab(low, high), 60.0)]


@pytest.mark.parametrize(
    "parts",
    [
        pytest.param(slab(400), id="table"),
        pytest.param(slab(30), id="a board under a third of the image"),
        pytest.param(supine.cradle_parts(), id="wide cradle"),
        pytest.param(
            supine.cradle_parts(radius_mm=180.0, thick_mm=10.0, half_width_mm=150.0, slope=0.04), id="narrow, tilted"
        ),
    ],
)
def test_what_touches_the_back_is_no_body(tmp_path, parts):
    """It holds together with the skin: no path through it is safe, the front stays free, and it is said."""
    write_scene(tmp_path, [*supine.trunk_parts(), *parts])
    context, found = searched(tmp_path)
    through(context, found, parts[-1], 100)
    assert hit_parts(context, found, parts, ("cradle",)) == set()
    assert found.safe.sum() > 40
    assert "at its back side" in said(context)


def crop(folder, box=np.s_[:, :, :], move_mm=(0.0, 0.0, 0.0)):
    """``crop.nii.gz``: a part of the CT, in its place or moved."""
    image = sitk.ReadImage(str(folder / "ct.nii.gz"))[box]
    image.SetOrigin(np.add(image.GetOrigin(), move_mm))
    sitk.WriteImage(image, str(folder / "crop.nii.gz"))


@pytest.mark.parametrize(
    ("name", "box", "names", "least", "key", "faces"),
    [
        ("gap", np.s_[:, :76, :], OUTER, 40, "table", "its back face"),
        ("all", np.s_[34:116, :, :], ("arm_left", "arm_right", "table"), 10, "arms", "right and left face"),
    ],
    ids=["ends before the table", "narrower than the table"],
)
def test_what_an_image_ends_before_is_no_air(scene, name, box, names, least, key, faces):
    """Beyond a face near the body that cuts no table, and beside one that does, is unknown; one warning names it."""
    folder, parts = scene(name)
    crop(folder, box)
    context, found = searched(folder, skin='ct = "crop.nii.gz"')
    assert hit_parts(context, found, parts, names) == set()
    assert found.safe.sum() > least
    assert len([one for one in context.anatomy.warnings if f'{key} = "none"' in one and faces in one]) == 1


def test_air_beside_a_label_of_the_skin_is_no_gas(tmp_path):
    """The tolerance of a skin from elsewhere, wider than two voxels of this scan, leaves the safe front as it is."""
    write_scene(tmp_path, supine.trunk_parts(), supine.grid(slice_mm=8.0))
    context, found = searched(tmp_path, skin=TRUNK_SKIN, more=BESIDE.format("ct"))
    assert [structure.name for structure in context.anatomy.structures] == ["lesion", "spine"]
    assert found.safe.sum() > 40


def test_beyond_a_ct_that_ends_in_the_body_nothing_is_free(scene):
    """A CT of the lesion's surroundings beside a skin from elsewhere shows neither table nor arms: nothing is safe."""
    folder, _ = scene("alone")
    crop(folder, np.s_[52:72, 42:62, 10:30])
    assert searched(folder, skin=TRUNK_SKIN)[1].safe.sum() > 40
    assert searched(folder, skin=TRUNK_SKIN, more=BESIDE.format("crop"))[1].safe.sum() == 0


def test_a_ct_of_another_place_is_refused(scene):
    """Shifted against the skin, or without the target. In its place, the same CT is not blamed."""
    folder, codes = scene("bed")[0], {25.0: "labels_beside_image", 1000.0: "target_outside_ct"}
    for move_mm, code in codes.items():
        crop(folder, move_mm=(move_mm, 0.0, 0.0))
        with refused(code):
            prepare(write_case(folder, skin=TRUNK_SKIN, more=BESIDE.format("crop")), arm=False)
    context = prepare(write_case(folder, skin=TRUNK_SKIN, more=BESIDE.format("ct")), arm=False)
    assert not {one.code for one in context.anatomy.findings} & set(codes.values())


def test_a_table_beside_a_long_image_is_drawn_as_far_as_is_plausible(tmp_path):
    """A CT from head to knee was refused: table and image together were larger than any surface that is read."""
    table = supine.slab((-250, supine.BACK_MM + 10, -2000), (250, supine.BACK_MM + 50, 2000))
    trunk = capsule((0.0, 0.0, -2000.0), (0.0, 0.0, 2000.0), 95.0, 115.0)
    parts = [ScannedPart("trunk", trunk, 20.0), *supine.trunk_parts()[2:], ScannedPart("table", table, 60.0)]
    write_scene(tmp_path, parts, Grid((-296.0, -190.0, -700.0), (8.0, 8.0, 8.0), (75, 48, 175)))
    context = prepare(write_case(tmp_path), arm=False)
    outside = part_of(context.anatomy.surroundings, "outside_body")
    assert np.ptp(outside.mesh.vertices[:, 2]) > 1400.0 + 2 * 900.0


def test_an_obstacle_that_is_nowhere_is_mentioned(scene):
    """Without the base's place an obstacle of the frame ``base`` cannot be checked; a warning names it."""
    box = '[[obstacle]]\nname = "monitor"\nframe = "base"\ncenter_mm = [0, 0, 300]\nsize_mm = [60, 60, 60]'
    context = prepare(write_case(scene("alone")[0], more=box), arm=False)
    assert any("not checked" in warning and "monitor" in warning for warning in context.anatomy.warnings)


def disc(radius, size=80):
    """Pixels of a square image within a circle about its middle."""
    across = np.arange(size) - (size - 1) / 2
    return np.hypot(across[:, None], across) <= radius


def test_what_is_padded_around_a_circle_was_not_scanned():
    """One least value outside of the circle of reconstruction, be it that of air, is no air."""
    hu = np.random.default_rng(1).normal(-1000.0, 15.0, (80, 80, 12)).clip(-1024)
    for padding in (-3024.0, -1024.0, -1000.0, 0.0):
        padded = np.where(disc(39.0)[:, :, None], hu, padding)
        found = find_unscanned(padded)
        assert found[~disc(39.0)].all()
        assert not (found[disc(39.0)] & (padded[disc(39.0)] != padding)).any()
        assert found[disc(36.0)].sum() == 0


def beyond_slab(grid):
    """What a tilted gantry leaves when its slices are made straight."""
    _, y, z = np.moveaxis(grid.centres().reshape(*grid.shape, 3), -1, 0)
    return np.abs(z * np.cos(0.26) - y * np.sin(0.26)) > 60.0


def beyond_ends(grid):
    return np.abs(grid.centres()[:, 2].reshape(grid.shape)) > 80.0


@pytest.mark.parametrize(("padded", "value"), [(beyond_slab, -1024.0), (beyond_slab, 0.0), (beyond_ends, -1024.0)])
def test_where_a_volume_is_filled_up_there_is_neither_skin_nor_air(tmp_path, padded, value):
    """Padded with air's value, half of the "safe" needles left the body through a cut, some of them past the spine."""
    parts = [*supine.trunk_parts(), *supine.bed_parts()]
    grid = Grid((-296.0, -190.0, -117.0), (8.0, 4.0, 6.0), (75, 95, 40))
    write_scene(tmp_path, parts, grid, fill=(padded(grid), value))
    context, found = searched(tmp_path)
    cut = context.anatomy.skin.field_of_view.cut[2].all()
    assert cut if padded is beyond_ends else "a constant fill value" in said(context)
    assert found.safe.sum() > 40
    assert hit_parts(context, found, parts, {"trunk", "table", "spine"}, beyond_mm=12.0) == set()


@pytest.mark.parametrize("value", [-1024.0, 0.0])
def test_a_slice_of_one_value_was_not_scanned(value):
    """A lost slice in the middle of a volume would be skin to both sides; air with noise is kept as it is."""
    hu = np.random.default_rng(1).normal(-1000.0, 15.0, (40, 40, 12))
    assert measured_hu(hu)[0] is hu
    hu[:, :, 5] = value
    assert np.array_equal(find_unscanned(hu), np.broadcast_to(np.arange(12) == 5, hu.shape))
    assert (measured_hu(hu)[0][:, :, 5] == (BLANK_HU if value == 0.0 else value)).all()


def test_constant_air_about_a_body_was_scanned():
    """A round body in air without noise, and clipped air with noise, are no circle of reconstruction."""
    rng = np.random.default_rng(1)
    for hu in (
        np.where(disc(25.0)[:, :, None], 40.0, np.full((80, 80, 12), -1000.0)),
        np.where(sum((np.indices((99, 99, 99)) - 49.0) ** 2) < 45.0**2, 40.0, -1000.0),
        rng.normal(-1024.0, 15.0, (80, 80, 12)).clip(-1024),
        np.where(disc(30.0)[:, :, None], rng.normal(40.0, 15.0, (80, 80, 12)), -1024.0),
    ):
        assert not find_unscanned(hu).any()


def upright(x, y, thick_mm, wide_mm):
    def field(points):
        off = (points[:, :2] - [x, y]) / [thick_mm, wide_mm]
        return (np.linalg.norm(off, axis=1) - 1.0) * thick_mm

    return field


def across(radius_mm):
    return capsule((-207.0, -10.0, 0.0), (95.0, -104.0, 10.0), radius_mm)


@pytest.mark.parametrize(
    ("arm", "bone", "x", "name", "more"),
    [
        (upright(-196, 30, 44, 44), upright(-196, 30, 12, 12), -110.0, "bone", ""),
        (upright(-175, 10, 25, 25), upright(-175, 10, 9, 9), -85.0, "humerus_left", ""),
        (upright(-182, 10, 32, 48), upright(-182, 10, 9, 9), -85.0, "humerus_left", ""),
        (across(32.0), across(7.0), None, "bone", ""),
        (across(24.0), across(7.0), None, "bone", '[ct]\nunnamed = "free"'),
    ],
    ids=["thick", "thin", "flat", "across the belly", "thin, across the belly"],
)
def test_an_arm_that_is_pressed_against_the_trunk_is_no_way_in(tmp_path, arm, bone, x, name, more):
    """No air, and no ball tells a thin one from the trunk; its bone does, although a structure names it.

    Paths through the arm are unknown, a warning says so, and the front stays free.
    """
    parts = [*supine.trunk_parts(), ScannedPart("arm", arm, 20.0), ScannedPart(name, bone, 700.0)]
    keys = {"more": more, "structures": SPINE + (LEFT if name == "humerus_left" else "")}
    if x is not None:
        parts[3] = ScannedPart("lesion", ellipsoid((x - 1.0, 11.0, 1.0), (12, 12, 12)), 90.0)
        keys["target"] = x, 10.0, 0.0
    write_scene(tmp_path, parts)
    context, found = searched(tmp_path, **keys)
    assert not (depth_in(context, found.outward_ct[found.safe], part_of(parts, "arm"), 0.5) > 4.0).any()
    assert x != -110.0 or hit_parts(context, found, parts, ("arm", "bone")) == set()
    assert "attached_limb" in found.verdict.structure
    assert "pressed against" in said(context)
    assert found.safe.sum() > (10 if x is None else 40)


@pytest.mark.parametrize(
    ("name", "contains"),
    [("lung_upper_lobe_left", True), ("small_bowel", True), ("femoral_artery", False), ("pectoral_muscle", False),
     ("oral_cavity", True), ("liver", False), ("hair", False), ("trachea", True)],
)  # fmt: skip
def test_whose_name_may_contain_gas(name, contains):
    assert Structure(name, Role.AVOID, 0.0, None, "").may_contain_gas is contains
