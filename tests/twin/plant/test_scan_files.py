"""What the scanner writes, read by us, by SimpleITK (as Slicer) and by pydicom: same voxels, same place."""

from pathlib import Path

import numpy as np
import pydicom
import pytest
import SimpleITK as sitk  # noqa: N813

from puncture_twin.planning.formats.dicom.ct_series import parse_series
from puncture_twin.planning.formats.volumes.volume_files import read_volume
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, pose
from puncture_twin.twin.plant.scanner.image import ScanSettings, Solid, ball, scan_solids
from puncture_twin.twin.plant.scanner.writers import write_nifti, write_series

PLACES = {"left": (30.0, 5.0, 2.0), "back": (-4.0, 22.0, 8.0), "head": (6.0, -3.0, 26.0)}
"""Three balls, mm LPS, no two of which a mirror or a swap of axes exchanges."""
VALUES = {"left": 100.0, "back": 400.0, "head": 900.0}
SETTINGS = ScanSettings(spacing_mm=2.5, pixel_mm=0.9, noise_hu=3.0)


@pytest.fixture(scope="module", params=[None, (0.2, -0.4, 0.3)], ids=["straight", "oblique"])
def written(request, tmp_path_factory):
    R = np.eye(3) if request.param is None else exp_rotation(np.array(request.param))
    T = pose(R, R @ [-31.2507, -20.1, -12.6251]) @ np.diag([0.9, 0.9, 2.5, 1.0])
    solids = [Solid(name, ball(np.array(PLACES[name]), 14.0), VALUES[name], 1) for name in PLACES]
    image = scan_solids(solids, VolumeGrid((80, 60, 24), T, {}), SETTINGS, np.random.default_rng(0))
    folder = tmp_path_factory.mktemp("scan")
    files = write_series(folder / "dicom", image, SETTINGS, "test", "phantom")
    nifti = write_nifti(folder / "ct.nii.gz", image.hu, T)
    return image, files, nifti


def check_places(values, T_ct_index):
    for name, place in PLACES.items():
        index = np.round(apply(np.linalg.inv(T_ct_index), np.array(place))).astype(int)
        assert values[tuple(index)] == pytest.approx(VALUES[name], abs=20.0), name
    assert np.linalg.det(T_ct_index[:3, :3]) > 0


def of_itk(image):
    T = np.eye(4)
    T[:3, :3] = np.array(image.GetDirection()).reshape(3, 3) * image.GetSpacing()
    T[:3, 3] = image.GetOrigin()
    return sitk.GetArrayFromImage(image).transpose(2, 1, 0), T


def test_itk_and_our_readers_read_both_in_their_place(written):
    """Equal voxels, affine to 1e-9; of NIfTI, which keeps places in single precision, to 1e-5."""
    image, files, nifti = written
    folder, reader = files[0].parent, sitk.ImageSeriesReader()
    reader.SetFileNames(reader.GetGDCMSeriesFileNames(str(folder)))
    series = parse_series(folder, [path.name for path in files], lambda name: (folder / name).read_bytes()).volume()
    single = read_volume(nifti)
    for (values, T), near in (
        (of_itk(reader.Execute()), 1e-9),
        ((series.values, series.T_ct_index), 1e-9),
        (of_itk(sitk.ReadImage(str(nifti))), 1e-5),
        ((single.values, single.T_ct_index), 1e-5),
    ):
        assert np.array_equal(values, image.hu)
        assert np.allclose(T, image.grid.T_ct_index, atol=near)
        check_places(values, T)


def test_the_series_states_what_it_is(written):
    """CT Image Storage, identifiers of its own, one frame of reference, signed, and how thick its slices are."""
    image, files, _ = written
    slices = [pydicom.dcmread(path) for path in files]
    assert {one.SOPClassUID for one in slices} == {pydicom.uid.CTImageStorage}
    assert len({one.SOPInstanceUID for one in slices}) == len(slices)
    for keyword in ("StudyInstanceUID", "SeriesInstanceUID", "FrameOfReferenceUID"):
        (uid,) = {getattr(one, keyword) for one in slices}
        assert uid.is_valid
    assert {one.PixelRepresentation for one in slices} == {1}
    apart = {(float(one.SliceThickness), float(one.SpacingBetweenSlices), *one.PixelSpacing) for one in slices}
    assert apart == {(2.5, 2.5, 0.9, 0.9)}
    normal = np.cross(*np.array(slices[0].ImageOrientationPatient, dtype=float).reshape(2, 3))
    step = np.array(slices[1].ImagePositionPatient, float) - np.array(slices[0].ImagePositionPatient, float)
    assert step @ normal == pytest.approx(2.5)
    assert np.array_equal(slices[3].pixel_array, image.hu[:, :, 3].T)


def test_another_scan_has_other_identifiers(written, tmp_path):
    """And the same scan the same, to the last byte."""
    image, files, nifti = written
    same = write_series(tmp_path / "same", image, SETTINGS, "test", "phantom")
    other = write_series(tmp_path / "other", image, SETTINGS, "another", "phantom")
    assert [path.read_bytes() for path in same] == [path.read_bytes() for path in files]
    uids = [{pydicom.dcmread(path).SOPInstanceUID for path in some} for some in (files, other)]
    assert uids[0].isdisjoint(uids[1])
    again = write_nifti(Path(tmp_path / "again.nii.gz"), image.hu, image.grid.T_ct_index)
    assert again.read_bytes() == nifti.read_bytes()
