"""The trunk of benchmarks.placements as a case on disk: a CT, and a label map that a slip has moved."""

import numpy as np

from benchmarks.placements import phantoms
from puncture_twin.twin.plant.scanner.writers import write_nifti

PHANTOMS = dict(phantoms())

CASE = """schema = 2
region = "{region}"
name = "trunk"
space = "LPS"
[target]
position_mm = [-68.0, -12.0, 12.0]
structure = "lesion"
[needle]
length_mm = 200.0
shaft_mm = 150.0
diameter_mm = 1.2
[search]
theta_deg = [0, 60]
step_deg = 10.0
{more}
[[structure]]
name = "skin"
ct = "ct.nii.gz"
role = "skin"
[[structure]]
name = "lesion"
labelmap = "labels.nii.gz"
label = 6
role = "target"
"""
ORGANS = {"liver": 1, "spleen": 2, "kidney_right": 3, "kidney_left": 4, "colon": 5, "aorta": 7, "vertebrae": 8}


def write_trunk(folder, T_slip, more="", region="abdomen"):
    """The phantom's CT, and its labels at a map's grid that was moved by a slip (4, 4)."""
    patient = PHANTOMS["trunk"]
    write_nifti(folder / "ct.nii.gz", patient.hu.astype(np.int16), patient.T)
    write_nifti(folder / "labels.nii.gz", patient.labels.astype(np.uint8), T_slip @ patient.T)
    rows = [
        f'[[structure]]\nname = "{name}"\nlabelmap = "labels.nii.gz"\nlabel = {label}\n'
        + ('role = "traverse"\n' if name == "liver" else 'role = "avoid"\nmargin_mm = 2.0\n')
        for name, label in ORGANS.items()
    ]
    (folder / "case.toml").write_text(CASE.format(more=more, region=region) + "".join(rows) + "[end]\nstructures = 9\n")
    return folder / "case.toml"


def moved(x=0.0, y=0.0, z=0.0):
    T = np.eye(4)
    T[:3, 3] = (x, y, z)
    return T
