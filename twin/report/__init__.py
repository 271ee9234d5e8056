"""What a person looks at: the map, the scene, the film and the page."""

from puncture_twin.twin.report.map.map_picture import draw_map
from puncture_twin.twin.report.page.page import write_page
from puncture_twin.twin.report.scene.film import draw_film
from puncture_twin.twin.report.scene.scene_picture import draw_scene

__all__ = ["draw_film", "draw_map", "draw_scene", "write_page"]
