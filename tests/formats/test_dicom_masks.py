"""SEG and RTSTRUCT: each structure's voxels where they were drawn, or a refusal."""

import dicom_world as world
import highdicom as hd
import numpy as np
import pytest
from pydicom.sr.codedict import codes
from pydicom.uid import RLELossless, generate_uid
from refusals import refused
from scipy import ndimage
from skimage.draw import polygon2mask

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.formats.dicom.ct_series import parse_series
from puncture_twin.planning.formats.dicom.segmentation import parse_segmentation
from puncture_twin.planning.formats.dicom.structure_set import parse_structure_set, polygon_fill

SHAPE = (19, 15, 8)
LEAN = np.array([0.0, 0.4, 2.5])


def masks():
    i, j, k = np.indices(SHAPE)
    liver = (i - 8) ** 2 / 49 + (j - 7) ** 2 / 25 + (k - 4) ** 2 / 9 < 1
    vessel = (abs(i - 10) <= 2) & (abs(j - 6) <= 1) & (k > 1)
    return {"Liver": liver, "portal vein": vessel, "tip": (i == 3) & (j == 2) & ((k == 2) | (k == 5))}


UPRIGHT = np.array([0.0, 0.0, 2.5])
BOTH = pytest.mark.parametrize("scanned", [UPRIGHT, LEAN], ids=["upright", "tilted"], indirect=True)


def scan(folder, slices):
    path = world.write_series(folder / "ct", slices)
    return parse_series(path, [one.name for one in path.iterdir()], lambda name: (path / name).read_bytes())


@pytest.fixture
def scanned(request, tmp_path):
    """A CT, tilted unless stated otherwise; its affine, its slices."""
    T = world.affine(step=getattr(request, "param", LEAN))
    slices = world.series(world.phantom(SHAPE), T)
    return scan(tmp_path, slices), T, slices


def read_seg(data, folder, ct):
    path = world.write(data, folder / "seg.dcm")
    return parse_segmentation(path, "seg.dcm", lambda name: path.read_bytes(), ct)


def read_rt(data, folder, ct):
    path = world.write(data, folder / "rt.dcm")
    return parse_structure_set(path, "rt.dcm", lambda name: path.read_bytes(), ct)


def places(mask, T):
    at = np.argwhere(mask)
    return {tuple(where) for where in (at @ T[:3, :3].T + T[:3, 3]).round(2) + 0.0}


def same(found, truth, T):
    assert list(found.masks) == list(truth)
    for name, mask in found.masks.items():
        volume = mask.volume()
        assert set(np.unique(volume.values)) <= {0, 1}
        assert places(volume.values, volume.T_ct_index) == places(truth[name], T), name


@BOTH
@pytest.mark.parametrize("omit", [True, False])
def test_segments_lie_where_they_were_drawn(scanned, tmp_path, omit):
    """Overlapping, with and without empty frames; on the CT's own slices, also where its gantry was tilted."""
    ct, T, _ = scanned
    found = read_seg(world.segmentation(masks(), T, omit=omit), tmp_path, ct)
    same(found, masks(), T)
    assert all(mask.grid.shape == SHAPE for mask in found.masks.values())
    assert found.notes == ()
    assert found.masks["Liver"].files == ("seg.dcm", *ct.files)


@BOTH
def test_frames_smaller_than_a_slice_say_nothing_of_what_lies_beside_them(scanned, tmp_path):
    """Their masks' grid ends where they end: laid on the whole slice, organs that were never drawn were free."""
    ct, T, _ = scanned
    part = {name: mask[2:14, 1:12] for name, mask in masks().items()}
    T_part = T.copy()
    T_part[:3, 3] = (T @ [2, 1, 0, 1])[:3]
    found = read_seg(world.segmentation(part, T_part), tmp_path, ct)
    same(found, part, T_part)
    for mask in found.masks.values():
        assert mask.grid.shape == (12, 11, SHAPE[2])
        assert np.allclose(mask.grid.T_ct_index, T_part)


@BOTH
def test_a_file_that_states_empty_frames_says_nothing_of_slices_beyond_them(scanned, tmp_path):
    ct, T, _ = scanned
    part = {name: mask[:, :, 1:7] & (np.arange(6) < 4) for name, mask in masks().items()}
    T_part = T.copy()
    T_part[:3, 3] = (T @ [0, 0, 1, 1])[:3]
    for omit, slices in ((False, 6), (True, SHAPE[2])):
        found = read_seg(world.segmentation(part, T_part, omit=omit), tmp_path, ct)
        same(found, part, T_part)
        assert {mask.grid.shape for mask in found.masks.values()} == {(*SHAPE[:2], slices)}


def test_segments_of_highdicom_come_back(scanned, tmp_path):
    ct, T, slices = scanned
    for number, one in enumerate(slices):
        one.StudyDate = one.StudyTime = one.AccessionNumber = one.StudyID = one.PatientName = ""
        one.PatientBirthDate = one.PatientSex = one.ReferringPhysicianName = ""
        one.InstanceNumber, one.SliceThickness = number + 1, "2.5"
    described = [
        hd.seg.SegmentDescription(
            segment_number=number,
            segment_label=name,
            segmented_property_category=codes.SCT.Organ,
            segmented_property_type=codes.SCT.Liver,
            algorithm_type="MANUAL",
        )
        for number, name in enumerate(masks(), start=1)
    ]
    stacked = np.stack([mask.transpose(2, 1, 0) for mask in masks().values()], axis=-1).astype(np.uint8)
    made = hd.seg.Segmentation(
        source_images=slices,
        pixel_array=stacked,
        segmentation_type="BINARY",
        segment_descriptions=described,
        series_instance_uid=generate_uid(),
        series_number=9,
        sop_instance_uid=generate_uid(),
        instance_number=1,
        manufacturer="a",
        manufacturer_model_name="b",
        software_versions="1",
        device_serial_number="1",
    )
    same(read_seg(made, tmp_path, ct), masks(), T)


def test_fractional_segments_count_from_one_half_on(scanned, tmp_path):
    ct, T, _ = scanned
    values = np.random.default_rng(2).integers(0, 201, SHAPE)
    found = read_seg(world.segmentation({"lesion": values}, T, fractional=True), tmp_path, ct)
    same(found, {"lesion": values >= 100}, T)
    assert "0.5" in found.notes[0]


def broken(change, names=None):
    made = world.segmentation(names or masks(), world.affine())
    change(made)
    return made


def of(keyword, value):
    return lambda data: setattr(data, keyword, value)


def frame(number, change):
    return lambda data: change(data.PerFrameFunctionalGroupsSequence[number])


def push(group):
    group.PlanePositionSequence[0].ImagePositionPatient = world.ds([*world.ORIGIN[:2], 815.9])


def again(data):
    groups = data.PerFrameFunctionalGroupsSequence
    groups[1].PlanePositionSequence = groups[0].PlanePositionSequence


WRONG_SEG = {
    "another frame of reference": (of("FrameOfReferenceUID", "1.2.3"), "other_frame_of_reference 1.2.3"),
    "no frame of reference": (of("FrameOfReferenceUID", ""), "other_frame_of_reference"),
    "a CT": (of("SOPClassUID", world.CT_CLASS), "wrong_format"),
    "a label map": (of("SegmentationType", "LABELMAP"), "unsupported_feature LABELMAP"),
    "fewer groups than frames": (of("NumberOfFrames", 3), "size_mismatch"),
    "pixels cut": (lambda data: setattr(data, "PixelData", data.PixelData[:-2]), "size_mismatch"),
    "a frame of no segment": (
        frame(0, lambda one: setattr(one.SegmentIdentificationSequence[0], "ReferencedSegmentNumber", 9)),
        "unknown_segment",
    ),
    "two frames at one place": (again, "duplicate_place"),
    "a frame beside the others": (frame(2, push), "off_grid"),
    "two of one name": (lambda data: setattr(data.SegmentSequence[1], "SegmentLabel", "Liver"), "duplicate_name"),
    "no name": (lambda data: setattr(data.SegmentSequence[1], "SegmentLabel", ""), "bad_name"),
    "one number twice": (lambda data: setattr(data.SegmentSequence[1], "SegmentNumber", 1), "duplicate_number"),
    "compressed": (lambda data: setattr(data.file_meta, "TransferSyntaxUID", RLELossless), "transfer_syntax RLE"),
}


@pytest.mark.parametrize("name", sorted(WRONG_SEG))
def test_a_wrong_segmentation_is_refused(tmp_path, name):
    ct = scan(tmp_path, world.series(world.phantom(SHAPE)))
    change, message = WRONG_SEG[name]
    made = broken(change)
    if name == "compressed":
        made.PixelData = b"\xfe\xff\x00\xe0\0\0\0\0\xfe\xff\x00\xe0\x02\0\0\0ab"
        made["PixelData"].is_undefined_length = True
    with refused(*message.split(), "seg.dcm"):
        read_seg(made, tmp_path, ct)


def outline(T, k, corners):
    index = np.column_stack([corners, np.full(len(corners), k), np.ones(len(corners))])
    return (index @ T.T)[:, :3]


def box(low, high):
    (x0, y0), (x1, y1) = np.array(low) - 0.5, np.array(high) + 0.5
    return [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]


KEYHOLE = [(1.5, 1.5), (10.5, 1.5), (10.5, 9.5), (1.5, 9.5), (1.5, 5.5)]
KEYHOLE += [(4.5, 5.5), (4.5, 7.5), (7.5, 7.5), (7.5, 3.5), (4.5, 3.5), (4.5, 5.5), (1.5, 5.5)]


@BOTH
def test_contours_enclose_what_they_were_drawn_around(scanned, tmp_path):
    """Holes by a second contour and by a keyhole, two parts in one slice; also on a tilted CT's own slices."""
    ct, T, _ = scanned
    hole, island = outline(T, 3, box((5, 4), (7, 7))), outline(T, 3, box((12, 11), (13, 12)))
    found = read_rt(
        world.structure_set(
            {
                "ring": [outline(T, 3, box((2, 2), (10, 9))), hole, island],
                "key": [outline(T, 3, KEYHOLE)],
                "XOR": [("CLOSEDPLANAR_XOR", outline(T, 3, box((2, 2), (10, 9)))), ("CLOSEDPLANAR_XOR", hole)],
            }
        ),
        tmp_path,
        ct,
    )
    ring = np.zeros(SHAPE, bool)
    ring[2:11, 2:10, 3] = True
    ring[5:8, 4:8, 3] = False
    both = ring.copy()
    both[12:14, 11:13, 3] = True
    same(found, {"ring": both, "key": ring, "XOR": ring}, T)
    assert found.notes == ()


def test_slices_that_were_left_out_are_filled_and_small_contours_are_kept(tmp_path, scanned):
    """Where both neighbours overlap, with what either encloses; parts apart stay apart. Each is told."""
    ct, T, _ = scanned
    small = outline(T, 1, [(14.1, 3.1), (14.3, 3.1), (14.2, 3.3)])
    found = read_rt(
        world.structure_set(
            {
                "organ": [outline(T, 1, box((2, 2), (6, 6))), outline(T, 4, box((4, 2), (8, 6)))],
                "nodes": [outline(T, 1, box((2, 2), (3, 3))), outline(T, 4, box((17, 13), (18, 14)))],
                "vessel": [small],
                "wire": [outline(T, 1, [(7, 9)]), outline(T, 2, [(10, 4), (12, 4)])],  # as planning systems leave them
                "couch": [outline(T, 2, box((-9, 12), (40, 13)))],
                "isocentre": [("POINT", outline(T, 2, [(3, 3)]))],
                "nothing": [],
            }
        ),
        tmp_path,
        ct,
    )
    truth = {name: np.zeros(SHAPE, bool) for name in found.masks}
    truth["organ"][2:7, 2:7, 1] = truth["organ"][4:9, 2:7, 4] = truth["organ"][2:9, 2:7, 2:4] = True
    truth["wire"][7, 9, 1] = truth["wire"][10:13, 4, 2] = True
    truth["nodes"][2:4, 2:4, 1] = truth["nodes"][17:19, 13:15, 4] = True
    truth["vessel"][14, 3, 1] = truth["couch"][:, 12:14, 2][...] = True
    same(found, truth, T)
    notes = " | ".join(found.notes)
    assert "not closed (points, lines) were left out of isocentre" in notes
    assert "filled where both overlap, lie near each other or all are evenly spaced, and otherwise left empty" in notes
    assert "smaller than a pixel count as the pixels along them, in vessel, wire" in notes
    assert "beyond the CT's image end there, in couch" in notes


def test_copies_and_overlaps_of_contours_erase_nothing(scanned, tmp_path):
    """Paths through them were safe.

    Counted by odd and even, a contour that stood twice in the file left no organ, two that overlap lost what they
    share, and one traced twice was empty.
    """
    ct, T, _ = scanned
    first, second = box((2, 2), (8, 8)), box((6, 5), (12, 11))
    found = read_rt(
        world.structure_set(
            {
                "copied": [outline(T, 3, first), outline(T, 3, first)],
                "two": [outline(T, 3, first), outline(T, 3, second)],
                "traced twice": [outline(T, 3, first + first)],
                "hole at the edge": [outline(T, 3, first), outline(T, 3, box((2, 4), (5, 6)))],
            }
        ),
        tmp_path,
        ct,
    )
    truth = {name: np.zeros(SHAPE, bool) for name in found.masks}
    for one in truth.values():
        one[2:9, 2:9, 3] = True
    truth["two"][6:13, 5:12, 3] = True
    same(found, truth, T)


def test_a_vessel_narrower_than_a_pixel_has_no_gaps(scanned, tmp_path):
    """A lean strip of a third of a pixel encloses few centres: it came out as dots that a needle passes between."""
    ct, T, _ = scanned
    strip = [(1.0, 1.2), (16.0, 12.2), (16.0, 12.5), (1.0, 1.5)]
    bulb = [(1.0, 1.2), (11.0, 8.5), (14.6, 8.5), (14.6, 12.6), (11.0, 12.6), (11.0, 8.9), (1.0, 1.5)]
    found = read_rt(world.structure_set({"strip": [outline(T, 2, strip)], "bulb": [outline(T, 2, bulb)]}), tmp_path, ct)
    for mask in found.masks.values():
        pixels = mask.volume().values[:, :, 2]
        assert ndimage.label(pixels, np.ones((3, 3)))[1] == 1
    at = np.array(strip[0]) + np.linspace(0, 1, 200)[:, None] * (np.array(strip[1]) - strip[0])
    centres = np.argwhere(found.masks["strip"].volume().values[:, :, 2])
    assert np.linalg.norm(at[:, None] - centres, axis=2).min(axis=1).max() < 1.0


def test_a_leaning_vessel_drawn_in_every_third_slice_has_no_gaps(scanned, tmp_path):
    """Its contours do not overlap, and nothing was filled between them: paths between two were safe."""
    ct, T, _ = scanned
    contours = [outline(T, k, box((2 + 2 * k, 5), (4 + 2 * k, 7))) for k in (0, 3, 6)]
    found = read_rt(world.structure_set({"vessel": contours}), tmp_path, ct)
    values = found.masks["vessel"].volume().values
    for k in range(7):
        assert values[2 + 2 * k : 5 + 2 * k, 5:8, k].all(), k


@pytest.mark.parametrize("drawn", [(0, 2, 6), (0, 1, 2, 4, 6), (0, 3, 5)])
def test_a_leaning_vessel_drawn_in_some_slices_has_no_gaps(scanned, tmp_path, drawn):
    """Its steps are uneven: nothing was filled between them, or what overlaps, with an upright one beside it."""
    ct, T, _ = scanned
    leaning = [outline(T, k, box((2 + 2 * k, 5), (3 + 2 * k, 7))) for k in drawn]
    upright = [outline(T, k, box((1, 11), (3, 13))) for k in drawn]
    found = read_rt(world.structure_set({"vessel": leaning, "both": leaning + upright}), tmp_path, ct)
    for name, mask in found.masks.items():
        values = mask.volume().values
        for k in range(drawn[-1]):
            assert values[2 + 2 * k : 4 + 2 * k, 5:8, k].all(), (name, k)
            assert values[1:4, 11:14, k].all() == (name == "both")


def test_a_leaning_vessel_whose_contours_overlap_a_little_is_not_pinched(scanned, tmp_path):
    ct, T, _ = scanned
    contours = [
        outline(T, k, diamond)
        for k, diamond in ((1, [(5, 2), (10, 7), (5, 12), (0, 7)]), (3, [(13, 2), (18, 7), (13, 12), (8, 7)]))
    ]
    values = read_rt(world.structure_set({"vessel": contours}), tmp_path, ct).masks["vessel"].volume().values
    assert values[6:13, 3:12, 2].all(), "as wide between the two as either is"


@pytest.mark.parametrize("with_ct", [True, False])
def test_thin_slices_are_no_closer_than_they_lie(scanned, tmp_path, with_ct):
    """Slices of 1.25 mm every 2.5 mm: the thickness was taken for the step, and a path between two plates was safe.

    Without its CT, which is told, a segmentation lies on a grid of its own; sparse frames keep the stated step.
    """
    ct, T, _ = scanned
    for step, thickness in (("2.5", "2.5"), ("", "2.5"), ("", "1.25"), ("", "0.5")):
        data = world.segmentation(masks(), T, step=step)
        data.SharedFunctionalGroupsSequence[0].PixelMeasuresSequence[0].SliceThickness = thickness
        found = read_seg(data, tmp_path, ct if with_ct else None)
        same(found, masks(), T)
        assert with_ct or "may belong to another CT" in found.notes[0]


def test_a_polygon_is_filled_as_by_the_slow_rule():
    """Random polygons, that cross themselves too: a ray's crossings counted for each pixel; skimage for simple ones."""
    rng = np.random.default_rng(7)
    for count in (3, 5, 12, 40):
        points = rng.uniform(-4, 24, (count, 2))
        filled = polygon_fill(points, (20, 17))
        for i, j in np.ndindex(filled.shape):
            turns = 0
            for (x0, y0), (x1, y1) in zip(points, np.roll(points, -1, axis=0), strict=True):
                if (y0 > j) != (y1 > j) and i < x0 + (j - y0) * (x1 - x0) / (y1 - y0):
                    turns += 1 if y0 > j else -1
            assert filled[i, j] == (turns != 0)
    angle = np.linspace(0, 2 * np.pi, 50, endpoint=False)
    circle = np.column_stack([9.3 + 6.1 * np.cos(angle), 8.2 + 7.7 * np.sin(angle)])
    assert np.array_equal(polygon_fill(circle, (20, 17)), polygon2mask((20, 17), circle))


CORNERS = box((2, 2), (6, 6))


def without_points(data):
    del data.ROIContourSequence[0].ContourSequence[0].ContourData
    return data


WRONG_RT = {
    "another frame of reference": (
        lambda T: world.structure_set({"a": [outline(T, 1, CORNERS)]}, "1.2.3"),
        "other_frame_of_reference 1.2.3",
    ),
    "between slices": (lambda T: world.structure_set({"a": [outline(T, 1.4, CORNERS)]}), "contour_outside_ct"),
    "beyond the slices": (lambda T: world.structure_set({"a": [outline(T, 9, CORNERS)]}), "contour_outside_ct"),
    "not planar": (lambda T: world.structure_set({"a": [outline(T, np.arange(4), CORNERS)]}), "contour_outside_ct"),
    "no point": (lambda T: without_points(world.structure_set({"a": [outline(T, 1, CORNERS)]})), "wrong_count 0"),
    "no structure": (lambda T: world.structure_set({}), "no_structure"),
    "a SEG": (lambda T: world.segmentation(masks(), T), "wrong_format"),
}


@pytest.mark.parametrize("name", sorted(WRONG_RT))
def test_a_wrong_structure_set_is_refused(tmp_path, name):
    ct = scan(tmp_path, world.series(world.phantom(SHAPE)))
    make, message = WRONG_RT[name]
    with refused(*message.split(), "rt.dcm"):
        read_rt(make(world.affine()), tmp_path, ct)


@pytest.mark.parametrize("kind", ["seg", "rt"])
@pytest.mark.parametrize("undefined", [True, False])
def test_every_cut_is_refused_whatever_the_lengths_say(tmp_path, kind, undefined):
    """Sequences with a length and with a delimiter: a contour or a frame is never lost without a word."""
    T = world.affine()
    ct = scan(tmp_path, world.series(world.phantom(SHAPE)))
    contours = [outline(T, k, CORNERS) for k in range(3)]
    data = world.segmentation(masks(), T) if kind == "seg" else world.structure_set({"a": contours, "b": contours})
    for element in data.iterall():
        if element.VR == "SQ":
            element.is_undefined_length = undefined
            for one in element.value:
                one.is_undefined_length_sequence_item = undefined
    path = world.write(data, tmp_path / "whole.dcm")
    whole, parse = path.read_bytes(), parse_segmentation if kind == "seg" else parse_structure_set
    truth = {name: mask.volume().values for name, mask in parse(path, "x", lambda _: whole, ct).masks.items()}
    step = max(1, len(whole) // 100)
    for length in range(132, len(whole), step):
        try:
            found = parse(path, "x", lambda _, n=length: whole[:n], ct)
        except InputError:
            continue
        assert all(np.array_equal(found.masks[name].volume().values, values) for name, values in truth.items())
