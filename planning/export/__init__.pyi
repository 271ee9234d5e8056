from .exporter import FORMATS as FORMATS
from .exporter import Exported as Exported
from .exporter import export_name as export_name
from .exporter import export_plan as export_plan
