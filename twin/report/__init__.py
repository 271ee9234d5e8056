"""What a person looks at. Here: colours, numbers, the map's projection, text on pictures, progress.

Pictures, map, scene and page have a room each. Nothing here decides; every number comes from a result.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
