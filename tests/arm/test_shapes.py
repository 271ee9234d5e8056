"""The shapes that ship here: pinned, of the stated licence, and the arms' own."""

import hashlib
import json

import numpy as np
import pytest

from puncture_twin import meshes
from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.links import LINK_NAMES, visual_links
from puncture_twin.planning.arm.ur import ur_model

FOLDER = meshes.folder() / "ur"
FILES = {entry["path"]: entry for entry in json.loads((FOLDER / "manifest.json").read_text(encoding="utf-8"))["files"]}
E_SERIES = ["ur3e", "ur5e", "ur10e"]
ARMS = ["ur3", "ur5", "ur10", *E_SERIES]
EDGE_MM = 1.0
"""How far apart two shapes may lie where they share a joint: 0.7 mm at the UR5e's wrist 3, which a pin closes."""


def test_every_shape_is_listed_with_its_hash_and_source():
    """Seven meshes and a URDF an arm, and nothing else; the licence lies beside them."""
    there = {path.relative_to(FOLDER).as_posix() for path in FOLDER.rglob("*.*") if path.suffix in {".stl", ".urdf"}}
    assert there == set(FILES) and len(FILES) == len(ARMS) * (len(LINK_NAMES) + 1)
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
