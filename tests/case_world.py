"""A small case on disk: a round body with an organ, a rib and a vessel from a label map."""

import numpy as np
import SimpleITK
import trimesh

CASE = """schema = 1
name = "small"
space = "LPS"
[target]
position_mm = [0.0, 0.0, 0.0]
structure = "organ"
[needle]
length_mm = 210.0
shaft_mm = 150.0
diameter_mm = 1.2
[search]
theta_deg = [0, 10]
step_deg = 10.0
[registration]
markers_ct = "markers_ct.csv"
markers_base = "touch.csv"
[[structure]]
name = "skin"
mesh = "skin.stl"
unit = "mm"
role = "skin"
[[structure]]
name = "organ"
mesh = "organ.stl"
unit = "mm"
role = "target"
[[structure]]
name = "rib"
mesh = "rib.stl"
unit = "mm"
role = "avoid"
margin_mm = 3.0
[[structure]]
name = "vessel"
labelmap = "labels.nrrd"
label = 3
role = "avoid"
margin_mm = 3.0
"""

MARKERS = "name,x_mm,y_mm,z_mm\nA,0,0,80\nB,50,0,75\nC,0,60,70\nD,-40,-30,72\n"


def write_case(folder, *changes, text=CASE, labels=None, spacing=(2.0, 2.0, 2.0)):
    """Write the case, with (old, new) changes to its text; returns its file.

    Args:
        folder: Where.
        changes: Pairs of strings, each replaced once.
        text: The case file.
        labels: Voxels (z, y, x); a vessel with label 3 by default.
        spacing: Of the label map, mm, along x, y and z.
    """
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new, 1)
    for name, radius, centre in (("skin", 90, (0, 0, 0)), ("organ", 20, (0, 0, 0)), ("rib", 5, (40, 0, 40))):
        mesh = trimesh.creation.icosphere(subdivisions=2, radius=radius)
        mesh.apply_translation(centre)
        mesh.export(folder / f"{name}.stl")
    write_labels(folder / "labels.nrrd", labels, spacing)
    (folder / "markers_ct.csv").write_text(MARKERS)
    (folder / "touch.csv").write_text(MARKERS)
    (folder / "case.toml").write_text(text)
    return folder / "case.toml"


def write_labels(path, labels=None, spacing=(2.0, 2.0, 2.0)):
    """A label map about the origin, 200 mm wide; a vessel with label 3 by default."""
    if labels is None:
        shape = [round(200 / one) for one in spacing[::-1]]
        z, y, x = (np.arange(n) * s - 100 + s / 2 for n, s in zip(shape, spacing[::-1], strict=True))
        labels = np.zeros(shape, np.uint8)
        labels[np.ix_(np.abs(z) < 20, np.abs(y - 36) < 4, np.abs(x - 36) < 4)] = 3
    image = SimpleITK.GetImageFromArray(labels)
    image.SetSpacing(spacing)
    image.SetOrigin([-100 + one / 2 for one in spacing])
    SimpleITK.WriteImage(image, path)
