"""What a structure is made of where the case does not say: Hounsfield units of an unenhanced CT, by name.

Air, fat, water, blood, liver, spleen and kidney lie in the ranges of Buzug, Computed Tomography, Springer 2008, p. 475
(as quoted in other tables, not read there); lung between inspiration and expiration. The rest is declared as ours.
"""

from __future__ import annotations

from types import MappingProxyType

from puncture_twin.planning.anatomy.default_roles import default_role

METAL_HU = 8000.0
"""Steel and titanium lie beyond what 12 bits hold; how far is declared as ours."""
SOFT_TISSUE_HU = 20.0
"""What fills the skin between the structures: fat and muscle, mixed; ours. Also of a name that no line knows."""
SHELL_HU, FOAM_HU, SHELL_MM = 60.0, -930.0, 3.0
"""Of a table, and of every obstacle in the CT's frame: a shell so thick about foam; ours."""

HU_OF_GROUP = MappingProxyType(
    {
        "vertebrae, spine": 300.0,  # ours: cancellous bone in a thin shell, mixed
        "ribs": 500.0,  # ours
        "costal cartilages, sternum": 130.0,  # ours
        "pelvis": 400.0,  # ours
        "limbs and girdles": 700.0,
        "skull and face": 900.0,
        "spinal cord": 35.0,  # as grey and white matter
        "brain": 35.0,
        "aorta and venae cavae": 45.0,
        "great vessels of the chest and neck": 45.0,
        "portal vein": 45.0,
        "iliac vessels": 45.0,
        "other vessels": 45.0,
        "heart": 45.0,
        "lungs": -800.0,
        "airways": -1000.0,
        "gallbladder and bile ducts": 8.0,  # ours: nearly water
        "urinary bladder and ureters": 5.0,  # ours
        "ventricles of the brain": 8.0,  # ours
        "stomach and bowel": 25.0,  # ours: filled with fluid, no gas
        "liver": 58.0,
        "spleen": 48.0,
        "kidneys": 32.0,
        "pancreas": 38.0,  # ours
        "muscles": 55.0,  # ours
        "fat, breast": -90.0,
        "lesion": 25.0,  # ours: darker than liver
        "devices": METAL_HU,
    }
)
"""By group of the table of default roles (`planning.anatomy.default_roles`)."""

OF_NAME = MappingProxyType({"bolt": METAL_HU, "unnamed_dense": 700.0, "unnamed_gas": -1000.0})
"""By the beginning of a name, before the groups."""


def default_hu(name: str, region: str) -> float:
    """Hounsfield units of a structure by its name.

    Args:
        name: In any spelling.
        region: As the case states it.
    """
    for start, hu in OF_NAME.items():
        if name.lower().startswith(start):
            return hu
    line = default_role(name, region)
    return SOFT_TISSUE_HU if line is None else HU_OF_GROUP.get(line.group, SOFT_TISSUE_HU)
