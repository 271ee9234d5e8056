"""A case file or a list that was cut is refused wherever it was cut."""

from types import SimpleNamespace

import numpy as np
import pytest
from case_world import CASE, MARKERS, write_case, write_labels
from refusals import refused

from puncture_twin.planning.anatomy.anatomy import OUTSIDE_NOT_KNOWN
from puncture_twin.planning.anatomy.regions import USUAL, absent_organs
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.case.named_files import NOT_LAST_NOTE, TOP_COUNT_NOTE
from puncture_twin.planning.evidence.checks import ignored_organs
from puncture_twin.planning.formats.labels.naming import V2
from puncture_twin.planning.search.context import prepare
from puncture_twin.run_twin import main
from puncture_twin.twin.jobs.exit_codes import BAD_INPUT

TOP = CASE.replace("schema = 2", "schema = 2\nstructures = 4").replace("[end]\nstructures = 4\n", "")
BOX = '[[obstacle]]\nname = "table"\nframe = "ct"\ncenter_mm = [0, 150, 0]\nsize_mm = [400, 20, 400]\n'


def test_a_case_that_states_its_structures_is_read_without_a_note(tmp_path):
    case = load_case(write_case(tmp_path))
    assert (case.stated_structures, case.region, case.warnings) == (4, "other", ())
    (outside, unknown, base) = prepare(tmp_path, arm=False).anatomy.warnings
    assert "'organ', a name that is not in the table of default roles" in unknown
    assert outside == OUTSIDE_NOT_KNOWN and "the robot's base would be in the patient" in base  # of equal lists


def test_a_case_cut_anywhere_is_refused(tmp_path):
    """Every shorter file, byte by byte, with an obstacle behind the structures: none is read as a smaller case."""
    text = CASE.replace("[end]", BOX + "[end]")
    path = write_case(tmp_path, text=text)
    load_case(path)
    for length in range(len(text.rstrip("\n"))):
        path.write_text(text[:length])
        with pytest.raises(InputError):
            load_case(path)


@pytest.mark.parametrize("kept", [1, 2, 3])
def test_a_lost_structure_is_refused_with_a_count_at_the_top_too(kept, tmp_path, capfd):
    """structures = N at the top: the command says both numbers, in one line, exit code 2."""
    pieces = TOP.split("[[structure]]")
    path = write_case(tmp_path, text="[[structure]]".join(pieces[: kept + 1]), listed=None)
    assert main(["check", str(path), "--theta", "0", "--beta", "0", "--no-arm"]) == BAD_INPUT
    said = capfd.readouterr()
    assert said.out == ""
    assert len(said.err.strip().splitlines()) == 1
    assert f"structures = 4 is stated, but the case has {kept}, the skin included; was the file cut?" in said.err


def test_what_a_count_at_the_top_does_not_show_is_said(tmp_path):
    """A margin on the last line, an obstacle behind: one note, and the case is read."""
    assert load_case(write_case(tmp_path, text=TOP, listed=None)).warnings == (TOP_COUNT_NOTE,)
    assert load_case(write_case(tmp_path, text=CASE + BOX, listed=None)).warnings == (NOT_LAST_NOTE,)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('region = "other"\n', ""), "missing_key"),
        (('region = "other"', 'region = "belly"'), "bad_value abdomen"),
        (("[end]\nstructures = 4\n", ""), "file_cut"),
        (("structures = 4", "structures = 5"), "structures_miscounted"),
        (("structures = 4", "structures = 0"), "bad_value end.structures"),
        (("structures = 4", "structures = true"), "bad_value end.structures"),
        (("schema = 2", "schema = 2\nstructures = 5"), "stated_twice"),
        (("schema = 2", "schema = true"), "unknown_version True"),
    ],
)
def test_what_a_case_states_of_itself_must_be_right(change, message, tmp_path):
    with refused(*message.split()):
        load_case(write_case(tmp_path, change, listed=None))


def test_labels_that_rules_name_count_each(tmp_path):
    """Beside [[structures]] the count stands in [end]; ignored labels are no structures."""
    many = (
        '[[structures]]\nlabelmap = "many.nrrd"\nnaming = "names.csv"\navoid = { "vein*" = 1.0 }\nignore = ["fold"]\n'
    )
    labels = np.zeros((100, 100, 100), np.uint8)
    for number, at in enumerate((60, 64, 68), start=1):
        labels[40:60, at, at] = number
    (tmp_path / "names.csv").write_text("id,name\n1,vein_left\n2,vein_right\n3,fold\n")
    path = write_case(tmp_path, ("[end]", many + "[end]"), listed=2)
    write_labels(tmp_path / "many.nrrd", labels)
    assert prepare(path, arm=False).anatomy.ignored == ("fold",)
    path.write_text(path.read_text().replace("structures = 6", "structures = 7"))
    with refused("structures_miscounted"):
        prepare(path, arm=False)


@pytest.mark.parametrize("name", ["touch.csv", "markers_ct.csv", "targets.csv"])
def test_a_list_that_ends_within_a_line_is_refused(name, tmp_path):
    """Cut within its last number a list is whole CSV with another number: 70 became 7."""
    target = ("position_mm = [0.0, 0.0, 0.0]", 'points = "targets.csv"')
    path = write_case(tmp_path, target)
    (tmp_path / "targets.csv").write_text("name,x_mm,y_mm,z_mm\ntarget,0,0,10\n")
    load_case(path)
    (tmp_path / name).write_text((tmp_path / name).read_text().rstrip("\n")[:-1])
    with refused("file_cut", name):
        load_case(path)


@pytest.mark.parametrize("content", [MARKERS, MARKERS.replace("\n", "\r\n"), MARKERS + "  \n", MARKERS + " \t"])
def test_a_list_whose_last_line_ends_is_whole(content, tmp_path):
    """Line breaks of every system; spaces after the last one are no line."""
    path = write_case(tmp_path)
    (tmp_path / "touch.csv").write_bytes(content.encode())
    assert load_case(path).warnings == ()


def test_usual_organs_that_are_absent_are_listed_once(tmp_path):
    """By name, with the side of a paired organ; those that the case ignores are named, not forgotten."""
    path = write_case(tmp_path, ('region = "other"', 'region = "pelvis"'))
    (said,) = [warning for warning in prepare(path, arm=False).anatomy.warnings if "region" in warning]
    assert said.startswith("region pelvis: no structure is named like urinary bladder, rectum or colon, small bowel")
    assert said.endswith("femurs; organs without a structure count as free")


@pytest.mark.parametrize(
    ("region", "names", "absent"),
    [
        ("spine", ["vertebrae_L3", "spinal_cord", "aorta", "IVC", "kidney_left", "lungs"], ["kidneys (right)"]),
        (
            "spine",
            ["Spine", "spinalCord", "Aorta", "vena cava inf", "VH_M_Kidney_L", "KidneyR", "lung l"],
            ["lungs (right)"],
        ),
        ("limb", ["humerus_left", "brachial artery", "Vena basilica"], ["nerve"]),
        ("spine", ["vertebrae", "spinal_cord", "aorta", "ivc", "adrenal_gland_left", "lungs"], ["kidneys"]),
        ("phantom", [], []),
    ],
)
def test_organs_are_known_by_their_common_names(region, names, absent):
    """TotalSegmentator's names, other spellings, sides; an adrenal gland is no kidney."""
    assert absent_organs(region, names) == absent


def test_the_vessels_of_an_organ_are_not_the_organ():
    """A liver that nobody segmented was not told where its vessels were: it counts as free."""
    names = ["liver_vessels", "kidney_cyst_left", "right renal artery", "lung vessels", "intercostal_artery"]
    names += ["vertebral artery", "pancreatic duct", "Liver tumor", "splenic vein"]
    assert absent_organs("abdomen", names) == absent_organs("abdomen", [])
    assert absent_organs("neck", ["superior thyroid artery", "left carotid artery", "Right Carotid"]) == [
        name for name in absent_organs("neck", []) if name != "carotid arteries"
    ]
    assert "portal vein" not in absent_organs("abdomen", ["portal_vein_and_splenic_vein"])


def test_totalsegmentator_names_every_usual_organ_of_the_trunk():
    """Its second version has a class for each organ of abdomen and chest."""
    for region in ("abdomen", "chest"):
        assert absent_organs(region, V2.values()) == []
    assert set(USUAL) >= {"abdomen", "chest", "pelvis", "brain", "head", "neck", "spine", "limb", "phantom"}


def test_what_is_ignored_and_should_be_avoided_is_said():
    """An aorta that a case leaves out on purpose counts as free: every result names it, but no outline of the body."""
    anatomy = SimpleNamespace(ignored=("aorta", "body", "made_up_name"))
    (said,) = ignored_organs(SimpleNamespace(region="abdomen"), anatomy)
    assert (said.code, said.numbers) == ("organs_ignored", {"count": 1.0})
    assert "aorta" in said.sentence
    assert not list(ignored_organs(SimpleNamespace(region=None), SimpleNamespace(ignored=("body",))))
