from .exporter import FORMATS as FORMATS, Exported as Exported, export_name as export_name, export_plan as export_plan
