"""What is fuzzed: each reader with the files it starts from, and what must hold of whatever it accepts."""

from dataclasses import dataclass

import numpy as np

from fuzz.output_sets import rewritten_set, whole_set
from puncture_twin.planning.anatomy.anatomy import load_anatomy
from puncture_twin.planning.anatomy.unseen import BEYOND_LABELS
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.certify.certificate import read_certificate
from puncture_twin.planning.collision_cases.checks_file import read_checks
from puncture_twin.planning.export.exporter import read_csv
from puncture_twin.planning.formats.dicom.ct_series import parse_series
from puncture_twin.planning.formats.dicom.recognise import recognise
from puncture_twin.planning.formats.dicom.segmentation import parse_segmentation
from puncture_twin.planning.formats.dicom.structure_set import parse_structure_set
from puncture_twin.planning.formats.itk_transform import parse_transform
from puncture_twin.planning.formats.labels.labelmaps import labelmap_of
from puncture_twin.planning.formats.labels.naming import names_for
from puncture_twin.planning.formats.meshes.mesh_files import mesh_warnings, read_mesh
from puncture_twin.planning.formats.points import read_points
from puncture_twin.planning.formats.volumes.volume_files import read_volume
from puncture_twin.planning.geometry.spaces import Space, Unit, Up
from puncture_twin.planning.plan.plan_document import read_plan
from puncture_twin.planning.registration.placement import load_placement
from puncture_twin.twin.guidance.stereo.servo_case import load_servo_case
from puncture_twin.twin.guidance.ultrasound.recording_file import read_recording
from puncture_twin.twin.guidance.ultrasound.selfcal_case import load_selfcal_case
from puncture_twin.twin.jobs.live.mirror import recorded
from puncture_twin.twin.pictures import read_frames


@dataclass(frozen=True)
class Target:
    """A reader and its files."""

    name: str
    files: dict[str, str]  # file name in the corpus to the kind of its mutators
    read: object  # takes the path of a file
    check: object  # takes what was read; asserts what holds of it, whatever the file held
    heavy: bool = False  # drawn less often: it reads other files too


def whole_mesh(mesh):
    assert mesh.vertices.shape[1:] == (3,) and mesh.faces.shape[1:] == (3,) and len(mesh.faces) > 0
    assert np.isfinite(mesh.vertices).all() and np.abs(mesh.vertices).max() <= 1e6
    assert mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.vertices)
    assert mesh.closed or any("open mesh" in line for line in mesh_warnings(mesh, "a"))


def whole_volume(volume):
    assert volume.values.ndim == 3 and min(volume.values.shape) >= 2 and np.isfinite(volume.values).all()
    assert volume.T_ct_index.shape == (4, 4) and np.isfinite(volume.T_ct_index).all()
    assert abs(np.linalg.det(volume.T_ct_index[:3, :3])) > 1e-6


def whole_labelmap(labelmap):
    assert labelmap.labels.dtype.kind in "iu" and labelmap.labels.min() >= 0 and labelmap.labels.max() > 0


def whole_points(points):
    assert points.points.shape == (len(points.names), 3) and np.isfinite(points.points).all()
    assert len(set(points.names)) == len(points.names) > 0 and all(points.names)


def whole_transform(T):
    assert np.isfinite(T).all() and np.abs(T[:3, :3].T @ T[:3, :3] - np.eye(3)).max() < 1e-4
    assert np.linalg.det(T[:3, :3]) > 0


def whole_names(names):
    assert names and len(set(names.values())) == len(names) and all(0 < label <= 65535 for label in names)


def whole_frames(read):
    assert read.grey.dtype == np.uint8 and read.grey.ndim == 3 and read.grey.size
    assert read.pixel_mm is None or np.isfinite(read.pixel_mm).all()


def whole_recording(recording):
    for T in (recording.A, recording.B):
        R = T[:, :3, :3]
        assert np.isfinite(T).all() and np.abs(R.transpose(0, 2, 1) @ R - np.eye(3)).max() < 1e-5
    assert np.isfinite(recording.P).all() and len(set(recording.names)) == len(recording)
    assert recording.v is None or np.allclose(np.linalg.norm(recording.v, axis=1), 1)


def whole_states(states):
    assert all(np.isfinite(state.time_s) and np.isfinite(state.q).all() and state.q.shape == (6,) for state in states)


def whole_plan(plan):
    assert np.isfinite([plan.theta, plan.beta, plan.roll, plan.standoff_mm, plan.needle_length_mm]).all()
    R = plan.T_base_ct[:3, :3]
    assert np.abs(R.T @ R - np.eye(3)).max() < 1e-5 and np.linalg.det(R) > 0
    assert np.allclose(plan.approach.q[-1], plan.insertion.q[0], rtol=0, atol=1e-9)
    assert all((np.diff(part.times_s) > 0).all() for part in (plan.approach, plan.insertion))


def whole_motion(motion):
    assert all((np.diff(part.times_s) > 0).all() and np.isfinite(part.q).all() for part in motion)


def whole_certificate(certificate):
    count = len(certificate.leaves)
    assert all(len(part) == count for part in (certificate.verdict, certificate.reason, certificate.triangle))
    assert np.isfinite(certificate.size) and np.isfinite(certificate.question.length)


def whole_case(read):
    """Finite numbers, one skin, something to avoid, unique names, a target inside; meshes that are whole.

    And nothing is lost: there are as many structures as the file states.
    """
    case, anatomy = read
    stated = sum(structure.name != BEYOND_LABELS for structure in anatomy.structures) + 1  # the skin is one
    assert case.stated_structures == stated
    assert np.isfinite(case.target_ct).all() and np.isfinite(case.T_ct_entry).all()
    names = [structure.name for structure in anatomy.structures]
    assert len(set(names)) == len(names) and any(s.demands_margin for s in anatomy.structures)
    for structure in anatomy.structures:
        assert 0 <= structure.margin_mm <= 1000
        whole_mesh(structure.mesh)


def whole_checks(checks):
    assert any(checks.tables().values()) and all(0 <= check.theta_deg <= 180 for check in checks.check)


def whole_anything(value):
    assert value is not None


def read_case(path):
    case = load_case(path)
    load_placement(case)
    return case, load_anatomy(case)


def read_own_mesh(path):
    return read_mesh(path, unit=Unit.MM, space=Space.LPS, up=Up.Z)


def read_own_points(path):
    return read_points(path, default_space=Space.LPS, default_unit=Unit.MM)


DICOM_SERIES = ("slice0.dcm", "slice1.dcm", "slice2.dcm")
DICOM = {**dict.fromkeys((*DICOM_SERIES, "enhanced.dcm"), "dicom")}
DICOM_MASKS = {"seg.dcm": "dicom", "rt.dcm": "dicom"}


def dicom_series(path):
    recognise(path)
    names = DICOM_SERIES if path.name in DICOM_SERIES else (path.name,)
    return parse_series(path, names, lambda name: (path.parent / name).read_bytes())


def read_dicom_masks(path):
    recognise(path)
    ct = dicom_series(path.parent / DICOM_SERIES[0])
    parse = parse_segmentation if path.name == "seg.dcm" else parse_structure_set
    found = parse(path, path.name, lambda name: (path.parent / name).read_bytes(), ct)
    return [mask.volume() for mask in found.masks.values()]


def whole_masks(volumes):
    assert volumes
    for volume in volumes:
        whole_volume(volume)
        assert set(np.unique(volume.values)) <= {0, 1}


def read_names(path):
    return names_for(path.name, path.parent, lambda name: (path.parent / name).read_bytes(), None)


def read_times(path):
    return read_csv(path.read_bytes().decode("utf-8", "replace"), where=path)


def read_transform(path):
    return parse_transform(path.read_bytes(), path)


TEXTS = ("ascii.stl", "a.obj", "ascii.ply", "ascii.vtp", "base64.vtp", "ascii.vtk")
MESHES = {
    "a.stl": "stl",
    "a.ply": "headed",
    "a.glb": "glb",
    "a.vtk": "headed",
    "strips.vtk": "headed",
    **dict.fromkeys(TEXTS, "text"),
}
HEADED = ("raw.nrrd", "gzip.nrrd", "labels.seg.nrrd")
LABELS = {"labels.nii.gz": "gzip", "labels.nii": "nifti", "labels.nhdr": "text", **dict.fromkeys(HEADED, "headed")}
POINTS = {"a.mrk.json": "tree", **dict.fromkeys(("markers_ct.csv", "kinds.csv", "a.fcsv"), "table")}
TRANSFORMS = {"transform.h5": "hdf5", "earliest.h5": "hdf5", "transform.tfm": "text"}
CASES = ("full.toml", "case.toml", "mount.toml")
TARGETS = [
    Target("mesh", MESHES, read_own_mesh, whole_mesh),
    Target("volume", {"ct.nii.gz": "gzip", "ct.nrrd": "headed", **LABELS}, read_volume, whole_volume),
    Target("series", DICOM, lambda path: dicom_series(path).volume(), whole_volume),
    Target("dicom masks", DICOM_MASKS, read_dicom_masks, whole_masks),
    Target("label map", LABELS, lambda path: labelmap_of(read_volume(path)), whole_labelmap),
    Target("points", POINTS, read_own_points, whole_points),
    Target("transform", TRANSFORMS, read_transform, whole_transform),
    Target("naming", {"names.csv": "table"}, read_names, whole_names),
    Target("case", dict.fromkeys(CASES, "text"), read_case, whole_case, heavy=True),
    Target("servo case", {"servo.toml": "text"}, load_servo_case, whole_anything, heavy=True),
    Target("selfcal case", {"selfcal.toml": "text"}, load_selfcal_case, whole_anything),
    Target("collision file", {"x.collision.toml": "text"}, lambda path: read_checks(path).content, whole_checks),
    Target("certificate", {"certificate.json": "tree"}, read_certificate, whole_certificate),
    Target("plan", {"plan.json": "tree"}, read_plan, whole_plan),
    Target("output set", {"set.json": "tree"}, rewritten_set, whole_set),
    Target("recording", {"recording.csv": "table"}, read_recording, whole_recording),
    Target("pictures", {"seen.png": "text", "seen.dcm": "dicom", "clip.dcm": "dicom"}, read_frames, whole_frames),
    Target("joints", {"joints.csv": "table"}, lambda path: list(recorded(path).states), whole_states),
    Target("times", {"times.csv": "table"}, read_times, whole_motion),
]
