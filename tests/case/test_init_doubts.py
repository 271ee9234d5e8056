"""What `init` and every result say of a target that may be a slip: its space, its unit, its name, its surroundings."""

import json

import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
from case_world import SKIN, ball, case_text, structure
from round_body import inside, run_init, write_ct, write_mask

from puncture_twin.planning.anatomy.default_roles import default_role
from puncture_twin.planning.init.target import likely_region
from puncture_twin.planning.search.context import prepare
from puncture_twin.run_twin import main

HERE, THERE = (-40.0, 0.0, 10.0), (40.0, 0.0, 10.0)
"""A place of the body and what the same numbers, read in the other space, mean; LPS, mm."""


def patient(folder, *organs):
    write_ct(folder / "scan.nii.gz")
    for name, voxels in (("aorta", inside((36, 36, 0), 8.0)), *organs):
        write_mask(folder / f"{name}.nii.gz", voxels)


def init(capfd, folder, *words):
    return run_init(capfd, folder, *words, "--force")[::2]


def refusal_of(case, capfd):
    assert main(["check", str(case), "--theta", "0", "--beta", "0", "--no-arm"]) == 2
    return capfd.readouterr().err.strip().splitlines()[-1]


def results_warn(capfd, case, text):
    assert any(text in one for one in prepare(case, arm=False).anatomy.warnings)
    main(["check", str(case), "--theta", "10", "--beta", "0", "--no-arm", "--json"])
    return any(text in one for one in json.loads(capfd.readouterr().out)["warnings"])


@pytest.mark.parametrize(("words", "other"), [(("40,0,10", "LPS"), "RAS"), (("40,0,10", "RAS"), "LPS")])
def test_a_target_in_nothing_is_refused_where_the_other_space_has_a_lesion(tmp_path, capfd, words, other):
    """It was taken, with a remark that no result repeated: the needle would miss the lesion by 80 mm."""
    patient(tmp_path, ("lung_tumor", inside(HERE if other == "RAS" else THERE, 8.0)))
    code, said = init(capfd, tmp_path, "--target", words[0], "--space", words[1])
    assert code == 2 and len(said) == 1 and not (tmp_path / "case.toml").exists()
    assert f"mm {words[1]}) lies in no structure (read in {other} it lies in 'lung_tumor': --space {other})" in said[0]
    assert said[0].endswith("allowed: the other --space; or --hit-radius MM for a target in no structure")
    assert init(capfd, tmp_path, "--target", words[0], "--space", other)[0] == 0
    code, said = init(capfd, tmp_path, "--target", words[0], "--space", words[1], "--hit-radius", "3")
    assert code == 0 and "hit_radius_mm = 3.0" in (tmp_path / "case.toml").read_text()
    warning = f"lies in no structure; read in {other}, the same numbers lie in 'lung_tumor'"
    assert any(warning in one for one in said) and results_warn(capfd, tmp_path, warning)


def test_a_target_in_an_organ_is_doubted_where_the_other_space_has_a_lesion(tmp_path, capfd):
    """Where no space was stated, it is asked for: the lung on the other side became the target's structure."""
    patient(tmp_path, ("right lung", inside(HERE, 18.0)), ("liver_lesion", inside(THERE, 8.0)))
    code, said = init(capfd, tmp_path, "--target", "-40,0,10")
    assert code == 2 and "lies in 'right lung' (read in RAS it lies in 'liver_lesion': --space RAS)" in said[0]
    assert init(capfd, tmp_path, "--target", "-40,0,10", "--space", "LPS")[0] == 0
    assert results_warn(capfd, tmp_path, "lies in right lung; read in RAS, the same numbers lie in 'liver_lesion'")


def test_a_target_in_nothing_is_doubted_where_the_other_space_has_an_organ(tmp_path, capfd):
    """Also in a case that a person wrote; not where what holds it there is muscle, a vessel, or nothing."""
    for one in ("skin", "organ"):
        ball(tmp_path / f"{one}.stl", *((90.0,) if one == "skin" else (12.0, np.array(THERE))))
    target = "position_mm = [{}, 0.0, 10.0]\nhit_radius_mm = 5.0"
    case = tmp_path / "case.toml"
    for name, space, doubted in (
        ("liver", "LPS", True),
        ("liver", "RAS", True),
        ("psoas", "LPS", False),
        ("aorta", "LPS", False),
        ("liver", "local", False),
    ):
        organ = structure(name, "avoid", {"mesh": "organ.stl", "unit": "mm"}, margin_mm=3.0)
        text = case_text(SKIN, organ, space=space, target=target.format(40.0 if space == "RAS" else -40.0))
        case.write_text(text.replace('unit = "mm"', 'unit = "mm"\nspace = "LPS"') if space == "RAS" else text)
        other = "RAS" if space == "LPS" else "LPS"
        said = [one for one in prepare(case, arm=False).anatomy.warnings if "same numbers" in one]
        assert len(said) == doubted, (name, space, said)
        assert not doubted or f"read in {other}, the same numbers lie in 'liver'" in said[0]


def test_a_target_outside_names_its_space_and_the_readings_that_fit(tmp_path, capfd):
    """LPS numbers without a word of it, for someone who had typed RAS; and 0.15 was outside without saying why."""
    ball(tmp_path / "skin.stl", 60.0, np.array((150.0, 150.0, 900.0)))
    ball(tmp_path / "rib.stl", 5.0, np.array((150.0, 150.0, 930.0)))
    rib = structure("rib", "avoid", margin_mm=3.0)
    places = {
        "[0.15, 0.15, 0.9]": "(0.1, 0.1, 0.9 mm LPS) lies outside the skin (read in m it lies in the body)",
        "[15, 15, 90]": "(15.0, 15.0, 90.0 mm LPS) lies outside the skin (read in cm it lies in the body)",
        "[-150, -150, 900]": "lies outside the skin (read in RAS it lies in the body)",
        "[-0.15, -0.15, 0.9]": "lies outside the skin (read in RAS and m it lies in the body)",
        "[0, 150, 900]": "(0.0, 150.0, 900.0 mm LPS) lies outside the skin: allowed",
    }
    for place, text in places.items():
        target = f"position_mm = {place}\nhit_radius_mm = 5.0"
        (tmp_path / "case.toml").write_text(case_text(SKIN, rib, target=target))
        line = refusal_of(tmp_path, capfd)
        assert text.removesuffix(": allowed") in line and ("read in" in line) == ("read in" in text), line


def test_a_target_outside_its_structure_names_the_reading_that_lies_inside(tmp_path, capfd):
    """A hand-written case: how far outside was said, not that the signs of x and y were those of the other space."""
    for name, radius, center in (("skin", 90.0, (0, 0, 0)), ("organ", 12.0, HERE), ("rib", 5.0, (0, 0, 40))):
        ball(tmp_path / f"{name}.stl", radius, np.array(center))
    sections = SKIN, structure("organ", "target"), structure("rib", "avoid", margin_mm=3.0)
    for place, reading in (("[40, 0, 10]", "RAS"), ("[-4, 0, 1]", "cm"), ("[0, 0, 60]", "")):
        target = f'position_mm = {place}\nstructure = "organ"'
        (tmp_path / "case.toml").write_text(case_text(*sections, target=target))
        line = refusal_of(tmp_path, capfd)
        assert "mm outside its structure 'organ'" in line
        assert f"(read in {reading} it lies inside)" in line if reading else "read in" not in line


def test_init_tells_a_target_in_metres(tmp_path, capfd):
    patient(tmp_path, ("right lung", inside(HERE, 18.0)))
    image = sitk.ReadImage(str(tmp_path / "scan.nii.gz"))
    image.SetOrigin((100.0, 100.0, 700.0))
    sitk.WriteImage(image, str(tmp_path / "scan.nii.gz"))
    code, said = init(capfd, tmp_path, "--target", "-0.198,-0.198,0.798", "--space", "RAS")
    assert code == 2 and "(-0.2, -0.2, 0.8 mm RAS) lies outside the CT" in said[0]
    assert "(read in m it lies in the body)" in said[0] and "in the space given by --space" in said[0]


@pytest.mark.parametrize(
    ("name", "region", "told"),
    [("tumor feeder", "chest", True), ("liver tumour 2", "chest", False), ("bolt", "phantom", False)],
)
def test_a_target_whose_name_is_not_wholly_known_is_told_by_every_result(tmp_path, capfd, name, region, told):
    """Only `init` said so; a search called paths into a tumour's vein safe without a word."""
    patient(tmp_path, (name, inside(HERE, 10.0)))
    code, said = init(capfd, tmp_path, "--target", "-40,0,10", "--space", "LPS", "--region", region)
    text = f"the target lies in '{name}', a name that "
    assert code == 0 and sum(text in one for one in said) == told
    if told:
        assert results_warn(capfd, tmp_path, text)
    else:
        assert not any("a name that" in one for one in prepare(tmp_path, arm=False).anatomy.warnings)
    if region == "phantom":  # it may hold nothing but its target; of a patient that says nothing about safety
        (tmp_path / "aorta.nii.gz").unlink()
        assert init(capfd, tmp_path, "--target", "-40,0,10", "--space", "LPS", "--region", region)[0] == 0
        code, said = init(capfd, tmp_path, "--target", "-40,0,10", "--space", "LPS", "--region", "other")
        assert code == 2 and 'region = "phantom"' in said[-1]


def test_a_lateral_mass_is_a_vertebra():
    for name in ("C1 lateral mass", "lateral_mass_left", "LateralMass_C1"):
        assert default_role(name, "other").group == "vertebrae, spine"
    assert default_role("lateral lung mass", "other").group == "lesion"


def test_a_region_is_told_by_organs_of_its_own():
    """Liver, aorta and kidney were a spine, whose list is short; two vessels were a limb."""
    for region, *names in (
        ("abdomen", "liver", "aorta", "kidney"),
        ("abdomen", "liver", "aorta", "kidney_left", "vertebrae_L1"),
        ("other", "liver", "portal vein", "hepatic artery"),
        ("other", "right lung", "aorta"),
        ("chest", "heart", "lung_left", "aorta"),
        ("spine", "vertebrae_L1", "spinal_cord", "aorta"),
        ("limb", "femur", "artery", "vein"),
        ("brain", "brain", "skull", "ventricle"),
    ):
        assert likely_region(tuple(names), None) == region


@pytest.mark.parametrize("lesion_at", [(-40, 0, 10), (-58, 0, 10)])
def test_an_organ_that_the_lesion_was_carved_out_of_holds_it(tmp_path, capfd, lesion_at):
    """A label map has one label a voxel: a path crosses the liver that goes all round, as one that holds the lesion.

    One that goes round most of it leaves another path, and is named.
    """
    lesion, liver = inside(lesion_at, 8.0), inside((-36, 0, 10), 24.0)
    target = ",".join(map(str, lesion_at))
    patient(tmp_path, ("liver_lesion", lesion), ("liver", liver & ~lesion), ("spleen", inside((40, 0, 10), 12.0)))
    code, said = init(capfd, tmp_path, f"--target={target}", "--space", "LPS", "--region", "abdomen")
    told = [one for one in said if "surrounds" in one]
    if lesion_at == (-40, 0, 10):
        assert code == 0 and not told and any("(traverse): liver" in one for one in said)
    else:
        assert code == 0 and len(told) == 1 and "make it traverse" in told[0]
    patient(tmp_path, ("liver", liver))
    _, said = init(capfd, tmp_path, f"--target={target}", "--space", "LPS", "--region", "abdomen")
    assert not any("surrounds" in one for one in said) and any("(traverse): liver" in one for one in said)


def test_the_ball_of_a_target_is_not_warned_of(tmp_path, capfd):
    """A warning about triangles of a shape that is ours is of no use. A radius that is none is refused."""
    patient(tmp_path, ("right lung", inside(HERE, 18.0)))
    for radius in ("0.5", "37"):
        code, said = init(capfd, tmp_path, "--target", "0,0,-40", "--space", "LPS", "--hit-radius", radius)
        assert code == 0 and not any("'target'" in one or "target: " in one for one in said), said
    for radius in ("0", "101", "nan"):
        code, said = init(capfd, tmp_path, "--target", "0,0,-40", "--hit-radius", radius)
        assert code == 2 and "--hit-radius" in said[0] and "above 0, at most 100" in said[0]
