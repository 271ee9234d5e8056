"""A scan as DICOM, one CT Image a file (PS3.3, A.3 and C.8.2), or NIfTI-1 (nifti1.h, DFWG 2003), sform in RAS."""

import gzip
import hashlib
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydicom.dataset import FileDataset, FileMetaDataset
from pydicom.uid import UID, CTImageStorage, ExplicitVRLittleEndian

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.formats.volumes.nifti_header import FIRST_VOXEL_BYTE, LPS_FROM_RAS, TYPES
from puncture_twin.twin.plant.scanner.image import CtImage, ScanSettings

DECIMAL_STRING = 16
"""Characters of a DS at most."""


def write_series(folder: Path, image: CtImage, settings: ScanSettings, identity: str, name: str) -> list[Path]:
    """Write a series into a new folder; the same ``identity`` gives the same identifiers, any other gives others."""
    folder.mkdir(parents=True, exist_ok=True)
    T = image.grid.T_ct_index
    spacing = image.grid.spacing_mm
    axes = T[:3, :3] / spacing
    files = []
    for k in range(image.grid.shape[2]):
        data = _image(identity, k, name, image.hu[:, :, k].T)
        data.ImageOrientationPatient = _decimals(axes[:, :2].T)
        data.ImagePositionPatient = _decimals(T[:3, 3] + k * T[:3, 2])
        data.PixelSpacing = _decimals(spacing[[1, 0]])
        data.SliceThickness = data.SpacingBetweenSlices = _decimals(spacing[2:])[0]
        data.SliceLocation = _decimals((T[:3, 3] + k * T[:3, 2]) @ axes[:, 2])[0]
        data.InstanceNumber = k + 1
        data.SeriesDescription = f"virtual CT {settings.spacing_mm:g} mm"
        path = folder / f"IM{k + 1:04d}.dcm"
        data.save_as(path, enforce_file_format=True)
        files.append(path)
    return files


def uid(*parts: object) -> UID:
    """An identifier of 128 bits of a hash, below the root for UUIDs (DICOM PS3.5, B.2)."""
    digest = hashlib.sha256("\n".join(map(str, parts)).encode()).hexdigest()
    return UID(f"2.25.{int(digest[:32], 16)}")


def _image(identity: str, k: int, name: str, rows: NDArray[np.int16]) -> FileDataset:
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = CTImageStorage
    meta.MediaStorageSOPInstanceUID = uid(identity, "image", k)
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    data = FileDataset("", {}, file_meta=meta, preamble=b"\0" * 128)
    data.SOPClassUID, data.SOPInstanceUID = CTImageStorage, meta.MediaStorageSOPInstanceUID
    data.StudyInstanceUID, data.SeriesInstanceUID = uid(identity, "study"), uid(identity, "series")
    data.FrameOfReferenceUID = uid(identity, "frame of reference")
    if not name.isascii():
        data.SpecificCharacterSet = "ISO_IR 192"
    data.PatientName, data.PatientID, data.Modality = name[:64], name[:64], "CT"
    for keyword in (
        *("StudyDate", "StudyTime", "ReferringPhysicianName", "StudyID", "AccessionNumber", "PatientBirthDate"),
        *("PatientSex", "Manufacturer", "PositionReferenceIndicator", "AcquisitionNumber", "KVP"),
    ):
        setattr(data, keyword, None)
    data.SeriesNumber, data.PatientPosition = 1, "HFS"
    data.ImageType = ["ORIGINAL", "PRIMARY", "AXIAL"]
    data.ImageComments = "simulated by puncture-twin: no patient"
    data.Rows, data.Columns = rows.shape
    data.SamplesPerPixel, data.PhotometricInterpretation = 1, "MONOCHROME2"
    data.BitsAllocated, data.BitsStored, data.HighBit, data.PixelRepresentation = 16, 16, 15, 1
    data.RescaleSlope, data.RescaleIntercept, data.RescaleType = "1", "0", "HU"
    data.WindowCenter, data.WindowWidth = "40", "400"
    data.PixelData = np.ascontiguousarray(rows).astype("<i2", copy=False).tobytes()
    return data


def _decimals(numbers: Floats) -> list[str]:
    texts = ([f"{number + 0.0:.{digits}g}" for digits in range(15, 4, -1)] for number in np.ravel(numbers).tolist())
    return [next(text for text in those if len(text) <= DECIMAL_STRING) for those in texts]


CODE_OF_TYPE = {name: code for code, name in TYPES.items()}
MM = 2
"""``xyzt_units``."""
SCANNER = 1
"""``sform_code``: the scanner's own coordinates."""
FAST = 1
"""Level of gzip: noise does not get smaller by trying harder."""


def write_nifti(path: Path, values: NDArray[Any], T_ct_index: Floats) -> Path:
    """Write a ``.nii.gz`` of whole numbers or floats (ni, nj, nk); T_ct_index (4, 4), LPS mm, in single precision."""
    code = CODE_OF_TYPE[values.dtype.str[1:]]
    header = bytearray(FIRST_VOXEL_BYTE)
    struct.pack_into("<i", header, 0, 348)
    struct.pack_into("<8h", header, 40, 3, *values.shape, 1, 1, 1, 1)
    struct.pack_into("<2h", header, 70, code, 8 * values.dtype.itemsize)
    spacing = np.linalg.norm(T_ct_index[:3, :3], axis=0)
    struct.pack_into("<8f", header, 76, 1.0, *spacing, 0.0, 0.0, 0.0, 0.0)
    struct.pack_into("<f", header, 108, FIRST_VOXEL_BYTE)
    struct.pack_into("<2f", header, 112, 1.0, 0.0)
    header[123] = MM
    struct.pack_into("<2h", header, 252, 0, SCANNER)
    struct.pack_into("<12f", header, 280, *(LPS_FROM_RAS * T_ct_index)[:3].ravel())
    header[344:348] = b"n+1\0"
    with path.open("wb") as raw, gzip.GzipFile("", "wb", FAST, raw, mtime=0) as packed:
        packed.write(bytes(header))
        packed.write(np.ascontiguousarray(values.T).astype(values.dtype.newbyteorder("<"), copy=False).data)
    return path
