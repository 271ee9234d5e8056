"""The trunk of benchmarks.placements as a case on disk: a CT, and a label map that a slip has moved."""

import numpy as np
from case_world import case_text, structure

from benchmarks.placements import phantoms
from puncture_twin.twin.plant.scanner.writers import write_nifti

PHANTOMS = dict(phantoms())

ORGANS = {"liver": 1, "spleen": 2, "kidney_right": 3, "kidney_left": 4, "colon": 5, "aorta": 7, "vertebrae": 8}


def labelled(name, role, label, **keys):
    return structure(name, role, {"labelmap": "labels.nii.gz", "label": label}, **keys)


PARTS = (
    structure("skin", "skin", {"ct": "ct.nii.gz"}),
    labelled("lesion", "target", 6),
    labelled("liver", "traverse", ORGANS["liver"]),
    *(labelled(name, "avoid", label, margin_mm=2.0) for name, label in ORGANS.items() if name != "liver"),
)


def write_trunk(folder, T_slip, more=""):
    """The phantom's CT, and its labels at a map's grid that was moved by a slip (4, 4)."""
    patient = PHANTOMS["trunk"]
    write_nifti(folder / "ct.nii.gz", patient.hu.astype(np.int16), patient.T)
    write_nifti(folder / "labels.nii.gz", patient.labels.astype(np.uint8), T_slip @ patient.T)
    text = case_text(
        f"{more}\n",
        *PARTS,
        region="abdomen",
        name="trunk",
        target='position_mm = [-68.0, -12.0, 12.0]\nstructure = "lesion"',
        needle="length_mm = 200.0\nshaft_mm = 150.0\ndiameter_mm = 1.2",
        search="theta_deg = [0, 60]\nstep_deg = 10.0",
    )
    (folder / "case.toml").write_text(text)
    return folder / "case.toml"


def moved(x=0.0, y=0.0, z=0.0):
    T = np.eye(4)
    T[:3, 3] = (x, y, z)
    return T
