"""Two structures in one place, and a mesh whose triangles are those of another unit."""

from types import SimpleNamespace

import numpy as np
import pytest

from puncture_twin.planning.anatomy.structure import Role, Structure
from puncture_twin.planning.base.cache.array_cache import NO_CACHE
from puncture_twin.planning.evidence.inside_skin import odd_units, overlaps, shared

CASE = SimpleNamespace(region="abdomen")


def structure(name, mesh, role=Role.AVOID, voxel_ct=None):
    return Structure(name, role, 2.0, mesh, f"masks/{name}.nii.gz:1", voxel_ct=voxel_ct)


def found(*structures):
    return [one.numbers for one in overlaps(CASE, SimpleNamespace(structures=structures), NO_CACHE)]


def test_shared_volume_is_that_of_the_lens_of_two_balls(ball):
    """By the formula for two balls of one radius, and none for balls beside each other."""
    r, d = 30.0, 35.0
    lens = np.pi * (4 * r + d) * (2 * r - d) ** 2 / 12
    (one,) = shared([ball(r), ball(r, (d, 0, 0)), ball(r, (0, 70, 0))])
    assert {one.one, one.other} == {0, 1}
    assert one.ml == pytest.approx(lens / 1000, rel=0.03)
    assert one.fraction == pytest.approx(lens / (4 / 3 * np.pi * r**3), rel=0.03)


@pytest.mark.parametrize(
    ("inner", "outer", "shift", "said"),
    [
        ("gallbladder", "liver", 25.0, True),
        ("gallbladder", "liver", 0.0, True),
        ("gallbladder", "liver", 60.0, False),
        ("aorta", "vertebrae_L1", 25.0, True),
        ("rib_left_7", "rib_left_8", 25.0, True),
        ("portal_vein", "liver", 25.0, False),
        ("portal_vein", "vertebrae_L1", 25.0, True),
        ("spinal_cord", "vertebrae_L1", 25.0, False),
        ("liver_tumor", "liver", 25.0, False),
        ("lung_upper_lobe_left", "lung_left", 25.0, False),
        ("iliopsoas_left", "skeletal_muscle", 25.0, False),
        ("node_1", "node_2", 25.0, True),
        ("node_1", "node_2", 0.0, False),
    ],
)
def test_what_may_lie_in_what_is_told_by_names(ball, inner, outer, shift, said):
    """A part, a vessel, a lesion or a tissue may; an organ that straddles another one, or lies in it, may not."""
    assert bool(found(structure(inner, ball(12, (shift, 0, 0))), structure(outer, ball(30)))) == said


def test_labels_of_one_map_and_what_is_unknown_are_not_asked(ball):
    """Each voxel of a map has one label; an unknown region may lie over anything."""
    one, other = (Structure(name, Role.AVOID, 2.0, ball(20), f"labels.nii.gz:{k}") for k, name in enumerate("ab"))
    assert not found(one, other)
    assert not found(structure("a", ball(20)), structure("b", ball(20, (15, 0, 0)), Role.UNKNOWN))


@pytest.mark.parametrize(("factor", "unit"), [(1.0, None), (0.1, "cm"), (0.001, "m")])
def test_a_mesh_in_another_unit_than_its_siblings_is_named(ball, factor, unit):
    """By its triangles, where it would lie in the body in that unit too."""
    meshes = [ball(20, (x, 10, 5)) for x in (-50, 0, 50)]
    T = np.diag([factor, factor, factor, 1.0])
    structures = [structure(f"m{k}", mesh.transformed(T) if k == 2 else mesh) for k, mesh in enumerate(meshes)]
    said = list(odd_units(SimpleNamespace(structures=structures, skin=SimpleNamespace(mesh=ball(120)))))
    assert [one.sentence.endswith(f"is it in {unit}?") for one in said] == [True] * (unit is not None)


def test_a_fine_mesh_among_coarse_ones_is_no_other_unit(ball):
    structures = [structure(f"m{k}", ball(20, (40 * k, 60, 0), 2)) for k in range(3)] + [
        structure("fine", ball(10, (0, -50, 30), 5))
    ]
    assert not list(odd_units(SimpleNamespace(structures=structures, skin=SimpleNamespace(mesh=ball(150)))))
