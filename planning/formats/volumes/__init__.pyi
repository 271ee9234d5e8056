from .orientation import Oriented as Oriented
from .orientation import canonical as canonical
from .volume_files import (
    NRRD_ENDINGS as NRRD_ENDINGS,
)
from .volume_files import (
    Volume as Volume,
)
from .volume_files import (
    parse_header as parse_header,
)
from .volume_files import (
    parse_volume as parse_volume,
)
from .volume_files import (
    read_volume as read_volume,
)
from .volume_header import VolumeHeader as VolumeHeader
