"""What counts as body and as air: patients on a table, with arms, mattress, sheet and line, whose truth is known."""

from collections import Counter

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
from puncture_twin.planning.anatomy.unnamed import Named
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

STEP_DEG = 6.0
KIDNEY_FIELD = ellipsoid((75.0, 40.0, 0.0), (20, 15, 40))
PLANK = ScannedPart("plank", supine.slab((-250, supine.BACK_MM - 6, -400), (250, supine.BACK_MM + 30, 400)), 60.0)
"""A solid table on which the back lies, with nothing between."""
NEEDLE = "length_mm = 210.0\nshaft_mm = 150.0\ndiameter_mm = 1.2"

CASE = """
schema = 2
region = "other"
name = "supine"
space = "LPS"
[target]
position_mm = [-55.0, 20.0, 0.0]
structure = "lesion"
[needle]
{needle}
[search]
theta_deg = [0, 180]
step_deg = {step}
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
SPINE = '[[structure]]\nname = "spine"\nlabelmap = "labels.nii.gz"\nlabel = 2\nrole = "avoid"\nmargin_mm = 2.0\n'
KIDNEY = SPINE.replace("spine", "kidney").replace("label = 2", "label = 5")
TRUNK_SKIN = 'labelmap = "trunk.nii.gz"\nlabel = 1'
HUMERI = "".join(
    f'[[structure]]\nname = "humerus_{side}"\nlabelmap = "labels.nii.gz"\nlabel = {label}\nrole = "avoid"\n'
    f"margin_mm = 2.0\n"
    for label, side in ((3, "left"), (4, "right"))
)


def scanned(parts, grid, seed):
    """The scene by the scanner: surfaces, exact partial volume, blur and noise."""
    settings = ScanSettings(grid.spacing_mm[2], grid.spacing_mm[0], noise_hu=15.0)
    cells = VolumeGrid(grid.shape, grid.affine, {})
    return scan_solids(supine.solids(parts), cells, settings, np.random.default_rng(seed)).hu


def write_scene(folder, parts, grid, seed=3, fill=None, scanner=False):
    """``ct.nii.gz`` of the scene, and ``labels.nii.gz`` of lesion (1), spine (2), humeri (3, 4) and kidney (5).

    ``fill``: the voxels that were not scanned, and the value that is written there.
    """
    if scanner:
        hu = scanned(parts, grid, seed)
    else:
        hu = rendered(parts, grid, noise_hu=15.0, rng=np.random.default_rng(seed))
    labels = np.zeros(grid.shape, np.uint8)
    fields = {part.name: part.field for part in parts}
    for label, name in enumerate(("lesion", "spine", "humerus_left", "humerus_right"), start=1):
        if name in fields:
            labels[(fields[name](grid.centres()) < 0).reshape(grid.shape)] = label
    labels[(KIDNEY_FIELD(grid.centres()) < 0).reshape(grid.shape)] = 5
    if fill is not None:
        labels[fill[0]], hu[fill[0]] = 0, fill[1]
    for name, values in (("ct", hu.astype(np.int16)), ("labels", labels)):
        image = sitk.GetImageFromArray(values.transpose(2, 1, 0))
        image.SetSpacing(grid.spacing_mm)
        image.SetOrigin(grid.low_mm)
        sitk.WriteImage(image, str(folder / f"{name}.nii.gz"))


def write_case(folder, *, skin='ct = "ct.nii.gz"', structures=SPINE, search="", more="", step=STEP_DEG, name="case"):
    """A case beside the scene."""
    path = folder / f"{name}.toml"
    text = CASE.format(needle=NEEDLE, step=step, search=search, skin=skin, structures=structures, more=more)
    path.write_text(whole(text))
    return path


def write_trunk(folder, parts, grid):
    """``trunk.nii.gz``: the label of the trunk alone."""
    trunk = (parts[0].field(grid.centres()) < 0).reshape(grid.shape)
    image = sitk.GetImageFromArray(trunk.astype(np.uint8).transpose(2, 1, 0))
    image.SetSpacing(grid.spacing_mm)
    image.SetOrigin(grid.low_mm)
    sitk.WriteImage(image, str(folder / "trunk.nii.gz"))


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A function: the folder of a scene of these parts."""
    made = {}

    def make(name):
        if name not in made:
            parts = {
                "arms": supine.trunk_parts() + supine.arm_parts("down"),
                "bed": supine.trunk_parts() + supine.bed_parts(),
                "all": [
                    *supine.trunk_parts(),
                    *supine.arm_parts("down"),
                    *supine.bed_parts(),
                    supine.line_part(),
                    supine.sheet_part(),
                ],
                "alone": supine.trunk_parts() + supine.arm_parts("up"),
                "gap": [*supine.trunk_parts(), *supine.bed_parts(gap_mm=12.0)],
                "plank": [*supine.trunk_parts(), PLANK],
                "all by the scanner": [
                    *supine.trunk_parts(),
                    *supine.arm_parts("down"),
                    *supine.bed_parts(),
                    supine.line_part(),
                    supine.sheet_part(),
                ],
            }[name]
            folder = tmp_path_factory.mktemp(name)
            write_scene(folder, parts, supine.grid(), scanner="scanner" in name)
            made[name] = folder, parts
        return made[name]

    return make


def hit_parts(context, found, parts, names, beyond_mm=1.0):
    """Rows of safe needles whose axis enters a part's truth between skin and flange at standoff, by the part's name.

    From ``beyond_mm`` behind the skin on.
    """
    case, hit = context.case, {}
    for row in np.flatnonzero(found.safe):
        standoff = float(standoffs(case.needle, found.path.length[row], found.path.skin_angle[row]))
        depths = np.arange(found.path.length[row] + beyond_mm, standoff + case.needle.length_mm, 0.5)
        points = case.target_ct + depths[:, None] * found.outward_ct[row]
        for part in parts:
            if part.name in names and part.field(points).min() < 0.0:
                hit.setdefault(part.name, []).append(int(row))
    return hit


def through(found, case, part, first_mm=0.0):
    """Rows whose straight line from the target to the flange at its farthest passes a part's truth."""
    depths = np.arange(first_mm, case.needle.length_mm, 1.0)
    points = case.target_ct + depths[:, None, None] * found.outward_ct
    return (part.field(points.reshape(-1, 3)).reshape(points.shape[:2]) < -3.0).any(axis=0)


OUTER = ("arm_left", "arm_right", "humerus_left", "humerus_right", "mattress", "table", "line", "sheet")


@pytest.mark.parametrize("name", ["arms", "bed", "all", "all by the scanner"])
def test_no_safe_needle_passes_what_the_scan_shows_outside_of_the_trunk(scene, name):
    """Arms, table, mattress, sheet and line: none is entered by a safe needle, inserted or at its standoff."""
    folder, parts = scene(name)
    context = prepare(write_case(folder), arm=False)
    found = context.search()

    assert hit_parts(context, found, parts, OUTER) == {}
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
        prepare(write_case(folder, structures=SPINE + HUMERI, name="counted"), arm=False).search()
        assert read <= Counter(most)
    assert "labels.nii.gz" not in read


def test_a_detached_arm_is_body(scene):
    """A path into an arm enters skin again; a warning names both arms, and a labelled humerus lies inside the skin."""
    folder, parts = scene("arms")
    context = prepare(write_case(folder, structures=SPINE + HUMERI), arm=False)
    found = context.search()
    arm = next(part for part in parts if part.name == "arm_right")

    rows = through(found, context.case, arm)
    assert rows.sum() > 20
    assert not found.safe[rows].any()
    assert (found.verdict.reason[rows] == Reason.REENTERS_SKIN).sum() > 10
    said = " ".join(context.anatomy.warnings)
    assert "not connected to the trunk" in said
    assert "left of it" in said
    assert "right of it" in said


def test_the_table_below_a_posterior_target_is_no_air(scene):
    """Every direction through the back meets mattress and table: none is safe, and the reason names the structure."""
    folder, parts = scene("bed")
    context = prepare(write_case(folder), arm=False)
    found = context.search()
    table = next(part for part in parts if part.name == "table")

    rows = through(found, context.case, table)
    assert rows.sum() > 100
    assert not found.safe[rows].any()
    beyond_skin = rows & (found.verdict.reason == Reason.UNKNOWN_REGION) & (found.verdict.structure == "outside_body")
    assert beyond_skin.sum() > 50


def test_a_trunk_alone_has_nothing_outside(scene):
    """Arms up: nothing outside of the body but beyond the image, no warning of detached parts."""
    folder, _ = scene("alone")
    context = prepare(write_case(folder), arm=False)

    assert [one.name for one in context.anatomy.surroundings] == ["beyond_image"]
    assert "do not touch" not in " ".join(context.anatomy.warnings)


def test_a_skin_from_elsewhere_with_the_ct_beside_it(scene):
    """The skin is a label of the trunk alone: with ``[ct] file`` arms, table and line are unknown all the same."""
    folder, parts = scene("all")
    write_trunk(folder, parts, supine.grid())
    skin = TRUNK_SKIN
    blind = prepare(write_case(folder, skin=skin, name="blind"), arm=False)
    seeing = prepare(write_case(folder, skin=skin, more='[ct]\nfile = "ct.nii.gz"', name="seeing"), arm=False)

    assert OUTSIDE_NOT_KNOWN in blind.anatomy.warnings
    assert len(hit_parts(blind, blind.search(), parts, OUTER)) > 3
    assert OUTSIDE_NOT_KNOWN not in seeing.anatomy.warnings
    assert hit_parts(seeing, seeing.search(), parts, OUTER) == {}
    assert "ct.nii.gz" in str(seeing.case.inputs)


def test_a_bone_that_nobody_labelled_is_unknown(scene):
    """Without its label the spine is ``unnamed_dense``; ``[ct] unnamed`` takes it for free, trusted labels do not."""
    folder, parts = scene("alone")
    spine = next(part for part in parts if part.name == "spine")
    found = prepare(write_case(folder, structures=KIDNEY), arm=False).search()
    labels = prepare(write_case(folder, structures=KIDNEY, search="trust_labels = true", name="trust"), arm=False)
    trusted = prepare(write_case(folder, structures=KIDNEY, more='[ct]\nunnamed = "free"', name="free"), arm=False)

    rows = through(found, trusted.case, spine)
    assert rows.sum() > 20
    assert not found.safe[rows].any()
    assert "unnamed_dense" in found.clearance.structures
    assert trusted.search().safe[rows].any()
    assert any("unnamed" in warning for warning in trusted.anatomy.warnings)
    np.testing.assert_array_equal(labels.search().safe, found.safe)


def test_a_named_bone_leaves_nothing_unnamed(scene):
    """With the spine's label no dense voxel and no gas is left in the body."""
    folder, _ = scene("alone")
    names = [s.name for s in prepare(write_case(folder), arm=False).anatomy.structures]
    assert names == ["lesion", "spine"]


def test_gas_outside_of_hollow_organs_is_unknown(tmp_path):
    """A bubble of gas of 30 mm in the trunk that no bowel's label covers: no safe path through it."""
    bubble = ScannedPart("bubble", ellipsoid((-55.0, -50.0, 0.0), (15, 15, 15)), -1000.0)
    write_scene(tmp_path, [*supine.trunk_parts(), bubble], supine.grid())
    context = prepare(write_case(tmp_path), arm=False)
    found = context.search()

    rows = through(found, context.case, bubble)
    assert rows.sum() > 3
    assert not found.safe[rows].any()
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


def test_a_ball_about_the_target_matters_where_something_unnamed_lies_beside_it(scene):
    """Else what no structure names is one for every target; a bone in the ball is what is hit."""
    folder, _ = scene("alone")
    found = prepare(write_case(folder, structures=KIDNEY, name="ball"), arm=False)
    unnamed = found.anatomy.scan.unnamed([Named("lesion", found.anatomy.structures[0].mesh)], found.case.ct.dense_hu)
    far = ball(found.case.target_ct + [0.0, 0.0, 500.0], 5.0)
    near = ball(unnamed.dense.vertices.mean(axis=0), 5.0)
    assert not found.anatomy.scan.may_hold(unnamed, far)
    assert found.anatomy.scan.may_hold(unnamed, near)


def test_an_obstacle_stops_the_needle_without_an_arm_too(scene):
    """A box in front of the trunk, within the needle's length outside: refused with its name, with no arm asked."""
    folder, _ = scene("alone")
    box = '[[obstacle]]\nname = "monitor"\nframe = "ct"\ncenter_mm = [-55, -260, 0]\nsize_mm = [60, 60, 60]'
    free = prepare(write_case(folder), arm=False).check(0.0, 0.0)
    stopped = prepare(write_case(folder, more=box, name="boxed"), arm=False).check(0.0, 0.0)

    assert free.safe[0]
    assert stopped.verdict.reason[0] == Reason.TOO_CLOSE
    assert stopped.verdict.structure[0] == "monitor"


def test_the_flange_at_standoff_counts(scene):
    """A box that only the waiting needle's upper end reaches, 60 mm beyond the inserted flange, stops it."""
    folder, _ = scene("alone")
    box = '[[obstacle]]\nname = "lamp"\nframe = "ct"\ncenter_mm = [-55, -280, 0]\nsize_mm = [40, 40, 40]'
    stopped = prepare(write_case(folder, more=box, name="lamp"), arm=False).check(0.0, 0.0)

    assert stopped.verdict.structure[0] == "lamp"
    assert stopped.verdict.depth[0] > 210.0


def test_a_certificate_holds_outside_of_the_body_too(scene):
    """Between the grid points: no cell that is proven safe holds a direction that the search refuses."""
    folder, _ = scene("all")
    path = write_case(folder, step=5.0, name="certified")
    context = prepare(path, arm=False)
    found = context.search()
    certificate = certify(context.case, context.anatomy, size=np.radians(6.0))
    verify(certificate, context.case, context.anatomy)

    low_theta, high_theta = certificate.leaves.theta.T
    low_beta, high_beta = certificate.leaves.beta.T
    seen = Counter()
    for theta, beta, safe in zip(found.theta, found.beta, found.safe, strict=True):
        contains = (low_theta <= theta) & (theta <= high_theta) & (low_beta <= beta) & (beta <= high_beta)
        letters = set(certificate.verdict[contains])
        assert safe or "S" not in letters
        assert not safe or "R" not in letters
        seen.update(letters)
    assert min(seen["S"], seen["R"]) > 100


def test_two_cts_are_refused(scene):
    """``[ct] file`` beside a skin from another CT: which one is right cannot be known."""
    folder, _ = scene("alone")
    (folder / "other.nii.gz").write_bytes((folder / "ct.nii.gz").read_bytes())
    path = write_case(folder, more='[ct]\nfile = "other.nii.gz"', name="two")
    with refused("several_cts"):
        prepare(path, arm=False)


@pytest.mark.parametrize("level", [-1000, -200, "high"])
def test_a_level_of_air_that_cannot_be_is_refused(scene, level):
    """``air_hu`` between air and fat."""
    folder, _ = scene("alone")
    with refused("bad_value", "air_hu"):
        load_case(write_case(folder, more=f"[ct]\nair_hu = {level!r}".replace("'", '"'), name="level"))


def test_what_a_person_declares_stands_in_every_result(scene):
    """Arms, table, and how far the body may go on beyond the image."""
    folder, _ = scene("alone")
    more = '[ct]\narms = "none"\ntable = "present"\nbeyond_mm = "all"'
    context = prepare(write_case(folder, more=more, name="declared"), arm=False)
    said = [one.sentence for one in context.anatomy.findings if one.code == "declared"]
    assert said == [
        "declared: no arms in the image",
        "declared: a table in the image",
        "declared: beyond the image the body fills all",
    ]
    assert context.case.ct.beyond_mm == np.inf


@pytest.mark.parametrize("line", ['arms = "some"', "table = true", "beyond_mm = -1", 'beyond_mm = "none"'])
def test_what_cannot_be_declared_is_refused(scene, line):
    """The key is named."""
    folder, _ = scene("alone")
    with refused("bad_value", line.split()[0]):
        load_case(write_case(folder, more=f"[ct]\n{line}", name="undeclared"))


def test_a_table_that_touches_the_back_is_no_body(scene):
    """Back and solid table hold together; no path through the table is safe, the front stays free, it is said."""
    folder, _ = scene("plank")
    context = prepare(write_case(folder), arm=False)
    found = context.search()

    rows = through(found, context.case, PLANK)
    assert rows.sum() > 100
    assert not found.safe[rows].any()
    assert found.safe.sum() > 40
    assert any("at its back side" in warning for warning in context.anatomy.warnings)


def test_a_board_under_a_third_of_the_image_is_no_body(tmp_path):
    """A solid board that touches the back along 60 of 160 mm: no path through it is safe, the front stays free."""
    field = supine.slab((-250, supine.BACK_MM - 6, -30), (250, supine.BACK_MM + 30, 30))
    board = ScannedPart("board", field, 60.0)
    parts = [*supine.trunk_parts(), board]
    write_scene(tmp_path, parts, supine.grid())
    prepared = prepare(write_case(tmp_path), arm=False)
    found = prepared.search()

    rows = through(found, prepared.case, board)
    assert rows.sum() > 100
    assert not found.safe[rows].any()
    assert found.safe.sum() > 40
    assert any("at its back side" in warning for warning in prepared.anatomy.warnings)


@pytest.mark.parametrize(
    "cradle",
    [supine.cradle_parts(), supine.cradle_parts(radius_mm=180.0, thick_mm=10.0, half_width_mm=150.0, slope=0.04)],
    ids=["wide", "narrow and tilted"],
)
def test_a_curved_cradle_that_touches_the_back_is_no_body(tmp_path, cradle):
    """Skin and cradle are of one density and hold together: no safe needle enters the cradle, the front stays free."""
    parts = [*supine.trunk_parts(), *cradle]
    write_scene(tmp_path, parts, supine.grid())
    prepared = prepare(write_case(tmp_path), arm=False)
    found = prepared.search()

    rows = through(found, prepared.case, cradle[1])
    assert rows.sum() > 100
    assert not found.safe[rows].any()
    assert hit_parts(prepared, found, parts, ("cradle",)) == {}
    assert found.safe.sum() > 40
    assert any("at its back side" in warning for warning in prepared.anatomy.warnings)


def test_an_image_that_ends_before_the_table_does_not_make_it_air(scene):
    """The face between back and mattress cuts nothing: what is beyond it is unknown, and one warning names it."""
    folder, parts = scene("gap")
    crop(folder, np.s_[:, :76, :])
    path = write_case(folder, skin='ct = "crop.nii.gz"', name="ends")
    prepared = prepare(path, arm=False)
    found = prepared.search()

    assert hit_parts(prepared, found, parts, OUTER) == {}
    assert found.safe.sum() > 40
    said = [warning for warning in prepared.anatomy.warnings if 'table = "none"' in warning]
    assert len(said) == 1
    assert "its back face" in said[0]


def test_a_face_that_cuts_the_table_beside_the_body_does_not_make_arms_air(scene):
    """Arms beyond an image that is narrower than the table: its left and right face are unknown, the front is free."""
    folder, parts = scene("all")
    crop(folder, np.s_[34:116, :, :])
    prepared = prepare(write_case(folder, skin='ct = "crop.nii.gz"', name="slim"), arm=False)
    found = prepared.search()

    assert hit_parts(prepared, found, parts, ("arm_left", "arm_right", "table")) == {}
    assert found.safe.sum() > 10
    said = [warning for warning in prepared.anatomy.warnings if 'arms = "none"' in warning]
    assert "right and left face" in said[0]


def test_air_beside_a_label_of_the_skin_is_no_gas(tmp_path):
    """The tolerance of a skin from elsewhere, wider than two voxels of this scan, leaves the safe front as it is."""
    grid = supine.grid(slice_mm=8.0)
    write_scene(tmp_path, supine.trunk_parts(), grid)
    write_trunk(tmp_path, supine.trunk_parts(), grid)
    beside = write_case(tmp_path, skin=TRUNK_SKIN, more='[ct]\nfile = "ct.nii.gz"', name="beside")
    context = prepare(beside, arm=False)

    assert [structure.name for structure in context.anatomy.structures] == ["lesion", "spine"]
    assert context.search().safe.sum() > 40


def crop(folder, box, move_mm=(0.0, 0.0, 0.0)):
    """``crop.nii.gz``: a part of the CT, in its place or moved."""
    image = sitk.ReadImage(str(folder / "ct.nii.gz"))[box]
    image.SetOrigin(np.add(image.GetOrigin(), move_mm))
    sitk.WriteImage(image, str(folder / "crop.nii.gz"))


def test_beyond_a_ct_that_ends_in_the_body_nothing_is_free(scene):
    """A CT of the lesion's surroundings beside a skin from elsewhere shows neither table nor arms: nothing is safe."""
    folder, parts = scene("alone")
    write_trunk(folder, parts, supine.grid())
    crop(folder, np.s_[52:72, 42:62, 10:30])
    narrow = write_case(folder, skin=TRUNK_SKIN, more='[ct]\nfile = "crop.nii.gz"', name="narrow")

    assert prepare(write_case(folder, skin=TRUNK_SKIN, name="none"), arm=False).search().safe.sum() > 40
    assert prepare(narrow, arm=False).search().safe.sum() == 0


def test_a_ct_that_is_shifted_against_the_skin_is_refused(scene):
    """Its air was blamed on gas that nobody labelled. In its place, the same CT is not blamed."""
    folder, parts = scene("bed")
    write_trunk(folder, parts, supine.grid())
    for name, shift in (("ct", 0.0), ("moved", 25.0)):
        if shift:
            crop(folder, np.s_[:, :, :], (shift, 0.0, 0.0))
        file = '[ct]\nfile = "ct.nii.gz"' if not shift else '[ct]\nfile = "crop.nii.gz"'
        path = write_case(folder, skin=TRUNK_SKIN, more=file, name=name)
        if not shift:
            assert "labels_beside_image" not in {one.code for one in prepare(path, arm=False).anatomy.findings}
            continue
        with refused("labels_beside_image"):
            prepare(path, arm=False)


def test_a_table_beside_a_long_image_is_drawn_as_far_as_is_plausible(tmp_path):
    """A CT from head to knee was refused: table and image together were larger than any surface that is read."""
    table = supine.slab((-250, supine.BACK_MM + 10, -2000), (250, supine.BACK_MM + 50, 2000))
    trunk = capsule((0.0, 0.0, -2000.0), (0.0, 0.0, 2000.0), 95.0, 115.0)
    parts = [ScannedPart("trunk", trunk, 20.0), *supine.trunk_parts()[2:], ScannedPart("table", table, 60.0)]
    grid = Grid((-296.0, -190.0, -700.0), (8.0, 8.0, 8.0), (75, 48, 175))
    write_scene(tmp_path, parts, grid)
    context = prepare(write_case(tmp_path), arm=False)
    outside = next(one for one in context.anatomy.surroundings if one.name == "outside_body")
    assert np.ptp(outside.mesh.vertices[:, 2]) > 1400.0 + 2 * 900.0


def test_a_ct_of_another_place_is_refused(scene):
    """A ``[ct] file`` that does not hold the target says nothing about it: another patient's, or a slip of space."""
    folder, parts = scene("alone")
    write_trunk(folder, parts, supine.grid())
    crop(folder, np.s_[:, :, :], move_mm=(1000.0, 0.0, 0.0))
    path = write_case(folder, skin=TRUNK_SKIN, more='[ct]\nfile = "crop.nii.gz"', name="elsewhere")
    with refused("target_outside_ct"):
        prepare(path, arm=False)


def test_an_obstacle_that_is_nowhere_is_mentioned(scene):
    """Without the base's place an obstacle of the frame ``base`` cannot be checked; a warning names it."""
    folder, _ = scene("alone")
    box = '[[obstacle]]\nname = "monitor"\nframe = "base"\ncenter_mm = [0, 0, 300]\nsize_mm = [60, 60, 60]'
    context = prepare(write_case(folder, more=box, name="nowhere"), arm=False)
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
    """Slices that fill a volume up."""
    return np.abs(grid.centres()[:, 2].reshape(grid.shape)) > 80.0


@pytest.mark.parametrize("value", [-1024.0, 0.0])
@pytest.mark.parametrize("padded", [beyond_slab, beyond_ends])
def test_where_a_volume_is_filled_up_there_is_neither_skin_nor_air(tmp_path, padded, value):
    """Padded with air's value, half of the "safe" needles left the body through a cut, some of them past the spine."""
    parts = [*supine.trunk_parts(), *supine.bed_parts()]
    grid = Grid((-296.0, -190.0, -117.0), (8.0, 4.0, 6.0), (75, 95, 40))
    write_scene(tmp_path, parts, grid, fill=(padded(grid), value))
    context = prepare(write_case(tmp_path), arm=False)
    found = context.search()
    if padded is beyond_ends:
        assert context.anatomy.skin.field_of_view.cut[2].all()
    else:
        assert any("a constant fill value" in warning for warning in context.anatomy.warnings)
    assert found.safe.sum() > 40
    assert hit_parts(context, found, parts, {"trunk", "table", "spine"}, beyond_mm=12.0) == {}


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
    still = np.where(disc(25.0)[:, :, None], 40.0, np.full((80, 80, 12), -1000.0))
    clipped = np.random.default_rng(1).normal(-1024.0, 15.0, (80, 80, 12)).clip(-1024)
    ball = np.where(sum((np.indices((99, 99, 99)) - 49.0) ** 2) < 45.0**2, 40.0, -1000.0)
    assert not find_unscanned(still).any()
    assert not find_unscanned(ball).any()
    assert not find_unscanned(clipped).any()
    blanked = np.where(disc(30.0)[:, :, None], np.random.default_rng(1).normal(40.0, 15.0, (80, 80, 12)), -1024.0)
    assert not find_unscanned(blanked).any()


def test_an_arm_that_is_pressed_against_the_trunk_is_no_way_in(tmp_path):
    """No air between arm and trunk: paths through the arm are unknown, a warning says so, and the front stays free."""
    arm = ScannedPart("arm", capsule((-196.0, 30.0, -300.0), (-196.0, 30.0, 300.0), 44.0), 20.0)
    bone = ScannedPart("humerus", capsule((-196.0, 30.0, -300.0), (-196.0, 30.0, 300.0), 12.0), 700.0)
    lesion = ScannedPart("lesion", ellipsoid((-111.0, 11.0, 1.0), (12, 12, 12)), 90.0)
    parts = [*supine.trunk_parts()[:3], lesion, arm, bone]
    write_scene(tmp_path, parts, supine.grid())
    path = write_case(tmp_path)
    path.write_text(path.read_text().replace("[-55.0, 20.0, 0.0]", "[-110.0, 10.0, 0.0]"))
    context = prepare(path, arm=False)
    found = context.search()

    assert hit_parts(context, found, parts, ("arm", "humerus")) == {}
    assert "attached_limb" in found.verdict.structure
    assert any("pressed against" in warning for warning in context.anatomy.warnings)
    assert found.safe.sum() > 40


@pytest.mark.parametrize(("thick_mm", "wide_mm"), [(25.0, 25.0), (32.0, 48.0)], ids=["thin", "flat"])
def test_a_thin_or_flat_arm_that_is_pressed_against_the_trunk_is_no_way_in(tmp_path, thick_mm, wide_mm):
    """No ball tells it from the trunk; its bone does, although a structure names it. The front stays free."""
    middle = np.array([-150.0 - thick_mm, 10.0])

    def arm_field(points):
        off = (points[:, :2] - middle) / [thick_mm, wide_mm]
        return (np.linalg.norm(off, axis=1) - 1.0) * thick_mm

    arm = ScannedPart("arm", arm_field, 20.0)
    bone = ScannedPart("humerus_left", capsule((*middle, -300.0), (*middle, 300.0), 9.0), 700.0)
    lesion = ScannedPart("lesion", ellipsoid((-86.0, 11.0, 1.0), (12, 12, 12)), 90.0)
    parts = [*supine.trunk_parts()[:3], lesion, arm, bone]
    write_scene(tmp_path, parts, supine.grid())
    path = write_case(tmp_path, structures=SPINE + HUMERI.split("[[structure]]")[1].join(["[[structure]]", ""]))
    path.write_text(path.read_text().replace("[-55.0, 20.0, 0.0]", "[-85.0, 10.0, 0.0]"))
    prepared = prepare(path, arm=False)
    found = prepared.search()

    assert hit_parts_from_target(prepared, found, arm) == 0
    assert any("pressed against" in warning for warning in prepared.anatomy.warnings)
    assert found.safe.sum() > 40


@pytest.mark.parametrize("radius_mm", [32.0, 24.0], ids=["thick", "thin"])
@pytest.mark.parametrize("unnamed", ["unknown", "free"])
def test_a_forearm_across_the_belly_is_no_way_in(tmp_path, radius_mm, unnamed):
    """Nothing narrows between it and the trunk, and its bone runs across the bed: air on many sides of it tells."""
    line = (-207.0, -10.0, 0.0), (95.0, -104.0, 10.0)
    arm = ScannedPart("arm", capsule(*line, radius_mm), 20.0)
    bone = ScannedPart("radius", capsule(*line, 7.0), 700.0)
    parts = [*supine.trunk_parts(), arm, bone]
    write_scene(tmp_path, parts, supine.grid())
    prepared = prepare(write_case(tmp_path, more=f'[ct]\nunnamed = "{unnamed}"'), arm=False)
    found = prepared.search()

    assert hit_parts_from_target(prepared, found, arm) == 0
    assert "attached_limb" in found.verdict.structure
    assert any("pressed against" in warning for warning in prepared.anatomy.warnings)
    assert found.safe.sum() > 10


def hit_parts_from_target(prepared, found, part):
    """Safe needles whose path in the body passes a part's truth by more than a voxel."""
    depths = np.arange(0.0, 210.0, 0.5)
    points = prepared.case.target_ct + depths[:, None, None] * found.outward_ct[found.safe]
    deepest = part.field(points.reshape(-1, 3)).reshape(points.shape[:2]).min(axis=0)
    return int((deepest < -4.0).sum())


@pytest.mark.parametrize(
    ("name", "contains"),
    [("lung_upper_lobe_left", True), ("small_bowel", True), ("femoral_artery", False), ("pectoral_muscle", False),
     ("oral_cavity", True), ("liver", False), ("hair", False), ("trachea", True)],
)  # fmt: skip
def test_whose_name_may_contain_gas(name, contains):
    """Words, not letters within words."""
    assert Named(name, None).may_contain_gas is contains
