"""Structures that are not of their image are refused, warned of, or said to be open; those that are, never refused."""

from functools import cache

import numpy as np
import pytest
from placed_trunk import PHANTOMS, moved, write_trunk
from places import DATA
from refusals import refused

from benchmarks.placements import Patient, changed, meshes_of, real, source_of, wrong
from puncture_twin.planning.base.errors import Severity
from puncture_twin.planning.evidence.edges import compare, edge_image, sample_surfaces
from puncture_twin.planning.evidence.label_placement import REFUSING_Z, STRUCTURES, WARNING_Z, assess, slip_of
from puncture_twin.planning.geometry.rigid import exp_rotation
from puncture_twin.planning.search.context import prepare

needs_scans = pytest.mark.skipif(
    not (DATA / "slicer_chest_ct4").is_dir(), reason="the real scans are not on this machine"
)


@cache
def scans():
    """The real patients, by name."""
    return dict(real(DATA))


@cache
def seen(name):
    """A phantom or a real patient, the edges of the image, and the structures as they lie."""
    patient = PHANTOMS[name] if name in PHANTOMS else scans()[name]
    return patient, edge_image(patient.hu, patient.T), source_of(patient, meshes_of(patient))


def about(point, linear):
    """The affine map (4, 4) that leaves a point in place."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = linear, point - linear @ point
    return T


@pytest.mark.parametrize("name", ["trunk", "head"])
def test_slips_are_found_and_true_placements_pass(name):
    """Of three seeded slips none passes in silence. In noise, cropped, on thick slices the true is not doubted."""
    rng = np.random.default_rng(2)
    patient, image, source = seen(name)
    for _ in range(3):
        kind, T = wrong(source, rng)
        found = assess(image, source_of(patient, {n: mesh.transformed(T) for n, mesh in source.meshes.items()}))
        assert found.z >= WARNING_Z or found.open, (kind, found)
    for change in ("noise 40 HU", "cropped", "every third slice"):
        same = changed(patient, change, rng)
        found = assess(edge_image(same.hu, same.T), source_of(same, meshes_of(same)))
        assert found.z < WARNING_Z, (change, found)


@needs_scans
@pytest.mark.parametrize("name", ["abdomen", "chest"])
def test_real_labels_are_told_from_the_same_off_by_least(name):
    """A voxel and a half (15 mm along the chest's slices), 5 %, a mirror image: refused, and the true ones excluded."""
    patient, image, source = seen(name)
    assert assess(image, source).open == ()
    least = np.maximum(6.0, 1.5 * source.voxel_mm)
    mirror = np.eye(4)
    mirror[0, 0], mirror[0, 3] = -1.0, 2 * source.middles[0][0]
    for T in (moved(*-np.diag(least)[1]), np.diag([0.95, 0.95, 0.95, 1.0]), mirror):
        found = assess(image, source_of(patient, {n: mesh.transformed(T) for n, mesh in source.meshes.items()}))
        assert found.z >= REFUSING_Z
        assert found.T is not None
        points = np.concatenate([mesh.vertices[::20] for mesh in source.meshes.values()])
        back = np.c_[points, np.ones(len(points))] @ (found.T @ T).T
        assert np.sqrt(np.mean(np.sum((back[:, :3] - points) ** 2, axis=1))) < max(3.0, 0.5 * source.voxel_mm.max())


@needs_scans
def test_labels_that_were_resampled_in_another_pose_are_refused():
    """Five degrees on the CT's own grid: no shift finds them, 43 paths led through a gallbladder."""
    patient, image, source = seen("abdomen")
    turn = about(source.middles[0], exp_rotation([0.0, np.radians(5.0), 0.0]))
    off = {name: mesh.transformed(turn) for name, mesh in source.meshes.items()}
    assert assess(image, source_of(patient, off)).refuses


def test_structures_that_agree_on_another_place_are_named():
    """Two of eight organs 24 mm off, the others right: they are named, and lie better at one and the same place."""
    patient, image, source = seen("trunk")
    down = moved(0.0, 0.0, 24.0)
    off = {name: mesh.transformed(down) if name in "12" else mesh for name, mesh in source.meshes.items()}
    found = assess(image, source_of(patient, off))
    assert found.agreeing == ("1", "2") or found.refuses
    assert assess(image, source).agreeing == ()


def test_one_structure_that_is_off_is_named():
    """Each of eight by itself 15 mm off to the side: it lies better elsewhere, or its outline is not confirmed."""
    patient, image, source = seen("trunk")
    meshes, true = source.meshes, assess(image, source)
    assert true.odd == true.unseen == ()
    assert len(true.unconfirmed) <= 3
    for name in ("2", "5", "6"):
        off = meshes | {name: meshes[name].transformed(moved(0.0, 15.0, 0.0))}
        found = assess(image, source_of(patient, off))
        assert name in {*found.odd, *found.unconfirmed}, (name, found)
    away = meshes | {"5": meshes["5"].transformed(moved(0.0, 0.0, 400.0))}
    assert assess(image, source_of(patient, away)).unseen == ("5",)


def test_a_better_edge_around_what_is_uneven_is_no_other_place():
    """A vein of hardly any contrast beside an artery of much: half in it its edges are stronger beyond chance."""
    x, y, z = np.meshgrid(*(np.arange(n) * 2.0 - n + 1 for n in (80, 80, 60)), indexing="ij")
    vein, artery = np.hypot(x, y) < 10, np.hypot(x - 24, y) < 7
    hu = np.where(artery, 300.0, np.where(vein, 24.0, 20.0)) + np.random.default_rng(1).normal(0, 10, x.shape)
    T = np.diag([2.0, 2.0, 2.0, 1.0])
    T[:3, 3] = x[0, 0, 0], y[0, 0, 0], z[0, 0, 0]
    patient = Patient(hu, vein.astype(np.int16) + 2 * artery, T)
    image, source = edge_image(hu, T), source_of(patient, meshes_of(patient))
    tried = compare(image, sample_surfaces(list(source.meshes.values())), source.placements())
    (z_least, ratio_least, _), _ = STRUCTURES
    assert np.any((tried.own_z[:, 0] >= z_least) & (tried.own_ratio[:, 0] >= ratio_least))
    assert assess(image, source).odd == ()


def test_a_thin_slab_is_told_by_the_shifts_that_it_has_room_for():
    """Of 40 mm along the bed a shift of 48 mm leaves nothing in the image; that it is not excluded says nothing."""
    patient = PHANTOMS["trunk"]
    slab = patient._replace(hu=patient.hu[:, :, 20:36], labels=patient.labels[:, :, 20:36])
    found = assess(edge_image(slab.hu, slab.T), source_of(slab, meshes_of(slab)))
    assert "shift" not in found.open


def test_what_edges_cannot_tell_is_said():
    """Rods in an image without any edge: no place is excluded, and none is claimed to be right."""
    patient = PHANTOMS["cylinder"]
    image = edge_image(np.full(patient.hu.shape, 30.0), patient.T)
    found = assess(image, source_of(patient, meshes_of(patient)))
    assert "shift" in found.open
    assert found.z < WARNING_Z


def test_surfaces_beside_the_image_are_not_said_to_fit():
    patient, image, source = seen("trunk")
    far = {n: mesh.transformed(moved(2000.0)) for n, mesh in source.meshes.items()}
    assert "shift" in assess(image, source_of(patient, far)).open


def test_a_case_with_labels_beside_its_ct_is_refused_with_the_shift(tmp_path):
    """9 mm to the back: code and numbers say it, and the way that brings them back."""
    path = write_trunk(tmp_path, moved(0.0, 9.0, 0.0))
    with refused("labels_beside_image", "trust_labels") as caught:
        prepare(path, arm=False)
    np.testing.assert_allclose(caught.value.numbers["shift_mm"], (0.0, -9.0, 0.0), atol=1.5)


def test_a_person_who_has_looked_may_go_on(tmp_path):
    """With trust_labels the same is a warning in every result, with its numbers among the findings."""
    path = write_trunk(tmp_path, moved(0.0, 9.0, 0.0), more="trust_labels = true")
    context = prepare(path, arm=False)
    found = [one for one in context.anatomy.findings if one.code == "labels_beside_image"]
    assert [one.severity for one in found] == [Severity.WARNING]
    assert found[0].sentence in context.anatomy.warnings
    documents = context.provenance()["findings"]
    assert {"code", "severity", "numbers", "sentence"} == set(documents[0])


def test_true_labels_are_confirmed_and_kept(tmp_path):
    """A note says so, which is no warning; the second time nothing is computed anew, and the same is said."""
    path = write_trunk(tmp_path, np.eye(4))
    first, second = (prepare(path, arm=False).anatomy.findings for _ in range(2))
    assert "labels_on_edges" in {one.code for one in first}
    assert first == second


def test_a_lost_grid_is_named(tmp_path):
    """The CT's matrix on voxels of 1 mm at the origin: read so, eight organs lie in a corner of the trunk."""
    patient = PHANTOMS["trunk"]
    grid = np.diag([1.0, 1.0, 1.0, 1.0])
    grid[:3, 3] = (-90.0, -35.0, -10.0)
    with refused("labels_beside_image") as caught:
        prepare(write_trunk(tmp_path, grid @ np.linalg.inv(patient.T)), arm=False)
    assert "own grid" in caught.value.what
    assert caught.value.numbers["scale"] == pytest.approx(3.0)


def test_a_slip_in_words_and_numbers():
    """A mirror image that was also scaled, turned and moved, about a point."""
    middle = np.array([10.0, 20.0, 30.0])
    T = np.eye(4)
    T[:3, :3] = 1.1 * exp_rotation([0.0, 0.0, np.radians(4.0)]) @ np.diag([-1.0, 1.0, 1.0])
    T[:3, 3] = middle - T[:3, :3] @ middle + (1.0, 2.0, 3.0)
    slip = slip_of(T, middle)
    assert slip.axes == "mirrored in x"
    assert slip.numbers() == {"shift_mm": [1.0, 2.0, 3.0], "scale": 1.1, "turn_deg": 4.0}
    assert "scaled by 1.1 and rotated by 4 degrees" in slip.text(own_grid=False)
