from .camera import ViewCamera as ViewCamera, camera_around as camera_around
from .compositing import (
    NOWHERE as NOWHERE,
    SAMPLES as SAMPLES,
    PixelBox as PixelBox,
    RasterShot as RasterShot,
    TranslucentLayer as TranslucentLayer,
    compose as compose,
)
from .render import (
    BACKGROUND as BACKGROUND,
    Layer as Layer,
    Surface as Surface,
    opaque_shot as opaque_shot,
    picture as picture,
    put_moving as put_moving,
    translucents_of as translucents_of,
)
