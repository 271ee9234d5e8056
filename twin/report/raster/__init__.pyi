from .camera import Camera as Camera
from .camera import camera_around as camera_around
from .compositing import (
    NOWHERE as NOWHERE,
)
from .compositing import (
    SAMPLES as SAMPLES,
)
from .compositing import (
    PixelBox as PixelBox,
)
from .compositing import (
    Shot as Shot,
)
from .compositing import (
    Veil as Veil,
)
from .compositing import (
    compose as compose,
)
from .render import (
    BACKGROUND as BACKGROUND,
)
from .render import (
    Layer as Layer,
)
from .render import (
    Surface as Surface,
)
from .render import (
    opaque_shot as opaque_shot,
)
from .render import (
    picture as picture,
)
from .render import (
    put_moving as put_moving,
)
from .render import (
    veils_of as veils_of,
)
