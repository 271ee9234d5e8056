"""The arm in torque mode: inverse dynamics, impedance and admittance at the needle's tip. SI units: m, kg, N, rad."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
