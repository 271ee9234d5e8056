"""CT series: every voxel at its place in LPS with its Hounsfield units, or a refusal that names the slice."""

import itertools
import re

import dicom_world as world
import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813 - the name that its whole documentation uses
from pydicom.encaps import encapsulate
from pydicom.uid import ImplicitVRLittleEndian, RLELossless
from refusals import refused

from puncture_twin.planning.anatomy.body.body_mask import UNSCANNED_HU
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.formats.dicom.ct_series import UNMEASURED_HU, parse_series, read_series
from puncture_twin.planning.formats.dicom.recognise import choose_series

HU = world.phantom().astype(np.float32) - 1024


def place(T, *index):
    return (T @ [*index, 1.0])[:3]


def by_place(volume):
    at = np.argwhere(volume.values > UNMEASURED_HU)
    places = (at @ volume.T_ct_index[:3, :3].T + volume.T_ct_index[:3, 3]).round(2) + 0.0
    return {tuple(where): float(volume.values[tuple(index)]) for where, index in zip(places, at, strict=True)}


def expected(T, hu=HU):
    return {
        tuple(place(T, *index).round(2) + 0.0): float(hu[index]) for index in itertools.product(*map(range, hu.shape))
    }


def with_simpleitk(folder):
    reader = sitk.ImageSeriesReader()
    reader.SetFileNames(reader.GetGDCMSeriesFileNames(str(folder)))
    image = reader.Execute()
    values = sitk.GetArrayFromImage(image).transpose(2, 1, 0)
    places = {}
    for index in itertools.product(*map(range, values.shape)):
        where = np.round(image.TransformIndexToPhysicalPoint(index), 2) + 0.0
        places[tuple(where)] = float(values[index])
    return places


TURNS = {
    "head first, supine": np.eye(3),
    "feet first, supine": np.diag([-1.0, 1.0, -1.0]),
    "head first, prone": np.diag([-1.0, -1.0, 1.0]),
    "feet first, prone": np.diag([1.0, -1.0, -1.0]),
    "decubitus": np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
    "coronal": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "oblique": world.rotation(0.3, (0, 1)) @ world.rotation(0.2, (1, 2)),
}


@pytest.mark.parametrize("turn", sorted(TURNS))
@pytest.mark.parametrize("kind", ["classic", "enhanced"])
def test_every_voxel_lies_where_its_slice_says(tmp_path, turn, kind):
    """However the patient lies, in one file or in many, and whatever the files are called; SimpleITK says the same."""
    axes = TURNS[turn]
    T = world.affine(axes, step=2.5 * np.cross(axes[:, 0], axes[:, 1]))
    if kind == "classic":
        folder = world.write_series(tmp_path, world.series(T=T))
        assert with_simpleitk(folder) == pytest.approx(expected(T))
    else:
        world.write(world.enhanced(T=T), tmp_path / "a")
    volume = read_series(tmp_path)
    assert by_place(volume) == expected(T)
    assert not volume.values.flags.writeable


def test_a_backward_stack_is_sorted_by_place_and_not_by_number(tmp_path):
    """Instance numbers that run against the normal, or say nothing, decide nothing."""
    T = world.affine(step=(0, 0, -2.5))
    slices = world.series(T=T)
    for one, number in zip(slices, (4, 4, 1, 9), strict=True):
        one.InstanceNumber = number
    assert by_place(read_series(world.write_series(tmp_path, slices))) == expected(T)


@pytest.mark.parametrize("angle", [0.3, -0.45])
def test_a_tilted_gantry_is_put_right_where_simpleitk_is_not(tmp_path, angle):
    """Slices whose planes lean against the table's way: a linear image comes back exactly; SimpleITK's is off by mm."""
    axes = world.rotation(angle, (1, 2))
    shape, step = (12, 14, 9), np.array([0.0, 0.0, 3.0])
    T = world.affine(axes, step)
    index = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1)
    places = index @ T[:3, :3].T + T[:3, 3]
    linear = places @ [2.0, -3.0, 1.5]
    stored = np.round(10 * (linear - linear.min())).astype(np.int16)
    folder = world.write_series(tmp_path, world.series(stored, T))
    volume = read_series(folder)
    axes_found = volume.T_ct_index[:3, :3] / np.linalg.norm(volume.T_ct_index[:3, :3], axis=0)
    assert np.allclose(axes_found.T @ axes_found, np.eye(3), atol=1e-6)
    assert np.linalg.norm(volume.T_ct_index[:3, 2]) == pytest.approx(3.0 * np.cos(angle))
    at = np.argwhere(volume.values > UNMEASURED_HU)
    truth = (
        10 * ((at @ volume.T_ct_index[:3, :3].T + volume.T_ct_index[:3, 3]) @ [2.0, -3.0, 1.5] - linear.min()) - 1024
    )
    assert np.abs(volume.values[tuple(at.T)] - truth).max() <= 0.51  # stored values were rounded to 1
    assert len(at) >= 0.85 * stored.size
    assert set(np.unique(volume.values[volume.values < UNSCANNED_HU])) == {UNMEASURED_HU}
    for k in range(shape[2]):  # every slice keeps its plane
        assert (volume.values[:, :, k] > UNMEASURED_HU).any()
    last = place(T, 0, 0, 8)
    assert np.linalg.norm(places[0, 0, 8] - last) < 1e-9
    reader = sitk.ImageSeriesReader()
    reader.SetFileNames(reader.GetGDCMSeriesFileNames(str(folder)))
    ends = [reader.Execute().TransformIndexToPhysicalPoint((0, 0, k)) for k in (0, 8)]
    assert min(np.linalg.norm(np.array(ends) - last, axis=1)) > 24.0 * abs(np.sin(angle)) - 1.0


def changed(at, **values):
    slices = world.series()
    for keyword, value in values.items():
        if value is None:
            delattr(slices[at], keyword)
        else:
            setattr(slices[at], keyword, value)
    return slices


def moved(at, z, x=world.ORIGIN[0]):
    return changed(at, ImagePositionPatient=world.ds([x, world.ORIGIN[1], z]))


def shorter(slices):
    slices[-1].PixelData = slices[-1].PixelData[:-14]
    return slices


REFUSED = {
    "one slice": (lambda: world.series()[:1], "too_few_slices"),
    "twelve slices missing": (  # beside them each true step was less than a tenth of the largest one
        lambda: world.series(world.phantom((7, 5, 24)))[:10] + world.series(world.phantom((7, 5, 24)))[22:],
        "uneven_slices 12",
    ),
    "uneven step": (lambda: moved(2, 812.25 + 5.9), "uneven_slices 3.4"),
    "two at one place": (lambda: moved(2, 812.25 + 2.5), "duplicate_place"),
    "one slice off the line": (lambda: changed(2, ImagePositionPatient=world.ds([-101.0, 33.0, 817.25])), "off_grid"),
    "another orientation": (
        lambda: changed(1, ImageOrientationPatient=["1", "0", "0", "0", "0.98", "0.199"]),
        "mixed_geometry",
    ),
    "another pixel size": (lambda: changed(1, PixelSpacing=["0.9", "0.8"]), "mixed_geometry"),
    "no position": (lambda: changed(1, ImagePositionPatient=None), "missing_tag _1 ImagePositionPatient 0020 0032"),
    "no spacing": (lambda: changed(1, PixelSpacing=None), "missing_tag PixelSpacing 0028 0030"),
    "no slope": (lambda: changed(1, RescaleSlope=None), "no_rescale _1 0028 1053"),
    "no intercept": (lambda: changed(1, RescaleIntercept=None), "no_rescale -1024"),
    "slope 0": (lambda: changed(1, RescaleSlope="0"), "out_of_range"),
    "no Hounsfield units": (lambda: changed(1, RescaleType="MGML"), "not_hounsfield MGML"),
    "a skewed plane": (lambda: changed(1, ImageOrientationPatient=list("100") + ["0.5", "1", "0"]), "axes_not_square"),
    "inverted": (lambda: changed(1, PhotometricInterpretation="MONOCHROME1"), "unsupported_feature MONOCHROME1"),
    "colours": (lambda: changed(1, SamplesPerPixel=3), "bad_tag SamplesPerPixel"),
    "another frame of reference": (lambda: changed(1, FrameOfReferenceUID=world.ROOT + "9"), "several_series"),
    "a high bit elsewhere": (lambda: changed(1, BitsStored=12), "bad_tag HighBit"),
    "pixels cut short": (lambda: shorter(world.series()), "size_mismatch _3 56 70"),
    "no pixels": (lambda: changed(1, PixelData=None), "missing_tag"),
    "slices side by side": (lambda: world.series(T=world.affine(step=(5.0, 0, 2.5))), "gantry_tilt 63"),
}


@pytest.mark.parametrize("name", sorted(REFUSED))
def test_a_series_that_is_no_regular_stack_is_refused_naming_the_slice(tmp_path, name):
    make, message = REFUSED[name]
    folder = world.write_series(tmp_path, make(), [f"a{number:02d}_{number}" for number in range(20)])
    with refused(*message.split()):
        read_series(folder)


@pytest.mark.parametrize("numbers", ["1212", "1231231"])
def test_two_scans_whose_slices_lie_in_turns_are_refused(tmp_path, numbers):
    """In one series: together they looked like one of half the step. Parts of one scan lie one behind the other."""

    def written(name, numbers):
        slices = world.series(world.phantom((7, 5, len(numbers))))
        for one, number in zip(slices, numbers, strict=True):
            one.AcquisitionNumber = number
        return world.write_series(tmp_path / name, slices)

    with refused("several_acquisitions", "in turns"):
        read_series(written("turns", numbers))
    for name, parts in (("parts", sorted(numbers)), ("own", range(len(numbers))), ("slip", "1121111"[: len(numbers)])):
        assert read_series(written(name, parts)).values.shape == (7, 5, len(numbers))


def scout():
    data = world.ct_slice(world.phantom()[:, :, 0], world.affine(TURNS["coronal"]), series=world.ROOT + "50", number=77)
    data.ImageType = ["ORIGINAL", "PRIMARY", "LOCALIZER"]
    return data


def capture():
    data = world.base(world.CAPTURE_CLASS, world.ROOT + "60", series=world.ROOT + "51", description="dose")
    return world.image(data, world.phantom()[:, :, 0])


def page():
    data = changed(0, ImagePositionPatient=None, ImageOrientationPatient=None)[0]
    data.ImageType = ["DERIVED", "SECONDARY", "OTHER"]
    return data


def test_scouts_pages_and_other_files_are_left_out_and_told(tmp_path):
    """By SOP class and ImageType; a folder is read as if they were not there, and a note counts them."""
    folder = world.write_series(tmp_path / "s", [*world.series(), scout(), capture(), page()])
    (folder / "README.txt").write_text("x" * 300)
    assert by_place(read_series(folder)) == expected(world.affine())
    note = " ".join(choose_series(folder).notes)
    assert "2 CT Image Storage '1 abdomen 2.5'" in note
    assert "1 Secondary Capture Image Storage" in note


def test_two_series_are_refused_with_names_and_a_file_chooses_one(tmp_path):
    """Their descriptions, counts and a file of each; then one file of a series stands for it."""
    other = world.series(world.phantom() + 5, series=world.ROOT + "70", description="arterial")
    folder = world.write_series(tmp_path / "s", [*world.series(), *other], [f"{n}.dcm" for n in range(8)])
    with refused("several_series", "2.5", "0.dcm"):
        read_series(folder)
    assert by_place(read_series(folder / "2.dcm")) == expected(world.affine())
    assert by_place(read_series(folder / "6.dcm")) == expected(world.affine(), HU + 5)


def test_a_folder_without_a_series_says_what_it_holds(tmp_path):
    with refused("no_ct", "not a DICOM file"):
        read_series(tmp_path)
    (tmp_path / "series 1").mkdir()
    with refused("no_ct", "series 1 (is a folder)"):
        read_series(tmp_path)
    (tmp_path / "series 1" / "a.txt").write_text("no")
    with refused("no_ct", "not a DICOM file"):
        read_series(tmp_path / "series 1")
    with refused("no_ct", "1 Secondary Capture"):
        read_series(world.write_series(tmp_path / "captures", [capture()]))


def test_rescaling_is_that_of_each_slice(tmp_path):
    slices = world.series()
    slices[1].RescaleSlope, slices[1].RescaleIntercept = "0.5", "-1000.25"
    values = read_series(world.write_series(tmp_path, slices)).values
    assert np.array_equal(values[:, :, 1], 0.5 * world.phantom()[:, :, 1] - 1000.25)
    assert np.array_equal(values[:, :, 2], HU[:, :, 2])


def test_bits_above_the_stored_ones_do_not_count(tmp_path):
    """Two's complement of 12 bits, unsigned values of 16, and overlay bits above 12."""
    rng = np.random.default_rng(3)
    for bits, signed in ((16, True), (16, False), (12, True), (12, False)):
        low, high = (-(1 << (bits - 1)), 1 << (bits - 1)) if signed else (0, 1 << bits)
        truth = rng.integers(low, high, world.SHAPE)
        stored = (truth & ((1 << bits) - 1)) | rng.integers(0, 1 << (16 - bits), world.SHAPE) << bits
        slices = world.series()
        for k, one in enumerate(slices):
            world.image(one, stored[:, :, k].astype(np.uint16).view(np.int16), bits)
            one.PixelRepresentation = int(signed)
        folder = world.write_series(tmp_path / f"{bits} {signed}", slices)
        assert np.array_equal(read_series(folder).values, truth - 1024)


def test_padding_is_not_scanned(tmp_path):
    """What the header calls padding is neither air nor body: it is below what anything measured can be."""
    slices = world.series()
    for limit in (11, 17):
        for one in slices:
            one.add_new("PixelPaddingValue", "SS", 11)
            if limit > 11:
                one.add_new("PixelPaddingRangeLimit", "SS", limit)
        values = read_series(world.write_series(tmp_path / str(limit), slices)).values
        padded = (world.phantom() >= 11) & (world.phantom() <= limit)
        assert (values[padded] == UNMEASURED_HU).all()
        assert np.array_equal(values[~padded], HU[~padded])
    assert UNMEASURED_HU < UNSCANNED_HU


@pytest.mark.parametrize("syntax", [ImplicitVRLittleEndian, RLELossless])
def test_transfer_syntaxes_without_loss_hold_the_same_voxels(tmp_path, syntax):
    slices = world.series()
    for one in slices:
        if syntax == RLELossless:
            one.compress(RLELossless)
        else:
            one.file_meta.TransferSyntaxUID = syntax
    assert by_place(read_series(world.write_series(tmp_path, slices))) == expected(world.affine())


@pytest.mark.parametrize("io", ["JPEG-LS", "JPEG 2000", "JPEG lossless"])
def test_compressed_pixels_are_read_where_a_decoder_is_installed(tmp_path, io):
    """As SimpleITK's library writes them; the decoder is another build of the same library's, the oracle the array."""
    gdcm = pytest.importorskip("gdcm")
    codes = {"JPEG-LS": gdcm.TransferSyntax.JPEGLSLossless, "JPEG 2000": gdcm.TransferSyntax.JPEG2000Lossless}
    syntax = gdcm.TransferSyntax(codes.get(io, gdcm.TransferSyntax.JPEGLosslessProcess14_1))
    plain = world.write_series(tmp_path / "plain", world.series(world.phantom((16, 12, 3))))
    (tmp_path / "packed").mkdir()
    for path in plain.iterdir():
        reader = gdcm.ImageReader()
        reader.SetFileName(str(path))
        assert reader.Read()
        change = gdcm.ImageChangeTransferSyntax()
        change.SetTransferSyntax(syntax)
        change.SetInput(reader.GetImage())
        assert change.Change()
        writer = gdcm.ImageWriter()
        writer.SetFileName(str(tmp_path / "packed" / path.name))
        writer.SetFile(reader.GetFile())
        writer.SetImage(change.GetOutput())
        assert writer.Write()
    assert not re.search(rb"1\.2\.840\.10008\.1\.2\.1\0", next((tmp_path / "packed").iterdir()).read_bytes()[:400])
    assert np.array_equal(read_series(tmp_path / "packed").values, read_series(plain).values)


def test_every_cut_of_a_slice_is_refused_naming_it(tmp_path):
    folder = world.write_series(tmp_path / "s", world.series(), [f"{n}.dcm" for n in range(4)])
    multi = world.write(world.enhanced(), tmp_path / "multi.dcm")
    for path, call in ((folder / "3.dcm", folder), (multi, multi)):
        whole = path.read_bytes()
        for length in [*range(132, len(whole), 97), len(whole) - 1]:
            path.write_bytes(whole[:length])
            with pytest.raises(InputError, match=path.name):
                read_series(call / "3.dcm" if call == folder else call)
        path.write_bytes(whole)


def restate(path, syntax):
    """Write another transfer syntax into the meta information."""
    content, old = path.read_bytes(), b"1.2.840.10008.1.2.1\0"
    new = syntax.encode() + b"\0" * (len(syntax) % 2)
    at = content.index(old)
    path.write_bytes(content[: at - 2] + len(new).to_bytes(2, "little") + new + content[at + len(old) :])


def test_other_transfer_syntaxes_are_refused_with_what_to_do(tmp_path):
    for number, syntax in enumerate(("1.2.840.10008.1.2.1.99", "1.2.840.10008.1.2.4.100", "1.2.3.4")):
        folder = world.write_series(tmp_path / str(number), world.series())
        for path in folder.iterdir():
            restate(path, syntax)
        with refused("transfer_syntax", syntax):
            read_series(folder)


def test_a_class_that_only_the_meta_information_states_is_taken(tmp_path):
    """Of a data set that says nothing of itself; it is told. What says another thing is believed."""
    slices = world.series()
    for one in slices:
        one.SOPClassUID = ""
    folder = world.write_series(tmp_path / "s", slices)
    assert by_place(read_series(folder)) == expected(world.affine())
    chosen = choose_series(folder)
    series = parse_series(folder, chosen.names, lambda name: (folder / name).read_bytes(), chosen.notes)
    assert any("4 files state no SOP class" in note for note in series.notes)
    slices[2].SOPClassUID = world.CAPTURE_CLASS
    with refused("uneven_slices"):
        read_series(world.write_series(tmp_path / "t", slices))


def test_big_endian_is_refused_by_its_name_where_it_may_be_read(tmp_path):
    """In a folder too, and not as a folder without a CT; what is no CT by its meta information is passed over."""
    folder = world.write_series(tmp_path / "s", [*world.series(), capture()], [f"{n}" for n in range(5)])
    restate(folder / "4", "1.2.840.10008.1.2.2")
    assert by_place(read_series(folder)) == expected(world.affine())
    restate(folder / "2", "1.2.840.10008.1.2.2")
    with refused("transfer_syntax", folder / "2"):
        read_series(folder)


def test_pixels_that_no_decoder_takes_are_named_by_their_syntax(tmp_path):
    """A lossy JPEG of 12 bits is a whole file, not a damaged one."""
    slices = world.series()
    for one in slices:
        one.file_meta.TransferSyntaxUID = "1.2.840.10008.1.2.4.51"
        one.PixelData = encapsulate([b"\xff\xd8\xff\xdb\0\x04\0\0\xff\xd9"])
        one["PixelData"].VR = "OB"
        one["PixelData"].is_undefined_length = True
    folder = world.write_series(tmp_path, slices)
    with refused("not_decoded", "JPEG", "Extended", "1.2.840.10008.1.2.4.51") as caught:
        read_series(folder)
    assert caught.value.code in {"not_decoded", "no_decoder"} and "damaged" not in str(caught.value)
