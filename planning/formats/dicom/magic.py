"""Whether a path is to be read as DICOM, told without the library: that takes a while to load, few cases need it."""

from __future__ import annotations

from pathlib import Path

from puncture_twin.planning.base.files import is_folder, is_plain_file
from puncture_twin.planning.formats.volumes.volume_files import NIFTI_ENDINGS, NRRD_ENDINGS

PREAMBLE_BYTES, MAGIC = 128, b"DICM"
META_START = PREAMBLE_BYTES + len(MAGIC)


def is_dicom(start: bytes) -> bool:
    """Whether a file that begins so is DICOM: ``DICM`` stands behind a preamble of 128 bytes."""
    return start[PREAMBLE_BYTES:META_START] == MAGIC


def is_series(path: Path) -> bool:
    """Whether a path is to be read as a CT series: a folder, or a DICOM file of any name but a volume's."""
    if is_folder(path):
        return True
    if not is_plain_file(path) or path.name.lower().endswith(NIFTI_ENDINGS + NRRD_ENDINGS):
        return False
    try:
        with path.open("rb") as stream:
            return is_dicom(stream.read(META_START))
    except OSError:  # whoever reads it says why
        return False
