from .directions import ring_weights as ring_weights
from .document import (
    place_document as place_document,
    write_place_document as write_place_document,
    write_placements as write_placements,
)
from .mounts import Region as Region
from .search import PlaceSearch as PlaceSearch, RatedPlacement as RatedPlacement, search_placements as search_placements
