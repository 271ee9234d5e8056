from .needle_detector import Detection as Detection
from .needle_detector import Missed as Missed
from .needle_detector import detect as detect
from .probe_image import (
    Imager as Imager,
)
from .probe_image import (
    Lesion as Lesion,
)
from .probe_image import (
    NeedleEcho as NeedleEcho,
)
from .probe_image import (
    NeedlePose as NeedlePose,
)
from .probe_image import (
    Picture as Picture,
)
from .probe_image import (
    render as render,
)
