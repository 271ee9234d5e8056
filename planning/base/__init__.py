"""What every room needs and none of them owns: errors, reasons, files, provenance, TOML, names, processes, stages.

Nothing here knows of needles, arms or anatomy.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
