"""What a cohort is made of: a folder, a CSV, or a TOML file with patterns and grids of options; cases stay unread."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
