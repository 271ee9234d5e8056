from .image import CtImage as CtImage, ScanSettings as ScanSettings, scan_solids as scan_solids
from .solids import Solid as Solid
