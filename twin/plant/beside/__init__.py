"""What lies in a scanner beside the patient: arms, the bed, lines; each drawn about a skin, as closed surfaces.

It is ground truth: no segmentation names it, and who plans has to find it in the image.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
