"""The shapes of the e-Series that ship here: pinned, of the stated licence, and the arm's own."""

import hashlib
import json

import numpy as np
import pytest

from puncture_twin import meshes
from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.links import LINK_NAMES, resolve_package, urdf_link_poses, visual_links
from puncture_twin.planning.arm.ur import ur_model

FOLDER = meshes.folder() / "ur"
FILES = {entry["path"]: entry for entry in json.loads((FOLDER / "manifest.json").read_text(encoding="utf-8"))["files"]}
E_SERIES = ["ur3e", "ur5e", "ur10e"]
EDGE_MM = 1.0
"""How far apart two shapes may lie where they share a joint: 0.7 mm at the UR5e's wrist 3, which a pin closes."""


def test_every_shape_is_listed_with_its_hash_and_source():
    """Seven meshes and a URDF an arm, and nothing else; the licence lies beside them."""
    there = {path.relative_to(FOLDER).as_posix() for path in FOLDER.rglob("*.*") if path.suffix in {".stl", ".urdf"}}
    assert there == set(FILES) and len(FILES) == len(E_SERIES) * (len(LINK_NAMES) + 1)
    for path, entry in FILES.items():
        data = (FOLDER / path).read_bytes()
        assert (hashlib.sha256(data).hexdigest(), len(data)) == (entry["sha256"], entry["bytes"])
        assert len(entry["source_sha256"]) == 64 and entry["package"].endswith(".whl")
    licence = (FOLDER / "LICENSE").read_text(encoding="utf-8")
    assert "BSD-3-Clause" in licence and licence.count("MIT License") == 2


@pytest.mark.parametrize("name", E_SERIES)
def test_each_shape_begins_where_the_one_before_ends(name):
    """Along the axis of their joint two links' own meshes meet to 1 mm, at the angle zero and thus at every one."""
    model = ur_model(name)
    poses = link_poses(model, np.zeros(6))
    links = visual_links(model)
    for joint in range(6):
        heights = []
        for link in links[joint : joint + 2]:
            T = np.linalg.inv(poses[joint]) @ poses[link.frame]
            heights.append((link.mesh.vertices @ T[:3, :3].T + T[:3, 3])[:, 2])
        low, high = heights
        gap = min(abs(high.min() - low.max()), abs(low.min() - high.max()))
        assert gap < EDGE_MM or (high.min() < low.max() and low.min() < high.max()), LINK_NAMES[joint : joint + 2]


@pytest.mark.parametrize("name", E_SERIES)
def test_the_urdf_is_the_table(name):
    """At random angles the flange is where the Denavit-Hartenberg table has it, to 0.1 mm and far below."""
    model = ur_model(name)
    for q in np.random.default_rng(8).uniform(-np.pi, np.pi, (50, 6)):
        assert np.abs(urdf_link_poses(model, q)[6] - link_poses(model, q)[6]).max() < 1e-5


def test_addresses_lead_to_our_own_files_or_to_the_package():
    """Shapes of the e-Series are ours, others example-robot-data's."""
    assert resolve_package("package://ur/ur3e/base.stl") == FOLDER / "ur3e" / "base.stl"
    assert "cmeel.prefix" in str(resolve_package("package://example-robot-data/robots/x.stl"))
