"""Bodies with known truth: the carton of Chen 2019, an abdomen and an open head of our own."""

from puncture_twin.twin.phantoms.abdomen import STRUCTURES, abdomen_field, abdomen_mesh, lesion_centre_ct
from puncture_twin.twin.phantoms.carton import carton_field, carton_meshes
from puncture_twin.twin.phantoms.guidance import abdomen_guidance, patient_placement, skin_markers_ct
from puncture_twin.twin.phantoms.head import head_field, head_mesh, head_targets
from puncture_twin.twin.phantoms.manifest import write_phantoms

__all__ = [
    "STRUCTURES",
    "abdomen_field",
    "abdomen_guidance",
    "abdomen_mesh",
    "carton_field",
    "carton_meshes",
    "head_field",
    "head_mesh",
    "head_targets",
    "lesion_centre_ct",
    "patient_placement",
    "skin_markers_ct",
    "write_phantoms",
]
