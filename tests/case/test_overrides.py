"""What a refusal of `init` names as a way out can be taken: keys, roles, files and the skin, stated with it."""

import json

import numpy as np
import pytest
from case_world import ball
from refusals import refused
from round_body import BODY, X, inside, run_init, write_ct, write_image, write_mask

from puncture_twin.planning.init.overrides import overrides_of, with_keys
from puncture_twin.planning.search.context import prepare
from puncture_twin.run_twin import main

TARGET = ("--target=-40,0,10",)
BALLS = {"nodule": ((-40.0, 0.0, 10.0), 8.0), "aorta": ((36.0, 36.0, 0.0), 8.0), "odd": ((30.0, -40.0, 0.0), 7.0)}


def write_labels(folder, names=(*BALLS, "rest")):
    """A label map of the balls, and of what is left of the body where there is a fourth name."""
    voxels = np.zeros(X.shape, np.uint8)
    voxels[BODY & (len(names) > len(BALLS))] = len(BALLS) + 1
    for number, (middle, radius) in enumerate(BALLS.values(), start=1):
        voxels[inside(middle, radius)] = number
    write_image(folder / "map.nii.gz", voxels)
    (folder / "map.json").write_text(json.dumps({str(n): name for n, name in enumerate(names, start=1)}))


def write_masks(folder):
    folder.mkdir()
    for name, place in BALLS.items():
        write_mask(folder / f"{name}.nii.gz", inside(*place))


def init(capfd, folder, *words):
    code, _, said = run_init(capfd, folder, *(() if any("--target" in word for word in words) else TARGET), *words)
    return code, "\n".join(said)


def roles(folder):
    """Name to role of the case's structures, as a search reads them."""
    return {one.name: str(one.role) for one in prepare(folder, arm=False).anatomy.structures}


def test_keys_are_written_and_read_again(tmp_path, capfd):
    """A word needs no quotes; what stands in every result is there; a table that the case lacked is made."""
    write_ct(tmp_path / "ct.nii.gz")
    write_labels(tmp_path, tuple(BALLS))
    words = ("--set", "ct.arms=none", "--set", "needle.shaft_mm=120", "--set", "place.up=anterior")
    assert init(capfd, tmp_path, *words)[0] == 0
    context = prepare(tmp_path, arm=False)
    assert (context.case.ct.arms, context.case.needle.shaft_mm, context.case.place.up) == ("none", 120.0, "anterior")
    assert [one.sentence for one in context.anatomy.findings if one.code == "declared"] == [
        "declared: no arms in the image"
    ]


@pytest.mark.parametrize("words", ["needle.length=3", "ct.arms=some", "search.step_deg=fine"])
def test_a_key_that_cannot_be_is_refused_and_leaves_nothing(tmp_path, capfd, words):
    write_ct(tmp_path / "ct.nii.gz")
    write_labels(tmp_path, tuple(BALLS))
    code, said = init(capfd, tmp_path, "--set", words)
    assert code == 2 and words.partition("=")[0].partition(".")[2] in said
    assert not (tmp_path / "case.toml").exists()


@pytest.mark.parametrize(
    "text", ["arms", "skin.role=avoid", "nothing.here=1", "structure.name=liver", "region=chest", "end.structures=2"]
)
def test_what_is_no_key_of_a_table_is_refused(text):
    """Lists of structures have options of their own, and so have region and target."""
    with refused("unknown_key"):
        overrides_of(None, (), (), [text])


def test_a_key_takes_the_place_of_the_one_that_is_there():
    """In its own table alone; a key at the top stands before the first table."""
    text = "schema = 2\n\n[needle]\nlength_mm = 200.0\n\n[tool]\nlength_mm = 3.0\n\n[end]\nstructures = 1\n"
    lines = with_keys(text, {"needle.length_mm": "150", "ct.arms": '"none"', "tool.mass": "1"}).split("\n")
    assert [line.partition("  #")[0] for line in lines if line] == [
        "schema = 2", "[needle]", "length_mm = 150", "[tool]", "mass = 1", "length_mm = 3.0",
        "[ct]", 'arms = "none"', "[end]", "structures = 1",
    ]  # fmt: skip


@pytest.mark.parametrize("write", [write_labels, lambda folder: write_masks(folder / "seg")])
def test_roles_are_stated_by_name(tmp_path, capfd, write):
    write_ct(tmp_path / "ct.nii.gz")
    write(tmp_path)
    code, said = init(capfd, tmp_path, "--ignore", "odd", "--unknown", "aorta")
    assert code == 0 and "left out as stated (ignore)" in said
    found = roles(tmp_path)
    assert found["aorta"] == "unknown" and found["nodule"] == "target" and "odd" not in found


def test_what_is_left_out_holds_no_target(tmp_path, capfd):
    """Else the rest of the body would be the target's structure, and every path into it safe."""
    write_ct(tmp_path / "ct.nii.gz")
    write_labels(tmp_path, (*BALLS, "rest"))
    assert init(capfd, tmp_path, "--target=-10,0,10", "--ignore", "rest")[0] == 0
    context = prepare(tmp_path, arm=False)
    assert context.case.own_target and "rest" not in {one.name for one in context.anatomy.structures}


@pytest.mark.parametrize(
    ("words", "option"),
    [(("--ignore", "ood"), "--ignore"), (("--unknown", "ct.nii.gz"), "--unknown"), (("--skin", "bdy"), "--skin")],
)
def test_a_name_that_nothing_has_is_refused(tmp_path, capfd, words, option):
    """With what there is; a file can be left out, and not be unknown."""
    write_ct(tmp_path / "ct.nii.gz")
    write_labels(tmp_path)
    code, said = init(capfd, tmp_path, *words)
    assert code == 2 and option in said and "aorta" in said


def test_a_file_that_is_not_read_can_be_left_out(tmp_path, capfd):
    """The refusal names the option, and with it the case is read; the masks beside the file are all there."""
    write_ct(tmp_path / "ct.nii.gz")
    write_masks(tmp_path / "seg")
    (tmp_path / "seg" / "portal_vein.mgz").write_bytes(b"in another format")
    code, said = init(capfd, tmp_path)
    assert code == 2 and "--ignore seg/portal_vein.mgz" in said
    code, said = init(capfd, tmp_path, "--ignore", "seg/portal_vein.mgz")
    assert code == 0 and "portal_vein.mgz" in said
    assert roles(tmp_path).keys() >= set(BALLS)
    assert "portal_vein.mgz" in (tmp_path / "case.toml").read_text()


@pytest.mark.parametrize("name", ["skin", "masks", "rest"])
def test_labels_alone_start(tmp_path, capfd, name):
    """With the label or mask that is named like the skin, or the one that is stated; its skin is the drawn body's."""
    if name == "masks":
        write_masks(tmp_path / "seg")
        write_mask(tmp_path / "seg" / "body.nii.gz", BODY)
    else:
        write_labels(tmp_path, (*BALLS, name))
    if name == "rest":
        code, said = init(capfd, tmp_path)
        assert code == 2 and "--skin NAME" in said and "rest" in said
    assert init(capfd, tmp_path, *(("--skin", "rest") if name == "rest" else ()))[0] == 0
    context = prepare(tmp_path, arm=False)
    assert np.ptp(context.anatomy.skin.mesh.bounds, axis=0) == pytest.approx([180.0] * 3, abs=4.0)
    assert {one.name for one in context.anatomy.structures} == set(BALLS)
    assert context.search().safe.any()


def test_meshes_alone_start_with_the_skin_that_is_stated(tmp_path, capfd):
    for name, (middle, radius) in {**BALLS, "surface": ((0.0, 0.0, 0.0), 90.0)}.items():
        ball(tmp_path / f"{name}.stl", radius, middle)
    code, said = init(capfd, tmp_path, "--unit", "mm")
    assert code == 2 and "surface" in said
    words = ("--unit", "mm", "--skin", "surface")
    assert init(capfd, tmp_path, *words)[0] == 0
    assert set(roles(tmp_path)) == set(BALLS)
    assert init(capfd, tmp_path, *words, "--force", "--set", "skin.cut=[]")[0] == 0
    assert prepare(tmp_path, arm=False).case.skin_section.cut == ()


def test_a_stated_skin_goes_before_the_cts_body(tmp_path, capfd):
    """The CT stays beside it: what it shows outside of the skin is seen."""
    write_ct(tmp_path / "ct.nii.gz")
    write_labels(tmp_path)
    assert init(capfd, tmp_path, "--skin", "rest")[0] == 0
    context = prepare(tmp_path, arm=False)
    assert context.case.skin_section.labelmap == "map.nii.gz" and context.case.ct.file == "ct.nii.gz"


def test_the_image_is_proposed_as_statements(tmp_path):
    """Commented keys: without its # each is one that the case takes; a picture shows what was found."""
    write_ct(tmp_path / "ct.nii.gz")
    write_labels(tmp_path, tuple(BALLS))
    assert main(["init", str(tmp_path), *TARGET]) == 0
    case = tmp_path / "case.toml"
    text = case.read_text()
    assert "# arms: none found" in text and (tmp_path / "slices.png").stat().st_size > 1000
    stated = ('arms = "none"', 'table = "none"', "beyond_mm = 150")
    for line in stated:
        assert f"\n# {line}\n" in text
        text = text.replace(f"\n# {line}\n", f"\n{line}\n")
    case.write_text(text)
    context = prepare(tmp_path, arm=False)
    assert sum(one.code == "declared" for one in context.anatomy.findings) == len(stated)


def test_a_phantom_is_taken_as_one(tmp_path, capfd):
    write_ct(tmp_path / "ct.nii.gz")
    write_labels(tmp_path, tuple(BALLS))
    code, said = init(capfd, tmp_path, "--region", "phantom")
    assert code == 0 and "no limbs are searched for" in said
    context = prepare(tmp_path, arm=False)
    assert context.case.region == "phantom" and not [s for s in context.anatomy.checked if s.name == "attached_limb"]
