"""Where is the patient for the robot, and how sure is that? Two lists of the same markers, no case needed.

    python examples/02_register_two_marker_lists.py [MARKERS_CT MARKERS_BASE X Y Z]

Both files are CSV (name,x_mm,y_mm,z_mm) or 3D Slicer's; X Y Z is the target in the CT frame, LPS, mm.
"""

import sys

import numpy as np

import puncture_twin as pt
from puncture_twin.meshes import folder
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, pose

SLIP = pose(exp_rotation(np.array([0.0, 0.0, np.radians(1.0)])), [0.0, 0.0, 3.0])
"""A slip of the patient, in the CT frame: 3 mm to the head and a rotation of 1 degree about that axis."""
TIMES = 200
"""So often the markers are touched anew, for what happens beside what is expected."""


def main() -> None:
    """Register; print each marker's residual, and the error to expect at the target beside what happens."""
    files = sys.argv[1:3] or [folder() / "abdomen" / name for name in ("markers_ct.csv", "touch.csv")]
    target = np.array([float(word) for word in (sys.argv[3:6] or ("-90", "-10", "60"))])
    found = pt.register(*map(pt.read_points, files), target_ct=target)
    names, markers_ct, there = found.markers.names, found.markers.points_ct, apply(found.T_base_ct, target)
    for name, residual in zip(names, found.residual_mm, strict=True):
        print(f"marker {name} misses by {residual:.2f} mm")
    expected = found.expected_tre_mm(target[None])[0]
    print(f"FRE {found.fre_mm:.2f} mm, which is not the error at the target: {expected:.2f} mm (rms) is expected there")
    for flag in found.flags:
        print(f"weak: {flag.sentence}")
    rng, errors = np.random.default_rng(0), []
    for _ in range(TIMES):
        noise = rng.normal(scale=found.fle_mm / np.sqrt(3), size=markers_ct.shape)
        touched = dict(zip(names, apply(found.T_base_ct, markers_ct) + noise, strict=True))
        again = pt.register(dict(zip(names, markers_ct, strict=True)), touched, target_ct=target, fle_mm=found.fle_mm)
        errors.append(np.linalg.norm(apply(again.T_base_ct, target) - there))
    print(f"touched anew {TIMES} times with noise as large: {np.sqrt(np.mean(np.square(errors))):.2f} mm (rms)")
    slipped = np.linalg.norm(apply(found.T_base_ct @ SLIP, target) - there)
    print(f"a slip of 3 mm and 1 degree after the touch would move the target by {slipped:.2f} mm")


if __name__ == "__main__":
    main()
