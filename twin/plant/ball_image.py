"""Image of the ball on its rod, computed per pixel instead of rasterised, so that it is truer than what measures it.

Each pixel is cut into 4 x 4 cells, whose rays are intersected with ball, rod and occluder in closed form; along an
outline a cell is covered as by a straight edge. The ball's centre errs by less than 1e-3 px, a pixel by less than one
grey level of 140. The lens's blur (a Gaussian), the sensor's noise (normal) and rounding to 8 bits follow.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.optimize import brentq

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.twin.devices import GreyImage
from puncture_twin.twin.guidance.stereo.camera import Camera, distortion_slope, tangent_axes, undistort

CELLS = 4
"""Cells per pixel and axis."""
BLUR_REACH = 4.0
"""Standard deviations after which the blur's tail (6e-5) is cut."""
OCCLUDER_SIZE = 4.0
"""The occluder's radius in radii of the ball: its edge is nearly straight there."""


@dataclass(frozen=True, eq=False)
class BallScene:
    """A ball on its rod as a camera may see it, frame C, mm. Directions need not be unit; greys are from 0 to 255."""

    center_c: Floats  # the ball's centre, shape (3,), mm, frame C
    radius_mm: float = 4.0
    rod_c: Floats | tuple[float, float, float] = (0.0, -1.0, 0.0)  # shape (3,)
    rod_radius_mm: float = 1.5
    rod_length_mm: float = 60.0
    light_c: Floats | tuple[float, float, float] = (0.3, -0.8, -0.6)  # shape (3,): toward the light
    diffuse: float = 0.8  # fraction of the light that comes from everywhere, 0 to 1; directed light obeys Lambert's law
    ball_grey: float = 200.0
    rod_grey: float = 130.0
    background_grey: float = 60.0
    texture_grey: float = 0.0
    texture_px: float = 3.0
    hidden_fraction: float = 0.0  # fraction of the ball's disc that an occluder covers, 0 to 1
    hidden_from: float = 0.0  # angle in the tangent plane from which it comes, rad
    occluder_grey: float = 100.0
    ball: bool = True
    rod: bool = True


class _Layer(NamedTuple):
    """A body as the cells see it, each (h, w): covered fraction, depth along the ray in mm, and grey."""

    cover: Floats
    depth: Floats
    grey: Floats


def render(
    camera: Camera, scene: BallScene, *, rng: np.random.Generator,
    noise: float = 2.0, blur_px: float = 0.7, half_px: int | None = None,
) -> GreyImage:  # fmt: skip
    """The camera's image of a scene: whole, or only the window of `half_px` around the ball's centre."""
    low, high = _window(camera, scene, half_px)
    shape = (max(high[1] - low[1], 0), max(high[0] - low[0], 0))
    grey = np.full(shape, scene.background_grey, dtype=np.float64)
    if scene.texture_grey > 0 and grey.size:
        pattern = gaussian_filter(rng.normal(size=shape), scene.texture_px, mode="wrap")
        grey += pattern * (scene.texture_grey / max(float(pattern.std()), 1e-12))
    _paint(grey, low, camera, scene, blur_px)
    grey += rng.normal(0.0, noise, shape)
    return GreyImage(np.clip(np.round(grey), 0, 255).astype(np.uint8), (int(low[0]), int(low[1])))


def _window(camera: Camera, scene: BallScene, half_px: int | None) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    low, high = np.zeros(2, dtype=np.int64), np.array([camera.width, camera.height])
    if half_px is None:
        return low, high
    center = camera.project(scene.center_c)
    if not np.isfinite(center).all():
        return low, low
    middle = np.round(center).astype(np.int64)
    return np.clip(middle - half_px, low, high), np.clip(middle + half_px + 1, low, high)


def _paint(grey: Floats, low: NDArray[np.int64], camera: Camera, scene: BallScene, blur_px: float) -> None:
    pad = int(np.ceil(BLUR_REACH * blur_px)) + 1
    size = np.array(grey.shape[::-1])
    box_low, box_high = (box - low for box in _bounds(camera, scene, pad))
    box_low, box_high = np.clip(box_low, 0, size), np.clip(box_high, 0, size)
    if np.any(box_high <= box_low) or not (scene.ball or scene.rod or scene.hidden_fraction > 0):
        return
    first = low + box_low - pad
    shape = box_high - box_low + 2 * pad
    ink, clear = _composite(_layers(_cell_rays(camera, first, shape), camera, scene))
    blurred = (gaussian_filter(cells, blur_px * CELLS, truncate=BLUR_REACH) for cells in (ink, clear))
    ink, clear = (cells.reshape(shape[1], CELLS, shape[0], CELLS).mean(axis=(1, 3)) for cells in blurred)
    inner = (slice(pad, shape[1] - pad), slice(pad, shape[0] - pad))
    part = (slice(box_low[1], box_high[1]), slice(box_low[0], box_high[0]))
    grey[part] = ink[inner] + clear[inner] * grey[part]


def _bounds(camera: Camera, scene: BallScene, pad: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """A box of pixels that holds all that the bodies cover: spheres around ball, rod's end and occluder."""
    rod = np.asarray(scene.rod_c, dtype=np.float64)
    reach = scene.radius_mm * (2 * OCCLUDER_SIZE + 1 if scene.hidden_fraction > 0 else 1.0)
    ends = [(scene.center_c, reach)]
    if scene.rod:
        ends.append((scene.center_c + scene.rod_length_mm * rod / np.linalg.norm(rod), scene.rod_radius_mm))
    lows, highs = [], []
    for point, radius in ends:
        pixel = camera.project(point)
        if np.isfinite(pixel).all():
            margin = 1.2 * camera.ball_radius_px(point, radius) + pad
            lows.append(np.floor(pixel - margin))
            highs.append(np.ceil(pixel + margin) + 1)
    none = [np.zeros(2)]
    return np.min(lows or none, axis=0).astype(np.int64), np.max(highs or none, axis=0).astype(np.int64)


def _cell_rays(camera: Camera, first: NDArray[np.int64], shape: NDArray[np.int64]) -> Floats:
    """Unit rays (h, w, 3) of the cells of a block of pixels, camera's frame.

    The lens is inverted at each pixel's centre and followed by its slope to the cells: over half a pixel its bend is
    below 1e-4 px.
    """
    focal = np.array([camera.fx, camera.fy])
    columns, rows = np.meshgrid(np.arange(shape[0]) + first[0], np.arange(shape[1]) + first[1])
    flat = undistort((np.stack([columns, rows], axis=-1) - [camera.cx, camera.cy]) / focal, camera.distortion)
    slope = np.linalg.inv(distortion_slope(np.nan_to_num(flat), camera.distortion))
    inside = (np.arange(CELLS) + 0.5) / CELLS - 0.5
    along_rows = slope[:, None, :, None, :, 0] * (inside / camera.fx)[None, None, None, :, None]
    along_columns = slope[:, None, :, None, :, 1] * (inside / camera.fy)[None, :, None, None, None]
    cells = flat[:, None, :, None] + along_rows + along_columns
    cells = cells.reshape(shape[1] * CELLS, shape[0] * CELLS, 2)
    rays = np.concatenate([cells, np.ones_like(cells[..., :1])], axis=-1)
    return np.asarray(rays / _length(rays)[..., None])


def _layers(rays: Floats, camera: Camera, scene: BallScene) -> list[_Layer]:
    R = camera.T_camera_c[:3, :3]
    center = apply(camera.T_camera_c, np.asarray(scene.center_c, dtype=np.float64))
    light = R @ _unit(scene.light_c)
    layers = []
    if scene.ball:
        layers.append(_ball(rays, center, scene, light))
    if scene.rod:
        layers.append(_rod(rays, center, R @ _unit(scene.rod_c), scene, light))
    if scene.hidden_fraction > 0:
        layers.append(_occluder(rays, center, camera, scene))
    return layers


def _ball(rays: Floats, center: Floats, scene: BallScene, light: Floats) -> _Layer:
    distance = float(np.linalg.norm(center))
    along = rays @ center
    angle = np.arccos(np.clip(along / distance, -1, 1))
    half = np.sqrt(np.clip(scene.radius_mm**2 - distance**2 + along**2, 0, None))
    depth = along - half
    normal = depth[..., None] * rays - center
    normal /= _length(normal)[..., None]
    cover = _cover(np.arcsin(scene.radius_mm / distance) - angle)
    return _Layer(cover, depth, _lit(scene.ball_grey, normal @ light, scene))


def _rod(rays: Floats, start: Floats, rod: Floats, scene: BallScene, light: Floats) -> _Layer:
    """The rod: where a ray passes nearest to its axis, and whether that is within its radius."""
    slant = rays @ rod
    across = np.clip(1 - slant**2, 1e-12, None)
    along_rod = np.clip(((rays @ start) * slant - start @ rod) / across, 0, scene.rod_length_mm)
    foot = start + along_rod[..., None] * rod
    nearest = np.einsum("...i,...i->...", rays, foot)
    miss = nearest[..., None] * rays - foot
    gap = _length(miss)
    half = np.sqrt(np.clip(scene.rod_radius_mm**2 - gap**2, 0, None) / across)
    normal = (nearest - half)[..., None] * rays - foot
    normal -= (normal @ rod)[..., None] * rod
    normal /= np.clip(_length(normal), 1e-12, None)[..., None]
    cover = _cover((scene.rod_radius_mm - gap) / nearest)
    return _Layer(cover, nearest - half, _lit(scene.rod_grey, normal @ light, scene))


def _occluder(rays: Floats, center: Floats, camera: Camera, scene: BallScene) -> _Layer:
    """A flat disc just before the ball, so far over it that it hides the wanted fraction."""
    distance = float(np.linalg.norm(center))
    axes = tangent_axes(center / distance)
    flat = (rays @ axes) / (rays @ (center / distance))[..., None]
    size = float(np.tan(np.arcsin(scene.radius_mm / distance)))
    from_side = np.array([np.cos(scene.hidden_from), np.sin(scene.hidden_from)])
    gap = OCCLUDER_SIZE - np.linalg.norm(flat / size - disc_distance(scene.hidden_fraction) * from_side, axis=-1)
    return _Layer(_cover(gap), np.zeros_like(gap), np.full_like(gap, scene.occluder_grey))


def disc_distance(fraction: float) -> float:
    """Offset of the occluder's centre that hides a fraction of the disc; lengths in radii of the ball."""

    def hidden(distance: float) -> float:
        r, R, d = 1.0, OCCLUDER_SIZE, distance
        a = r * r * np.arccos(np.clip((d * d + r * r - R * R) / (2 * d * r), -1, 1))
        b = R * R * np.arccos(np.clip((d * d + R * R - r * r) / (2 * d * R), -1, 1))
        kite = (-d + r + R) * (d + r - R) * (d - r + R) * (d + r + R)
        return float((a + b - np.sqrt(max(kite, 0.0)) / 2) / np.pi - fraction)

    return float(brentq(hidden, OCCLUDER_SIZE - 1, OCCLUDER_SIZE + 1))


def _cover(gap: Floats) -> Floats:
    """Covered fraction of each cell by a function that is above 0 inside a body and 0 on its outline."""
    down, right = np.gradient(gap)
    cells = gap / np.clip(np.hypot(down, right), 1e-30, None)
    return np.clip(cells + 0.5, 0.0, 1.0)


def _lit(grey: float, cosine: Floats, scene: BallScene) -> Floats:
    return np.asarray(grey * (scene.diffuse + (1 - scene.diffuse) * np.clip(cosine, 0, None)))


def _composite(layers: list[_Layer]) -> tuple[Floats, Floats]:
    """Light from the bodies, and the fraction of the background that is left, per cell: nearer bodies over farther."""
    depths = np.stack([layer.depth for layer in layers])
    order = np.argsort(depths, axis=0)  # of each cell: ball and rod swap where one comes out of the other
    covers = np.take_along_axis(np.stack([layer.cover for layer in layers]), order, axis=0)
    greys = np.take_along_axis(np.stack([layer.grey for layer in layers]), order, axis=0)
    ink, clear = np.zeros_like(depths[0]), np.ones_like(depths[0])
    for cover, grey in zip(covers, greys, strict=True):
        ink += clear * cover * grey
        clear *= 1 - cover
    return ink, clear


def _length(vectors: Floats) -> Floats:
    """Lengths of vectors (..., 3), shape (...); three times as fast as numpy's norm over a short axis."""
    return np.asarray(np.sqrt(np.einsum("...i,...i->...", vectors, vectors)))


def _unit(direction: Floats | tuple[float, float, float]) -> Floats:
    vector = np.asarray(direction, dtype=np.float64)
    return np.asarray(vector / np.linalg.norm(vector))
