"""``selfcal --recording`` of pictures: PNG and DICOM by a renderer that the detector does not know, and refusals."""

import copy
import csv
import io
import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
from dicom_world import encoded, ultrasound, write
from other_bmode import logarithm, picture, power_law
from PIL import Image
from pydicom.encaps import encapsulate
from pydicom.uid import JPEG2000, JPEGBaseline8Bit, RLELossless
from refusals import refused, refused_command
from selfcal_world import as_estimate

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.formats.csv_table import pose_columns, pose_values, table_text
from puncture_twin.run_twin import main
from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import calibrate
from puncture_twin.twin.guidance.ultrasound.axp_ybq.equation import tip_residuals
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Noise
from puncture_twin.twin.guidance.ultrasound.needle_detector import Imager, detect
from puncture_twin.twin.guidance.ultrasound.recording_file import open_recording, read_recording
from puncture_twin.twin.guidance.ultrasound.selfcal_case import load_selfcal_case
from puncture_twin.twin.jobs.exit_codes import OK
from puncture_twin.twin.pictures import read_frames
from puncture_twin.twin.plant.simulated_recording import (
    PoseRanges,
    draw_image_poses,
    draw_probe_poses,
    draw_truth,
    exact_recording,
    with_noise,
)

COUNT, SIZE, PIXEL_MM = 30, (220, 200), 0.22
EMPTY, FOREIGN = (4, 11), 17
"""Rows whose picture shows no needle, and one whose picture is of another pose."""
RANGES = PoseRanges(u_mm=(9.0, 35.0), v_mm=(12.0, 42.0))
ARMS = Noise(robot_mm=0.05, robot_rad=float(np.radians(0.01)), image_mm=0.0, direction_rad=0.0)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """Truth, exact poses and folder, with greys as a logarithm."""
    return filled(tmp_path_factory.mktemp("pictures"), logarithm)


def filled(folder, display, *, seed=5, beaded=False):
    """Exact poses, and a folder with a picture of each by the other renderer: two without a needle, one foreign."""
    rng = np.random.default_rng(seed)
    truth = draw_truth(rng)
    exact = exact_recording(truth, draw_probe_poses(rng, truth, COUNT), draw_image_poses(rng, COUNT, RANGES))
    for row in range(COUNT):
        shown = (FOREIGN + 1) % COUNT if row == FOREIGN else row
        needle, off = row not in EMPTY, rng.normal(0.0, 0.1)
        look = {"off_mm": off, "size": SIZE, "pixel_mm": PIXEL_MM, "display": display, "needle": needle}
        look["beaded"] = beaded
        grey = picture(rng, exact.P[shown], exact.v[shown], **look)
        cv2.imwrite(str(folder / f"{row}.png"), grey)
    read = with_noise(rng, exact, ARMS)
    poses = np.column_stack([pose_values(read.A), pose_values(read.B)]).tolist()
    rows = [(f"p{row}", *poses[row], f"{row}.png", PIXEL_MM) for row in range(COUNT)]
    header = ("name", *pose_columns("A"), *pose_columns("B"), "picture", "pixel_mm")
    (folder / "recording.csv").write_text(table_text(header, rows))
    return truth, exact, folder


def test_unknown_pictures_calibrate_to_a_tenth_of_a_millimetre(world):
    """Tips scatter by .1 mm about one shift along the shaft, which a known length finds."""
    truth, exact, folder = world
    recording = read_recording(folder)
    assert [name for name, _ in recording.missed] == [f"p{row}" for row in EMPTY]
    rows = np.array([int(name[1:]) for name in recording.names])
    length = float(truth.tip_end2 @ truth.direction_end2)
    found = calibrate(recording, needle_length_mm=length)
    assert f"p{FOREIGN}" in found.outliers
    used = found.weights > 0
    e, v = (recording.P - exact.P[rows])[used], exact.v[rows][used]
    along, across = (e * v).sum(axis=1), e[:, 0] * v[:, 1] - e[:, 1] * v[:, 0]
    assert along.std() <= 0.1 and np.sqrt(np.mean(across**2)) <= 0.01
    assert abs(found.tip_bias_mm - along.mean()) <= 0.05
    assert np.linalg.norm(found.tip_end2 - truth.tip_end2) <= 0.1
    rng = np.random.default_rng(6)
    unseen = exact_recording(truth, draw_probe_poses(rng, truth, 100), draw_image_poses(rng, 100, RANGES))
    errors = np.linalg.norm(tip_residuals(found.estimate, unseen), axis=1)
    assert np.sqrt(np.mean(errors**2)) <= 0.1
    assert np.abs(tip_residuals(as_estimate(truth), unseen)).max() < 1e-9  # what the errors are measured against


def test_of_a_beaded_needle_the_last_bead_is_the_tip(tmp_path):
    """Gaps of 2.5 mm, beads and facets of any brightness: tips to .5 mm; the few that are not are set aside."""
    truth, exact, folder = filled(tmp_path, power_law, seed=911, beaded=True)
    recording = read_recording(folder)
    rows = np.array([int(name[1:]) for name in recording.names])
    along = ((recording.P - exact.P[rows]) * exact.v[rows]).sum(axis=1)
    missed = {f"p{row}" for row in rows[np.abs(along - np.median(along)) > 0.5]} - {f"p{FOREIGN}"}
    assert len(rows) >= COUNT - len(EMPTY) - 2 and len(missed) <= 2
    found = calibrate(recording, needle_length_mm=float(truth.tip_end2 @ truth.direction_end2))
    assert missed | {f"p{FOREIGN}"} <= set(found.outliers)
    assert np.linalg.norm(found.tip_end2 - truth.tip_end2) <= 0.1
    assert distance(found, as_estimate(truth)) <= found.region_limit()


@pytest.mark.parametrize("short", [3, 6])
def test_tips_millimetres_short_are_set_aside(short):
    """Of 30 poses, as a detector leaves them that loses the end: the others' tip, to .1 mm, and a region with it."""
    for seed in range(5):
        rng = np.random.default_rng([921, seed])
        truth = draw_truth(rng)
        exact = exact_recording(truth, draw_probe_poses(rng, truth, 30), draw_image_poses(rng, 30, RANGES))
        P = exact.P + rng.normal(-0.1, 0.07, (30, 1)) * exact.v + rng.normal(0.0, 0.01, (30, 2))
        rows = rng.choice(30, short, replace=False)
        P[rows] -= rng.uniform(1.5, 5.0, (short, 1)) * exact.v[rows]
        read = replace(with_noise(rng, exact, ARMS), P=P, v=exact.v + rng.normal(0.0, 0.0005, (30, 2)))
        found = calibrate(read, needle_length_mm=float(truth.tip_end2 @ truth.direction_end2))
        assert set(np.array(read.names)[rows]) <= set(found.outliers)
        assert np.linalg.norm(found.tip_end2 - truth.tip_end2) <= 0.1
        assert distance(found, as_estimate(truth)) <= 1.5 * found.region_limit()


def distance(found, truth):
    """Squared distance of the truth in the region; a known length leaves one direction without any spread."""
    error, spread = found.parameter_error(truth), np.sqrt(np.diag(found.covariance_counts))
    inverse = np.linalg.pinv(found.covariance_counts / np.outer(spread, spread), rcond=1e-9, hermitian=True)
    return (error / spread) @ inverse @ (error / spread)


def grey_of(folder, row):
    return cv2.imread(str(folder / f"{row}.png"), cv2.IMREAD_UNCHANGED)


def rewritten(change):
    """A change of the table's rows: a list of dictionaries, in place."""

    def apply(folder):
        path = folder / "recording.csv"
        with path.open() as stream:
            rows = list(csv.DictReader(stream))
        change(rows)
        path.write_text(table_text(list(rows[0]), [list(row.values()) for row in rows]))

    return apply


def moved_by(count):
    def change(rows):
        names = [row["picture"] for row in rows]
        for row, name in zip(rows, names[count:] + names[:count], strict=True):
            row["picture"] = name

    return rewritten(change)


def on_file(change):
    return lambda folder: (folder / "3.png").write_bytes(change((folder / "3.png").read_bytes()))


def of_cells(cells):
    return on_file(lambda _: cv2.imencode(".png", cells)[1].tobytes())


WRONG = {
    "a PNG cut in its middle": (on_file(lambda data: data[: len(data) // 2]), "file_cut", "3.png"),
    "a PNG with another byte": (on_file(lambda data: data[:900] + bytes([data[900] ^ 1]) + data[901:]), "file_damaged"),
    "a PNG in colour": (of_cells(np.zeros((*SIZE, 3), np.uint8)), "not_grey", "3.png"),
    "a PNG of 16 bits": (of_cells(np.zeros(SIZE, np.uint16)), "not_grey", "3.png"),
    "neither PNG nor DICOM": (on_file(lambda _: b"P5 2 2 255 abcd"), "wrong_format", "3.png"),
    "a picture of another size": (of_cells(np.zeros((100, 90), np.uint8)), "wrong_size", "90 x 100"),
    "no picture": (lambda folder: (folder / "3.png").unlink(), "no_such_file", "3.png"),
    "a picture twice": (rewritten(lambda rows: rows[3].update(picture="2.png")), "duplicate_name", "2.png"),
    "a picture elsewhere": (rewritten(lambda rows: rows[3].update(picture="../3.png")), "bad_value", "../3.png"),
    "a pixel of no size": (rewritten(lambda rows: [row.update(pixel_mm="0") for row in rows]), "pixel_size"),
    "no size of the pixel": (rewritten(lambda rows: [row.pop("pixel_mm") for row in rows]), "pixel_size", "0.png"),
    "one pixel of another size": (rewritten(lambda rows: rows[9].update(pixel_mm="0.3")), "wrong_size", "9.png"),
    "each picture a row too early": (moved_by(1), "recording_slip"),
    "each picture a row too late": (moved_by(-1), "recording_slip"),
    "pictures of anywhere": (moved_by(7), "directions_scattered"),
    "too few with a needle": (rewritten(lambda rows: rows.__delitem__(slice(17, None))), "too_few_poses", "15 poses"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_what_is_wrong_in_a_folder_is_one_line(world, tmp_path, capfd, wrong):
    change, code, *values = WRONG[wrong]
    shutil.copytree(world[2], tmp_path / "pictures")
    change(tmp_path / "pictures")
    command = ["selfcal", "--recording", tmp_path / "pictures", "--out", tmp_path / "out"]
    refused_command(command, capfd, code, *values)
    assert not (tmp_path / "out" / "calibration.json").exists()


def test_two_swapped_pictures_are_named(world, tmp_path, capfd):
    folder = tmp_path / "pictures"
    shutil.copytree(world[2], folder)
    for old, new in (("8", "x"), ("20", "8"), ("x", "20")):
        (folder / f"{old}.png").rename(folder / f"{new}.png")
    assert main(["selfcal", "--recording", str(folder), "--out", str(tmp_path / "out"), "--json"]) == OK
    facts = json.loads(capfd.readouterr().out)
    assert {"p8", "p20", f"p{FOREIGN}"} <= set(facts["set_aside"])
    assert list(facts["without_needle"]) == [f"p{row}" for row in EMPTY]
    assert len(facts["inputs"]) == COUNT + 1


def test_a_case_that_states_another_pixel_is_refused(world, tmp_path):
    """Column and case must agree; a case that does not state it has no say."""
    path = tmp_path / "selfcal.toml"
    path.write_text('schema = 1\nname = "a"\n[image]\nslice_fwhm_mm = 1.0\n')
    assert len(open_recording(world[2], load_selfcal_case(path)).recording) == COUNT - len(EMPTY)
    path.write_text('schema = 1\nname = "a"\n[image]\npixel_mm = 0.2\n')
    with refused("pixel_size", "0.png"):
        open_recording(world[2], load_selfcal_case(path))


@pytest.mark.parametrize("colour", [False, True])
def test_a_region_of_tissue_is_cut_out_with_its_pixel(rng, tmp_path, colour):
    """What lies about it is text, and may be coloured; grey in three channels is grey; width and height apart."""
    frames = np.asarray(rng.integers(0, 256, (3, 60, 80)), np.uint8)
    cells = np.repeat(frames[..., None], 3, axis=3) if colour else frames
    if colour:
        cells[:, 0, 0] = (255, 0, 0)
    read = read_frames(write(ultrasound(cells, delta_cm=(0.02, 0.025), box=(10, 5, 69, 54)), tmp_path / "a.dcm"))
    np.testing.assert_array_equal(read.grey, frames[:, 5:55, 10:70])
    assert read.pixel_mm == pytest.approx((0.2, 0.25)) and read.coloured is None


def ycc(cells):
    """JFIF's luminance and chrominance of RGB, by its equations."""
    r, g, b = np.moveaxis(cells.astype(float), -1, 0)
    luminance = 0.299 * r + 0.587 * g + 0.114 * b
    parts = (luminance, 128 + (b - luminance) / 1.772, 128 + (r - luminance) / 1.402)
    return np.clip(np.round(np.stack(parts, axis=-1)), 0, 255).astype(np.uint8)


def halved(cells):
    """As YBR_FULL_422 stores it: two luminances, then the chrominances of the first (rows of even length)."""
    Y, chrominance = cells[..., 0], cells[..., ::2, 1:]
    parts = (Y[..., ::2], Y[..., 1::2], chrominance[..., 0], chrominance[..., 1])
    return np.stack(parts, axis=-1)


def stored(kind, cells):
    """One of the forms in which machines write greys, of RGB cells (frames, rows, columns, 3)."""
    if kind == "RGB by planes":
        planes = np.ascontiguousarray(np.moveaxis(cells, -1, 1))
        return ultrasound(cells, spacing=(0.2, 0.2), PlanarConfiguration=1, PixelData=planes.tobytes())
    meaning, _, syntax = kind.partition(", ")
    data = ultrasound(cells, spacing=(0.2, 0.2), PhotometricInterpretation=meaning)
    if meaning == "MONOCHROME2":
        cells = np.ascontiguousarray(cells[..., 1])
        data = ultrasound(cells, spacing=(0.2, 0.2))
    if meaning.startswith("YBR_FULL") and syntax != "JPEG":
        data.PixelData = (halved(ycc(cells)) if meaning.endswith("422") else ycc(cells)).tobytes()
    found = {"RLE": RLELossless, "JPEG": JPEGBaseline8Bit, "JPEG 2000": JPEG2000}
    return encoded(data, found[syntax], cells) if syntax else data


@pytest.mark.parametrize(
    ("kind", "rounding"),
    [
        ("MONOCHROME2, RLE", 0),
        ("MONOCHROME2, JPEG", 3),
        ("RGB by planes", 0),
        ("RGB, RLE", 0),
        ("YBR_FULL", 1),
        ("YBR_FULL, RLE", 1),
        ("YBR_FULL_422", 1),
        ("YBR_FULL_422, JPEG", 3),
        ("YBR_ICT, JPEG 2000", 3),
    ],
)
def test_greys_are_read_however_a_machine_stores_them(world, tmp_path, kind, rounding):
    """The picture, and what is coloured on it, from every form; a needle shows as in the PNG."""
    greys = np.stack([grey_of(world[2], row) for row in (0, 1)])
    cells = np.repeat(greys[..., None], 3, axis=3)
    box = np.s_[1, 8:40, 8:40]
    cells[box] = (220, 180, 20)
    read = read_frames(write(stored(kind, cells), tmp_path / "a.dcm"))
    plain = np.ones(greys.shape, bool)
    plain[1, :56, :56] = False  # chrominance is stored in blocks of 16 pixels
    errors = read.grey.astype(int) - greys
    assert np.abs(errors[plain]).mean() <= rounding / 2 and np.abs(errors[plain]).max() <= 4 * rounding
    if kind.startswith("MONOCHROME2"):
        assert read.coloured is None
        return
    assert read.coloured[box].mean() > 0.95 and not read.coloured[plain].any()
    imager = Imager(rows=SIZE[0], columns=SIZE[1], pixel_mm=PIXEL_MM)
    tips = [detect(grey, imager).tip_image for grey in (greys[0], read.grey[0])]
    assert np.linalg.norm(tips[0] - tips[1]) < 0.02


def test_a_tinted_picture_is_refused(rng, tmp_path):
    """A colour map of the tissue is no drawing on it; nor is luminance that is called red."""
    grey = np.asarray(rng.integers(0, 200, (1, 40, 50)), np.uint8)
    sepia = np.stack([grey + 40, grey + 20, grey], axis=-1).astype(np.uint8)
    cells = np.repeat(grey[..., None], 3, axis=3)
    for data in (ultrasound(sepia, spacing=(0.2, 0.2)), ultrasound(ycc(cells), spacing=(0.2, 0.2))):
        with refused("not_grey", "a.dcm"):
            read_frames(write(data, tmp_path / "a.dcm"))


def test_of_a_box_of_flow_the_tissue_about_it_is_read(rng, tmp_path):
    """A second region with another content is no second picture; two of tissue are."""
    data = ultrasound(np.zeros((1, 60, 80), np.uint8), delta_cm=(0.02, 0.02), box=(10, 5, 69, 54))
    regions = data.SequenceOfUltrasoundRegions
    regions.append(copy.deepcopy(regions[0]))
    regions[1].RegionDataType, regions[1].RegionLocationMinX0 = 2, 30
    assert read_frames(write(data, tmp_path / "a.dcm")).grey.shape == (1, 50, 60)
    regions[1].RegionDataType = 1
    with refused("unsupported_feature", "a.dcm"):
        read_frames(write(data, tmp_path / "a.dcm"))


def test_what_no_decoder_reads_names_its_transfer_syntax(tmp_path):
    data = ultrasound(np.zeros((1, 60, 80), np.uint8), spacing=(0.2, 0.2))
    data.PixelData = encapsulate([b"abcd" * 8])
    data["PixelData"].is_undefined_length = True
    for syntax, code in (("1.2.840.10008.1.2.4.102", "transfer_syntax"), (JPEGBaseline8Bit, "not_decoded")):
        data.file_meta.TransferSyntaxUID = syntax
        with refused(code, "a.dcm", syntax, "gdcmconv"):
            read_frames(write(data, tmp_path / "a.dcm"))


def test_a_jpeg_that_is_cut_is_refused(rng, tmp_path, capfd):
    """In one line, and without what a decoder prints on the terminal."""
    grey, stream = np.asarray(rng.integers(0, 255, (1, 64, 64)), np.uint8), io.BytesIO()
    Image.fromarray(grey[0]).save(stream, "JPEG")
    data, whole = encoded(ultrasound(grey, spacing=(0.2, 0.2)), JPEGBaseline8Bit, grey), stream.getvalue()
    for length in (len(whole) // 2, len(whole) - 2):
        data.PixelData = encapsulate([whole[:length]])
        with refused("not_decoded", "a.dcm"):
            read_frames(write(data, tmp_path / "a.dcm"))
    assert capfd.readouterr().err == ""


def test_drawings_are_said_and_cover_a_needle_only_at_its_tip(world, tmp_path):
    """A line through the tip leaves its picture out, with the reason; a ruler in a corner changes nothing."""
    _, exact, pictures = world
    whole = read_recording(pictures)
    shutil.copytree(pictures, tmp_path / "pictures")
    for row in (0, 1):
        grey = grey_of(pictures, row)
        cells = np.repeat(grey[..., None], 3, axis=2)
        column = round(exact.P[0, 0] / PIXEL_MM) if row == 0 else 2
        cells[5:, column : column + 2] = (250, 220, 0)
        write(ultrasound(cells[None], spacing=(PIXEL_MM, PIXEL_MM)), tmp_path / "pictures" / f"{row}.dcm")
    rewritten(lambda rows: [rows[row].update(picture=f"{row}.dcm") for row in (0, 1)])(tmp_path / "pictures")
    found = open_recording(tmp_path / "pictures", None)
    assert [name for name, _ in found.recording.missed] == ["p0", *(f"p{row}" for row in EMPTY)]
    np.testing.assert_allclose(found.recording.P[0], whole.P[1], atol=0.02)
    (warning,) = found.warnings
    assert "2 pictures" in warning and "p0" in warning


@pytest.mark.parametrize(
    ("others", "code"),
    [
        ({"spacing": (0.3, 0.2)}, "pixel_size"),
        ({"box": (10, 5, 80, 54)}, "bad_tag"),
        ({"box": (40, 5, 40, 54)}, "bad_tag"),
        ({"Rows": 61}, "size_mismatch"),
        ({"PixelData": b"abcd"}, "size_mismatch"),
        ({"BitsStored": 7, "HighBit": 6}, "not_grey"),
        ({"PhotometricInterpretation": "MONOCHROME1"}, "unsupported_feature"),
        ({"PhotometricInterpretation": "YBR_FULL", "SamplesPerPixel": 3}, "size_mismatch"),
    ],
)
def test_a_dicom_that_contradicts_itself_is_refused(tmp_path, others, code):
    parts = {"delta_cm": (0.02, 0.02), "box": (10, 5, 69, 54), **others}
    with refused(code, "a.dcm"):
        read_frames(write(ultrasound(np.zeros((2, 60, 80), np.uint8), **parts), tmp_path / "a.dcm"))


def test_every_truncation_of_a_dicom_is_refused(tmp_path):
    path = write(ultrasound(np.zeros((2, 20, 30), np.uint8), spacing=(0.2, 0.2)), tmp_path / "a.dcm")
    whole = path.read_bytes()
    assert read_frames(path).pixel_mm == (0.2, 0.2)
    for length in range(1, len(whole), 37):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError):
            read_frames(path)


def test_frames_of_one_file_are_as_many_pictures(world, tmp_path):
    """The same tips, from one DICOM with a frame a row; a pixel twice as high as wide is read as it lies."""
    folder, (_, _, pictures) = tmp_path, world
    greys = np.stack([grey_of(pictures, row) for row in range(COUNT)])
    shutil.copy(pictures / "recording.csv", folder / "recording.csv")

    def as_frames(rows):
        for number, row in enumerate(rows):
            row.pop("pixel_mm")
            row |= {"picture": "all.dcm", "frame": str(number + 1)}

    rewritten(as_frames)(folder)
    write(ultrasound(greys, spacing=(PIXEL_MM, PIXEL_MM)), folder / "all.dcm")
    single, many = read_recording(pictures), read_recording(folder)
    np.testing.assert_array_equal(single.P, many.P)
    assert many.missed == single.missed
    low = greys[:, ::2]
    write(ultrasound(np.ascontiguousarray(low), spacing=(2 * PIXEL_MM, PIXEL_MM)), folder / "all.dcm")
    coarse = read_recording(folder)
    assert np.median(np.linalg.norm(coarse.P - many.P, axis=1)) < 0.15
    rewritten(lambda rows: rows[0].update(frame=str(COUNT + 1)))(folder)
    with refused("out_of_range", "all.dcm"):
        read_recording(folder)
