from .film import draw_film as draw_film
from .scene_parts import (
    ArmPicture as ArmPicture,
    SceneBody as SceneBody,
    chosen_direction as chosen_direction,
    needle_bodies as needle_bodies,
    patient as patient,
    room as room,
    safe_region as safe_region,
)
from .scene_picture import draw_scene as draw_scene
from .shapes import bar as bar, box as box
from .views import overview as overview, up_ct as up_ct
