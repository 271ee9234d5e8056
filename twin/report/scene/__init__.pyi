from .film import draw_film as draw_film
from .scene_parts import (
    ArmPicture as ArmPicture,
)
from .scene_parts import (
    Body as Body,
)
from .scene_parts import (
    chosen_direction as chosen_direction,
)
from .scene_parts import (
    needle_bodies as needle_bodies,
)
from .scene_parts import (
    patient as patient,
)
from .scene_parts import (
    room as room,
)
from .scene_parts import (
    safe_region as safe_region,
)
from .scene_picture import draw_scene as draw_scene
from .shapes import bar as bar
from .shapes import box as box
from .views import overview as overview
from .views import up_ct as up_ct
