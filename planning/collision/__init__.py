"""The arm with its tool against everything: bounds that are proofs first, FCL where they decide nothing.

The workcell (patient, obstacles, gantry, table) is put together here. Motions are planned in `motion`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
