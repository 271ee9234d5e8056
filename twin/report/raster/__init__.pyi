from .camera import ViewCamera as ViewCamera, camera_around as camera_around
from .compositing import (
    NOWHERE as NOWHERE,
    SAMPLES as SAMPLES,
    PixelBox as PixelBox,
    RasterShot as RasterShot,
    Shells as Shells,
    compose as compose,
    recompose as recompose,
)
from .moving import MovingPicture as MovingPicture
from .render import (
    BACKGROUND as BACKGROUND,
    Layer as Layer,
    Surface as Surface,
    opaque_shot as opaque_shot,
    picture as picture,
    shells_of as shells_of,
)
