"""What is named like the outline of the body is left out by `init` only if it is one; else it is not crossed."""

import numpy as np
import pytest
from case_world import ball
from round_body import BODY, X, Z, inside, roles, run_init, write_ct, write_mask

from puncture_twin.planning.anatomy.skin import skin_from_mesh
from puncture_twin.planning.init.segmentation import MOST_OF_SKIN, PART_OF_SKIN, agreement
from puncture_twin.planning.search.context import prepare

TARGET = np.array([-40.0, 0.0, 10.0])
BODY_MM = 90.0
NAMES = ["External", "patient", "body envelope"]


def write_case(folder, **masks):
    """A CT of a round body, with a tumour about the target, an aorta, and further masks."""
    write_ct(folder / "scan.nii.gz")
    (folder / "seg").mkdir()
    named = {"tumor": inside(TARGET, 6.0), "aorta": inside((36.0, 36.0, 0.0), 8.0), **masks}
    for name, voxels in named.items():
        write_mask(folder / "seg" / f"{name}.nii.gz", voxels)


def init(capfd, folder, *words):
    return run_init(capfd, folder, *(words or ("--target", ",".join(map(str, TARGET)))))[::2]


def test_a_ball_that_is_named_like_the_body_is_an_obstacle(tmp_path, capfd):
    """It was left out (ignore), and paths through a carotid that somebody called External were safe."""
    ways = dict(zip(NAMES, np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]), strict=True))
    write_case(tmp_path, **{name: inside(TARGET + 40.0 * way, 10.0) for name, way in ways.items()})
    code, said = init(capfd, tmp_path)
    assert code == 0, said
    lines = [one for one in said if "named like the outline of the body" in one]
    context = prepare(tmp_path, arm=False)
    found, given = context.search(), roles(context)
    for name, way in ways.items():
        assert given[name] == ("avoid", 5.0)
        assert any(f"'{name}'" in line and "of the skin" in line and "ignore" in line for line in lines)
        through = found.outward_ct @ way > np.cos(np.arctan2(10.0, 40.0))
        assert through.any() and not found.safe[through].any()


def test_around_the_lesion_it_is_unknown(tmp_path, capfd):
    """Nobody knows whether a path may cross it; and it is not taken for the target."""
    write_case(tmp_path, **{name: inside(TARGET, 16.0 + number) for number, name in enumerate(NAMES[:2])})
    for words, target in (((), "tumor"), (("--target", "-40,12,10", "--force"), "target")):
        code, said = init(capfd, tmp_path, *words)
        assert code == 0, said
        context = prepare(tmp_path, arm=False)
        given = roles(context)
        assert {given[name] for name in NAMES[:2]} == {("unknown", 5.0)} and given[target][0] == "target"
        assert words or not context.search().safe.any()


OUTLINES = {
    "skin": BODY,
    "External": inside((0.0, 0.0, 0.0), BODY_MM - 5.0),
    "patient": BODY & ~inside((0.0, 0.0, 0.0), BODY_MM - 10.0),
    "body_envelope": BODY & ~inside((40.0, 0.0, 0.0), 35.0) & ~inside((-40.0, 0.0, -20.0), 25.0),
    "body_trunc": BODY & (Z < 60.0),
    "outline": BODY & (X < 0.0),
}
"""Whole, 5 mm less, a shell, with holes, without its head, the half with the target."""


def test_the_outline_itself_is_left_out(tmp_path, capfd):
    """Whole, as a shell, with holes for the lungs, cropped: paths cross it as they did."""
    write_case(tmp_path, **OUTLINES)
    code, said = init(capfd, tmp_path)
    assert code == 0, said
    context = prepare(tmp_path, arm=False)
    assert not OUTLINES.keys() & roles(context).keys() and context.search().safe.any()
    (line,) = [one for one in said if "treated as the outline of the body, so not checked (ignore)" in one]
    assert all(name in line for name in OUTLINES)


def test_a_limb_beside_the_target_is_no_outline(tmp_path, capfd):
    """It lies on the skin all over, but does not hold the target: TotalSegmentator's body_extremities."""
    write_case(tmp_path, body_extremities=BODY & (X > 20.0))
    code, said = init(capfd, tmp_path)
    assert code == 0, said
    assert roles(tmp_path)["body_extremities"] == ("avoid", 5.0)


def meshes(folder, **balls):
    (folder / "meshes").mkdir()
    for name, (radius, middle) in balls.items():
        ball(folder / "meshes" / f"{name}.stl", radius, np.array(middle))


def test_of_meshes_the_one_that_holds_the_others_is_the_skin(tmp_path, capfd):
    """The first by its name was taken: a ball in the body, and what lay outside of it was air."""
    meshes(tmp_path, External=(12.0, (-40, -40, 10)), skin=(90.0, (0, 0, 0)), liver=(20.0, TARGET))
    assert init(capfd, tmp_path)[0] == 0
    context = prepare(tmp_path, arm=False)
    assert np.ptp(context.anatomy.skin.mesh.bounds[:, 0]) == pytest.approx(180.0, abs=2.0)
    assert roles(context)["External"] == ("avoid", 5.0)


def test_of_two_skins_one_is_the_skin_and_the_other_left_out(tmp_path, capfd):
    meshes(tmp_path, External=(89.0, (0, 0, 0)), skin=(90.0, (0, 0, 0)), liver=(20.0, TARGET), aorta=(8.0, (36, 36, 0)))
    assert init(capfd, tmp_path)[0] == 0
    assert set(roles(tmp_path)) == {"liver", "aorta"}


def test_a_mesh_that_holds_nothing_is_no_skin(tmp_path, capfd):
    """Without a CT: the path would begin at its surface, and what lies about it would be air."""
    meshes(
        tmp_path, patient=(30.0, (-40, 0, 10)), tumor=(10.0, TARGET), aorta=(20.0, (60, 60, 0)), lung=(20.0, (0, 60, 0))
    )
    code, said = init(capfd, tmp_path, "--target", "-40,0,10", "--unit", "mm")
    assert code == 2 and "'patient' is named like the skin, but contains 1 of the 3 other meshes" in said[-1]


def test_small_bodies_have_small_bounds(ball):
    """A mouse's liver lies within 8 mm of its skin everywhere: what counts is its size."""
    skin = skin_from_mesh(ball(15.0))
    assert agreement(ball(12.0), skin) == (0.0, 0.0) and agreement(ball(14.9), skin).skin_covered > MOST_OF_SKIN
    assert agreement(ball(5.0, (9.5, 0.0, 0.0)), skin).skin_covered < PART_OF_SKIN
