from .gains import Stiffness as Stiffness
from .impedance import Impedance as Impedance
from .rigid_model import rigid_model as rigid_model
