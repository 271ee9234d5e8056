from .needle_detector import Detection as Detection, Missed as Missed, detect as detect
from .probe_image import (
    Imager as Imager,
    Lesion as Lesion,
    NeedleEcho as NeedleEcho,
    NeedleInImage as NeedleInImage,
    render as render,
)
