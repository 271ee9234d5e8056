"""What a person looks at: the map, the scene, the film and the page."""

from twin.report.film import draw_film
from twin.report.map_picture import draw_map
from twin.report.page import write_page
from twin.report.scene_picture import draw_scene

__all__ = ["draw_film", "draw_map", "draw_scene", "write_page"]
