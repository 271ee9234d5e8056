"""What the scan's archive is given: regions on the scan's own slices, numbers and lines as they are; of its study."""

import hashlib
import io
import json
import shutil

import dicom_world as world
import highdicom as hd
import numpy as np
import pydicom
import pytest
import SimpleITK
from refusals import refused
from search.test_dicom_case import write_scene

from puncture_twin.planning.export.archive import (
    NAMES,
    ArchiveContent,
    Quantity,
    Region,
    archive_files,
    finest_mm,
    report_content,
    rod_points,
    surface_points,
)
from puncture_twin.planning.formats.dicom.ct_series import parse_series
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, inverse, pose
from puncture_twin.run_twin import main

SHAPE = (40, 36, 12)
NAME = "Björk^Åsa=山田^太郎"


TILTED = world.affine(world.rotation(np.radians(20.0), (1, 2)), step=(0.0, 0.0, 2.5))
SCANS = {
    "upright": world.series,
    "tilted": lambda values: world.series(values, TILTED),
    "backwards": lambda values: world.series(values, world.affine(step=(0.0, 0.0, -2.5)))[::-1],
    "enhanced": lambda values: [world.enhanced(values)],
}


@pytest.fixture(params=sorted(SCANS))
def scan(request, tmp_path):
    slices = SCANS[request.param](world.phantom(SHAPE) % 2000)
    for one in slices:
        one.SpecificCharacterSet, one.PatientName = "ISO_IR 192", NAME
        one.StudyDate, one.AccessionNumber = "20261126", "A-7"
    return series_of(slices, tmp_path)


def series_of(slices, folder):
    content = {}
    for number, one in enumerate(slices):
        stream = io.BytesIO()
        one.save_as(stream, enforce_file_format=True)
        content[f"{number}.dcm"] = stream.getvalue()
    return parse_series(folder, tuple(content), content.__getitem__)


def centres(scan):
    """Every voxel's centre, shape (*shape, 3), LPS mm, by each slice's own header."""
    made = np.empty((*scan.slice_shape, len(scan.stack.slices), 3))
    i, j = np.meshgrid(*(np.arange(n) for n in scan.slice_shape), indexing="ij")
    for k, one in enumerate(scan.stack.slices):
        axes = one.plane.axes_ct * one.plane.spacing_mm
        made[:, :, k] = one.plane.origin_ct + i[..., None] * axes[:, 0] + j[..., None] * axes[:, 1]
    return made


def content_of(scan):
    at = centres(scan)
    ends = np.stack([at[6, 5, 2], at[31, 28, 9]])
    corners = np.stack([at[30, 26, 9], at[36, 26, 9], at[33, 33, 10]])
    step = finest_mm(scan)
    regions = (
        Region("needle", "needle", rod_points(ends, 1.0, step)),
        Region("entry window 1", "skin", surface_points(corners, np.array([[0, 1, 2]]), step)),
    )
    numbers = (
        Quantity("length_mm", float(np.pi * 10), "mm"),
        Quantity("theta_deg", 1 / 3, "deg"),
        Quantity("p", 0.97, ""),
    )
    words = (("verdict", "safe"), ("use", "für Ärzte nicht zugelassen"))
    return ArchiveContent("A path", regions, {"path": ends, "target": ends[:1]}, numbers, words), ends


def read_masks(data, scan):
    """Each segment's voxels in the stack's order, by highdicom and each frame's own position."""
    seg = hd.seg.segread(io.BytesIO(data))
    at = centres(scan)[0, 0]
    masks = {
        one.SegmentLabel: np.zeros(at.shape[:0] + (*scan.slice_shape, len(at)), bool) for one in seg.SegmentSequence
    }
    names = list(masks)
    for number, groups in enumerate(seg.PerFrameFunctionalGroupsSequence):
        origin = np.array(groups.PlanePositionSequence[0].ImagePositionPatient, float)
        k = int(np.argmin(np.linalg.norm(at - origin, axis=1)))
        assert np.linalg.norm(at[k] - origin) < 1e-3
        name = names[groups.SegmentIdentificationSequence[0].ReferencedSegmentNumber - 1]
        masks[name][:, :, k] |= (
            np.atleast_3d(seg.pixel_array.reshape(-1, *scan.slice_shape[::-1])[number].T)[:, :, 0] > 0
        )
    return masks


def test_regions_lie_where_they_are_and_report_and_patient_are_the_scans(scan):
    content, ends = content_of(scan)
    files = archive_files(scan, content)
    masks, at = read_masks(files[NAMES[0]], scan), centres(scan)
    forward = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    lever = at - ends[0]
    along = np.clip(lever @ forward, 0.0, np.linalg.norm(ends[1] - ends[0]))
    distance = np.linalg.norm(lever - along[..., None] * forward, axis=-1)
    half = np.linalg.norm([*scan.stack.plane.spacing_mm, np.linalg.norm(scan.stack.step_ct)]) / 2
    assert distance[masks["needle"]].max() <= 1.0 + half
    inside = distance <= 0.95  # by the axis itself, not by its rasterised points
    assert masks["needle"][inside].all() and inside.sum() > 20
    assert masks["entry window 1"][[30, 36, 33], [26, 26, 33], [9, 9, 10]].all()
    read = report_content(files[NAMES[1]])
    assert read.quantities == {"length_mm": (np.pi * 10, "mm"), "theta_deg": (1 / 3, "deg"), "p": (0.97, "1")}
    assert np.allclose(read.lines["path"], ends, atol=1e-4) and read.sentences == content.sentences
    tree = hd.sr.srread(io.BytesIO(files[NAMES[1]]))
    (line,) = (one for one in tree.ContentSequence if one.get("GraphicType") == "POLYLINE")
    assert line.ReferencedFrameOfReferenceUID == world.FRAME
    for data in files.values():
        read = pydicom.dcmread(io.BytesIO(data))
        stated = (str(read.PatientName), read.PatientID, read.StudyInstanceUID, read.StudyDate, read.AccessionNumber)
        assert stated == (NAME, "phantom", world.STUDY, "20261126", "A-7")
        assert read.SeriesInstanceUID != world.SERIES
    away = Region("far", "skin", np.full((1, 3), 5000.0))
    with refused("outside_image"):
        archive_files(scan, ArchiveContent("A path", (away,), {}, (), ()))


def test_another_reader_finds_the_voxels_where_they_are(scan, tmp_path):
    """By the SEG's own orientation, spacing and positions alone: every set voxel's centre is that of the scan's voxel.

    The frames are decoded by SimpleITK (GDCM), which shares no code with highdicom.
    """
    files = archive_files(scan, content_of(scan)[0])
    (tmp_path / "segments.dcm").write_bytes(files[NAMES[0]])
    frames = SimpleITK.GetArrayFromImage(SimpleITK.ReadImage(tmp_path / "segments.dcm"))
    head = pydicom.dcmread(tmp_path / "segments.dcm", stop_before_pixels=True)
    masks, at = read_masks(files[NAMES[0]], scan), centres(scan)
    groups, names = head.SharedFunctionalGroupsSequence[0], [one.SegmentLabel for one in head.SegmentSequence]
    found = {name: [] for name in names}
    for frame, own in zip(frames, head.PerFrameFunctionalGroupsSequence, strict=True):
        plane, measures = own.get("PlaneOrientationSequence", groups.get("PlaneOrientationSequence")), groups
        row, column = np.reshape(np.array(plane[0].ImageOrientationPatient, float), (2, 3))
        down, right = np.array(measures.PixelMeasuresSequence[0].PixelSpacing, float)
        origin = np.array(own.PlanePositionSequence[0].ImagePositionPatient, float)
        j, i = np.nonzero(frame)
        points = origin + i[:, None] * right * row + j[:, None] * down * column
        found[names[own.SegmentIdentificationSequence[0].ReferencedSegmentNumber - 1]].append(points)
    for name, mask in masks.items():
        points, true = np.concatenate(found[name]), at[mask]
        assert len(points) == len(true) > 0
        assert np.linalg.norm(points[:, None] - true, axis=2).min(axis=1).max() < 1e-3


@pytest.mark.parametrize(("name", "value"), [("PatientID", "another"), ("StudyInstanceUID", "1.2.3.4")])
def test_slices_of_several_patients_are_refused(tmp_path, name, value):
    slices = world.series(world.phantom(SHAPE) % 2000)
    setattr(slices[5], name, value)
    scan = series_of(slices, tmp_path)
    with refused("several_patients"):
        archive_files(scan, content_of(scan)[0])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("patient")
    write_scene(made)
    for name in ("dicom", "nifti"):
        text = (made / f"{name}.toml").read_text()
        text = text.replace("[0, 180]", "[40, 140]").replace("step_deg = 30.0", "step_deg = 5.0")
        (made / f"{name}.toml").write_text(text)
    return made


def test_a_case_is_exported_only_to_a_study_with_a_frame(folder, capsys, tmp_path):
    out = folder / "out"
    case = str(folder / "dicom.toml")
    assert main(["export", case, "--format", "dicom", "--rank", "1", "--out", str(out), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert [path.rpartition("/")[2] for path in said["files"]] == list(NAMES)
    assert main(["search", case, "--no-pictures", "--out", str(folder / "found"), "--json"]) == 0
    best = json.loads(capsys.readouterr().out)["best"][0]
    read = report_content((out / NAMES[1]).read_bytes())
    assert read.quantities["theta_deg"] == (best["theta_deg"], "deg")
    assert dict(read.sentences)["verdict"] == "safe"
    seg = hd.seg.segread(out / NAMES[0])
    names = [one.SegmentLabel for one in seg.SegmentSequence]
    assert names[0] == "planned needle" and "entry window 1" in names
    out = tmp_path / "out"
    assert main(["export", str(folder / "nifti.toml"), "--format", "dicom", "--out", str(out), "--json"]) == 2
    assert json.loads(capsys.readouterr().out)["error"]["code"] == "no_dicom_series"
    assert not out.exists()
    shutil.copytree(folder, tmp_path / "again", ignore=shutil.ignore_patterns("out", "found"))
    for path in (tmp_path / "again" / "series").iterdir():
        data = pydicom.dcmread(path)
        del data.FrameOfReferenceUID
        data.save_as(path)
    case, out = tmp_path / "again" / "dicom.toml", tmp_path / "out"
    assert main(["export", str(case), "--format", "dicom", "--out", str(out), "--json"]) == 2
    assert json.loads(capsys.readouterr().out)["error"]["code"] == "no_frame_of_reference"
    assert not out.exists()


def confirmation(place, folder, ends):
    """What `confirm` writes of a needle between two points of a scan, as far as its export reads it."""
    T_scan_ct = pose(exp_rotation(np.array([0.2, -0.1, 0.3])), np.array([12.0, -7.0, 30.0]))
    control = [
        {"role": "control ct", "path": path.name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
        for path in sorted(folder.iterdir())
    ]
    written = {
        "inputs": control,
        "frames": {"T_scan_ct": T_scan_ct.tolist()},
        "diameter_mm": 2.0,
        "angle_deg": None,
        "path_ct_mm": apply(inverse(T_scan_ct), ends).tolist(),
        "verdict": "safe",
        "structure": "",
        "lateral_mm": 1.25,
        "depth_mm": -4.5,
        "inserted_mm": 80.0,
        "sagitta_mm": 0.0,
        "in_predicted_region": True,
        "next_aim": {"kind": "deeper", "by_mm": 4.5, "turn_deg": 0.0, "p_hit": 0.97, "lateral_mm": 1.25},
    }
    (place / "confirm.json").write_text(json.dumps(written))
    return place / "confirm.json"


def test_a_confirmed_needle_goes_to_its_scans_study(tmp_path, capsys):
    """Its voxels lie about the needle in the scan's frame, the numbers are the confirmation's; another scan is not."""
    folder = tmp_path / "scan"
    world.write_series(folder, world.series(world.phantom(SHAPE) % 2000))
    ends = (world.affine() @ [[33, 6], [28, 5], [9, 2], [1, 1]])[:3].T
    source = confirmation(tmp_path, folder, ends)
    order = ["export", str(source), "--format", "dicom", "--out", str(tmp_path / "dicom"), "--json", "--scan"]
    assert main([*order, str(folder)]) == 0
    volume = hd.seg.segread(tmp_path / "dicom" / NAMES[0]).get_volume()
    points = volume.map_indices_to_reference(np.argwhere(volume.array.reshape(volume.spatial_shape) > 0))
    forward = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    lever = points - ends[0]
    across = np.linalg.norm(lever - (lever @ forward)[:, None] * forward, axis=1)
    assert len(points) > 100 and across.max() < 1.0 + np.linalg.norm(volume.spacing) / 2
    read = report_content((tmp_path / "dicom" / NAMES[1]).read_bytes())
    assert read.quantities["depth_mm"] == (-4.5, "mm") and read.quantities["next_by_mm"] == (4.5, "mm")
    assert "angle_deg" not in read.quantities and np.allclose(read.lines["needle"], ends, atol=1e-4)
    assert dict(read.sentences) | {"verdict": "safe", "next": "deeper"} == dict(read.sentences)
    changed = min(folder.iterdir())
    changed.write_bytes(changed.read_bytes()[:-1] + bytes([changed.read_bytes()[-1] ^ 1]))
    assert main([*order, str(folder)]) == 2
    assert '"input_changed"' in capsys.readouterr().out
