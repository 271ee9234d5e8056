"""The simulated workcell in PyBullet: client, arm, bodies, cameras. The only place with metres and with PyBullet."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
