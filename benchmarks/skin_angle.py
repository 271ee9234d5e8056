"""Normals of skins that were made from voxels, against those of the shapes that were sampled.

    python -m benchmarks.skin_angle

Degrees off: median, 95 % and the worst; of the stairs' own normals (what a mesh has), and of the skin's. And of a box
turned by 17 degrees the worst by the distance from its edge.
"""

from pathlib import Path

import numpy as np

from benchmarks.shared import versions
from puncture_twin.planning.anatomy.body.body_mask import ct_image
from puncture_twin.planning.anatomy.skin import skin_from_label, skin_of_image
from puncture_twin.planning.formats.labels.labelmaps import LabelMap
from puncture_twin.planning.formats.volumes.volume_files import Volume
from puncture_twin.planning.geometry.mesh import blended_normals, smooth_normals

SIZE_MM, SLAB_MM = np.array([350.0, 240.0, 200.0]), 60.0
SHAPES = {"elliptic cylinder": np.array([165.0, 108.0, np.inf]), "ellipsoid": np.array([165.0, 108.0, 90.0])}
VOXELS = ((1.0, 1.0, 1.0), (2.0, 2.0, 2.0), (3.0, 3.0, 3.0), (0.8, 0.8, 5.0))
BOX, TURNED, EDGES_MM = np.array([110.0, 80.0, 80.0]), np.radians(17.0), (2, 5, 10, 15, 20)


def grid(voxel):
    """Centres of voxels (nx, ny, nz, 3), LPS mm, off the middle by part of one; and T_ct_index."""
    count, T = np.ceil(SIZE_MM / voxel).astype(int), np.diag([*voxel, 1.0])
    T[:3, 3] = 0.3 - (count - 1) / 2 * voxel
    return np.moveaxis(np.indices(count), 0, -1) * voxel + T[:3, 3], T


def inside_mm(points, half):
    """Depth below an ellipsoid's surface, mm, to first order: exact where it is 0."""
    level = np.sqrt((points**2 / half**2).sum(axis=-1))
    return (1.0 - level) * level / np.maximum(np.sqrt((points**2 / half**4).sum(axis=-1)), 1e-12)


def skin_of(depth, T, *, grey):
    """The skin of what has a depth above 0: of a label, or of grey values that mix air and tissue at its surface."""
    if not grey:
        return skin_from_label(LabelMap((depth > 0.0).astype(np.uint8), T, None, Path("shape.nii")), 1)
    hu = -1000.0 + 1040.0 * np.clip(depth / np.diag(T)[:3].mean() + 0.5, 0.0, 1.0)
    return skin_of_image(ct_image(Volume(hu.astype(np.int16), T, Path("shape.nii"))))


def off_deg(skin, faces, true):
    """How far normals at triangles' middles are from the true ones (n, 3), any length: of stairs, and of the skin."""
    corners, middles = skin.mesh.faces[faces], skin.mesh.triangles[faces].mean(axis=1)
    stairs = smooth_normals(skin.mesh, faces, middles)
    ours = blended_normals(skin.mesh.vertices[corners], skin.normals[corners], middles)
    cosines = [(one * true).sum(axis=1) / np.linalg.norm(true, axis=1) for one in (stairs, ours)]
    return np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))


def shape_off_deg(half, voxel, *, grey):
    """`off_deg` of a sampled shape, away from the ends of the image, shape (2, n)."""
    points, T = grid(np.array(voxel))
    skin = skin_of(inside_mm(points, half), T, grey=grey)
    middles = skin.mesh.triangles.mean(axis=1)
    faces = np.flatnonzero(~skin.cut_faces & (np.abs(middles[:, 2]) < SLAB_MM))
    return off_deg(skin, faces, middles[faces] / half**2)


def box_off_deg(voxel):
    """Distance from the edge of a turned box's front, mm (n,), and `off_deg` there (2, n)."""
    points, T = grid(np.array(voxel))
    R = np.array([[np.cos(TURNED), np.sin(TURNED), 0.0], [-np.sin(TURNED), np.cos(TURNED), 0.0], [0.0, 0.0, 1.0]])
    skin = skin_of((BOX - np.abs(points @ R.T)).min(axis=-1), T, grey=False)
    own = skin.mesh.triangles.mean(axis=1) @ R.T
    faces = np.flatnonzero((own[:, 1] > BOX[1] - max(voxel)) & (np.abs(own[:, 2]) < SLAB_MM - 20.0))
    return BOX[0] - np.abs(own[faces, 0]), off_deg(skin, faces, np.broadcast_to(R[1], (len(faces), 3)))


def main():
    """Print both tables."""
    print("| shape | voxels, mm | from | stairs | skin |\n|---|---|---|---|---|")
    for name, half in SHAPES.items():
        for voxel in VOXELS:
            for grey in (False, True):
                figures = [np.percentile(one, (50, 95, 100)) for one in shape_off_deg(half, voxel, grey=grey)]
                said = [" / ".join(f"{value:.1f}" for value in three) for three in figures]
                size = " x ".join(f"{edge:g}" for edge in voxel)
                print(f"| {name} | {size} | {'grey values' if grey else 'label'} | {said[0]} | {said[1]} |", flush=True)
    away, (_, ours) = box_off_deg((2.0, 2.0, 2.0))
    worst = [f"{ours[np.abs(away - at) < 1.0].max():.0f} at {at} mm" for at in EDGES_MM]
    print(f"\nBox, label of 2 mm, the worst at a distance from its edge: {', '.join(worst)}\n{versions()}")


if __name__ == "__main__":
    main()
