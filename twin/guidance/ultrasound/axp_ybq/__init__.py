"""A X P = Y B Q: from a recording to the unknowns with their covariance, or a refusal with poses that would help."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
