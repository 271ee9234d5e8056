"""DICOM: CT series with their true geometry, segmentations and structure sets, read strictly."""
