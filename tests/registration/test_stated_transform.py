"""CT to robot from a transform file of ITK or Slicer, text or HDF5: ITK is the oracle, and nothing is guessed."""

import struct
import subprocess
import sys

import h5py
import numpy as np
import pytest
import SimpleITK
from case_world import CASE, changed, registration_section, write_case
from refusals import refused

from puncture_twin.planning.anatomy.anatomy import load_skin
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.formats.itk_transform import HEAP_HEAD_BYTES, parse_transform, transform_text
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, inverse, left_jacobian, pose
from puncture_twin.planning.registration.checks.checked_placement import placement_findings
from puncture_twin.planning.registration.checks.markers import Surroundings
from puncture_twin.planning.registration.placement import load_placement
from puncture_twin.twin.jobs.patient.answers import registration_report

TURN = np.array([0.4, -1.1, 2.0])
T_BASE_CT = pose(exp_rotation(TURN), left_jacobian(TURN) @ [310.0, -120.0, 240.0])
FLIP = np.diag([-1.0, -1.0, 1.0, 1.0])
POINTS = np.array([[0.0, 0.0, 80.0], [50.0, 0.0, 75.0], [0.0, 60.0, 70.0], [-40.0, -30.0, 72.0]])
TOLERANCE_MM = 1e-9


def itk_file(folder, T, center=(0.0, 0.0, 0.0), name="ct_to_robot.tfm"):
    affine = SimpleITK.AffineTransform(3)
    affine.SetCenter(center)
    affine.SetMatrix(T[:3, :3].ravel().tolist())
    affine.SetTranslation((T[:3, 3] - center + T[:3, :3] @ center).tolist())
    SimpleITK.WriteTransform(affine, str(folder / name))
    return affine


def stating(folder, maps="ct_to_base", axes="LPS", file="ct_to_robot.tfm", *more):
    keys = [f'transform = "{file}"', maps and f'transform_maps = "{maps}"', axes and f'base_axes = "{axes}"', *more]
    section = "\n".join(["[registration]", *filter(None, keys), ""])
    write_case(folder, text=changed(CASE, (registration_section(), section)))
    return folder


@pytest.mark.parametrize("maps", ["ct_to_base", "base_to_ct"])
@pytest.mark.parametrize("center", [(0.0, 0.0, 0.0), (10.0, -20.0, 30.0)])
def test_a_file_does_to_points_what_itk_does(tmp_path, maps, center):
    """Whichever way it goes, base coordinates are those that SimpleITK's TransformPoint goes to or comes from."""
    affine = itk_file(tmp_path, T_BASE_CT if maps == "ct_to_base" else inverse(T_BASE_CT), center)
    found = load_placement(load_case(stating(tmp_path, maps)))
    in_base = apply(found.T_base_ct, POINTS)
    pairs = zip(POINTS, in_base, strict=True) if maps == "ct_to_base" else zip(in_base, POINTS, strict=True)
    for start, end in pairs:
        assert affine.TransformPoint(start.tolist()) == pytest.approx(end, abs=TOLERANCE_MM)
    assert in_base == pytest.approx(apply(T_BASE_CT, POINTS), abs=TOLERANCE_MM)


@pytest.mark.parametrize("ending", ["tfm", "h5"])
def test_a_transform_that_slicer_registered(tmp_path, ending):
    """Of the CT's markers onto points as the robot shows them, in Slicer's RAS: the way from its parent, in LPS."""
    itk_file(tmp_path, FLIP @ inverse(T_BASE_CT @ FLIP) @ FLIP, name=f"a.{ending}")
    found = load_placement(load_case(stating(tmp_path, "base_to_ct", "RAS", f"a.{ending}")))
    assert found.T_base_ct == pytest.approx(T_BASE_CT, abs=TOLERANCE_MM)


def test_it_is_an_input_and_says_that_nothing_is_known_of_its_error(tmp_path):
    """Hashed; no residuals, no expected error; told in every result and by register, which has nothing to show."""
    itk_file(tmp_path, T_BASE_CT)
    case = load_case(stating(tmp_path))
    assert ("transform", "ct_to_robot.tfm") in [(one.role, one.path) for one in case.inputs]
    said = "stated transform ct_to_robot.tfm: no residuals, expected error unknown"
    (found,) = placement_findings(case, Surroundings(load_skin(case), None), load_placement(case))
    line = found.sentence
    assert line.startswith(f"registration: {said} (markers_ct and markers_base with it would check it)")
    placement = load_placement(case)
    assert placement.registration is None and np.isnan(placement.target_error_mm)
    with refused("no_markers", said):
        registration_report(tmp_path)


@pytest.mark.parametrize("ending", ["tfm", "h5"])
def test_a_translation_and_an_identity_are_linear(tmp_path, ending):
    """As ITK writes them, without a centre; alone, and as parts of a chain."""
    shift = np.array([1.0, -2.0, 3.5])
    moved, still = SimpleITK.TranslationTransform(3, shift), SimpleITK.Transform(3, SimpleITK.sitkIdentity)
    path = tmp_path / f"ct_to_robot.{ending}"
    for made, times in ((moved, 1.0), (still, 0.0), (SimpleITK.CompositeTransform([moved, still, moved]), 2.0)):
        SimpleITK.WriteTransform(made, str(path))
        assert np.array_equal(parse_transform(path.read_bytes(), path), pose(np.eye(3), times * shift))


STILL = "#Insight Transform File V1.0\nTransform: IdentityTransform_double_3_3\nParameters:\nFixedParameters:\n"
GOOD = transform_text(T_BASE_CT)
MIRRORED = transform_text(T_BASE_CT @ np.diag([-1.0, 1.0, 1.0, 1.0]))
BENT = transform_text(T_BASE_CT @ np.diag([1.001, 1.0, 1.0, 1.0]))
TWICE = GOOD + "\n".join(GOOD.splitlines()[1:]) + "\n"


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("a.tfm", MIRRORED, "mirrored"),
        ("a.tfm", BENT, "not_rigid"),
        ("a.tfm", TWICE, "several_transforms"),
        ("a.tfm", GOOD.replace("#Insight", "#Insight Out"), "wrong_format"),
        ("a.tfm", GOOD.replace("AffineTransform", "BSplineTransform"), "unknown_type BSpline"),
        ("a.tfm", GOOD.replace("\nParameters: ", "\nParameters: 1 "), "wrong_count 13"),
        ("a.tfm", GOOD.replace("\nParameters: ", "\nParameters: a"), "not_a_number"),
        ("a.tfm", GOOD.replace("FixedParameters: 0", "FixedParameters: nan"), "not_finite"),
        ("a.tfm", GOOD.splitlines()[0], "no_linear_transform"),
        ("a.tfm", GOOD.replace("Transform: Aff", "Transform:\nAff"), "unknown_line"),
        ("a.tfm", GOOD.replace("\nFixed", "\vFixed"), "not_a_number"),
        ("a.tfm", GOOD.replace("FixedParameters: 0", "FixedParameters: \uff11"), "not_a_number"),
        ("a.tfm", GOOD.replace("FixedParameters: 0", "FixedParameters: 1_0"), "not_a_number"),
        ("a.mat", GOOD, "unknown_format"),
        ("a.tfm", STILL.replace("\nParameters:", "\nParameters: 1 2 3"), "wrong_count 3"),
        ("a.tfm", STILL.replace("Identity", "Translation"), "wrong_count 0"),
        ("a.tfm", STILL.replace("Identity", "Scale"), "unknown_type"),
    ],
)
def test_a_file_that_cannot_be_trusted_is_refused(tmp_path, name, text, says):
    """Mirrored, stretched, several, of another kind, cut: one line, and nothing is repaired."""
    (tmp_path / name).write_text(text)
    with refused(*says.split()):
        load_case(stating(tmp_path, file=name))


BOTH_LISTS = 'markers_ct = "markers_ct.csv"\nmarkers_base = "touch.csv"'


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ((None, "LPS"), "missing_key transform_maps base_to_ct"),
        (("ct_to_base", None), "missing_key base_axes RAS"),
        (("inward", "LPS"), "bad_value transform_maps"),
        (("ct_to_base", "LPS", "ct_to_robot.tfm", 'markers_ct = "markers_ct.csv"'), "missing_key markers_base"),
        (("ct_to_base", "LPS", "ct_to_robot.tfm", BOTH_LISTS, 'method = "rigid"'), "key_not_of_it"),
        (("ct_to_base", "LPS", "ct_to_robot.tfm", "fle_mm = 1.0"), "key_not_of_it fle_mm"),
    ],
)
def test_silence_and_contradiction_are_refused(tmp_path, keys, says):
    """Which way a transform goes, and what the robot's axes are, the case says."""
    itk_file(tmp_path, T_BASE_CT)
    with refused(*says.split()):
        load_case(stating(tmp_path, *keys))


def test_keys_of_a_transform_need_one(tmp_path):
    """A key of a transform without one is refused."""
    write_case(tmp_path, text=changed(CASE, (registration_section(), registration_section('base_axes = "LPS"'))))
    with refused("key_not_of_it"):
        load_case(tmp_path)


SINGLE_MM = 2e-4
"""What a rotation in single precision moves a point at 500 mm by, several times over."""
KINDS = ("affine", "euler", "euler_zyx", "versor", "composite")


def random_transform(kind, rng):
    """A rigid transform of SimpleITK with a centre of rotation somewhere."""
    centre, shift = rng.uniform(-200, 200, (2, 3)).tolist()
    if kind == "composite":
        return SimpleITK.CompositeTransform([random_transform(one, rng) for one in KINDS[:4]])
    euler = SimpleITK.Euler3DTransform(centre, *rng.uniform(-3, 3, 3).tolist(), shift)
    euler.SetComputeZYX(kind == "euler_zyx")
    if kind.startswith("euler"):
        return euler
    made = SimpleITK.AffineTransform(3) if kind == "affine" else SimpleITK.VersorRigid3DTransform()
    made.SetCenter(centre)
    made.SetMatrix(euler.GetMatrix())
    made.SetTranslation(shift)
    return made


def read(file):
    return parse_transform(file.read_bytes(), file)


def by_itk(transform):
    return np.array([transform.TransformPoint(point) for point in POINTS.tolist()])


@pytest.mark.parametrize("ending", [".hdf5", ".tfm"])
@pytest.mark.parametrize("kind", KINDS)
def test_every_linear_kind_does_to_points_what_itk_does(tmp_path, kind, ending):
    """Written by SimpleITK, read back by it and by us: centre of rotation, order of angles, order of parts."""
    rng = np.random.default_rng([14, *kind.encode()])
    for number in range(10):
        file = tmp_path / f"{number}{ending}"
        SimpleITK.WriteTransform(random_transform(kind, rng), str(file))
        expected = by_itk(SimpleITK.ReadTransform(str(file)))
        assert apply(read(file), POINTS) == pytest.approx(expected, abs=TOLERANCE_MM)


@pytest.mark.parametrize("angle", [0.0, 1e-9, np.pi - 1e-7, np.pi])
def test_a_versor_at_its_ends(tmp_path, angle):
    """No rotation, and half a turn, where the vector part has length 1 and ITK shortens it."""
    versor = SimpleITK.VersorRigid3DTransform()
    versor.SetRotation([0.6, 0.0, 0.8], float(angle))
    SimpleITK.WriteTransform(versor, str(tmp_path / "a.h5"))
    expected = by_itk(SimpleITK.ReadTransform(str(tmp_path / "a.h5")))
    assert apply(read(tmp_path / "a.h5"), POINTS) == pytest.approx(expected, abs=1e-7)


def rewritten(folder, kind, change, name="b.h5"):
    """A file of SimpleITK's after a change of its HDF5."""
    SimpleITK.WriteTransform(random_transform(kind, np.random.default_rng(7)), str(folder / name))
    with h5py.File(folder / name, "r+") as file:
        change(file["TransformGroup"], file)
    return folder / name


def in_single_precision(parent, _):
    for group in parent.values():
        kind = group["TransformType"].asstr()[0].replace("double", "float")
        replace(group, "TransformType", kind)
        if "TransformParameters" in group:
            replace(group, "TransformParameters", group["TransformParameters"][()].astype("<f4"))


def as_itk_4(parent, _):
    """The names that older files spell wrongly; Euler without its flag."""
    for group in parent.values():
        group["TranformParameters"] = group["TransformParameters"][()]
        group["TranformFixedParameters"] = group["TransformFixedParameters"][()][:3]
        del group["TransformParameters"], group["TransformFixedParameters"]


def replace(group, name, value):
    """Another dataset under a name; a text as ITK writes one."""
    group.pop(name, None)
    if isinstance(value, str):
        group.create_dataset(name, data=[value], dtype=h5py.string_dtype("ascii"))
    else:
        group[name] = value


@pytest.mark.parametrize(
    ("kind", "change"), [(kind, in_single_precision) for kind in KINDS] + [("euler", as_itk_4), ("versor", as_itk_4)]
)
def test_single_precision_and_older_files(tmp_path, kind, change):
    file = rewritten(tmp_path, kind, change)
    expected = by_itk(SimpleITK.ReadTransform(str(file)))
    assert apply(read(file), POINTS) == pytest.approx(expected, abs=SINGLE_MM)


def test_a_compressed_file_is_read(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        group = file.create_group("TransformGroup/0")
        replace(group, "TransformType", "AffineTransform_double_3_3")
        group.create_dataset("TransformParameters", data=[1.0, 0, 0, 0, 1, 0, 0, 0, 1, 1, 2, 3], compression="gzip")
        group.create_dataset("TransformFixedParameters", data=[0.0, 0, 0], compression="gzip")
    assert read(tmp_path / "a.h5")[:3, 3].tolist() == [1, 2, 3]


def test_a_field_of_displacements_is_refused(tmp_path):
    """Beside an affine part, as ANTs writes it."""
    field = SimpleITK.DisplacementFieldTransform(SimpleITK.Image([9, 8, 7], SimpleITK.sitkVectorFloat64, 3))
    both = SimpleITK.CompositeTransform([SimpleITK.AffineTransform(3), field])
    SimpleITK.WriteTransform(both, str(tmp_path / "a.h5"))
    with refused("unknown_type", "DisplacementFieldTransform_double_3_3"):
        read(tmp_path / "a.h5")


def times(matrix):
    """The affine part, by another matrix."""

    def change(parent, _):
        numbers = parent["0/TransformParameters"][()]
        numbers[:9] = (numbers[:9].reshape(3, 3) @ matrix).ravel()
        parent["0/TransformParameters"][...] = numbers

    return change


def set_to(name, value):
    return lambda parent, _: replace(parent["0"], name, value)


def no_composite(parent, _):
    del parent["0"]
    for number in range(4):
        parent.move(str(number + 1), str(number))


def linked_outside(parent, _):
    del parent["0/TransformParameters"]
    parent["0/TransformParameters"] = h5py.ExternalLink("/etc/other.h5", "/a")


def stored_outside(parent, _):
    del parent["0/TransformParameters"]
    parent["0"].create_dataset("TransformParameters", (12,), "f8", external=[("/etc/hostname", 0, 96)])


BAD = [
    ("affine", times(np.diag([1.001, 1.0, 1.0])), "not_rigid"),
    ("affine", times([[1, 0.01, 0], [0, 1, 0], [0, 0, 1]]), "not_rigid"),
    ("affine", lambda parent, _: parent["0"].pop("TransformType"), "missing_key /TransformGroup/0"),
    ("affine", lambda parent, file: file.pop("TransformGroup"), "wrong_format"),
    ("affine", lambda parent, _: parent.pop("0"), "wrong_count"),
    ("affine", set_to("TransformType", "BSplineTransform_double_3_3"), "unknown_type BSplineTransform_double_3_3"),
    ("affine", set_to("TransformParameters", np.arange(12)), "wrong_type int64"),
    ("affine", set_to("TransformParameters", np.ones(13)), "wrong_count 13 12"),
    ("affine", set_to("TransformParameters", np.full(12, np.nan)), "not_finite"),
    ("affine", set_to("TransformFixedParameters", np.ones(2)), "wrong_count"),
    ("affine", set_to("TranformParameters", np.ones(12)), "stated_twice"),
    ("affine", linked_outside, "wrong_format"),
    ("affine", stored_outside, "data_elsewhere"),
    ("versor", set_to("TransformParameters", np.array([1.0, 0.1, 0, 0, 0, 0])), "not_unit 1.00498756"),
    ("euler", set_to("TransformParameters", np.array([np.inf, 0, 0, 0, 0, 0])), "not_finite"),
    ("composite", lambda parent, _: parent.pop("2"), "wrong_format"),
    ("composite", no_composite, "several_transforms"),
]


@pytest.mark.parametrize(("kind", "change", "says"), BAD)
def test_what_is_not_one_rigid_transform_is_refused(tmp_path, kind, change, says):
    """Stretched, sheared, of another kind, incomplete, pointing elsewhere: named, in one line."""
    with refused(*says.split(), tmp_path / "b.h5"):
        read(rewritten(tmp_path, kind, change))


def test_every_truncation_is_refused(tmp_path):
    file = tmp_path / "a.h5"
    SimpleITK.WriteTransform(random_transform("composite", np.random.default_rng(3)), str(file))
    whole = file.read_bytes()
    for length in range(0, len(whole), 97):
        with refused("file_damaged"):
            parse_transform(whole[:length], file)


WITHOUT = """
import sys
sys.modules["h5py"] = None  # as if it were not installed
from pathlib import Path
from puncture_twin.planning.formats.itk_transform import parse_transform
parse_transform(b"x", Path("a.h5"))
"""


def test_without_h5py_it_says_how_to_get_it():
    """The extra, or the same transform as text; and nothing else of the program needs it."""
    done = subprocess.run([sys.executable, "-c", WITHOUT], capture_output=True, text=True)
    last = done.stderr.splitlines()[-1]
    assert last.endswith("WriteTransform(T, 'x.tfm')")
    assert "a.h5: it needs the extra 'hdf5', which is not installed (no h5py)" in last


def test_a_heap_on_which_hdf5_never_ends_is_refused(tmp_path):
    """An object of no size in the heap of texts: HDF5's own library would look for the next one for ever."""
    file = rewritten(tmp_path, "affine", lambda parent, _: None)
    data = bytearray(file.read_bytes())
    object_of_type = data.index(b"AffineTransform_double_3_3\0") - HEAP_HEAD_BYTES
    data[object_of_type : object_of_type + HEAP_HEAD_BYTES] = struct.pack("<HH4xQ", 7, 0, 0)
    with refused("file_damaged"):
        parse_transform(bytes(data), file)


@pytest.mark.parametrize(
    ("at", "layout", "value"), [(0, "<I", 2**31), (4, "<Q", 2**63), (4, "<Q", 5), (12, "<I", 99), (12, "<I", 0)]
)
def test_a_text_elsewhere_is_refused(tmp_path, at, layout, value):
    file = rewritten(tmp_path, "affine", lambda parent, _: None)
    data = bytearray(file.read_bytes())
    with h5py.File(file) as whole:
        place = whole["TransformGroup/0/TransformType"].id.get_offset()
    struct.pack_into(layout, data, place + at, value)
    with refused("file_damaged"):
        parse_transform(bytes(data), file)
