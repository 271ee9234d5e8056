"""An output folder as one set with a manifest: written beside the old set, then renamed in; no kill leaves a mix.

What the files hold is the business of the command that writes them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
