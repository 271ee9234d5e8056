from .label_surface import field_surface as field_surface, label_mesh as label_mesh
from .labelmaps import LabelMap as LabelMap, labelmap_of as labelmap_of, segment_names as segment_names
from .naming import RuleKind as RuleKind, names_for as names_for, select as select
