"""The one maker of cases for tests: a case's text from its parts, and the files that it names.

The usual patient is a round body about the origin, whose target is an organ in the middle; in front of it lie a rib
and, in a label map, a vessel.
"""

import json
import re
import shutil

import numpy as np
import SimpleITK
import trimesh

from puncture_twin.meshes import folder
from puncture_twin.planning.anatomy.body.body_mask import ct_image
from puncture_twin.planning.anatomy.body.cut_ends import cut_ends
from puncture_twin.planning.anatomy.skin import skin_of_image

HEAD = """schema = 2
region = "{region}"
name = "{name}"
space = "{space}"
[target]
{target}
[needle]
{needle}
[search]
{search}
"""
TARGET = 'position_mm = [0.0, 0.0, 0.0]\nstructure = "organ"'
NEEDLE = "length_mm = 210.0\nshaft_mm = 150.0\ndiameter_mm = 1.2"
SEARCH = "theta_deg = [0, 10]\nstep_deg = 10.0"


def case_text(
    *sections, name="small", region="other", space="LPS", target=TARGET, needle=NEEDLE, search=SEARCH, listed=0
):
    """A case file: its head with these lines, its sections, and their count; `listed` as for `whole`."""
    head = HEAD.format(region=region, name=name, space=space, target=target, needle=needle, search=search)
    return whole(head + "".join(sections), listed)


def whole(text, listed=0):
    """A case file that ends with the count of its structures, of which so many are named by ``[[structures]]``."""
    rest = re.sub(r"\[end\]\nstructures = \d+\n", "", text).rstrip("\n")
    count = sum(line == "[[structure]]" for line in rest.split("\n")) + listed
    return f"{rest}\n[end]\nstructures = {count}\n"


def structure(name, role, source=None, **keys):
    """A section of one structure.

    Args:
        name: Its name.
        role: Its role.
        source: Where its surface comes from; by default a mesh of its name, an STL in mm.
        keys: What else is stated.
    """
    values = {"name": name, **(source or {"mesh": f"{name}.stl", "unit": "mm"}), "role": role, **keys}
    return "[[structure]]\n" + "".join(f"{key} = {json.dumps(value)}\n" for key, value in values.items())


def registration_section(*more):
    """The section that names the two lists of markers, with further lines."""
    return "\n".join(
        ["[registration]", 'markers_ct = "markers_ct.csv"', 'markers_base = "touch.csv"', *filter(None, more), ""]
    )


SKIN = structure("skin", "skin")
ORGAN = structure("organ", "target")
CASE = case_text(
    registration_section(),
    SKIN,
    ORGAN,
    structure("rib", "avoid", margin_mm=3.0),
    structure("vessel", "avoid", {"labelmap": "labels.nrrd", "label": 3}, margin_mm=3.0),
)
BALLS = {"skin": (90.0, (0, 0, 0)), "organ": (20.0, (0, 0, 0)), "rib": (5.0, (40, 0, 40))}
"""Radius and centre of the usual patient's meshes, mm."""
MARKERS = "name,x_mm,y_mm,z_mm\nA,0,0,80\nB,50,0,75\nC,0,60,70\nD,-40,-30,72\n"


def changed(text, *changes):
    """A text with (old, new) replaced, each once."""
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new, 1)
    return text


def ball(path, radius=10.0, center=(0, 0, 0)):
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    mesh.apply_translation(center)
    mesh.export(path)


def write_balls(folder, *names, ending="stl"):
    """The meshes of the usual patient: those that are named, or all."""
    for name in names or BALLS:
        ball(folder / f"{name}.{ending}", *BALLS[name])


def write_markers(folder, ct=MARKERS, base=MARKERS):
    (folder / "markers_ct.csv").write_text(ct)
    (folder / "touch.csv").write_text(base)


def points_file(points, names="ABCDEFGH"):
    rows = [",".join([name, *(f"{x:.3f}" for x in point)]) for name, point in zip(names, points, strict=False)]
    return "\n".join(["name,x_mm,y_mm,z_mm", *rows]) + "\n"


def image_of(voxels_zyx, spacing=(2.0, 2.0, 2.0)):
    """An image about the origin, 200 mm wide, from values with the slices first."""
    image = SimpleITK.GetImageFromArray(voxels_zyx)
    image.SetSpacing(spacing)
    image.SetOrigin([-100 + one / 2 for one in spacing])
    return image


def vessel_voxels(spacing=(2.0, 2.0, 2.0)):
    """The usual patient's vessel, label 3, in front of the organ: voxels (z, y, x)."""
    shape = [round(200 / one) for one in spacing[::-1]]
    z, y, x = (np.arange(n) * s - 100 + s / 2 for n, s in zip(shape, spacing[::-1], strict=True))
    labels = np.zeros(shape, np.uint8)
    labels[np.ix_(np.abs(z) < 20, np.abs(y - 36) < 4, np.abs(x - 36) < 4)] = 3
    return labels


def write_labels(path, labels=None, spacing=(2.0, 2.0, 2.0), compressed=True):
    """A label map about the origin, 200 mm wide; a vessel with label 3 by default."""
    image = image_of(vessel_voxels(spacing) if labels is None else labels, spacing)
    SimpleITK.WriteImage(image, path, useCompression=compressed)


def write_case(folder, *changes, text=CASE, labels=None, spacing=(2.0, 2.0, 2.0), listed=0):
    """Write the usual patient's case, with (old, new) changes to its text, and its count; returns its file.

    Args:
        folder: Where.
        changes: Pairs of strings, each replaced once.
        text: The case file.
        labels: Voxels (z, y, x); a vessel with label 3 by default.
        spacing: Of the label map, mm, along x, y and z.
        listed: See `whole`; None leaves the count as the text has it.
    """
    write_balls(folder)
    write_labels(folder / "labels.nrrd", labels, spacing, compressed=False)
    write_markers(folder)
    said = changed(text, *changes)
    (folder / "case.toml").write_text(said if listed is None else whole(said, listed))
    return folder / "case.toml"


def coarse_carton(here, step_deg=12.0):
    """The embedded carton, copied into a folder that is not there yet, with a coarser grid; its case file.

    The needle goes in at 40 mm/s: a plan has a quarter of the states, which are all checked, and a rehearsal of the
    steps.
    """
    shutil.copytree(folder() / "carton", here)
    case = here / "case_m.toml"
    coarser = ("step_deg = 2.0", f"step_deg = {step_deg}")
    case.write_text(changed(case.read_text(), coarser, ("[robot]\n", "[robot]\ninsertion_speed_mm_s = 40.0\n")))
    return case


def skin_from_ct(volume):
    """The skin of a CT, as far as the CT alone says where it was cut."""
    image = ct_image(volume)
    content = image.content
    return skin_of_image(image.within(content.box(cut_ends(content, (), whole=False))))
