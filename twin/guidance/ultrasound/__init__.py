"""The ultrasound guidance: two arms calibrate themselves through the needle that shows in the image, A X P = Y B Q.

Here are the case, the poses, the recording in the twin and the puncture after it; the equation is solved in `axp_ybq`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
