"""A checked plan as a file for a robot: URScript, ROS 2, or a table of times. Metres: names with ``_m``."""

from puncture_twin.planning.export.exporter import FORMATS, Exported, export_name, export_plan

__all__ = ["FORMATS", "Exported", "export_name", "export_plan"]
