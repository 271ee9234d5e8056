"""A second plant for guided trials, built otherwise than the twin's: what guidance predicts must happen here too.

Errors are uniform, not normal. The arm is a product of exponentials of its joints' screws (Brockett 1984) with the same
28 errors as motions of its links. Cameras are two pinholes whose pixels err, triangulated by the midpoint of two rays:
along the line of sight they err more than across. A probe's picture has pixels of a tenth of a millimetre, shows what
lies in a slab about its plane as in it, and stands on a calibration of its own.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from puncture_twin.twin.plant.true_needle import TrueNeedle

PIXEL_MM = 0.1
"""Of a picture by the probe."""
FOCAL_PX, BASELINE_MM, DISTANCE_MM = 9000.0, 1200.0, 3000.0
"""Of the pinholes, and how far from them the robot's base is."""


class Uniform:
    """A generator whose normal draws are uniform ones of the same deviation."""

    def __init__(self, seed):
        self._rng = np.random.default_rng(seed)

    def normal(self, loc=0.0, scale=1.0, size=None):
        return loc + scale * self._rng.uniform(-np.sqrt(3.0), np.sqrt(3.0), size)

    def uniform(self, *args, **kwargs):
        return self._rng.uniform(*args, **kwargs)

    def spawn(self, count):
        return [Uniform(seed) for seed in self._rng.integers(2**32, size=count)]


def screw_motion(axis, point, turn, shift):
    """Rotation by turn about a line, and shift along it: R (n, 3, 3) and t (n, 3)."""
    R = Rotation.from_rotvec(np.multiply.outer(turn, axis)).as_matrix()
    return R, point - R @ point + np.multiply.outer(shift, axis)


def needle_by_screws(model, q_true, eta, tip_mm):
    """`true_needle` by exponentials: each joint is a motion about a line of the arm at its zero, each error another."""
    names = np.split(np.broadcast_to(eta, (len(q_true), 28)), [6, 11, 17, 23, 26], axis=1)
    a, d, alpha, zero, offset, lean = names
    d = np.insert(d, 1, 0.0, axis=1)
    R, t = np.tile(np.eye(3), (len(q_true), 1, 1)), np.zeros((len(q_true), 3))
    frame, origin = np.eye(3), np.zeros(3)
    for joint in range(6):
        z = frame[:, 2]
        R, t = after(R, t, *screw_motion(z, origin, q_true[:, joint] + zero[:, joint], d[:, joint]))
        origin = origin + model.d[joint] * z + model.a[joint] * frame[:, 0]
        R, t = after(R, t, *screw_motion(frame[:, 0], origin, alpha[:, joint], a[:, joint]))
        frame = frame @ Rotation.from_rotvec([model.alpha[joint], 0.0, 0.0]).as_matrix()
    flange = R @ frame
    tip = R @ origin + t + (flange @ (offset + [0.0, 0.0, tip_mm])[..., None])[..., 0]
    leaning = Rotation.from_rotvec(np.pad(lean, ((0, 0), (0, 1)))).as_matrix()
    return TrueNeedle(tip, flange @ leaning)


def after(R, t, R_next, t_next):
    """The motion (R, t), shapes (n, 3, 3) and (n, 3), of what another has moved before it."""
    return R @ R_next, (R @ t_next[..., None])[..., 0] + t


@dataclass(frozen=True, eq=False)
class PinholePair:
    """Two pinholes in each of n rooms; the frame of the first is that of what they see."""

    device: object
    rotation: Rotation
    rng: object

    @classmethod
    def placed(cls, device, count, rng):
        return cls(device, Rotation.random(count, random_state=0), rng)

    def read(self, points_base):
        """Points (n, m, 3) in the first camera's frame, as the midpoint of their rays."""
        count = len(self.rotation)
        points = np.broadcast_to(points_base, (count, *np.shape(points_base)[-2:]))
        own = np.einsum("nab,nmb->nma", self.rotation.as_matrix(), points)
        own = own + [BASELINE_MM / 2, 0.0, DISTANCE_MM]
        # three variances: across by x, y, and along the line of sight; their mean is the device's
        across, along = DISTANCE_MM / FOCAL_PX / np.sqrt(2.0), np.sqrt(2.0) * DISTANCE_MM**2 / FOCAL_PX / BASELINE_MM
        noise = self.device.sd_mm * np.sqrt(3.0 / (2 * across**2 + along**2))
        centres, rays = np.array([[0.0, 0.0, 0.0], [BASELINE_MM, 0.0, 0.0]]), []
        for centre in centres:
            seen = own - centre
            pixels = FOCAL_PX * seen[..., :2] / seen[..., 2:] + self.rng.normal(0.0, noise, seen[..., :2].shape)
            ray = np.concatenate([pixels / FOCAL_PX, np.ones((*pixels.shape[:-1], 1))], axis=-1)
            rays.append(ray / np.linalg.norm(ray, axis=-1, keepdims=True))
        one, other = rays
        base, cos = centres[1] - centres[0], np.sum(one * other, axis=-1)
        s, t = one @ base, other @ base
        along_one, along_other = (s - cos * t) / (1 - cos**2), (cos * s - t) / (1 - cos**2)
        return (centres[0] + along_one[..., None] * one + centres[1] + along_other[..., None] * other) / 2


@dataclass(frozen=True, eq=False)
class PicturingProbe:
    """A probe whose pictures show, of each point, a pixel; across its plane they show the plane."""

    axes: np.ndarray
    """Rows: two in the plane, and its normal."""
    calibration: np.ndarray
    read: dict

    @classmethod
    def placed(cls, device, across, count, rng):
        first = np.cross(across, [1.0, 0.0, 0.0] if abs(across[0]) < 0.9 else [0.0, 1.0, 0.0])
        first /= np.linalg.norm(first)
        axes = np.array([first, np.cross(across, first), across])
        sds = {"target": device.target_sd_mm, "tip": device.tip_sd_mm}
        read = {name: rng.normal(size=(count, 3)) * [sd[0], sd[0], sd[1]] for name, sd in sds.items()}
        return cls(axes, rng.normal(0.0, device.calibration_sd_mm, (count, 3)), read)

    def target(self, points_base):
        return self._shown(points_base, "target")

    def tip(self, points_base):
        return self._shown(points_base, "tip")

    def _shown(self, points_base, what):
        local = points_base @ self.axes.T + self.read[what]
        local[:, :2] = PIXEL_MM * np.round(local[:, :2] / PIXEL_MM)
        return local @ self.axes + self.calibration
