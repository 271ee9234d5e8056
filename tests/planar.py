"""Cameras from views of a flat board with known points (Zhang 2000), through this package's own camera and bundle.

Each view gives a homography. Its columns are orthogonal and equally long once the focal length is right, which gives
the start; the bundle adjustment then frees intrinsics, distortion, the boards' poses, and the cameras' relative poses.
"""

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.errors import refuse
from puncture_twin.twin.guidance.stereo.cameras.bundle import Bundle, Observations, PixelSpreads, adjust
from puncture_twin.twin.guidance.stereo.cameras.camera import Camera

Floats = NDArray[np.float64]

MIN_VIEWS = 3
"""Two views fix the focal length only where they are tilted well."""


def calibrate_planar(
    board: Floats, pixels: Floats, size: tuple[int, int], *, sigma_px: float = 0.2, where: str = "planar calibration"
) -> Bundle:
    """Calibrate one or more cameras that saw the same boards at the same moments.

    Args:
        board: Shape (k, 3), z = 0, in the board's unit.
        pixels: Shape (cameras, views, k, 2).
        size: Width and height, px.
        sigma_px: Standard deviation of a pixel coordinate; scales the covariance only.
        where: What errors name.

    Returns:
        The bundle; frame C is the first camera's, bodies are the views' boards, lengths are in the board's unit.

    Raises:
        InputError: Fewer than three views, points off the plane, or views that are all parallel to the picture.
    """
    if pixels.ndim != 4 or pixels.shape[1] < MIN_VIEWS or np.any(board[:, 2] != 0):
        what = f"pixels of shape {pixels.shape}"
        refuse(what, where, f"(cameras, views >= {MIN_VIEWS}, k, 2), z = 0", "too_few_points")
    alone = [_one(board, views, size, sigma_px, where) for views in pixels]
    if len(alone) == 1:
        return alone[0]
    first = alone[0].T_c_bodies
    cameras = [alone[0].cameras[0]]
    for other in alone[1:]:
        moves = other.T_c_bodies @ np.linalg.inv(first)
        cameras.append(other.cameras[0].moved(_middle(moves)))
    return _adjust(cameras, first, board, pixels, sigma_px)


def _one(board: Floats, views: Floats, size: tuple[int, int], sigma_px: float, where: str) -> Bundle:
    middle = (np.array(size) - 1) / 2
    homographies = [_homography(board[:, :2], view - middle) for view in views]
    focal = _focal(homographies, where)
    poses = np.stack([_pose(H, focal) for H in homographies])
    start = Camera(size[0], size[1], focal, focal, middle[0], middle[1], np.zeros(4), np.eye(4))
    return _adjust([start], poses, board, views[None], sigma_px)


def _adjust(cameras: list[Camera], poses: Floats, board: Floats, pixels: Floats, sigma_px: float) -> Bundle:
    count, views, corners = pixels.shape[:3]
    camera, view, corner = np.indices((count, views, corners)).reshape(3, -1)
    seen = Observations(camera, view, corner, pixels.reshape(-1, 2), sigma_px**2 * np.eye(2))
    free = np.full((count, 14), np.inf)
    free[0, 8:] = 0.0
    return adjust(cameras, poses, board, seen, PixelSpreads(free, np.full((views, 6), np.inf), np.zeros_like(board)))


def _homography(flat: Floats, pixels: Floats) -> Floats:
    """The 3x3 map from the board's plane to pixels, by the direct linear transform after scaling."""
    scale_flat, scale_px = np.abs(flat).max(), np.abs(pixels).max()
    X = np.column_stack([flat / scale_flat, np.ones(len(flat))])
    x = pixels / scale_px
    none = np.zeros_like(X)
    rows = np.concatenate([np.hstack([X, none, -x[:, :1] * X]), np.hstack([none, X, -x[:, 1:] * X])])
    H = np.linalg.svd(rows, full_matrices=False)[2][-1].reshape(3, 3)
    return np.asarray(np.diag([scale_px, scale_px, 1.0]) @ H @ np.diag([1 / scale_flat, 1 / scale_flat, 1.0]))


def _focal(homographies: list[Floats], where: str) -> float:
    """Focal length with the principal point in the middle: 1/f^2 from each view's two conditions, least squares."""
    left, right = [], []
    for H in homographies:
        h1, h2 = H[:, 0] / np.linalg.norm(H[:, 0]), H[:, 1] / np.linalg.norm(H[:, 0])
        left += [h1[0] * h2[0] + h1[1] * h2[1], h1[:2] @ h1[:2] - h2[:2] @ h2[:2]]
        right += [-h1[2] * h2[2], h2[2] ** 2 - h1[2] ** 2]
    inverse = float(np.dot(left, right) / np.dot(left, left))
    if not (np.isfinite(inverse) and inverse > 0):
        refuse("the views do not fix the focal length", where, "boards tilted several ways", "undetermined")
    return float(1 / np.sqrt(inverse))


def _pose(H: Floats, focal: float) -> Floats:
    """T_camera_board of a homography, the nearest rotation taken, the board in front."""
    columns = np.diag([1 / focal, 1 / focal, 1.0]) @ H
    columns = columns / np.linalg.norm(columns[:, 0]) * (np.sign(columns[2, 2]) or 1.0)
    U, _, Vt = np.linalg.svd(np.column_stack([columns[:, 0], columns[:, 1], np.cross(columns[:, 0], columns[:, 1])]))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = U @ Vt, columns[:, 2]
    return T


def _middle(moves: Floats) -> Floats:
    """The view whose relative pose is nearest to the median of all: a start that one bad view cannot spoil."""
    flat = moves.reshape(len(moves), -1)
    return np.asarray(moves[int(np.argmin(np.linalg.norm(flat - np.median(flat, axis=0), axis=1)))])
