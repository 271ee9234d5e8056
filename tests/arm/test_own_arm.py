"""An arm of the user's own, from a URDF with meshes beside it: right, or refused with what and where."""

import pickle
import tomllib
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import fcl
import numpy as np
import pytest
import trimesh
from own_arms import LENGTHS, LINKS, beside, origin, placed, shipped_as_own, slow_chain, write_own_arm
from refusals import refused

from puncture_twin.planning.arm.inverse_kinematics import inverse
from puncture_twin.planning.arm.kinematics import flange_pose, link_poses
from puncture_twin.planning.arm.links import collision_links, own_arm
from puncture_twin.planning.arm.tool import Box, Tool
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.arm.urdf.lengths import StatedLimits
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.collision.fast_checker import FastChecker

EXACT_MM = 1e-6
TOOL = Tool(200.0, 150.0, 1.2, 30.0)


def arm(path, **keys):
    return own_arm(path.read_bytes(), path, **{"flange": "tool0", "read": beside(path), **keys})


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return write_own_arm(tmp_path_factory.mktemp("plain"))


@pytest.mark.parametrize("seed", range(3))
def test_lengths_and_motion_are_the_urdfs_however_its_frames_lie(tmp_path, seed):
    """Random lengths, frames turned anyhow and shifted along the axes: the flange is where the text alone has it."""
    rng = np.random.default_rng(seed)
    lengths = tuple(np.round(rng.uniform(0.6, 1.6, 6) * LENGTHS, 3))
    path = write_own_arm(tmp_path, lengths, rng=rng)
    model = arm(path)
    assert model.lengths.tolist() == list(lengths) and model.name == "toy" and model.joint_names[0] == "j1"
    for q in rng.uniform(-6, 6, (20, 6)):
        wanted = slow_chain(path, q)
        assert np.abs(flange_pose(model, q) - wanted).max() < EXACT_MM
        solutions = inverse(model, wanted)[0]
        found = solutions[~np.isnan(solutions).any(axis=1)]
        assert len(found) and np.abs(flange_pose(model, found) - wanted).max() < EXACT_MM
        nearest = np.abs((found - q + np.pi) % (2 * np.pi) - np.pi).max(axis=1).min()
        assert nearest < 1e-6


@pytest.mark.parametrize("seed", [None, 3])
def test_shapes_lie_where_the_text_has_them(tmp_path, seed):
    """A block is met where FCL's own answer for the raw meshes says so: the links are convex."""
    rng = np.random.default_rng(seed or 0)
    path = write_own_arm(tmp_path, rng=None if seed is None else rng)
    checker = None
    met = 0
    raw = [trimesh.load_mesh(path.parent / f"{link}.stl") for link in LINKS]
    for q in rng.uniform(-3, 3, (60, 6)):
        at = slow_chain(path, q, LINKS[int(rng.integers(2, 7))])[:3, 3] + rng.normal(0, 60, 3)
        T = np.eye(4)
        T[:3, 3] = at
        checker = CellChecker(arm(path) if checker is None else checker.model, TOOL, [Box("block", T, (40.0,) * 3)])
        block = fcl.CollisionObject(fcl.Box(40.0, 40.0, 40.0), fcl.Transform(at))
        touched = [link for link, mesh in zip(LINKS[1:], raw[1:], strict=True) if touches(path, q, link, mesh, block)]
        found = checker.distances(q).boxes
        if touched:
            assert found.mm == 0.0
        elif found.body not in ("holder", "needle"):
            assert found.mm > 0.0
        met += bool(touched)
    assert 10 < met < 50


def touches(path, q, link, mesh, block):
    """Whether a link's raw mesh, as a convex body, meets a block."""
    T = slow_chain(path, q, link)
    body = fcl.CollisionObject(solid(mesh), fcl.Transform(T[:3, :3], T[:3, 3]))
    return bool(fcl.collide(body, block, fcl.CollisionRequest(), fcl.CollisionResult()))


@pytest.mark.parametrize("name", ["ur5", "ur5e"])
def test_a_urs_own_urdf_is_the_arm_of_the_table(tmp_path, name):
    """Lengths, torques and the links' bodies to the bit; limits but for the digits that the URDF writes."""
    known = ur_model(name)
    model = arm(shipped_as_own(tmp_path, name))
    assert model.name == name and model.joint_names == known.joint_names and model != known
    same = replace(model, joint_limits=known.joint_limits, max_speeds=known.max_speeds, shipped=True, urdf=None)
    assert same == known and hash(same) == hash(known)
    assert np.abs(model.joint_limits - known.joint_limits).max() < 1e-11
    pairs = zip(collision_links(model), collision_links(known), strict=True)
    assert all(a.mesh.digest == b.mesh.digest and len(a.pieces) == len(b.pieces) for a, b in pairs)


def test_an_arm_is_sent_to_another_process(plain):
    """Placements are rated in several: what arrives is the same arm, with its shapes."""
    model = arm(plain)
    arrived = pickle.loads(pickle.dumps(model))
    assert arrived == model and arrived.urdf.digest == model.urdf.digest
    assert collision_links(arrived)[3].mesh.digest == collision_links(model)[3].mesh.digest


def edited(plain, tmp_path, *changes):
    """The plain arm with its text changed, each change once at least."""
    for file in plain.parent.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    text = plain.read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    path = tmp_path / "toy.urdf"
    path.write_text(text, encoding="utf-8")
    return path


REFUSED = {
    one["kind"]: one
    for one in tomllib.loads(Path(__file__).with_name("own_arm_refusals.toml").read_text(encoding="utf-8"))["refused"]
}


@pytest.mark.parametrize("kind", REFUSED)
def test_what_is_not_understood_is_refused_with_its_place(plain, tmp_path, kind):
    """One line that names the file, and the joint or link where there is one."""
    case = REFUSED[kind]
    path = edited(plain, tmp_path, *case["changes"])
    with refused(*case["says"].split(), "toy.urdf"):
        arm(path)


@pytest.mark.parametrize(
    ("joint", "change", "says"),
    [
        (2, (0.0, 0.0, 1.0, 0.0, 0.0, 0.0), None),  # along its own axis, and all after it: a longer d4
        (2, (0.0, 2.0, 0.0, 0.0, 0.0, 0.0), "arm_not_as_ur j3"),
        (3, (0.0, 0.0, 0.0, 0.0, 0.01, 0.0), "arm_not_as_ur j4"),
        (3, (0.0, 0.0, 0.0, 0.0, 0.0, 1.5), "arm_not_as_ur j5"),  # another zero
        (4, (1.0, 0.0, 0.0, 0.0, 0.0, 0.0), "arm_not_as_ur j5"),
        (1, (3.0, 0.0, 0.0, 0.0, 0.0, 0.0), "arm_not_as_ur j2"),
        (5, (0.0, 0.0, 0.0, 0.0, 0.0, 0.5), "arm_not_as_ur 28.65"),
    ],
)
def test_an_arm_that_is_not_built_as_a_ur_is_refused_at_its_joint(plain, tmp_path, joint, change, says):
    """A step that a UR has not, before one joint; along the joint's own axis it is a length."""
    text = plain.read_text(encoding="utf-8").splitlines()
    row = next(i for i, line in enumerate(text) if f'name="j{joint + 1}"' in line)
    old = text[row][text[row].index("<origin") : text[row].index("<axis")]
    tag = ElementTree.fromstring(old)
    step = np.eye(4)
    step[:3, :3] = trimesh.transformations.euler_matrix(*change[3:])[:3, :3]
    step[:3, 3] = change[:3]
    path = edited(plain, tmp_path, (old, origin(placed(tag) @ step)))
    if says is None:
        assert (arm(path).lengths - LENGTHS).tolist() == [0, 0, 0, 1, 0, 0]
        return
    with refused(*says.split()):
        arm(path)


def test_rounded_angles_are_a_right_angle_and_two_digits_are_not(plain, tmp_path):
    """1.5708 and 3.1416 are what people write; 1.57 leans the arm by 0.8 mm a metre."""
    text = plain.read_text(encoding="utf-8")
    assert "1.5707963267948966" in text
    assert arm(edited(plain, tmp_path, ("1.5707963267948966", "1.5708"))).lengths == pytest.approx(LENGTHS, abs=1e-3)
    with refused("arm_not_as_ur", "j2"):
        arm(edited(plain, tmp_path, ("1.5707963267948966", "1.57")))


def test_limits_are_the_urdfs_or_the_cases(plain, tmp_path):
    model = arm(plain)
    assert model.joint_limits.tolist() == [[-6.0, 6.0]] * 6 and model.max_torques.tolist() == [100.0] * 6
    stated = StatedLimits(np.array([[-3.0, 3.0]] * 6))
    loose = edited(plain, tmp_path, ('name="j1" type="revolute"', 'name="j1" type="continuous"'))
    angles = arm(loose, stated=stated).joint_limits
    assert angles[0, 1] > 12 and angles[1].tolist() == [-6.0, 6.0]


def test_fixed_links_between_belong_to_the_link_before(plain, tmp_path):
    """A cover on the forearm and a root above the base: the same arm, with the cover's body."""
    fixed = (
        '<joint name="{0}" type="fixed"><parent link="{1}"/><child link="{2}"/><origin xyz="{3}" rpy="{4}"/></joint>'
    )
    path = edited(
        plain,
        tmp_path,
        ("</robot>", '<link name="world"/>' + fixed.format("w", "world", "base_link", "0 0 0", "0 0 0") + "</robot>"),
        ("</robot>", '<link name="cover"><collision><origin xyz="0 0 0.1"/><geometry><box size=".1 .1 .2"/></geometry>'
                     "</collision></link>" + fixed.format("c", "ulna", "cover", "-0.1 0 0", "1.5 0 0.2") + "</robot>"),
    )  # fmt: skip
    model, before = arm(path), arm(plain)
    assert model.lengths.tolist() == before.lengths.tolist()
    links, known = collision_links(model), collision_links(before)
    grown = [a.mesh.digest != b.mesh.digest for a, b in zip(links, known, strict=True)]
    assert grown == [name == "forearm" for name in [link.name for link in links]]
    q = np.array([0.3, -1.0, 0.8, 0.2, 1.0, 0.5])
    corner = (slow_chain(path, q, "cover") @ [50.0, 50.0, 200.0, 1.0])[:3]
    mesh = links[3].mesh.transformed(link_poses(model, q)[3])
    assert np.linalg.norm(mesh.vertices - corner, axis=1).min() < 1e-6


@pytest.mark.parametrize("what", ["open", "inside out", "mm", "stretched"])
def test_meshes_are_the_same_body_however_they_are_written(plain, tmp_path, what):
    """An open or inverted mesh has the same hull; a scale is a factor of each axis."""
    path = edited(plain, tmp_path)
    file = tmp_path / "ulna.stl"
    mesh = trimesh.load_mesh(file)
    if what == "open":
        mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    if what == "inside out":
        mesh.invert()
    factor = {"mm": (1000.0,) * 3, "stretched": (10.0, 100.0, 1000.0)}.get(what, (1.0,) * 3)
    mesh.vertices = mesh.vertices * factor
    mesh.export(file)
    scale = " ".join(repr(1 / one) for one in factor)
    path = edited(plain, tmp_path, ('filename="ulna.stl"', f'filename="ulna.stl" scale="{scale}"'))
    mesh.export(file)
    bounds = collision_links(arm(plain))[3].mesh.bounds
    assert np.abs(collision_links(arm(path))[3].mesh.bounds - bounds).max() < 1e-3


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (('filename="ulna.stl"', 'filename="ulna.stl" scale="0.3 0.3 0.3"'), "forearm"),
        (
            ('<geometry><mesh filename="ulna.stl"', '<origin xyz="0 0.3 0"/><geometry><mesh filename="ulna.stl"'),
            "forearm",
        ),
        (
            ('<geometry><mesh filename="roll.stl"', '<origin xyz="0 0 0.4"/><geometry><mesh filename="roll.stl"'),
            "wrist",
        ),
    ],
)
def test_links_that_do_not_hang_together_are_refused(plain, tmp_path, change, says):
    """A mesh in another unit, or at another place, leaves a gap through which a surface could pass unseen."""
    CellChecker(arm(plain), TOOL)
    with refused("links_apart", "toy.urdf", says):
        CellChecker(arm(edited(plain, tmp_path, change)), TOOL)


def test_flat_shapes_are_refused(plain, tmp_path):
    path = edited(plain, tmp_path)
    sheet = trimesh.Trimesh([[0, 0, 0], [0.3, 0, 0], [0, 0.3, 0]], [[0, 1, 2]])
    sheet.export(tmp_path / "ulna.stl")
    with refused("flat_mesh", "toy.urdf"):
        collision_links(arm(path))


@pytest.mark.parametrize(
    ("tag", "size"),
    [
        ("box size='0.1 0.2 0.3'", (50, 100, 150)),
        ("cylinder radius='0.05' length='0.3'", (50, 50, 150)),
        ("sphere radius='0.05'", (50, 50, 50)),
    ],
)
def test_plain_shapes_are_contained(plain, tmp_path, tag, size):
    """A box to the digit; a cylinder and a sphere by a prism about them, wider by 0.2 %."""
    path = edited(plain, tmp_path, ('<mesh filename="hand.stl"/>', f"<{tag}/>"))
    mesh = arm(path).urdf.shapes[6][0].mesh
    assert (mesh.bounds[1] >= np.array(size) - 1e-9).all() and (mesh.bounds[1] <= 1.003 * np.array(size)).all()
    assert trimesh.Trimesh(mesh.vertices, mesh.faces).is_watertight


CAMERA = (
    '<link name="camera"><collision><origin xyz="{0} 0 {1}"/><geometry><box size="{2} 0.02 0.02"/></geometry>'
    '</collision><collision><origin xyz="{3} 0 {4}"/><geometry><box size="0.02 0.06 0.2"/></geometry></collision>'
    "</link>"
    '<joint name="screws" type="fixed"><parent link="hand"/><child link="camera"/></joint></robot>'
)
"""A bracket from wrist 3 to the side, and a block at its end that reaches back beside wrist 2."""


@pytest.mark.parametrize("seed", [1, 2])
def test_what_is_fixed_to_a_link_meets_its_neighbours(plain, tmp_path, seed):
    """A camera on wrist 3 against wrist 2, an upper arm against the folded forearm: FCL's answer for the raw shapes."""
    path = edited(plain, tmp_path, ("</robot>", CAMERA.format(0.03, -0.03, 0.1, 0.07, -0.11)))
    checker, rng = CellChecker(arm(path), TOOL), np.random.default_rng(seed)
    raw = {link: trimesh.load_mesh(path.parent / f"{link}.stl") for link in LINKS}
    block = trimesh.creation.box((0.02, 0.06, 0.2))
    block.apply_translation([0.07, 0.0, -0.11])
    met = 0
    for q in rng.uniform(-3, 3, (150, 6)):
        T = slow_chain(path, q, "pitch")
        wrist_2 = fcl.CollisionObject(solid(raw["pitch"]), fcl.Transform(T[:3, :3], T[:3, 3]))
        meets = touches(path, q, "hand", block, wrist_2)
        assert not meets or checker.contact(q, needle_may_touch_patient=False) is not None
        met += meets
    assert 10 < met < 140
    for bend in np.radians([160.0, 170.0, -165.0]):
        assert checker.contact(np.array([0, -1.5, bend, 0, 1.5, 0]), needle_may_touch_patient=False) is not None


def solid(mesh):
    """A convex mesh in metres for FCL, in mm."""
    counted = np.insert(mesh.faces, 0, 3, axis=1).ravel().astype(np.int32)
    return fcl.Convex(1000.0 * np.asarray(mesh.vertices), len(mesh.faces), counted)


def test_a_shape_that_hangs_on_nothing_is_refused(plain, tmp_path):
    """A camera whose bracket was left out could lie in the patient while nothing touches the skin."""
    path = edited(plain, tmp_path, ("</robot>", CAMERA.format(0.3, 0.0, 0.02, 0.3, -0.1)))
    with refused("shape_detached", "wrist_3", "20"):
        CellChecker(arm(path), TOOL)


def test_holder_and_needle_are_asked_of_what_wrist_2_carries(tmp_path):
    """A plate that hangs on wrist 2 and stands across the needle, 60 mm before the flange, at every angle."""
    path = write_own_arm(tmp_path)
    bare = arm(path)
    flange = np.linalg.inv(link_poses(bare, np.zeros(6))[4]) @ flange_pose(bare, np.zeros(6))
    reach_mm = LENGTHS[5] + 70.0
    boxes = ((40, 0, -LENGTHS[5], 90, 20, 20), (80, 0, 35 - LENGTHS[5] / 2, 20, 20, reach_mm), (30, 0, 60, 120, 40, 10))
    shapes = ""
    for number, (x, y, z, *size) in enumerate(boxes):
        box = trimesh.creation.box(size)
        box.apply_translation((x, y, z))
        box.apply_transform(flange)
        box.apply_scale(0.001).export(path.parent / f"bracket{number}.stl")
        shapes += f'<collision><geometry><mesh filename="bracket{number}.stl"/></geometry></collision>'
    before, link, after = path.read_text().partition(f'<link name="{LINKS[5]}">')
    path.write_text(before + link + after.replace("</link>", f"{shapes}</link>", 1))
    model = arm(path)
    for checker in (CellChecker(model, TOOL), FastChecker(model, TOOL)):
        for q in np.random.default_rng(0).uniform(-2.5, 2.5, (20, 6)):
            contact = checker.contact(q, needle_may_touch_patient=False)
            assert contact is not None
        assert {("holder", "wrist_2"), ("needle", "wrist_2")} & {
            tuple(checker.contact(q, needle_may_touch_patient=False))[:2]
            for q in np.random.default_rng(1).uniform(-2.5, 2.5, (60, 6))
        }
