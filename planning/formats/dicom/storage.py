"""Recognition of DICOM bytes, and the kind of a file by its SOP class: not by its name or its modality.

Unique identifiers from DICOM PS3.4 (2024), table B.5-1, and PS3.6, table A-1.
"""

from enum import StrEnum
from pathlib import Path

from puncture_twin.planning.base.files import is_folder, is_plain_file
from puncture_twin.planning.formats.volumes.volume_files import NIFTI_ENDINGS, NRRD_ENDINGS

PREAMBLE_BYTES, MAGIC = 128, b"DICM"
META_START = PREAMBLE_BYTES + len(MAGIC)


class Kind(StrEnum):
    """Kind of a DICOM file, by how this project treats it."""

    CT = "CT"
    SEGMENTATION = "SEG"
    STRUCTURE_SET = "RTSTRUCT"
    OTHER = "other"


CLASSIC_CT = "1.2.840.10008.5.1.4.1.1.2"
ENHANCED_CT = ("1.2.840.10008.5.1.4.1.1.2.1", "1.2.840.10008.5.1.4.1.1.2.2")
"""Enhanced CT Image Storage, and Legacy Converted Enhanced CT Image Storage."""
SEGMENTATION = "1.2.840.10008.5.1.4.1.1.66.4"
STRUCTURE_SET = "1.2.840.10008.5.1.4.1.1.481.3"
_KINDS = {
    CLASSIC_CT: Kind.CT,
    **dict.fromkeys(ENHANCED_CT, Kind.CT),
    SEGMENTATION: Kind.SEGMENTATION,
    STRUCTURE_SET: Kind.STRUCTURE_SET,
}
IMPLICIT = "1.2.840.10008.1.2"
EXPLICIT = "1.2.840.10008.1.2.1"
DEFLATED = "1.2.840.10008.1.2.1.99"
BIG_ENDIAN = "1.2.840.10008.1.2.2"
PLAIN = (IMPLICIT, EXPLICIT)
"""Transfer syntaxes whose pixels are stored as they are."""
NOT_READ = (BIG_ENDIAN, DEFLATED)
"""Transfer syntaxes of which not even a header is read."""


def kind_of(sop_class: str) -> Kind:
    """Kind of a file of this SOP class."""
    return _KINDS.get(sop_class, Kind.OTHER)


def is_dicom(start: bytes) -> bool:
    """Whether a file that begins so is DICOM: ``DICM`` follows a preamble of 128 bytes."""
    return start[PREAMBLE_BYTES:META_START] == MAGIC


def is_series(path: Path) -> bool:
    """Whether a path is to be read as a CT series: a folder, or a DICOM file of any name but a volume's."""
    return is_folder(path) or (not path.name.lower().endswith(NIFTI_ENDINGS + NRRD_ENDINGS) and is_dicom_file(path))


def is_dicom_file(path: Path) -> bool:
    """Whether a path leads to a DICOM file that can be opened."""
    if not is_plain_file(path):
        return False
    try:
        with path.open("rb") as stream:
            return is_dicom(stream.read(META_START))
    except OSError:  # whoever reads it says why
        return False
