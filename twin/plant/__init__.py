"""The ground truth: where the patient is, what the arm's joints do, what scanner and touching tip measure.

Guidance must not import it; a job hands it over as functions that answer like devices.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
