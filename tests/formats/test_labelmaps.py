"""Label maps and the surfaces made of them."""

import itertools
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813 - the name that its whole documentation uses
from places import REAL_CT
from refusals import refused
from scipy import ndimage
from scipy.spatial import cKDTree

from puncture_twin.planning.anatomy.surfaces import VolumeSurfaces
from puncture_twin.planning.base.cache.array_cache import NO_CACHE
from puncture_twin.planning.formats.labels.labelmaps import LabelMap, label_mesh, labelmap_of
from puncture_twin.planning.formats.volumes.volume_files import VolumeFile, read_volume
from puncture_twin.planning.geometry.mesh import TriangleMesh

REAL = REAL_CT
needs_real = pytest.mark.skipif(not REAL.is_dir(), reason=f"the real CT is not at {REAL}")
OBLIQUE = np.array([[0.8, 0.0, -1.8, 15.0], [0.36, 1.6, 1.44, -40.0], [0.48, -1.2, 1.92, 300.0], [0.0, 0.0, 0.0, 1.0]])
"""Spacing 1, 2, 3 mm, oblique in all axes, determinant positive."""


def map_of(labels: np.ndarray, T: np.ndarray = OBLIQUE) -> LabelMap:
    return LabelMap(labels, T, None, Path("made.nii"))


def volume_of(mesh: TriangleMesh) -> float:
    a, b, c = mesh.triangles.swapaxes(0, 1)
    return float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6.0


def blobs(seed: int, shape: tuple[int, int, int] = (11, 9, 10)) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=shape)
    return (ndimage.gaussian_filter(noise, 0.7) > 0.05).astype(np.int32)


def write(folder: Path, values: np.ndarray, name: str = "a.nii.gz") -> Path:
    image = sitk.GetImageFromArray(np.ascontiguousarray(values.transpose(2, 1, 0)))
    sitk.WriteImage(image, str(folder / name))
    return folder / name


def test_one_voxel_is_an_octahedron_around_its_centre() -> None:
    labels = np.zeros((3, 4, 5), dtype=np.int32)
    labels[1, 2, 3] = 7
    mesh = label_mesh(map_of(labels), 7, where="test")
    centre = OBLIQUE[:3, :3] @ [1, 2, 3] + OBLIQUE[:3, 3]
    corners = np.concatenate([centre + OBLIQUE[:3, :3].T / 2, centre - OBLIQUE[:3, :3].T / 2])
    assert mesh.closed
    assert np.allclose(np.sort(mesh.vertices, axis=0), np.sort(corners, axis=0), atol=1e-9)
    assert volume_of(mesh) == pytest.approx(6.0 / 6.0)


def test_any_mask_makes_a_closed_manifold_surface_with_normals_outward() -> None:
    """Each edge has two triangles that run it in opposite directions; scikit-image's default fails this."""
    rng = np.random.default_rng(4)
    for share in np.linspace(0.02, 0.98, 20):
        labels = (rng.random((7, 8, 6)) < share).astype(np.int32)
        labels[3, 3, 3] = 1
        mesh = label_mesh(map_of(labels), 1, where="test")
        edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
        forward = {tuple(edge) for edge in edges.tolist()}
        assert len(forward) == len(edges)
        assert forward == {(b, a) for a, b in forward}
        assert volume_of(mesh) > 0


def test_all_48_axis_orders_and_flips_give_the_same_mesh() -> None:
    """However the map is stored, vertices and triangles in LPS are the same within 1e-4 mm."""
    labels = blobs(0, (7, 6, 8))
    wanted = label_mesh(map_of(labels), 1, where="test")
    for order, flips in itertools.product(itertools.permutations(range(3)), itertools.product((1, -1), repeat=3)):
        T_index = np.zeros((4, 4))
        T_index[3, 3] = 1
        for new, old in enumerate(order):
            T_index[old, new] = flips[new]
            T_index[old, 3] = 0 if flips[new] == 1 else labels.shape[old] - 1
        stored = labels.transpose(order)[tuple(slice(None, None, flip) for flip in flips)]
        mesh = label_mesh(map_of(stored, OBLIQUE @ T_index), 1, where="test")
        assert np.array_equal(mesh.faces, wanted.faces)
        assert np.abs(mesh.vertices - wanted.vertices).max() < 1e-4


def boundary_squares(mask: np.ndarray) -> np.ndarray:
    padded = np.pad(mask, 1).astype(bool)
    found = []
    for axis in range(3):
        index = np.argwhere(np.diff(padded, axis=axis)) - 1.0
        index[:, axis] += 0.5
        half = np.full((len(index), 3), 0.5)
        half[:, axis] = 0.0
        found.append(np.stack([index, half], axis=1))
    return np.concatenate(found)


def test_surface_and_voxel_boundary_are_within_half_a_voxel_of_each_other() -> None:
    """Sampled both ways, the greatest of the three index differences stays at or below 0.5."""
    labels = blobs(0, (7, 6, 8))
    mesh = label_mesh(map_of(labels), 1, where="test")
    index = np.linalg.solve(OBLIQUE[:3, :3], (mesh.vertices - OBLIQUE[:3, 3]).T).T
    weights = np.array([w for w in itertools.product(range(7), repeat=3) if sum(w) == 6]) / 6.0
    surface = np.einsum("gc,tcx->tgx", weights, index[mesh.faces]).reshape(-1, 3)
    squares = boundary_squares(labels)
    gaps = [
        np.maximum(np.abs(part[:, None] - squares[:, 0]) - squares[:, 1], 0).max(axis=2).min(axis=1)
        for part in np.array_split(surface, 40)
    ]
    assert max(gap.max() for gap in gaps) <= 0.5 + 1e-9
    at_vertices = np.maximum(np.abs(index[:, None] - squares[:, 0]) - squares[:, 1], 0).max(axis=2).min(axis=1)
    assert at_vertices.max() < 1e-6
    steps = np.array(list(itertools.product((-1, -0.5, 0, 0.5, 1), repeat=3)))
    boundary = (squares[:, None, 0] + steps * squares[:, None, 1]).reshape(-1, 3)
    assert cKDTree(surface).query(boundary, p=np.inf)[0].max() <= 0.5 + 1e-9


def test_a_label_that_is_not_there_is_refused_with_those_that_are() -> None:
    labels = np.zeros((4, 4, 4), dtype=np.int32)
    labels[1, 1, 1], labels[2, 2, 2] = 3, 9
    assert map_of(labels).labels_present() == (3, 9)
    with refused("label_absent"):
        label_mesh(map_of(labels), 5, where="case.toml")


def test_labels_are_read_from_integers_and_from_whole_floats(tmp_path: Path) -> None:
    values = np.zeros((4, 5, 6), dtype=np.float32)
    values[1, 2, 3] = 12
    for dtype in (np.float32, np.float64, np.uint8, np.int16, np.uint32, np.int64):
        labelmap = labelmap_of(read_volume(write(tmp_path, values.astype(dtype))))
        assert labelmap.labels_present() == (12,)
        assert labelmap.labels[1, 2, 3] == 12
        assert not labelmap.labels.flags.writeable


def test_values_that_are_no_labels_are_refused(tmp_path: Path) -> None:
    """Fractions, negative and too large values, a map with nothing in it; blended ones, by an interpolation.

    Of those most voxels are whole, those at the borders are not; a probability or a dose is none of it.
    """
    values = np.zeros((4, 5, 6), dtype=np.float32)
    for value, code in ((0.5, "no_labels"), (-1.0, "no_labels"), (70000.0, "no_labels"), (0.0, "empty")):
        values[1, 2, 3] = value
        with refused(code):
            labelmap_of(read_volume(write(tmp_path, values)))
    blended = ndimage.zoom(np.pad(np.full((4, 4, 4), 5.0), 3), 2.0, order=1)
    dose = np.random.default_rng(3).uniform(0.0, 60.0, (4, 5, 6))
    for voxels, code in ((blended, "labels_blended"), (dose, "no_labels")):
        with refused(code):
            labelmap_of(read_volume(write(tmp_path, voxels.astype(np.float32))))


@pytest.mark.parametrize("off", [1e-5, 0.016, -0.016])
def test_labels_that_are_nearly_whole_are_rounded_and_it_is_known(tmp_path: Path, off: float) -> None:
    """As a slope leaves them: never cut off, which would make a 3 of 2.99997 a 2."""
    values = np.zeros((4, 5, 6), dtype=np.float32)
    values[1], values[2] = 3 + off, 65_535
    labelmap = labelmap_of(read_volume(write(tmp_path, values)))
    assert labelmap.labels_present() == (3, 65_535)
    assert labelmap.rounded_by == pytest.approx(abs(off), rel=0.1)
    found = VolumeSurfaces(VolumeFile(tmp_path / "a.nii.gz", ("a.nii.gz",), content_of(tmp_path)), (), NO_CACHE)
    assert "were rounded" in found.present().notes(found.path)[0]


def content_of(folder: Path) -> Callable[[str], bytes]:
    return lambda name: (folder / name).read_bytes()


def segmentation(folder: Path, remarks: str) -> Path:
    labels = np.zeros((3, 3, 3), dtype=np.uint8)
    labels[0], labels[1] = 1, 2
    head = (
        "NRRD0004\ntype: unsigned char\ndimension: 3\nspace: left-posterior-superior\nsizes: 3 3 3\n"
        "space directions: (1,0,0) (0,1,0) (0,0,1)\nencoding: raw\nspace origin: (0,0,0)\n"
    )
    path = folder / "a.seg.nrrd"
    path.write_bytes((head + remarks + "\n").encode() + labels.tobytes(order="F"))
    return path


def test_names_come_out_of_a_slicer_segmentation(tmp_path: Path) -> None:
    remarks = (
        "Segment0_Name:=left kidney\nSegment0_LabelValue:=2\nSegment1_LabelValue:=1\nSegment1_Name:=liver: all\n"
        "Segmentation_MasterRepresentation:=Binary labelmap\n"
    )
    labelmap = labelmap_of(read_volume(segmentation(tmp_path, remarks)))
    assert labelmap.names == {2: "left kidney", 1: "liver: all"}
    with refused("label_absent"):
        label_mesh(labelmap, 3, where="case.toml")


def test_segments_that_contradict_each_other_are_refused(tmp_path: Path) -> None:
    name, value = "Segment{}_Name:={}\n", "Segment{}_LabelValue:={}\n"
    for remarks, says in (
        (name.format(0, "liver"), "bad_value"),
        (name.format(0, "liver") + value.format(0, -1), "bad_value -1"),
        (name.format(0, "a") + value.format(0, 1) + name.format(1, "b") + value.format(1, 1), "duplicate_label"),
    ):
        with refused(*says.split()):
            labelmap_of(read_volume(segmentation(tmp_path, remarks)))


@needs_real
@pytest.mark.parametrize("name", ["labels_v1_normal", "labels_v2_fast"])
def test_every_label_of_the_real_patient_is_closed_and_keeps_its_volume(name: str) -> None:
    """All are closed, none grows, and half keep 98 % of their volume.

    From 50 voxels (1.4 ml) on the surface lies, on average, less than a tenth of a voxel inside the voxels' faces,
    whose corners it cuts off.
    """
    labelmap = labelmap_of(read_volume(REAL / f"{name}.nii.gz"))
    named = json.loads((REAL / f"{name}.json").read_text())
    assert labelmap.labels_present() == tuple(sorted(map(int, named)))
    shares = []
    for label in labelmap.labels_present():
        mesh = label_mesh(labelmap, label, where=name)
        assert mesh.closed
        count = int(np.count_nonzero(labelmap.labels == label))
        lost = 27.0 * count - volume_of(mesh)
        shares.append(1.0 - lost / (27.0 * count))
        a, b, c = mesh.triangles.swapaxes(0, 1)
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
        assert lost >= 0
        assert lost / area < 0.3 or count < 50
    assert np.median(shares) > 0.98
