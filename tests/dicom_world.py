"""DICOM files written by pydicom from known arrays: series, multi-frame images, segmentations, structure sets."""

import io
from pathlib import Path

import numpy as np
from PIL import Image
from pydicom.dataset import Dataset, FileDataset, FileMetaDataset
from pydicom.encaps import encapsulate
from pydicom.sequence import Sequence
from pydicom.uid import UID, ExplicitVRLittleEndian, JPEGBaseline8Bit, RLELossless

CT_CLASS = "1.2.840.10008.5.1.4.1.1.2"
ENHANCED_CLASS = "1.2.840.10008.5.1.4.1.1.2.1"
SEG_CLASS = "1.2.840.10008.5.1.4.1.1.66.4"
RT_CLASS = "1.2.840.10008.5.1.4.1.1.481.3"
ULTRASOUND_CLASS = "1.2.840.10008.5.1.4.1.1.3.1"
CAPTURE_CLASS = "1.2.840.10008.5.1.4.1.1.7"
ROOT = "1.2.826.0.1.3680043.8.498.7."
STUDY, SERIES, FRAME = ROOT + "1", ROOT + "2", ROOT + "3"
SHAPE = (7, 5, 4)
"""Columns, rows, slices of the phantom."""
SPACING = (0.7, 0.9)
"""Between columns, between rows."""
ORIGIN = (-101.5, 33.0, 812.25)


def phantom(shape=SHAPE):
    """Stored values, (columns, rows, slices), each another: no flip and no swap maps it to itself."""
    return np.arange(np.prod(shape), dtype=np.int16).reshape(shape) * 3 + 11


def rotation(angle=0.0, about=(0, 1)):
    """Axes of rows, columns and normal, turned in the plane of two of the patient's axes."""
    R = np.eye(3)
    i, j = about
    R[i, i] = R[j, j] = np.cos(angle)
    R[i, j], R[j, i] = -np.sin(angle), np.sin(angle)
    return R


def affine(axes=None, step=(0.0, 0.0, 2.5), spacing=SPACING, origin=ORIGIN):
    """Index (column, row, slice) to LPS mm, from what each slice states; the oracle of every test of places."""
    axes = np.eye(3) if axes is None else axes
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2], T[:3, 3] = axes[:, 0] * spacing[0], axes[:, 1] * spacing[1], step, origin
    return T


def ds(numbers):
    """Decimal strings of at most 16 characters."""
    return [f"{float(number):.12g}"[:16] for number in np.ravel(numbers)]


def base(sop_class, uid, series=SERIES, number=1, description="abdomen 2.5"):
    """What every object has."""
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = sop_class
    meta.MediaStorageSOPInstanceUID = uid
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    data = FileDataset("", {}, file_meta=meta, preamble=b"\0" * 128)
    data.SOPClassUID, data.SOPInstanceUID = sop_class, uid
    data.StudyInstanceUID, data.SeriesInstanceUID, data.FrameOfReferenceUID = STUDY, series, FRAME
    data.SeriesNumber, data.SeriesDescription, data.PatientID = number, description, "phantom"
    data.Modality = {SEG_CLASS: "SEG", RT_CLASS: "RTSTRUCT"}.get(sop_class, "CT")
    return data


def image(data, stored, bits=16, signed=True):
    """The pixels, shape (columns, rows) or (columns, rows, frames)."""
    data.Columns, data.Rows = stored.shape[:2]
    data.SamplesPerPixel, data.PhotometricInterpretation = 1, "MONOCHROME2"
    data.BitsAllocated, data.BitsStored, data.HighBit, data.PixelRepresentation = 16, bits, bits - 1, int(signed)
    data.PixelData = stored.T.astype("<i2" if signed else "<u2").tobytes()
    return data


def ct_slice(stored, T, k=0, number=None, **more):
    """One classic slice at its place in a stack of affine ``T``."""
    data = base(CT_CLASS, f"{ROOT}100.{number or k}", **more)
    data.ImageType = ["ORIGINAL", "PRIMARY", "AXIAL"]
    spacing = np.linalg.norm(T[:3, :2], axis=0)
    data.PixelSpacing = ds(spacing[::-1])
    data.ImageOrientationPatient = ds((T[:3, :2] / spacing).T)
    data.ImagePositionPatient = ds((T @ [0, 0, k, 1])[:3])
    data.InstanceNumber = number or k
    data.RescaleSlope, data.RescaleIntercept, data.RescaleType = "1", "-1024", "HU"
    return image(data, stored)


def series(values=None, T=None, **more):
    values, T = phantom() if values is None else values, affine() if T is None else T
    return [ct_slice(values[:, :, k], T, k, **more) for k in range(values.shape[2])]


def enhanced(values=None, T=None):
    """The same as one multi-frame file."""
    values, T = phantom() if values is None else values, affine() if T is None else T
    data = base(ENHANCED_CLASS, ROOT + "200")
    data.ImageType = ["ORIGINAL", "PRIMARY", "VOLUME", "NONE"]
    spacing = np.linalg.norm(T[:3, :2], axis=0)
    shared = Dataset()
    shared.PixelMeasuresSequence = [item(PixelSpacing=ds(spacing[::-1]), SliceThickness="2.5")]
    shared.PlaneOrientationSequence = [item(ImageOrientationPatient=ds((T[:3, :2] / spacing).T))]
    rescale = item(RescaleSlope="1", RescaleIntercept="-1024", RescaleType="HU")
    shared.PixelValueTransformationSequence = [rescale]
    data.SharedFunctionalGroupsSequence = [shared]
    frames = []
    for k in range(values.shape[2]):
        place = item(ImagePositionPatient=ds((T @ [0, 0, k, 1])[:3]))
        kind = item(FrameType=["ORIGINAL", "PRIMARY", "VOLUME", "NONE"])
        frames.append(item(PlanePositionSequence=[place], CTImageFrameTypeSequence=[kind]))
    data.PerFrameFunctionalGroupsSequence = frames
    data.NumberOfFrames = values.shape[2]
    return image(data, values)


def item(**values):
    made = Dataset()
    for keyword, value in values.items():
        setattr(made, keyword, Sequence(value) if isinstance(value, list) and isinstance(value[0], Dataset) else value)
    return made


def write(data, path, syntax=None):
    if syntax is not None:
        data.file_meta.TransferSyntaxUID = UID(syntax)
    data.save_as(path, enforce_file_format=True)
    return path


def write_series(folder, slices, names=None):
    """A folder of slices, whose names say nothing of their order."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for number, one in enumerate(slices):
        write(one, folder / (names[number] if names else f"IM{(number * 7919) % 1000:04d}_{number}"))
    return folder


def segmentation(masks, T, step="2.5", fractional=None, omit=True):
    """A SEG of named masks (columns, rows, slices), each in as many frames as are not empty.

    ``fractional``: values of 0 to 200 instead of masks, whose half is 100.
    """
    data = base(SEG_CLASS, ROOT + "300", series=ROOT + "30", description="segments")
    spacing = np.linalg.norm(T[:3, :2], axis=0)
    shared = Dataset()
    measures = item(PixelSpacing=ds(spacing[::-1]), SliceThickness="2.5")
    if step:
        measures.SpacingBetweenSlices = step
    shared.PixelMeasuresSequence = [measures]
    shared.PlaneOrientationSequence = [item(ImageOrientationPatient=ds((T[:3, :2] / spacing).T))]
    data.SharedFunctionalGroupsSequence = [shared]
    data.SegmentSequence = [item(SegmentNumber=n, SegmentLabel=name) for n, name in enumerate(masks, start=1)]
    groups, images = [], []
    for number, mask in enumerate(masks.values(), start=1):
        for k in range(mask.shape[2]):
            if omit and not mask[:, :, k].any():
                continue
            place = item(ImagePositionPatient=ds((T @ [0, 0, k, 1])[:3]))
            whose = item(ReferencedSegmentNumber=number)
            groups.append(item(PlanePositionSequence=[place], SegmentIdentificationSequence=[whose]))
            images.append(mask[:, :, k].T)
    data.PerFrameFunctionalGroupsSequence = groups
    data.NumberOfFrames = len(images)
    data.Rows, data.Columns = images[0].shape
    data.SamplesPerPixel, data.PhotometricInterpretation, data.PixelRepresentation = 1, "MONOCHROME2", 0
    bits = 8 if fractional else 1
    data.BitsAllocated, data.BitsStored, data.HighBit = bits, bits, bits - 1
    data.SegmentationType = "FRACTIONAL" if fractional else "BINARY"
    flat = np.concatenate([image.ravel() for image in images]).astype(np.uint8)
    if fractional:
        data.SegmentationFractionalType, data.MaximumFractionalValue = "PROBABILITY", 200
    stored = flat if fractional else np.packbits(flat, bitorder="little")
    data.PixelData = stored.tobytes() + b"\0" * (len(stored) % 2)
    return data


def structure_set(regions, frame=FRAME):
    """An RTSTRUCT: name to contours, each an array (n, 3) in LPS mm, or a pair of its type and the array."""
    data = base(RT_CLASS, ROOT + "400", series=ROOT + "40", description="contours")
    del data.FrameOfReferenceUID
    rows, contours = [], []
    for number, (name, listed) in enumerate(regions.items(), start=1):
        rows.append(item(ROINumber=number, ReferencedFrameOfReferenceUID=frame, ROIName=name))
        drawn = Dataset()
        drawn.ReferencedROINumber = number
        made = []
        for one in listed:
            kind, points = one if isinstance(one, tuple) else ("CLOSED_PLANAR", one)
            made.append(item(ContourGeometricType=kind, NumberOfContourPoints=len(points), ContourData=ds(points)))
        if made:
            drawn.ContourSequence = Sequence(made)
        contours.append(drawn)
    data.StructureSetROISequence, data.ROIContourSequence = Sequence(rows), Sequence(contours)
    return data


def encoded(data, syntax, frames=()):
    """An image in another transfer syntax: RLE by pydicom, JPEG of these frames (rows, columns[, 3]) by Pillow."""
    if syntax == RLELossless:
        data.compress(RLELossless, generate_instance_uid=False)
        return data
    data.file_meta.TransferSyntaxUID = syntax
    streams = []
    for frame in frames:
        kind, more = ("JPEG", {"quality": 95}) if syntax == JPEGBaseline8Bit else ("JPEG2000", {"irreversible": True})
        Image.fromarray(frame).save(stream := io.BytesIO(), kind, **more)
        streams.append(stream.getvalue())
    data.PixelData = encapsulate(streams)
    data["PixelData"].is_undefined_length = True
    return data


def ultrasound(frames, *, delta_cm=None, spacing=None, box=None, **others):
    """A multi-frame ultrasound picture.

    Args:
        frames: Shape (frames, rows, columns), 8 bits; RGB with three channels behind.
        delta_cm: Width and height of a pixel in the region of tissue; None for no region.
        spacing: Of pixels, mm, rows first.
        box: The region's first column, first row, last column and last row.
        others: More elements, or others.
    """
    data = base(ULTRASOUND_CLASS, ROOT + "9")
    data.Modality, data.NumberOfFrames = "US", len(frames)
    data.Rows, data.Columns = frames.shape[1:3]
    colour = frames.ndim == 4
    data.SamplesPerPixel, data.PhotometricInterpretation = (3, "RGB") if colour else (1, "MONOCHROME2")
    if colour:
        data.PlanarConfiguration = 0
    data.BitsAllocated, data.BitsStored, data.HighBit, data.PixelRepresentation = 8, 8, 7, 0
    if delta_cm:
        ends = dict(zip(("MinX0", "MinY0", "MaxX1", "MaxY1"), box, strict=True))
        region = item(RegionSpatialFormat=1, RegionDataType=1, RegionFlags=0)
        for key, value in ends.items():
            setattr(region, f"RegionLocation{key}", value)
        region.PhysicalUnitsXDirection = region.PhysicalUnitsYDirection = 3
        region.PhysicalDeltaX, region.PhysicalDeltaY = delta_cm
        data.SequenceOfUltrasoundRegions = Sequence([region])
    if spacing:
        data.PixelSpacing = ds(spacing)
    data.PixelData = frames.tobytes()
    for key, value in others.items():
        setattr(data, key, value)
    return data
