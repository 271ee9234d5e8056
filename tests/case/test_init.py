"""`init`: from a folder of files to a case that a search takes, on a round patient with known organs."""

import hashlib
import json
import re

import dicom_world as world
import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
import trimesh
from case_world import MARKERS, ball, image_of
from round_body import AT, SPACING, X, Y, Z, body_hu, inside, roles, run_init as init, write_ct, write_image, write_mask

from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.base.toml_file import parse_toml
from puncture_twin.planning.case.case_file import CaseFile
from puncture_twin.planning.case.errors import error_model
from puncture_twin.planning.case.tables import ErrorsSection
from puncture_twin.planning.search.context import prepare

ORGANS = {
    "right lung": ((-40.0, 0.0, 10.0), 18.0),
    "aorta": ((36.0, 36.0, 0.0), 8.0),
    "odd thing": ((30.0, -40.0, 0.0), 7.0),
}
"""Middle (LPS, mm) and radius of balls in the body."""
TARGET = "-40,0,10"


def labels():
    voxels = np.zeros(X.shape, np.uint8)
    for number, (middle, radius) in enumerate(ORGANS.values(), start=1):
        voxels[inside(middle, radius)] = number
    return voxels


def write_masks(folder):
    folder.mkdir(exist_ok=True)
    for name, (middle, radius) in ORGANS.items():
        write_mask(folder / f"{name}.nii.gz", inside(middle, radius))
    write_mask(folder / "spleen.nii.gz", np.zeros(X.shape))


@pytest.fixture
def masked(tmp_path):
    write_ct(tmp_path / "scan.nii.gz")
    write_masks(tmp_path / "seg")
    return tmp_path


def write_seg_nrrd(path):
    image = image_of(labels(), SPACING)
    for number, name in enumerate(ORGANS):
        image.SetMetaData(f"Segment{number}_Name", name)
        image.SetMetaData(f"Segment{number}_LabelValue", str(number + 1))
    sitk.WriteImage(image, str(path))


def write_layered_seg_nrrd(path):
    layers = [inside(middle, radius).astype(np.uint8) for middle, radius in ORGANS.values()]
    n, (x, y, z) = len(layers), X.shape[::-1]
    lines = ["NRRD0004", "type: unsigned char", "dimension: 4", "space: left-posterior-superior"]
    lines += [
        f"sizes: {n} {x} {y} {z}",
        f"space directions: none ({SPACING[0]},0,0) (0,{SPACING[1]},0) (0,0,{SPACING[2]})",
    ]
    lines += ["kinds: list domain domain domain", "encoding: raw", f"space origin: ({AT[0]},{AT[0]},{AT[0]})"]
    for number, name in enumerate(ORGANS):
        lines += [f"Segment{number}_ID:=Segment_{number}", f"Segment{number}_Name:={name}"]
        lines += [f"Segment{number}_LabelValue:=1", f"Segment{number}_Layer:={number}"]
    voxels = np.stack(layers, axis=-1)  # the layers run fastest
    path.write_bytes(("\n".join(lines) + "\n\n").encode() + voxels.tobytes())


EXPECTED = {"right lung": ("target", 0.0), "aorta": ("avoid", 5.0), "odd thing": ("avoid", 5.0)}


def segmentation_of(kind, folder):
    """Written in one of the ways that there are."""
    if kind.startswith("masks"):
        folder = folder / "run" if kind == "masks two levels down" else folder
        folder.mkdir(exist_ok=True)
        write_masks(folder / "segmentations")
    elif kind == "seg.nrrd":
        write_seg_nrrd(folder / "Segmentation.seg.nrrd")
    elif kind == "layered seg.nrrd":
        write_layered_seg_nrrd(folder / "Segmentation.seg.nrrd")
    elif kind == "csv":
        write_image(folder / "map.nii.gz", labels())
        (folder / "organs.csv").write_text("Structure,Value\nright lung,1\naorta,2\nodd thing,3\n")
        (folder / "notes.txt").write_text("seen by two\n")
    else:
        write_image(folder / "map.nii.gz", labels().astype(np.float32))
        (folder / "map.json").write_text(json.dumps({str(n): name for n, name in enumerate(ORGANS, start=1)}))


@pytest.mark.parametrize("kind", ["masks", "masks two levels down", "seg.nrrd", "layered seg.nrrd", "csv", "json"])
def test_every_kind_of_segmentation_becomes_the_same_case(tmp_path, capfd, kind):
    """Names with spaces, an empty mask, a name that nobody knows: read by a search at once."""
    write_ct(tmp_path / "scan.nii.gz")
    segmentation_of(kind, tmp_path)
    code, out, said = init(capfd, tmp_path, "--target", TARGET)
    assert code == 0, said
    assert any("the target lies in 'right lung'" in line for line in said)
    assert any("default roles" in line and "odd thing" in line for line in said)
    assert all(line.startswith("warning: ") for line in said)
    assert ("spleen" in " ".join(said)) == kind.startswith("masks")
    assert "next: run-twin search" in out
    assert ".case-" not in out + " ".join(said) and not list(tmp_path.glob(".case*"))
    off = SPACING[0] / np.sqrt(12) * np.hypot(1.0, (SPACING[0] - 3.0) / 2 / SPACING[0])
    assert f"# surface_mm = {off:.2f}  # " in (tmp_path / "case.toml").read_text()
    context = prepare(tmp_path, arm=False)
    assert roles(context) == EXPECTED
    model = error_model(ErrorsSection(), space=context.case.space)
    for one in context.anatomy.structures:
        np.testing.assert_allclose(model.surface_cov_ct(one.voxel_ct), off**2 * np.eye(3), atol=1e-5)


def write_series(folder, number):
    hu = body_hu()
    T = np.diag([4.0, 4.0, 4.0, 1.0])
    T[:3, 3] = -98.0
    slices = world.series((hu + 1024).astype(np.int16).transpose(2, 1, 0), T)
    for one in slices:
        one.SeriesInstanceUID = f"1.2.3.{number}"
    world.write_series(folder, slices)
    return T


def test_a_dicom_series_is_the_ct(tmp_path, capfd):
    """Named by its folder; of two series in one folder the user says which, by a file of it."""
    write_series(tmp_path / "dicom", 1)
    write_masks(tmp_path / "seg")
    code, _, said = init(capfd, tmp_path, "--target", TARGET)
    assert code == 0, said
    assert 'ct = "dicom"' in (tmp_path / "case.toml").read_text()
    assert roles(tmp_path) == EXPECTED
    write_series(tmp_path / "more", 2)
    for path in (tmp_path / "more").iterdir():
        path.rename(tmp_path / "dicom" / f"b-{path.name}")
    (tmp_path / "more").rmdir()
    code, _, said = init(capfd, tmp_path, "--target", TARGET, "--force")
    assert code == 2
    names = re.search(r"several CTs: (\S+), (\S+) ", said[0])
    code, _, said = init(capfd, tmp_path, "--target", TARGET, "--force", "--ct", names[2])
    assert code == 0, said
    assert f'ct = "{names[2]}"' in (tmp_path / "case.toml").read_text()


@pytest.mark.parametrize("kind", ["seg", "rtstruct"])
def test_structures_in_dicom_are_found(tmp_path, capfd, kind):
    """On the series that they were drawn on; one file, named by its content."""
    T = write_series(tmp_path / "dicom", 1)
    masks = {name: inside(middle, radius).transpose(2, 1, 0) for name, (middle, radius) in ORGANS.items()}
    if kind == "seg":
        data = world.segmentation(masks, T, step="4")
    else:
        data = world.structure_set({name: contours(middle, radius) for name, (middle, radius) in ORGANS.items()})
    (tmp_path / "more").mkdir()
    world.write(data, tmp_path / "more" / "drawn")
    code, _, said = init(capfd, tmp_path, "--target", TARGET)
    assert code == 0, said
    assert f'{kind} = "more/drawn"' in (tmp_path / "case.toml").read_text()
    assert roles(tmp_path) == EXPECTED


def contours(middle, radius):
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    heights = [z for z in AT if abs(z - middle[2]) < radius - 1]
    wide = [np.sqrt(radius**2 - (z - middle[2]) ** 2) for z in heights]
    return [
        np.stack([middle[0] + r * np.cos(angle), middle[1] + r * np.sin(angle), np.full(40, z)], axis=1)
        for z, r in zip(heights, wide, strict=True)
    ]


def test_a_target_typed_in_ras_is_answered_in_ras(tmp_path, capfd):
    """The numbers as they were typed; the same verdicts as in LPS."""
    write_ct(tmp_path / "scan.nii.gz")
    write_seg_nrrd(tmp_path / "a.seg.nrrd")
    assert init(capfd, tmp_path, "--target", "40,0,10", "--space", "RAS")[0] == 0
    written = parse_toml((tmp_path / "case.toml").read_bytes(), tmp_path / "case.toml", CaseFile, allowed="", keys="")
    assert (written.space, written.target.position_mm, written.schema_) == ("RAS", (40.0, 0.0, 10.0), 2)
    ras = prepare(tmp_path, arm=False).search()
    assert init(capfd, tmp_path, "--target", TARGET, "--force")[0] == 0
    lps = prepare(tmp_path, arm=False).search()
    assert np.array_equal(ras.verdict.reason, lps.verdict.reason)
    assert 0 < lps.safe.sum() < len(lps)


def test_the_middle_of_a_label_is_a_target(masked, capfd):
    """The deepest point of a ball is its middle, to a cell of the grid."""
    code, out, _ = init(capfd, masked, "--target-label", "right lung", "--json")
    assert code == 0
    told = json.loads(out)
    assert np.linalg.norm(np.subtract(told["target_mm"], ORGANS["right lung"][0])) < 3.0
    assert told["target_structure"] == "right lung"
    assert told["structures"] == {"target": 1, "avoid": 2}
    inputs = {one["role"]: one for one in told["inputs"]}
    assert inputs.keys() >= {"case", "ct", "mask aorta", "mask spleen"}
    written = hashlib.sha256((masked / "case.toml").read_bytes()).hexdigest()
    assert (inputs["case"]["path"], inputs["case"]["sha256"]) == ("case.toml", written)
    assert any("deepest point" in line for line in told["warnings"])


def test_a_lesion_in_an_organ_is_the_target_and_the_organ_is_crossed(masked, capfd):
    """Of two masks that hold the target the lesion is meant; the other cannot be avoided."""
    write_mask(masked / "seg" / "lung tumor.nii.gz", inside((-40, 0, 10), 6.0))
    code, _, said = init(capfd, masked, "--target", TARGET, "--region", "chest")
    assert code == 0, said
    given = roles(masked)
    assert (given["lung tumor"], given["right lung"]) == (("target", 0.0), ("traverse", 0.0))
    assert any("paths cross them (traverse): right lung" in line for line in said)


def around_the_lesion(folder, name):
    """What is round a lesion, without another structure there."""
    write_ct(folder / "scan.nii.gz")
    write_masks(folder)
    (folder / "right lung.nii.gz").unlink()
    for one, radius in (("lung tumor", 6.0), (name, 14.0)):
        write_mask(folder / f"{one}.nii.gz", inside((-40, 0, 10), radius))


@pytest.mark.parametrize(
    ("name", "region"),
    [("artère pulmonaire", "chest"), ("brainstem", "other"), ("pons", "head"), ("brainstem", "brain")],
)
def test_what_holds_the_target_too_and_is_never_crossed_is_refused(tmp_path, capfd, name, region):
    """Masks overlap: the artery or the brainstem beside it became `traverse`, and every path through it was safe."""
    around_the_lesion(tmp_path, name)
    code, _, said = init(capfd, tmp_path, "--target", TARGET, "--region", region)
    assert code == 2 and f"lies inside '{name}', which is to be avoided" in said[-1]


@pytest.mark.parametrize("folder", ["", "seg"])
def test_no_path_through_what_nobody_knows_is_safe(tmp_path, capfd, folder):
    """It became `traverse`, and paths through an aneurysm were safe; the case says how to make it so."""
    around_the_lesion(tmp_path, "AAA")
    if folder:
        (tmp_path / folder).mkdir()
        for one in ("AAA", "aorta", "lung tumor", "odd thing", "spleen"):
            (tmp_path / f"{one}.nii.gz").rename(tmp_path / folder / f"{one}.nii.gz")
    code, _, said = init(capfd, tmp_path, "--target", TARGET)
    assert code == 0 and any("unknown_region unless the case makes them traverse: AAA" in line for line in said)
    path = tmp_path / "case.toml"
    before, context = path.read_text(), prepare(tmp_path, arm=False)
    assert roles(context)["AAA"] == ("unknown", 5.0)
    if folder:
        table = before[before.index("[structures.unknown]") :]
        assert "into traverse = [...] if a path may cross it" in table and '"AAA" = 5' in table
        return
    found = context.search()
    assert not found.safe.any() and Reason.UNKNOWN_REGION.value in set(found.verdict.reason)
    (line,) = [line for line in before.splitlines() if "it also contains the target" in line]
    assert 'role = "traverse", without a margin, if a path may cross it' in line
    at = before.index(line)
    start = before.rindex('role = "unknown"', 0, at)
    path.write_text(before[:start] + 'role = "traverse"' + before[at + len(line) :])
    assert prepare(path, arm=False).search().safe.any()


def test_a_typed_target_in_a_vessel_is_a_slip(masked, capfd):
    """The aorta became the target's structure: taken where it is named, and every result says so."""
    for words in (("--target", "36,36,0", "--space", "LPS"), ("--target", "-36,-36,0", "--space", "RAS")):
        code, out, said = init(capfd, masked, *words)
        assert code == 2 and out == "" and not (masked / "case.toml").exists()
        (line,) = said
        assert "lies in 'aorta'" in line and "of 'aorta and venae cavae' (large vessel: bleeding)" in line
        assert line.endswith("allowed: a point outside it, or --target-label 'aorta' if it is the target itself")
    code, _, said = init(capfd, masked, "--target-label", "aorta", "--space", "LPS")
    text = "the target lies in 'aorta', of 'aorta and venae cavae' (large vessel: bleeding): every safe path ends in it"
    assert code == 0 and any(text in line for line in said)
    warnings = prepare(masked, arm=False).anatomy.warnings
    assert any(line.startswith(text) for line in warnings)
    assert init(capfd, masked, "--target", TARGET, "--force")[0] == 0
    assert not any("every safe path ends in it" in line for line in prepare(masked, arm=False).anatomy.warnings)


def test_a_mask_that_is_none_is_no_structure_left_out(masked, capfd):
    spoiled = (
        np.clip(2.0 - np.sqrt((X - 30) ** 2 + Y**2 + Z**2) / 10, 0, 1).astype(np.float32),  # a probability
        np.where(Z < -90, -1, inside((30, 0, 0), 9.0)).astype(np.int16),  # -1 for not known
        np.ones(X.shape, np.uint8),  # no background
    )
    for voxels in spoiled:
        write_image(masked / "seg" / "vein.nii.gz", voxels)
        code, _, said = init(capfd, masked, "--target", TARGET)
        assert code == 2 and "seg/vein.nii.gz: values from " in said[0]


def test_tables_that_contradict_each_other_are_not_guessed(tmp_path, capfd):
    write_ct(tmp_path / "scan.nii.gz")
    write_image(tmp_path / "map.nii.gz", labels())
    (tmp_path / "a.csv").write_text("id,name\n1,muscle\n2,torso_fat\n3,rib_left_7\n")
    (tmp_path / "b.csv").write_text("id,name\n1,right lung\n2,aorta\n3,odd thing\n")
    code, _, said = init(capfd, tmp_path, "--target", TARGET)
    assert code == 2 and "map.nii.gz: several tables name its labels differently: a.csv, b.csv" in said[0]
    assert init(capfd, tmp_path, "--target", TARGET, "--naming", "b.csv")[0] == 0


@pytest.mark.parametrize(("third", "refused"), [("aorta", False), ("gallbladder", True)])
def test_organs_on_the_other_side_are_taken_where_a_person_has_looked(tmp_path, capfd, third, refused):
    """Situs inversus: one pair is warned of, two are refused with a way out that is there, at this command too."""
    write_ct(tmp_path / "scan.nii.gz")
    write_image(tmp_path / "map.nii.gz", labels())
    (tmp_path / "map.csv").write_text(f"id,name\n1,spleen\n2,liver\n3,{third}\n")
    code, _, said = init(capfd, tmp_path, "--target", TARGET)
    assert code == (2 if refused else 0), said
    if refused:
        assert "--trust-labels" in said[0] and not (tmp_path / "case.toml").exists()
        code, _, said = init(capfd, tmp_path, "--target", TARGET, "--trust-labels")
        assert (
            "trust_labels = true  # a person checked the structures on the CT" in (tmp_path / "case.toml").read_text()
        )
    assert code == 0, said
    findings = prepare(tmp_path, arm=False).provenance()["findings"]
    assert [one["severity"] for one in findings if one["code"] == "organs_out_of_order"] == ["warning"]


def test_a_target_in_no_structure_is_a_ball_of_its_own(masked, capfd):
    """In fat; also where the other space's reading lies in an organ, if the space was stated."""
    for words in (["--target", "0,0,-40"], ["--target", "40,0,10", "--space", "LPS"]):
        code, _, said = init(capfd, masked, *words, "--force")
        assert code == 0, said
        assert any("the target lies in no structure" in line and "nearest is" in line for line in said)
    context = prepare(masked, arm=False)
    assert roles(context) == {**EXPECTED, "right lung": ("avoid", 2.0), "target": ("target", 0.0)}
    mesh = context.anatomy.structure("target").mesh
    distance = np.linalg.norm(mesh.vertices - [40.0, 0.0, 10.0], axis=1)
    assert mesh.closed and np.abs(distance - 5.0).max() < 0.05
    found = context.search()
    assert 0 < found.safe.sum() < len(found)
    assert context.explain(0.3, 1.0).target_depth_mm == pytest.approx(5.0, abs=0.05)


def test_a_case_that_is_there_is_kept(masked, capfd):
    (masked / "case.toml").write_text("mine")
    code, _, said = init(capfd, masked, "--target", TARGET)
    assert code == 2 and "a case exists already" in said[0] and "--force" in said[0]
    assert init(capfd, masked, "--target", "5000,0,0", "--force")[0] == 2
    assert (masked / "case.toml").read_text() == "mine"
    assert sorted(path.name for path in masked.iterdir()) == ["case.toml", "scan.nii.gz", "seg"]


def test_what_cannot_be_a_target_is_refused_in_one_line(masked, capfd):
    for words, match in (
        (["--target", "0,0"], "--target: 2 numbers"),
        (["--target", "a,0,0"], "'a' is not a number"),
        (["--target", "500,0,0"], "lies outside the CT scan.nii.gz"),
        (["--target", "-95,-95,0"], "lies outside the body in scan.nii.gz"),
        (["--target", "40,0,10"], "lies in no structure (read in RAS it lies in 'right lung': --space RAS)"),
        ([], "either --target X,Y,Z or --target-label NAME"),
        (["--target", "0,0,0", "--target-label", "aorta"], "either --target X,Y,Z or --target-label NAME"),
        (["--target-label", "liver"], "no structure is named 'liver'"),
        (["--target", TARGET, "--region", "belly"], "region 'belly' is not known"),
        (["--target", TARGET, "--space", "local"], "LPS or RAS"),
    ):
        code, out, said = init(capfd, masked, *words)
        assert (code, out, len(said)) == (2, "", 1) and match in said[0], said
    assert not (masked / "case.toml").exists()


def test_all_that_is_wrong_is_said_at_once(tmp_path, capfd):
    """A truncated mask, two CTs, two maps of the same organs; each is named."""
    for name in ("a.nii.gz", "b.nii.gz"):
        write_ct(tmp_path / name)
    write_masks(tmp_path / "seg")
    write_seg_nrrd(tmp_path / "map.seg.nrrd")
    whole = (tmp_path / "seg" / "aorta.nii.gz").read_bytes()
    (tmp_path / "seg" / "aorta.nii.gz").write_bytes(whole[: len(whole) // 2])
    code, _, said = init(capfd, tmp_path, "--target", TARGET)
    assert (code, len(said)) == (2, 1)
    for part in ("seg/aorta.nii.gz: ", "compressed", "several CTs: a.nii.gz, b.nii.gz", "the same name"):
        assert part in said[0], said
    (tmp_path / "seg" / "aorta.nii.gz").write_bytes(whole)
    code, _, said = init(capfd, tmp_path, "--target", TARGET, "--ct", "b.nii.gz", "--segmentation", "seg")
    assert code == 0, said
    assert "b.nii.gz" in (tmp_path / "case.toml").read_text()


def test_a_folder_without_a_half_is_refused(tmp_path, capfd):
    for write, missing in ((write_ct, "no segmentation"), (write_seg_nrrd, "no CT in Hounsfield")):
        write(tmp_path / "one.seg.nrrd")
        code, _, said = init(capfd, tmp_path, "--target", TARGET)
        assert (code, len(said)) == (2, 1) and missing in said[0], said
    code, _, said = init(capfd, tmp_path / "nothing", "--target", TARGET)
    assert code == 2 and "is not a folder" in said[0]


def test_a_numbering_that_is_not_told_is_asked_for(tmp_path, capfd):
    """Three balls lie in no order of a body: the option that decides is named, and decides."""
    write_ct(tmp_path / "scan.nii.gz")
    write_image(tmp_path / "map.nii.gz", labels())
    code, _, said = init(capfd, tmp_path, "--target", TARGET)
    assert (code, len(said)) == (2, 1) and "--naming" in said[0], said
    code, _, said = init(capfd, tmp_path, "--target", TARGET, "--naming", "totalsegmentator-v2")
    assert code == 0, said
    assert set(roles(tmp_path)) == {"spleen", "kidney_right", "kidney_left"}


def test_the_unit_of_meshes_is_guessed_and_told(tmp_path, capfd):
    """By the extent of all of them; the surfaces are the same in mm. Lists of points are named in comments."""
    (tmp_path / "meshes").mkdir()
    balls = {"skin": ((0.0, 0.0, 0.0), 90.0), **ORGANS}
    (tmp_path / "points.csv").write_text(MARKERS)
    for unit, scale in (("mm", 1.0), ("cm", 0.1), ("m", 0.001)):
        for name, (middle, radius) in balls.items():
            ball(tmp_path / "meshes" / f"{name}.stl", radius * scale, np.array(middle) * scale)
        code, _, said = init(capfd, tmp_path, "--target", TARGET, "--force")
        assert code == 0 and any(f"4 meshes in {unit} (inferred" in line for line in said), said
        context = prepare(tmp_path, arm=False)
        assert np.ptp(context.anatomy.structure("aorta").mesh.bounds[:, 0]) == pytest.approx(16.0, abs=0.3)
    assert roles(context) == EXPECTED
    text = (tmp_path / "case.toml").read_text()
    assert '# markers_ct = "points.csv"  # read in LPS, the case\'s space' in text
    assert not re.search(r"^\[registration\]", text, re.MULTILINE)
    stated = init(capfd, tmp_path, "--target", TARGET, "--force", "--unit", unit)
    assert stated[0] == 0 and any("as stated" in line for line in stated[2])
    for name, (middle, radius) in balls.items():  # half as wide, in mm: 1.6 m in cm was taken for 16 cm in mm
        ball(tmp_path / "meshes" / f"{name}.stl", radius / 2, np.array(middle) / 2)
    code, _, said = init(capfd, tmp_path, "--target-label", "aorta", "--force")
    assert code == 2 and "a small body in mm, or a large one in cm" in said[0]


def test_glb_are_read_with_the_axis_that_is_stated(tmp_path, capfd):
    """As glTF has them, y up: refused until somebody says so, and then where the same meshes lie with z up."""
    (tmp_path / "meshes").mkdir()
    for name, (middle, radius) in {"skin": ((0.0, 0.0, 0.0), 90.0), **ORGANS}.items():
        mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
        mesh.apply_translation(middle)
        x, y, z = np.array(mesh.vertices).T
        mesh.vertices = np.stack([x, z, -y], axis=1)
        mesh.export(tmp_path / "meshes" / f"{name}.glb")
    code, _, said = init(capfd, tmp_path, "--target", TARGET)
    assert code == 2 and "--up" in said[0]
    assert init(capfd, tmp_path, "--target", TARGET, "--up", "y")[0] == 0
    structures = prepare(tmp_path, arm=False).anatomy.structures
    middles = {one.name: one.mesh.bounds.mean(axis=0) for one in structures if one.name in ORGANS}
    assert len(middles) == len(ORGANS)
    assert all(np.allclose(middle, ORGANS[name][0], atol=0.5) for name, middle in middles.items())
