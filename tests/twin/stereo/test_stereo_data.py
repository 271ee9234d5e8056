"""The cameras against data that nobody on this project made: published numbers, and OpenCV as the second engine."""

import json

import cv2
import numpy as np
import places
import pytest

from puncture_twin.planning.geometry.rigid import apply, pose
from puncture_twin.twin.guidance.stereo.camera import Camera
from puncture_twin.twin.guidance.stereo.camera_calibration import fit_matrix, project, reconstruct

DATA = places.DATA
CUBE = DATA / "dlt_cube_kwon_duarte" / "dlt_cube.json"
BOARDS = DATA / "opencv_stereo_chessboard"
SIZE = (640, 480)


@pytest.fixture(scope="module")
def cube():
    if not CUBE.is_file():
        pytest.skip(f"no data at {CUBE}")
    return json.loads(CUBE.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def corners():
    """Chessboard corners, shape (2 cameras, views, 54, 2), found and refined by OpenCV."""
    if not BOARDS.is_dir():
        pytest.skip(f"no data at {BOARDS}")
    found = []
    for left in sorted(BOARDS.glob("left*.jpg")):
        pair = [found_corners(left.with_name(left.name.replace("left", side))) for side in ("left", "right")]
        if all(one is not None for one in pair):
            found.append(pair)
    assert len(found) == 13
    return np.array(found).transpose(1, 0, 2, 3)


def found_corners(path):
    """9 x 6 corners to a part of a pixel, or None.

    The farthest board's squares are 15 px wide: a wider window than 11 px reaches the next corner and doubles the rms.
    """
    grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    there, pixels = cv2.findChessboardCorners(grey, (9, 6))
    if not there:
        return None
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 0.01)
    return cv2.cornerSubPix(grey, pixels, (5, 5), (-1, -1), stop).reshape(-1, 2).astype(float)


BOARD = np.stack([*np.meshgrid(np.arange(9.0), np.arange(6.0)), np.zeros((6, 9))], axis=-1).reshape(-1, 3)


def test_the_published_coefficients_of_the_cube(cube):
    """Each view's eleven coefficients to 5e-6 of their size, and its reprojection error to 1e-9 px."""
    xyz = np.array(cube["xyz"])
    for seen, L, error in zip(
        cube["views"], cube["published"]["L"], cube["published"]["reproj_error_px_norm"], strict=True
    ):
        M = fit_matrix(xyz, np.array(seen, dtype=float)).M
        np.testing.assert_allclose((M / M[2, 3]).ravel(), L, rtol=5e-6)
        rms = np.sqrt(np.mean(np.sum((project(M, xyz) - seen) ** 2, axis=1)))
        assert rms == pytest.approx(error, abs=1e-9)


def test_the_published_reconstruction_of_the_cube(cube):
    """The corners from four views: coordinates to 1e-8 cm, mean error to 1e-9 cm."""
    xyz, views = np.array(cube["xyz"]), np.array(cube["views"], dtype=float)
    matrices = np.stack([(M := fit_matrix(xyz, seen).M) / M[2, 3] for seen in views])
    found = reconstruct(matrices, views)
    np.testing.assert_allclose(found, cube["published"]["xyz_recon"], atol=1e-8)
    error = np.mean(np.linalg.norm(found - xyz, axis=1))
    assert error == pytest.approx(cube["published"]["mean_recon_error_cm"], abs=1e-9)


def reprojection_rms(T_left, seen, intrinsics, T_left_boards):
    """Of our camera model with a lens as OpenCV has it; T_left places this camera, shape (4, 4)."""
    K, lens = intrinsics
    camera = Camera(*SIZE, K[0, 0], K[1, 1], K[0, 2], K[1, 2], np.ravel(lens)[:4], T_left)
    misses = [camera.project(apply(T, BOARD)) - pixels for T, pixels in zip(T_left_boards, seen, strict=True)]
    return float(np.sqrt(np.mean(np.sum(np.square(misses), axis=2))))


def poses(turns, moves):
    """OpenCV's rotation vectors and translations, shape (n, 4, 4)."""
    return pose(np.array([cv2.Rodrigues(one)[0] for one in turns]), np.squeeze(moves, axis=2))


def test_our_camera_sees_the_chessboards_as_opencv_does(corners):
    """At OpenCV's optimum of the same parameters our model leaves its rms, 0.20 and 0.21 px at most."""
    for seen, most in zip(corners, (0.20, 0.21), strict=True):
        objects, images = [BOARD.astype(np.float32)] * len(seen), [*seen.astype(np.float32)]
        rms, K, lens, *boards = cv2.calibrateCamera(objects, images, SIZE, None, None, flags=cv2.CALIB_FIX_K3)
        ours = reprojection_rms(np.eye(4), seen, (K, lens), poses(*boards))
        assert ours == pytest.approx(rms, abs=1e-4) and ours <= most


def test_both_cameras_of_the_chessboards_together(corners):
    """Stereo rms at most 0.22 px, baseline 3.328 squares, turned by half a degree."""
    objects, images = [BOARD.astype(np.float32)] * corners.shape[1], [[*seen.astype(np.float32)] for seen in corners]
    alone = [cv2.calibrateCamera(objects, own, SIZE, None, None, flags=cv2.CALIB_FIX_K3)[1:3] for own in images]
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_USE_INTRINSIC_GUESS
    _, *lenses, R, t, _, _, turns, moves, _ = cv2.stereoCalibrateExtended(
        objects, *images, *alone[0], *alone[1], SIZE, np.eye(3), np.zeros((3, 1)), flags=flags
    )
    places = np.eye(4), pose(R, np.ravel(t))
    both = [
        reprojection_rms(T, seen, lens, poses(turns, moves))
        for T, seen, lens in zip(places, corners, (lenses[:2], lenses[2:]), strict=True)
    ]
    assert np.sqrt(np.mean(np.square(both))) <= 0.22
    assert np.linalg.norm(t) == pytest.approx(3.328, abs=0.01)
    assert np.degrees(np.linalg.norm(cv2.Rodrigues(R)[0])) == pytest.approx(0.50, abs=0.05)


def test_the_third_radial_coefficient_does_not_matter_here(corners):
    """OpenCV's k3, which this camera model lacks, gains less than 0.002 px: nothing to model."""
    for seen in corners:
        objects, images = [BOARD.astype(np.float32)] * len(seen), [*seen.astype(np.float32)]
        without = cv2.calibrateCamera(objects, images, SIZE, None, None, flags=cv2.CALIB_FIX_K3)[0]
        with_k3 = cv2.calibrateCamera(objects, images, SIZE, None, None)[0]
        assert without - with_k3 < 0.002
