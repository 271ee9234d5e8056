from .orientation import Oriented as Oriented, canonical as canonical
from .volume_files import (
    NRRD_ENDINGS as NRRD_ENDINGS,
    Volume as Volume,
    parse_header as parse_header,
    parse_volume as parse_volume,
    read_volume as read_volume,
)
from .volume_header import VolumeHeader as VolumeHeader
