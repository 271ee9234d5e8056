"""Where is the patient for the robot? Two lists of the same markers, no case needed.

    python examples/02_register_two_marker_lists.py [MARKERS_CT MARKERS_BASE X Y Z]

Both files are CSV (name,x_mm,y_mm,z_mm) or 3D Slicer's; X Y Z is the target in the CT frame, LPS, mm.
"""

import sys

import numpy as np

import puncture_twin as pt
from puncture_twin.meshes import folder
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, inverse, log_rotation, pose

SLIP = pose(exp_rotation(np.array([0.0, 0.0, np.radians(1.0)])), [0.0, 0.0, 3.0])
"""A slip of the patient, in the CT frame: 3 mm to the head and a rotation of 1 degree about that axis."""


def main() -> None:
    """Register, and print the pose, each marker's residual, and the error to expect at the target."""
    files = sys.argv[1:3] or [folder() / "abdomen" / name for name in ("markers_ct.csv", "touch.csv")]
    target_ct = [float(word) for word in (sys.argv[3:6] or ("-90", "-10", "60"))]
    markers_ct, markers_base = (pt.read_points(file) for file in files)
    found = pt.register(markers_ct, markers_base, target_ct=target_ct)
    print("T_base_ct, mm:")
    print(np.array2string(found.T_base_ct, precision=3, suppress_small=True))
    for name, residual in zip(found.markers.names, found.residual_mm, strict=True):
        print(f"marker {name} misses by {residual:.2f} mm")
    expected = found.expected_tre_mm(np.array([target_ct]))[0]
    print(f"FRE {found.fre_mm:.2f} mm, which is not the error at the target: {expected:.2f} mm (rms) is expected there")
    for flag in found.flags:
        print(f"weak: {flag.sentence}")
    T_base_slipped = found.T_base_ct @ SLIP
    missed = np.linalg.norm(apply(T_base_slipped, np.array(target_ct)) - apply(found.T_base_ct, np.array(target_ct)))
    print(f"a slip of 3 mm and 1 degree after the touch would move the target by {missed:.2f} mm")
    both = found.markers.points_ct, found.markers.points_base
    three = [dict(zip(found.markers.names[:3], points, strict=False)) for points in both]
    triad = pt.register(*three, target_ct=target_ct, method="triad")
    turn = log_rotation((inverse(found.T_base_ct) @ triad.T_base_ct)[:3, :3])
    print(f"the first three alone would turn the patient by {np.degrees(np.linalg.norm(turn)):.2f} degrees")


if __name__ == "__main__":
    main()
