"""Class numbers of TotalSegmentator's main task, versions 1 (104 classes) and 2 (117 classes).

Facts from its ``map_to_binary.py`` (``total_v1`` and ``total``), Wasserthal et al., Radiology: Artificial
Intelligence 2023;5(5):e230024. The versions number organs differently: the aorta is 7 or 52.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

_ABDOMEN = "spleen kidney_right kidney_left gallbladder liver stomach"
_LUNGS = "lung_upper_lobe_left lung_lower_lobe_left lung_upper_lobe_right lung_middle_lobe_right lung_lower_lobe_right"
_SPINE = " ".join(f"vertebrae_{part}{n}" for part, last in (("L", 5), ("T", 12), ("C", 7)) for n in range(last, 0, -1))
_RIBS = " ".join(f"rib_{side}_{n}" for side in ("left", "right") for n in range(1, 13))
_ILIAC = "iliac_artery_left iliac_artery_right iliac_vena_left iliac_vena_right"
_SHOULDERS = "humerus_left humerus_right scapula_left scapula_right clavicula_left clavicula_right"
_HIPS = "femur_left femur_right hip_left hip_right"
_GLUTEUS = " ".join(f"gluteus_{part}_{side}" for part in ("maximus", "medius", "minimus") for side in ("left", "right"))
_BACK = "autochthon_left autochthon_right iliopsoas_left iliopsoas_right"


def _numbered(*groups: str) -> Mapping[int, str]:
    return MappingProxyType(dict(enumerate(" ".join(groups).split(), start=1)))


V1: Mapping[int, str] = _numbered(
    _ABDOMEN,
    "aorta inferior_vena_cava portal_vein_and_splenic_vein pancreas adrenal_gland_right adrenal_gland_left",
    _LUNGS,
    _SPINE,
    "esophagus trachea heart_myocardium heart_atrium_left heart_ventricle_left heart_atrium_right",
    "heart_ventricle_right pulmonary_artery brain",
    _ILIAC,
    "small_bowel duodenum colon",
    _RIBS,
    _SHOULDERS,
    _HIPS,
    "sacrum face",
    _GLUTEUS,
    _BACK,
    "urinary_bladder",
)
"""Version 1."""

V2: Mapping[int, str] = _numbered(
    _ABDOMEN,
    "pancreas adrenal_gland_right adrenal_gland_left",
    _LUNGS,
    "esophagus trachea thyroid_gland small_bowel duodenum colon urinary_bladder prostate",
    "kidney_cyst_left kidney_cyst_right sacrum vertebrae_S1",
    _SPINE,
    "heart aorta pulmonary_vein brachiocephalic_trunk subclavian_artery_right subclavian_artery_left",
    "common_carotid_artery_right common_carotid_artery_left brachiocephalic_vein_left brachiocephalic_vein_right",
    "atrial_appendage_left superior_vena_cava inferior_vena_cava portal_vein_and_splenic_vein",
    _ILIAC,
    _SHOULDERS,
    _HIPS,
    "spinal_cord",
    _GLUTEUS,
    _BACK,
    "brain skull",
    _RIBS,
    "sternum costal_cartilages",
)
"""Version 2, task ``total``."""
