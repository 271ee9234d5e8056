from .beside import Beside as Beside, lay_beside as lay_beside
from .tubes import Part as Part
