"""Everything that a session measured, estimated at once, and what that says of ball, target and needle."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
