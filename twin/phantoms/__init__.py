"""Bodies with known truth: the carton of Chen 2019 and an abdomen of our own."""

from twin.phantoms.abdomen import STRUCTURES, abdomen_field, abdomen_mesh, lesion_centre_ct
from twin.phantoms.carton import carton_field, carton_meshes
from twin.phantoms.guidance import abdomen_guidance, patient_placement, skin_markers_ct
from twin.phantoms.manifest import write_phantoms

__all__ = [
    "STRUCTURES",
    "abdomen_field",
    "abdomen_guidance",
    "abdomen_mesh",
    "carton_field",
    "carton_meshes",
    "lesion_centre_ct",
    "patient_placement",
    "skin_markers_ct",
    "write_phantoms",
]
