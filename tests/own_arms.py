"""Arms of the user's own for tests: URDFs with meshes beside them, built as a UR, of any lengths, written many ways."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from puncture_twin import meshes

LENGTHS = (140.0, -310.0, -290.0, 125.0, 110.0, 130.0)
"""d1, a2, a3, d4, d5, d6 of the arm that the tests make, mm: of no UR."""
TWISTS = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)
HALF_MM = 22.0
LINKS = ("base_link", "swing", "humerus", "ulna", "roll", "pitch", "hand")
JOINTS = ("j1", "j2", "j3", "j4", "j5", "j6")


def dh(lengths):
    """The six Denavit-Hartenberg steps at the angle zero, mm, written out."""
    d1, a2, a3, d4, d5, d6 = lengths
    steps = []
    for d, a, twist in zip((d1, 0, 0, d4, d5, d6), (0, a2, a3, 0, 0, 0), TWISTS, strict=True):
        c, s = np.cos(twist), np.sin(twist)
        steps.append(np.array([[1, 0, 0, a], [0, c, -s, 0], [0, s, c, d], [0, 0, 0, 1.0]]))
    return steps


def origin(T):
    """An ``origin`` tag of a pose in mm, with all digits."""
    rpy = Rotation.from_matrix(T[:3, :3]).as_euler("xyz")
    return f'<origin xyz="{words(T[:3, 3] / 1000)}" rpy="{words(rpy)}"/>'


def words(values):
    """Numbers as URDF has them."""
    return " ".join(repr(float(value)) for value in values)


def bone(T_link_ends):
    """The hull of two cubes: a body between two joints, mm."""
    corners = np.array(np.meshgrid(*[[-HALF_MM, HALF_MM]] * 3)).reshape(3, -1).T
    points = [corners @ T[:3, :3].T + T[:3, 3] for T in T_link_ends]
    return trimesh.convex.convex_hull(np.concatenate(points))


def write_own_arm(folder, lengths=LENGTHS, *, rng=None, name="toy", limit='lower="-6" upper="6"'):
    """A URDF and its meshes; with ``rng`` each link's frame lies anywhere along its joint's axis, turned anyhow."""
    folder.mkdir(parents=True, exist_ok=True)
    frames = [np.eye(4)]
    for step in dh(lengths):
        frames.append(frames[-1] @ step)
    places, axes = [np.eye(4)], [None]
    for frame in frames[:-1]:
        T = frame.copy()
        if rng is not None:
            T[:3, 3] += rng.uniform(-80, 80) * frame[:3, 2]
            T[:3, :3] = Rotation.random(random_state=rng).as_matrix()
        places.append(T)
        axes.append(T[:3, :3].T @ frame[:3, 2])
    lines = [f'<?xml version="1.0"?>\n<robot name="{name}">']
    for number, link in enumerate(LINKS):
        T_link = np.linalg.inv(places[number])
        ends = (frames[max(number - 1, 0)], frames[number] if number < 6 else frames[6] @ back(HALF_MM))
        body = bone([T_link @ end for end in ends])
        body.apply_scale(0.001).export(folder / f"{link}.stl")
        lines.append(
            f'<link name="{link}"><inertial><mass value="2"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0"'
            f' iyz="0"/></inertial><collision><geometry><mesh filename="{link}.stl"/></geometry></collision></link>'
        )
    for number, joint in enumerate(JOINTS):
        T = np.linalg.inv(places[number]) @ places[number + 1]
        lines.append(
            f'<joint name="{joint}" type="revolute"><parent link="{LINKS[number]}"/><child link="{LINKS[number + 1]}"/>'
            f'{origin(T)}<axis xyz="{words(axes[number + 1])}"/><limit {limit} velocity="3" effort="100"/></joint>'
        )
    lines.append('<link name="tool0"/>')
    lines.append('<joint name="mount" type="fixed"><parent link="hand"/><child link="tool0"/>')
    lines.append(f"{origin(np.linalg.inv(places[6]) @ frames[6])}</joint>\n</robot>\n")
    path = folder / "toy.urdf"
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def back(mm):
    """A step against the flange's z axis."""
    T = np.eye(4)
    T[2, 3] = -mm
    return T


def shipped_as_own(folder, name="ur5"):
    """The URDF of an arm of the table as a user has it: relative paths, and the link ``base`` that ROS has."""
    folder.mkdir(parents=True, exist_ok=True)
    source = meshes.folder() / "ur"
    text = (source / f"{name}.urdf").read_text(encoding="utf-8").replace("package://ur/", "")
    base = (
        '<link name="base"/><joint name="base_fixed" type="fixed"><origin rpy="0 0 3.141592653589793" xyz="0 0 0"/>'
        '<parent link="base_link"/><child link="base"/></joint></robot>'
    )
    (folder / name).mkdir(exist_ok=True)
    for mesh in (source / name).iterdir():
        (folder / name / mesh.name).write_bytes(mesh.read_bytes())
    path = folder / f"{name}.urdf"
    path.write_text(text.replace("</robot>", base), encoding="utf-8")
    return path


def beside(path):
    """Reads the meshes that lie beside a URDF."""
    return lambda address: (Path(path).parent / address).read_bytes()


def slow_chain(path, q, to="tool0"):
    """A link's pose in the root's frame, mm, from the URDF's text alone: rpy and axes by their definitions."""
    root = ElementTree.parse(path).getroot()
    angles = dict(zip(JOINTS, q, strict=True))
    above = {joint.find("child").get("link"): joint for joint in root.findall("joint")}
    T = np.eye(4)
    while to in above:
        joint = above[to]
        T = placed(joint.find("origin")) @ turned(joint, angles.get(joint.get("name"), 0.0)) @ T
        to = joint.find("parent").get("link")
    return T


def placed(tag):
    """Yaw about z, of pitch about y, of roll about x."""
    roll, pitch, yaw = (float(word) for word in tag.get("rpy").split())
    T = np.eye(4)
    for axis, angle in ((2, yaw), (1, pitch), (0, roll)):
        T[:3, :3] = T[:3, :3] @ about(np.eye(3)[axis], angle)
    T[:3, 3] = [1000 * float(word) for word in tag.get("xyz").split()]
    return T


def turned(joint, angle):
    T = np.eye(4)
    if joint.get("type") != "fixed":
        T[:3, :3] = about(np.array([float(word) for word in joint.find("axis").get("xyz").split()]), angle)
    return T


def about(axis, angle):
    """Rodrigues' formula, element by element."""
    x, y, z = axis
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def write_holder(path):
    """A holder about the flange with something at its side, mm."""
    side = trimesh.creation.box((70.0, 20.0, 30.0)).apply_translation([30.0, 0.0, 16.0])
    round_one = trimesh.creation.cylinder(18.0, 50.0).apply_translation([0, 0, 26.0])
    trimesh.util.concatenate([round_one, side]).export(path)
