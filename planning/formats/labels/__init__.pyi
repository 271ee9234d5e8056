from .label_surface import field_surface as field_surface
from .label_surface import label_mesh as label_mesh
from .labelmaps import LabelMap as LabelMap
from .labelmaps import labelmap_of as labelmap_of
from .labelmaps import segment_names as segment_names
from .naming import RuleKind as RuleKind
from .naming import names_for as names_for
from .naming import select as select
